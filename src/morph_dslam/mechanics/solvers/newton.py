"""Newton's method for discretised equilibrium, from one parameter point to the next.

Any discretisation that offers `Equations` is solved: solids, shells, or three bars in a test. The first iteration moves
the prescribed dofs together with all others along the tangent (the linearised predictor), so that supports may move by
far more than an element's size. Damping follows Deuflhard's natural monotonicity test (Newton Methods for Nonlinear
Problems, 2004, section 3.3): the simplified correction, which reuses the factorisation, must shrink. It does not depend
on the scaling of the equations, which a test of the residual does: stretching and bending residuals of a thin sheet
differ by (length / thickness)^2. Contact, whose tangent jumps, may have a correction that grows. The simplified
correction also ends the iteration without the extra factorisation that would only confirm convergence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError

Array = NDArray[np.float64]
#: Size of the last correction, in units of `Equations.scale`.
TOLERANCE = 1e-8
#: Factorisations after which an iteration is given up.
MAX_ITERATIONS = 20
#: By so much, rad, supports turn a body in one increment at most: half a turn forwards and backwards end alike, and
#: Newton's method takes a body to either.
LARGEST_TURN = np.pi / 2.0
#: Size of an update that is certainly wrong.
DIVERGED = 10.0
#: A step damped further has stalled.
SMALLEST_DAMPING = 1.0 / 64.0
#: Where points begin or cease to touch on the way, the simplified correction may be so much larger than the update, and
#: more if contact is stiffer.
GROWTH_IN_CONTACT = 100.0
#: A tangent is kept where so many more corrections with it should do, judged by the last two ...
MOST_CHORDS = 4
#: ... and these end at this part of the tolerance.
CHORD_TARGET = 0.01


class Linearisation(Protocol):
    """Residual and tangent at one point; `linear_solver.AssembledLinearisation` is the usual one."""

    residual: Array
    """(n,) internal minus external forces at all dofs: reactions at prescribed ones."""

    @property
    def negative_pivots(self) -> int | None:
        """Negative eigenvalues of the free block of K; None if the solver does not know."""
        ...

    def solve(self, right: Array) -> Array:
        """K_ff^-1 right_f for (n,) or (k, n), zero at prescribed dofs."""
        ...

    def apply(self, vectors: Array) -> Array:
        """K times (n,) or (k, n), at all dofs."""
        ...


class Equations(Protocol):
    """Discretised equilibrium r(x, mu) = 0 at free dofs, with x given at prescribed ones.

    ``scale`` () or (n,) is what counts as a large change of each dof: the body's length for a displacement, infinity
    for a dof that follows from the others (a multiplier), whose change is not measured.
    """

    @property
    def n_dofs(self) -> int: ...

    @property
    def free(self) -> NDArray[np.bool_]: ...

    @property
    def scale(self) -> Array | float: ...

    def prescribed(self, mu: Array) -> Array:
        """(n,) values at prescribed dofs, 0 at free ones."""
        ...

    def prescribed_slopes(self, mu: Array) -> Array:
        """(d, n) derivatives of `prescribed` by mu."""
        ...

    def residual(self, x: Array, mu: Array) -> Array:
        """(n,) internal minus external forces at all dofs."""
        ...

    def linearise(self, x: Array, mu: Array) -> Linearisation: ...

    def residual_slopes(self, x: Array, mu: Array) -> Array:
        """(d, n) derivatives of the residual by mu at fixed x."""
        ...


@dataclass(frozen=True)
class State:
    """A converged solution.

    Attributes
    ----------
    mu : (d,) parameters.
    dofs : (n,) solution.
    negative_pivots : of the last factorised tangent; None if the solver does not know.
    iterations : factorisations it took.
    """

    mu: Array
    dofs: Array
    negative_pivots: int | None = None
    iterations: int = 0


def in_contact(equations: Equations) -> float:
    """How stiff contact is: 1 as usual, more in confined solids; 0 without, as where there is no such attribute.

    With contact, the tangent may jump.
    """
    return float(getattr(equations, "in_contact", 0.0))


def turn(equations: Equations, begin: Array, end: Array) -> float:
    """Angle, rad, by which supports turn a body between parameters (d,) and others.

    Equations with prescribed rotations have a method ``turn`` of both; 0 without.
    """
    method = getattr(equations, "turn", None)
    return 0.0 if method is None else float(method(begin, end))


def refuse_large_turn(equations: Equations, begin: Array, end: Array) -> None:
    """Raise SolverError if supports turn a body by more than `LARGEST_TURN` between parameters (d,) and others."""
    angle = turn(equations, begin, end)
    if angle > (1.0 + 1e-9) * LARGEST_TURN:
        raise SolverError(
            f"supports turn by {np.degrees(angle):.0f} degrees in one increment to {where(equations, end)}; "
            f"it may be {np.degrees(LARGEST_TURN):.0f} at most"
        )


def where(equations: Equations, mu: Array) -> str:
    """A state (d,) for messages: in words where the equations have a method ``state_text`` for that."""
    text = getattr(equations, "state_text", None)
    return str(mu) if text is None else text(mu)


def size(equations: Equations, update: Array) -> float:
    """Largest entry of ``update`` (n,) in units of `Equations.scale`."""
    return float(np.max(np.abs(update / equations.scale)))


def correction(linearisation: Linearisation, residual: Array, gap: Array) -> Array:
    """Newton's update: moves prescribed dofs by ``gap`` (n,) and brings the free residual to zero."""
    if gap.any():
        residual = residual + linearisation.apply(gap)
    return gap - linearisation.solve(residual)


def solve(equations: Equations, mu: Array, start: State, tolerance: float = TOLERANCE) -> State:
    """Equilibrium at ``mu`` (d,) by Newton's method from ``start``.

    Raises SolverError if it stalls, diverges, or meets values that are not finite; smaller increments may help.
    """
    mu = np.array(mu, dtype=float)
    x, target = start.dofs.copy(), equations.prescribed(mu)
    for iteration in range(1, MAX_ITERATIONS + 1):
        linearisation = equations.linearise(x, mu)
        gap = np.where(equations.free, 0.0, target - x)
        update = correction(linearisation, linearisation.residual, gap)
        largest = size(equations, update)
        if not largest < DIVERGED:
            raise SolverError(
                f"Newton's method diverges at {where(equations, mu)}: an update of {largest:.1e} times the body's size"
            )
        trial = _damped_step(equations, mu, x, update, gap, linearisation, tolerance)
        if trial.whole:
            trial = _follow_chords(equations, mu, trial, linearisation, tolerance)
            if min(trial.remaining, trial.length) <= tolerance:
                return State(mu, trial.x + trial.rest, linearisation.negative_pivots, iteration)
        x = trial.x
    raise SolverError(f"Newton's method has not converged in {MAX_ITERATIONS} iterations at {where(equations, mu)}")


@dataclass(frozen=True)
class _Trial:
    """A point ``x`` (n,) reached by an update of size ``length``, and what the same tangent asks for there.

    Attributes
    ----------
    rest : (n,) the simplified correction, and ``remaining`` its size.
    whole : whether the update was not damped.
    """

    x: Array
    length: float
    rest: Array
    remaining: float
    whole: bool = True


def _damped_step(
    equations: Equations, mu: Array, x: Array, update: Array, gap: Array, linearisation: Linearisation, tolerance: float
) -> _Trial:
    """The point along ``update`` that is accepted."""
    length, damping = size(equations, update), 1.0
    allowed = length * max(1.0, GROWTH_IN_CONTACT * in_contact(equations))
    while damping >= SMALLEST_DAMPING:
        point = x + damping * update
        residual = equations.residual(point, mu)
        if np.all(np.isfinite(residual)):
            rest = correction(linearisation, residual, (1.0 - damping) * gap)
            remaining = size(equations, rest)
            # An update at the level of rounding need not shrink any further.
            if remaining <= (1.0 - damping / 4.0) * allowed or (damping == 1.0 and length <= tolerance):
                return _Trial(point, length, rest, remaining, damping == 1.0)
        damping /= 2.0
    raise SolverError(
        f"Newton's method stalls at {where(equations, mu)}: no part of its update brings the solution nearer"
    )


def _follow_chords(
    equations: Equations, mu: Array, trial: _Trial, linearisation: Linearisation, tolerance: float
) -> _Trial:
    """Repeat the simplified correction where few repetitions will do: each saves a factorisation.

    They converge linearly, so that they must go further than Newton's method for the same error.
    """
    no_gap, target = np.zeros_like(trial.x), CHORD_TARGET * tolerance
    while tolerance < trial.length and target < trial.remaining < trial.length:
        contraction = np.log(trial.remaining / trial.length)
        goal = tolerance if trial.remaining > tolerance else target
        if np.log(goal / trial.remaining) < MOST_CHORDS * contraction:
            break
        point = trial.x + trial.rest
        residual = equations.residual(point, mu)
        if not np.all(np.isfinite(residual)):
            break
        rest = correction(linearisation, residual, no_gap)
        remaining = size(equations, rest)
        if not remaining < trial.remaining:
            break
        trial = _Trial(point, trial.remaining, rest, remaining)
    return trial


def sensitivities(equations: Equations, state: State, linearisation: Linearisation | None = None) -> Array:
    """Derivatives (d, n) of the solution by the parameters, by implicit differentiation.

    One factorisation and one back-substitution a parameter: K dx = -(dr/dmu + K dx_prescribed). A ``linearisation`` at
    the state is made here if none is given.
    """
    linearisation = linearisation or equations.linearise(state.dofs, state.mu)
    moved = equations.prescribed_slopes(state.mu)
    right = equations.residual_slopes(state.dofs, state.mu) + linearisation.apply(moved)
    return moved - linearisation.solve(right)


#: Two iterations with a kept tangent must shrink the correction to this part, or the tangent is too far off. Single
#: ones need not: bending and stretching of thin walls converge in turns.
KEPT_CONTRACTION = 0.2
MAX_KEPT_ITERATIONS, MAX_KEPT_TANGENTS = 14, 2
#: The error left is about as large as the last correction times the contraction, so stop later than Newton.
KEPT_TOLERANCE = 0.1 * TOLERANCE


def solve_with_kept_tangent(
    equations: Equations, mu: Array, guess: Array, tangent: Linearisation | None
) -> State | None:
    """Equilibrium at ``mu`` (d,) from ``guess`` (n,), or None where this does not lead there.

    The chord method: Newton's iteration with the tangent of a nearby solution, factorised already. For a small step it
    converges linearly and fast, and each iteration costs a residual and a back-substitution in place of a tangent and
    its factorisation (Kelley, Iterative Methods for Linear and Nonlinear Equations, 1995, section 5.4).

    Parameters
    ----------
    equations : what is solved.
    mu : (d,) parameters.
    guess : (n,) dofs to start from.
    tangent : linearisation at a solution nearby; None for one at the guess. Where it is too far off, it is made anew at
        the point reached; two are used in all.
    """
    x = np.where(equations.free, guess, equations.prescribed(mu))
    first = np.inf
    for _ in range(MAX_KEPT_TANGENTS):
        tangent = tangent or equations.linearise(x, mu)
        reached, lengths = _iterate(equations, mu, x, tangent)
        if not lengths or not lengths[0] < first:
            return None
        if lengths[-1] <= KEPT_TOLERANCE:
            return State(mu, reached, None, len(lengths))
        if len(lengths) < 2 or lengths[-1] < lengths[0]:
            x, first = reached, lengths[0]
        tangent = None
    return None


def _iterate(equations: Equations, mu: Array, x: Array, tangent: Linearisation) -> tuple[Array, list[float]]:
    """The point reached from ``x`` with one tangent while that converges well, and each correction's size."""
    lengths: list[float] = []
    while len(lengths) < MAX_KEPT_ITERATIONS:
        residual = equations.residual(x, mu)
        if not np.all(np.isfinite(residual)):
            return x, []
        correction = -tangent.solve(residual)
        length = size(equations, correction)
        if len(lengths) > 1 and not length < KEPT_CONTRACTION * lengths[-2]:
            break
        x = x + correction
        lengths.append(length)
        if length <= KEPT_TOLERANCE:
            break
    return x, lengths
