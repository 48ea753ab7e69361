"""Galerkin projection of nonlinear equilibrium on a few modes: the same physics with tens of unknowns.

A solution is sought as x = prescribed(mu) + sum_i y_i phi_i, the modes phi_i being zero at prescribed dofs,
and the residual is tested with the same modes: Phi r(x, mu) = 0. The reduced equations are again `Equations`,
so Newton's method, load stepping and implicit differentiation apply to them as they do to the full ones. Each
iteration assembles the full residual and tangent, but factorises nothing larger than the number of modes.

Too few modes lock: a thin or nearly incompressible body whose modes cannot follow its constraints answers far
too stiffly. About 30 are right for one to six parameters; what is kept of the solutions may be less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb
from pathlib import Path

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from morph_dslam.errors import SolverError, StudyError
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.continuation import PathError, advance
from morph_dslam.mechanics.solvers.newton import Equations, Linearisation, State, in_contact, solve, turn, where
from morph_dslam.reduction.pod import compute_pod
from morph_dslam.reduction.regression import fit_functions
from morph_dslam.studies.problem import SweepProblem
from morph_dslam.studies.snapshots import load_state

Array = NDArray[np.float64]


def galerkin_modes(
    equations: Equations, states: Array, tolerance: float, max_modes: int, weights: Array | None = None
) -> Array:
    """Orthonormal modes (k, n) of solved states, zero at prescribed dofs.

    Parameters
    ----------
    states : (s, n) solutions; derivatives of solutions by parameters, times the parameters' ranges, may be
        among them.
    tolerance, max_modes : as `morph_dslam.reduction.pod.compute_pod` takes them.
    weights : (n,) of the inner product; all equal by default.
    """
    free = np.asarray(equations.free, dtype=bool)
    inside = np.ones(np.count_nonzero(free)) if weights is None else weights[free]
    pod = compute_pod(states[:, free], inside, tolerance, max_modes)
    modes = np.zeros((len(pod.modes), equations.n_dofs))
    modes[:, free] = pod.modes
    return modes


class _ProjectedLinearisation:
    """Residual (k,) and dense tangent (k, k) of projected equations."""

    def __init__(self, residual: Array, tangent: Array) -> None:
        self.residual, self._tangent = residual, tangent
        self._factors: tuple[Array, NDArray[np.int32]] | None = None

    @property
    def negative_pivots(self) -> int | None:
        symmetric = (self._tangent + self._tangent.T) / 2.0
        return int(np.count_nonzero(np.linalg.eigvalsh(symmetric) < 0.0))

    def solve(self, right: Array) -> Array:
        if self._factors is None:
            if not np.all(np.isfinite(self._tangent)):
                raise SolverError("the projected tangent is not finite: the deformation is too large")
            self._factors = scipy.linalg.lu_factor(self._tangent)
        return scipy.linalg.lu_solve(self._factors, right.T).T

    def apply(self, vectors: Array) -> Array:
        return vectors @ self._tangent.T


class GalerkinEquations:
    """`Equations` for the coefficients of modes.

    Parameters
    ----------
    equations : the full ones.
    modes : (k, n), zero at prescribed dofs (`galerkin_modes`).
    """

    def __init__(self, equations: Equations, modes: Array) -> None:
        if np.any(modes[:, ~np.asarray(equations.free, dtype=bool)]):
            raise ValueError("the modes must be zero at prescribed dofs")
        self.full, self.modes, self.in_contact = equations, modes, in_contact(equations)
        self.n_dofs = len(modes)
        self.free = np.ones(self.n_dofs, dtype=bool)
        # A coefficient's change counts by the largest change of a full dof that it brings.
        self.scale = 1.0 / np.max(np.abs(modes) / equations.scale, axis=1)

    def lift(self, y: Array, mu: Array) -> Array:
        """Full solution (n,) of coefficients ``y`` (k,) at parameters ``mu`` (d,)."""
        return self.full.prescribed(mu) + y @ self.modes

    def state_text(self, mu: Array) -> str:
        """A state (d,) for messages."""
        return where(self.full, mu)

    def turn(self, begin: Array, end: Array) -> float:
        """See `newton.turn`."""
        return turn(self.full, begin, end)

    def prescribed(self, mu: Array) -> Array:
        return np.zeros(self.n_dofs)

    def prescribed_slopes(self, mu: Array) -> Array:
        return np.zeros((len(mu), self.n_dofs))

    def residual(self, x: Array, mu: Array) -> Array:
        return self.modes @ self.full.residual(self.lift(x, mu), mu)

    def linearise(self, x: Array, mu: Array) -> _ProjectedLinearisation:
        linearisation = self.full.linearise(self.lift(x, mu), mu)
        tangent = linearisation.apply(self.modes) @ self.modes.T
        return _ProjectedLinearisation(self.modes @ linearisation.residual, tangent.T)

    def residual_slopes(self, x: Array, mu: Array) -> Array:
        state = self.lift(x, mu)
        moved = self.full.linearise(state, mu).apply(self.full.prescribed_slopes(mu))
        return (self.full.residual_slopes(state, mu) + moved) @ self.modes.T


def newton_correction(equations: Equations, x: Array, mu: Array) -> Array:
    """The full Newton update (n,) at a state: the estimate of its error (one factorisation).

    Its norm over the true error's, the effectivity, is 0.98 to 1.00 on Galerkin solutions; on states that are
    not near equilibrium in the energy norm (regression of snapshots) it means little.
    """
    linearisation: Linearisation = equations.linearise(x, mu)
    return -linearisation.solve(linearisation.residual)


#: Modes are kept until so little of the states is left out, as a part of the tolerance of the reduction ...
MODE_TOLERANCE = 0.02
#: ... and the last correction is so small a part of it.
SOLVER_TOLERANCE = 1e-2
#: Most modes that equilibrium is projected on; more cost little, for assembly takes nearly all of the time.
MOST_MODES = 60
MOST_CORRECTIONS = 20
#: After so many corrections the last must be so small a part of the first, or the tangent is made anew.
PATIENCE, SLOW = 3, 0.05
#: Highest degree of the prediction that full solutions alone give.
FIT_DEGREE = 8
#: The prediction is fitted anew, with this highest degree, at so many times as many solutions as a cubic has
#: terms, and whenever their number has doubled since.
REFIT, REFIT_DEGREE = 4, 5
#: A correction larger than this part of the largest solution is not trusted.
TOO_LARGE = 2.0
UNMOVED_BODY = (
    "no solution moves the body: its loads are zero, miss it or act where it is held, or no obstacle reaches it; check "
    "their sets, places and ranges"
)


@dataclass(frozen=True)
class FullSolutions:
    """Solutions of the full equations.

    Attributes
    ----------
    samples : (n, d) parameters.
    states : (n, n_dofs).
    slopes : (n, d, n_dofs) of the states by parameters.
    """

    samples: Array
    states: Array
    slopes: Array

    @staticmethod
    def read(files: Sequence[Path]) -> FullSolutions:
        """Those kept with snapshots by a sweep of solids."""
        states = [load_state(file) for file in files]
        return FullSolutions(*(np.array([state[key] for state in states]) for key in ("mu", "dofs", "slopes")))


def solid_equations(sweep: SweepProblem | None) -> SolidProblem:
    """The full equations that a sweep solves."""
    problem = getattr(sweep, "problem", None)
    if not isinstance(problem, SolidProblem) or problem.history is not None:
        raise StudyError(
            "a Galerkin projection needs the equations of a solid without memory: use "
            'reduction.method = "pod", or an elastic material'
        )
    return problem


class ReducedSolver:
    """Solves equations projected on the modes of some of their solutions.

    A prediction is polynomial regression of the full solutions and their sensitivities, later of all reduced
    solutions, shifted by what it missed at the nearest solution known. Broyden's method corrects it (Kelley,
    Iterative Methods for Linear and Nonlinear Equations, 1995, chapter 7) with the inverse of the projected tangent
    there, made anew where it converges slowly; else Newton's method, or the path from the nearest full solution.

    Parameters
    ----------
    equations : the full ones.
    solutions : of them, with their sensitivities.
    box : (d, 2) ends of the parameters.
    tolerance : relative error that the reduction may have.

    Raises
    ------
    StudyError
        If all solutions are zero, or too few to fit a prediction to.

    Attributes
    ----------
    galerkin : the projected equations.
    measured : dofs whose errors count; others, pressures say, follow from them.
    largest : Euclidean norm of the largest solution over the dofs measured.
    """

    def __init__(self, equations: Equations, solutions: FullSolutions, box: Array, tolerance: float) -> None:
        self.equations, self._solutions, self._box = equations, solutions, box
        self.measured = np.broadcast_to(np.isfinite(equations.scale), equations.n_dofs)
        self.largest = float(np.linalg.norm(solutions.states[:, self.measured], axis=1).max())
        if self.largest == 0.0:  # errors would be relative to nothing
            raise StudyError(UNMOVED_BODY)
        spread = np.diff(box, axis=1)
        vectors = np.concatenate([solutions.states, *(solutions.slopes * spread).swapaxes(0, 1)])
        self._weights = balancing_weights(vectors, self.measured)
        modes = galerkin_modes(equations, vectors, MODE_TOLERANCE * tolerance, MOST_MODES, self._weights)
        self.galerkin = GalerkinEquations(equations, modes)
        known = (solutions.states * self._weights) @ modes.T
        slopes = (solutions.slopes * self._weights) @ modes.T
        self._known = known
        self._size = float(np.linalg.norm(known, axis=1).max())
        self._allowed = SOLVER_TOLERANCE * tolerance * self._size
        self._prediction, _ = fit_functions(
            solutions.samples, known, slopes, box[:, 0], box[:, 1], FIT_DEGREE, np.arange(len(known))
        )
        # what is known so far: parameters, coefficients, inverse tangent (when needed)
        self._samples: list[Array] = list(solutions.samples)
        self._values: list[Array] = list(known)
        self._inverses: list[Array | None] = [None] * len(known)
        self._next_fit = REFIT * comb(len(box) + 3, 3)

    def solve(self, mu: Array) -> Array:
        """Coefficients (k,) of the modes at ``mu`` (d,); SolverError if there is no solution."""
        nearest = self._nearest(np.array(self._samples), mu)
        predicted, _ = self._prediction.evaluate(mu)
        start = predicted + self._values[nearest] - self._prediction.evaluate(self._samples[nearest])[0]
        corrected = self._corrected(start, mu, self._inverse(nearest))
        if corrected is None:
            found, inverse = self._solved_by_newton(start, mu), None
        else:
            found, inverse = corrected
        self._samples.append(np.array(mu, dtype=float))
        self._values.append(found)
        self._inverses.append(inverse)
        if len(self._values) >= self._next_fit:
            self._predict_from_all()
        return found

    def _predict_from_all(self) -> None:
        """Fit the prediction to the reduced solutions too."""
        samples, values = np.array(self._samples), np.array(self._values)
        folds = np.arange(len(samples))
        lower, upper = self._box.T
        self._prediction, _ = fit_functions(samples, values, None, lower, upper, REFIT_DEGREE, folds)
        self._next_fit = 2 * len(samples)

    def _nearest(self, samples: Array, mu: Array) -> int:
        return int(np.argmin(np.linalg.norm((samples - mu) / np.diff(self._box, axis=1).T, axis=1)))

    def _solved_by_newton(self, start: Array, mu: Array) -> Array:
        try:
            return solve(self.galerkin, mu, State(mu, start)).dofs
        except SolverError:
            nearest = self._nearest(self._solutions.samples, mu)
            state = State(self._solutions.samples[nearest], self._known[nearest])
        try:
            return advance(self.galerkin, state, mu)[-1].dofs
        except PathError as error:
            reached = where(self.galerkin, error.states[-1].mu)
            raise SolverError(
                f"the equations projected on {self.galerkin.n_dofs} modes could not be solved at "
                f"{where(self.galerkin, mu)}, nor beyond {reached} on the way there"
            ) from error

    def lift(self, y: Array, mu: Array) -> Array:
        """Full state (n_dofs,) of coefficients ``y``."""
        return self.galerkin.lift(y, mu)

    def estimate(self, y: Array, mu: Array) -> float:
        """Estimated error of a reduced solution over the largest solution: the full Newton correction."""
        correction = newton_correction(self.equations, self.lift(y, mu), mu)
        return float(np.linalg.norm(correction[self.measured])) / self.largest

    def _inverse(self, number: int) -> Array:
        """Inverse (k, k) of the projected tangent at a solution known, kept once made."""
        inverse = self._inverses[number]
        if inverse is None:
            mu = self._samples[number]
            inverse = self._inverse_tangent(self._values[number], mu)
            self._inverses[number] = inverse
        return inverse

    def _inverse_tangent(self, y: Array, mu: Array) -> Array:
        return self.galerkin.linearise(y, mu).solve(np.eye(len(y))).T

    def _corrected(self, y: Array, mu: Array, inverse: Array) -> tuple[Array, Array] | None:
        """The solution and inverse tangent by Broyden's method from ``y`` (k,); None if it diverges."""
        prescribed = self.equations.prescribed(mu)
        modes = self.galerkin.modes

        def residual(y: Array) -> Array:
            return modes @ self.equations.residual(prescribed + y @ modes, mu)

        inverse, lengths = inverse.copy(), []
        r = residual(y)
        for _ in range(MOST_CORRECTIONS):
            step = -inverse @ r
            length = float(np.linalg.norm(step))
            if not length < TOO_LARGE * self._size:
                return None
            lengths.append(length)
            if len(lengths) > PATIENCE and length > SLOW * lengths[0]:
                inverse, lengths = self._inverse_tangent(y, mu), []
                continue
            y = y + step
            if length <= self._allowed:
                return y, inverse
            r = residual(y)
            if not np.all(np.isfinite(r)):
                return None
            # after a full step B s = -r_old, so that the rank-one update needs the new residual only
            asked = inverse @ r
            inverse -= np.outer(asked, step @ inverse) / (step @ (step + asked))
        return None


def balancing_weights(vectors: Array, measured: NDArray[np.bool_]) -> Array:
    """Weights (n,) of dofs that give those not measured, pressures say, as much energy as the others.

    Without them the modes of a mixed formulation would be those of its pressures, whose numbers are larger.
    """
    weights = np.ones(len(measured))
    other = float(np.sum(vectors[:, ~measured] ** 2))
    if other > 0.0:
        weights[~measured] = float(np.sum(vectors[:, measured] ** 2)) / other
    return weights
