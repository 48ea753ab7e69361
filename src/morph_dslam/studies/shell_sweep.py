"""A shell as the sweep sees it: a solid's paths with a shell's fields."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.shell_problem import ShellProblem
from morph_dslam.mechanics.solvers.continuation import loaded_state
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


class ShellSweep(SolidSweep):
    """Solves a shell at one parameter point after another (`morph_dslam.studies.problem.SweepProblem`)."""

    problem: ShellProblem

    def first_state(self) -> Any:
        """Equilibrium at the parameters' defaults: all loads grown together, or else where the shell comes to rest."""
        mu = self.problem.symbols.default
        try:
            return self._with_slopes(loaded_state(self.problem, mu))
        except SolverError:
            return self._with_slopes(relaxed_state(self.problem, mu, self.problem.area))

    def response_fields(self, state: Any, loads: Array, responses: Array) -> dict[str, Array]:
        """See `unknown_loads.LoadableProblem`."""
        forces = self._tangent(state).apply(responses) - loads
        fields = [self.problem.sample(response, state.mu) for response in responses]
        slopes = {name: np.array([field[name] for field in fields]) for name in fields[0]}
        return slopes | response_reactions(self.problem, state.dofs, state.mu, responses, forces)

    def take_snapshot(self, state: Any) -> Snapshot:
        """Displacement, stresses of both faces and their slopes, reactions, and the tangent's negative pivots."""
        problem = self.problem
        found = shell_snapshot(problem, state.dofs, state.mu)
        slopes = problem.sample_slopes(state.dofs, state.mu, state.slopes)
        if state.negative_pivots is not None:
            found.outputs["negative_pivots"] = np.array(state.negative_pivots)
        return replace(found, sensitivities=slopes)
