"""A solid as the sweep sees it: paths from neighbour to neighbour, and snapshots of its fields."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.offline.mechanics.solid import SolidProblem
from morph_dslam.offline.problem import Snapshot
from morph_dslam.offline.solvers.chord_iteration import solve_with_kept_tangent
from morph_dslam.offline.solvers.load_ramp import loaded_state
from morph_dslam.offline.solvers.newton import (
    Linearisation,
    PathError,
    State,
    advance,
    sensitivities,
    solve,
)

Array = NDArray[np.float64]

#: Fields of a snapshot and what they are called when recovered.
_FIELDS = {"displacement": "displacement", "stress_solid": "stress", "strain": "strain"}


@dataclass(frozen=True)
class SolidState:
    """A solution and its derivatives.

    Attributes
    ----------
    mu : (d,). dofs : (n,). slopes : (d, n) of the dofs by the parameters. negative_pivots : of the tangent.
    """

    mu: Array
    dofs: Array
    slopes: Array
    negative_pivots: int | None


class SolidSweep:
    """Solves a solid at one parameter point after another (`morph_dslam.offline.problem.SweepProblem`)."""

    def __init__(self, problem: SolidProblem) -> None:
        self.problem = problem
        self._tangent: tuple[Array, Linearisation] | None = None

    def first_state(self) -> SolidState:
        """Equilibrium at the parameters' defaults, all loads grown together."""
        return self._with_slopes(loaded_state(self.problem, self.problem.symbols.default))

    def pack(self, state: SolidState) -> dict[str, Array]:
        pivots = -1 if state.negative_pivots is None else state.negative_pivots
        return {"mu": state.mu, "dofs": state.dofs, "slopes": state.slopes, "pivots": np.array(pivots)}

    def unpack(self, arrays: dict[str, Array]) -> SolidState:
        pivots = int(arrays["pivots"])
        return SolidState(arrays["mu"], arrays["dofs"], arrays["slopes"], None if pivots < 0 else pivots)

    def advance(self, start: SolidState, target: Array) -> SolidState:
        """Solve at ``target``: from the prediction of the sensitivities, or else in increments.

        If the tangent at ``start`` is still at hand, as in a sweep along one parameter, it serves first.
        """
        predicted = start.dofs + (target - start.mu) @ start.slopes
        at_hand = self._tangent is not None and np.array_equal(self._tangent[0], start.mu)
        tangent = self._tangent[1] if self._tangent and at_hand else None
        self._tangent = None
        try:
            state = solve_with_kept_tangent(self.problem, target, predicted, tangent)
            state = state or solve(self.problem, target, State(target, predicted))
        except SolverError:
            state = follow(self.problem, State(start.mu, start.dofs), target)
        return self._with_slopes(state)

    def _with_slopes(self, state: State) -> SolidState:
        self._tangent = None
        tangent = self.problem.linearise(state.dofs, state.mu)
        slopes = sensitivities(self.problem, state, tangent)
        self._tangent = state.mu, tangent
        return SolidState(state.mu, state.dofs, slopes, tangent.negative_pivots)

    def take_snapshot(self, state: SolidState) -> Snapshot:
        """Displacement, Cauchy stress and Green-Lagrange strain at nodes, their slopes, and reactions."""
        outputs = support_reactions(self.problem, state.dofs, state.mu)
        if state.negative_pivots is not None:
            outputs["negative_pivots"] = np.array(state.negative_pivots)
        return Snapshot(
            state.mu,
            snapshot_fields(self.problem.sample(state.dofs, state.mu)),
            snapshot_fields(self.problem.sample_slopes(state.dofs, state.mu, state.slopes)),
            outputs,
        )


def follow(problem: SolidProblem, start: State, target: Array) -> State:
    """Solve at ``target`` (d,) in increments from ``start``.

    Raises
    ------
    SolverError
        Naming, in the parameters' units, where the last solution converged.
    """
    try:
        return advance(problem, start, target).states[-1]
    except PathError as error:
        last = ", ".join(
            f"{parameter.name} {parameter.display(value):.5g} {parameter.unit}".removesuffix(" 1")
            for parameter, value in zip(problem.symbols.parameters, error.path.states[-1].mu, strict=True)
        )
        raise SolverError(f"no equilibrium found beyond {last}, where the last solution converged") from error


def snapshot_fields(recovered: dict[str, Array]) -> dict[str, Array]:
    """Recovered fields under the names that they have in snapshots and model files."""
    return {name: recovered[key] for name, key in _FIELDS.items()}


def support_reactions(problem: SolidProblem, dofs: Array, mu: Array) -> dict[str, Array]:
    """Force (N) and moment (N m, about the object frame's origin) on each set that is held."""
    outputs = {}
    for support in problem.supports:
        force, moment = problem.reactions(dofs, mu, support.on, np.zeros(3))
        outputs[f"force_{support.on}"], outputs[f"moment_{support.on}"] = force, moment
    return outputs
