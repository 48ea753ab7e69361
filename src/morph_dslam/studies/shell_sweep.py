"""A shell as the sweep sees it: a solid's paths with a shell's fields."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.shell_problem import ShellProblem
from morph_dslam.mechanics.solvers.continuation import loaded_state
from morph_dslam.mechanics.solvers.newton import State
from morph_dslam.mechanics.solvers.relaxation import relaxed_state
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studies.solid_sweep import SolidSweep, response_reactions, support_reactions

Array = NDArray[np.float64]


def shell_snapshot(problem: ShellProblem, dofs: Array, mu: Array) -> Snapshot:
    """Displacement, stresses of both faces and reactions of a solution, without derivatives.

    Parameters
    ----------
    problem : the shell.
    dofs : (n,) of the solution.
    mu : (d,) parameters, SI.
    """
    return Snapshot(mu, problem.sample(dofs, mu), outputs=support_reactions(problem, dofs, mu))


def _moved_after_loads(problem: ShellProblem, mu: Array) -> State:
    """Equilibrium at ``mu`` (d,): the loads act on supports that do not move, whose motions follow."""
    if problem.at_rest is None:
        raise SolverError("the shell is not known on supports at rest")
    resting = problem.at_rest()
    try:
        start = loaded_state(resting, mu)
    except SolverError:
        start = relaxed_state(resting, mu)
    return loaded_state(problem, mu, start.dofs)


class ShellSweep(SolidSweep):
    """Solves a shell at one parameter point after another (`morph_dslam.studies.problem.SweepProblem`)."""

    problem: ShellProblem

    def first_state(self) -> Any:
        """The first stable equilibrium at the parameters' defaults that is found, or else the first one.

        Loads and motions grow together; or else motions follow the loads, as a cloth sags before its ends come
        together; or else the shell is let go.
        """
        problem, mu = self.problem, self.problem.symbols.default
        ways = [loaded_state, _moved_after_loads] if problem.loads and problem.prescribed(mu).any() else [loaded_state]
        unstable, failure = None, SolverError("no equilibrium found")
        for way in (*ways, relaxed_state):
            try:
                found = way(problem, mu)
            except SolverError as error:
                failure = error
                continue
            state = self._with_slopes(found)
            if not state.negative_pivots or not problem.loads:
                return state
            unstable = unstable or found
        if unstable is None and len(ways) > 1:
            raise SolverError(
                f"{failure}. Supports have moved at the defaults already: include in the ranges, and make the "
                "defaults, values at which they are at rest"
            ) from failure
        if unstable is None:
            raise failure
        return self._with_slopes(unstable)

    def response_fields(self, state: Any, loads: Array, responses: Array) -> dict[str, Array]:
        """See `SolidSweep`."""
        forces = self._tangent(state).apply(responses) - loads
        slopes = self.problem.response_slopes(state.dofs, state.mu, responses)
        return slopes | response_reactions(self.problem, state.dofs, state.mu, responses, forces)

    def _snapshot(self, state: Any) -> Snapshot:
        found = shell_snapshot(self.problem, state.dofs, state.mu)
        return replace(found, sensitivities=self.problem.sample_slopes(state.dofs, state.mu, state.slopes))
