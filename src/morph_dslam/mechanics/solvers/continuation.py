"""Load stepping from a solved state to new coordinates: increments shrink on failure and grow again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.gripped_sheet import EquilibriumState

Array = NDArray[np.float64]

AnyState = TypeVar("AnyState")

#: The path is given up when an increment falls below this part of it.
SMALLEST_INCREMENT = 1.0 / 64.0


class Problem(Protocol):
    """Anything that can be solved at given coordinates from a nearby state."""

    def solve(self, coordinates: Array, start: EquilibriumState) -> EquilibriumState: ...


def step_towards(attempt: Callable[[float, AnyState], AnyState], start: AnyState) -> tuple[AnyState, int]:
    """Solve at the end of a path, going there in one increment if possible.

    Parameters
    ----------
    attempt : solves at a fraction of the path from a solved state.
    start : state at fraction 0.

    Returns
    -------
    The state at fraction 1 and how many solves it took.

    Raises
    ------
    SolverError
        If the increments become too small.
    """
    state, done, increment, solves = start, 0.0, 1.0, 0
    while done < 1.0:
        step = min(increment, 1.0 - done)
        solves += 1
        try:
            state = attempt(done + step, state)
        except SolverError as error:
            increment = step / 2.0
            if increment < SMALLEST_INCREMENT:
                raise SolverError(f"{error}, {100.0 * done:.0f} % of the way from a solved state") from error
            continue
        done += step
        increment = min(1.0, 2.0 * step)
    return state, solves


def advance(problem: Problem, start: EquilibriumState, target: Array) -> tuple[EquilibriumState, int]:
    """Solve at ``target`` (d,) along the straight line from ``start``.

    Returns the state and how many solves it took.

    Raises
    ------
    SolverError
        Naming the last coordinates that converged.
    """
    origin = start.coordinates

    def attempt(fraction: float, nearby: EquilibriumState) -> EquilibriumState:
        return problem.solve(origin + fraction * (target - origin), nearby)

    return step_towards(attempt, start)
