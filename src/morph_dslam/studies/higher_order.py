"""States of a solid solved again with displacements of higher order, from the solutions of its own elements."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers import newton
from morph_dslam.mechanics.solvers.continuation import loaded_state
from morph_dslam.mechanics.solvers.linear_solver import SolverMaker
from morph_dslam.mechanics.solvers.newton import Equations, Linearisation, State, size, solve
from morph_dslam.mechanics.solvers.two_level import LowerOrder, TwoLevelSolver
from morph_dslam.model.reduced_model import REACTION
from morph_dslam.studies.solid_sweep import response_reactions, support_reactions

Array = NDArray[np.float64]
#: Of the last correction: at first in units of the body's size, then as a part of what the finer elements changed.
TOLERANCE, PART = 1e-2, 0.03


class OutOfTime(Exception):
    """A solve was stopped before it ended."""


class HigherOrder:
    """Solves the states of a solid again with displacements of higher order on the same cells.

    Parameters
    ----------
    coarse : the solid.
    problem : the same solid with elements of higher order.
    iterative : whether its tangents are too large to be factorised, so that `TwoLevelSolver` has to do.
    """

    def __init__(self, coarse: SolidProblem, problem: SolidProblem, iterative: bool = False) -> None:
        self._coarse, self.problem, self.iterative = coarse, problem, iterative
        self._equations: _Stoppable | None = None

    def solve(self, dofs: Array, mu: Array, in_time: Callable[[], bool] = lambda: True) -> State:
        """The solution at ``mu`` (d,) next to one of the coarse solid, to a few percent of the difference.

        First the unknowns that only the finer elements have are solved for, with the coarse solution ``dofs`` (n,)
        held: as finer displacements this one is strained far too much in bending, and Newton's method would take long
        from it. Elements with pressures do not lock, so that all unknowns may be solved for at once; held displacements
        leave cells of them large bubbles alone to keep their volume at more points. Where neither converges, the forces
        that the start lacks for balance fade away in increments, so that the solution is on the same branch. A start
        that is turned inside out between the points at which the coarse elements are evaluated has no such forces: then
        all loads grow from rest.

        Raises
        ------
        OutOfTime
            When ``in_time`` says no: it is asked before each factorisation.
        SolverError
            If no solution is found.
        """
        make = partial(TwoLevelSolver, lower=self._lower_order(dofs, mu)) if self.iterative else None
        pressures = self.problem.embedded_pressures(self._coarse, dofs)
        equations, given = _Stoppable(self.problem, in_time, make), self._embedded(dofs)
        self._equations = equations
        given[: len(pressures)] += pressures
        for is_held in (False, True) if pressures.any() else (True,):
            start = State(mu, given)
            try:
                first = _Added(self.problem, in_time, self._kept, given, make) if is_held else equations
                start = solve(first, mu, start, TOLERANCE)
                # Where finer elements change nothing, a part of the change would be less than rounding.
                tolerance = max(PART * size(equations, start.dofs - given), newton.TOLERANCE)
                return solve(equations, mu, start, tolerance)
            except SolverError:
                if is_held and self.iterative:
                    raise  # a path would take as long as many states
        try:
            return loaded_state(equations, mu, start.dofs, PART * TOLERANCE)
        except SolverError:
            return self._from_rest(equations, dofs, mu)

    def reactions_in_balance(self, found: State) -> dict[str, Array]:
        """Force (3,) N and moment (3,) Nm about the origin on each set that is held, of the last solution.

        What that lacks for balance, its last tangent moves on to the supports: a few percent of a difference of shapes
        may be many of a force that statics alone determine, since cells are stiff.
        """
        outputs, mu = support_reactions(self.problem, found.dofs, found.mu), found.mu
        tangent = None if self._equations is None else self._equations.latest
        if tangent is None:
            return outputs
        rest = -tangent.solve(self.problem.residual(found.dofs, mu))
        moved = response_reactions(self.problem, found.dofs, mu, rest[None], tangent.apply(rest)[None])
        return {name: value + moved[REACTION + name][0, 0] for name, value in outputs.items()}

    def _from_rest(self, equations: Equations, dofs: Array, mu: Array) -> State:
        """The solution at ``mu`` (d,) that loads lead to which grow from rest, if they lead to ``dofs`` (n,) too.

        Otherwise it may be another branch than that of the coarse solution.
        """
        place = newton.where(self.problem, mu)
        try:
            own = loaded_state(self._coarse, mu)
            found = loaded_state(equations, mu, tolerance=PART * TOLERANCE)
        except SolverError as error:
            raise SolverError(f"finer elements do not converge at {place}") from error
        if size(self._coarse, own.dofs - dofs) > PART * TOLERANCE:
            raise SolverError(
                f"finer elements do not converge at {place} from the study's solution, and loads that grow from rest "
                "lead to another equilibrium"
            )
        return found

    @cached_property
    def _kept(self) -> NDArray[np.bool_]:
        """The dofs (n,) that the coarse solid has too."""
        return self._embedded(np.ones(self._coarse.n_dofs)) != 0.0

    def _lower_order(self, dofs: Array, mu: Array) -> LowerOrder:
        """The coarse solid's tangent at its solution ``dofs`` (n,)."""
        numbers = self._embedded(np.arange(1.0, self._coarse.n_dofs + 1.0))[: self.problem.n_unknowns]
        kept = np.flatnonzero(numbers)
        return LowerOrder(self._coarse.linearise(dofs, mu), numbers[kept].astype(np.int64) - 1, kept)

    def _embedded(self, dofs: Array) -> Array:
        """The displacement of a coarse solution, and the motions of its couplings, as dofs (n,) of the finer solid."""
        result = np.zeros(self.problem.n_dofs)
        coarse = dofs[: 3 * self._coarse.displacements.n_scalar]
        embedded = self.problem.displacements.embedded(self._coarse.displacements, coarse)
        result[: len(embedded)] = embedded
        result[self.problem.n_unknowns :] = dofs[self._coarse.n_unknowns :]
        return result


class _Stoppable:
    """The equations of a solid, whose factorisations stop when time is up."""

    def __init__(self, problem: SolidProblem, in_time: Callable[[], bool], make: SolverMaker | None) -> None:
        self._problem, self._in_time = problem, in_time
        self.n_dofs, self.free, self.scale = problem.n_dofs, problem.free, problem.scale
        self.in_contact, self.applied_first = problem.in_contact, problem.applied_first
        self.prescribed, self.prescribed_slopes = problem.prescribed, problem.prescribed_slopes
        self.residual, self.residual_slopes = problem.residual, problem.residual_slopes
        self._solver = problem.solver_of(problem.free, make) if make else problem.solver
        self.latest: Linearisation | None = None

    def linearise(self, x: Array, mu: Array) -> Linearisation:
        if not self._in_time():
            raise OutOfTime
        self.latest = self._problem.linearise(x, mu, self._solver)
        return self.latest


class _Added(_Stoppable):
    """The same with the ``kept`` (n,) dofs held as in ``given`` (n,)."""

    def __init__(
        self,
        problem: SolidProblem,
        in_time: Callable[[], bool],
        kept: NDArray[np.bool_],
        given: Array,
        make: SolverMaker | None,
    ) -> None:
        super().__init__(problem, in_time, make)
        self._kept, self._given = kept, given
        self.free, self.prescribed = problem.free & ~kept, self._held
        self._solver = problem.solver_of(self.free, make)

    def _held(self, mu: Array) -> Array:
        prescribed = self._problem.prescribed(mu)
        return np.where(self._kept & self._problem.free, self._given, prescribed)
