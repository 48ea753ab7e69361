"""Load stepping from a solved state to new coordinates: increments shrink on failure and grow again."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.offline.gripped_sheet import EquilibriumState

Array = NDArray[np.float64]

#: The path is given up when an increment falls below this part of it.
SMALLEST_INCREMENT = 1.0 / 64.0


class Problem(Protocol):
    """Anything that can be solved at given coordinates from a nearby state."""

    def solve(self, coordinates: Array, start: EquilibriumState) -> EquilibriumState: ...


def advance(problem: Problem, start: EquilibriumState, target: Array) -> tuple[EquilibriumState, int]:
    """Solve at ``target`` (d,) along the straight line from ``start``.

    Returns the state and how many solves it took.

    Raises
    ------
    SolverError
        Naming the last coordinates that converged.
    """
    state, done, increment, solves = start, 0.0, 1.0, 0
    origin = start.coordinates
    while done < 1.0:
        step = min(increment, 1.0 - done)
        solves += 1
        try:
            state = problem.solve(origin + (done + step) * (target - origin), state)
        except SolverError as error:
            increment = step / 2.0
            if increment < SMALLEST_INCREMENT:
                raise SolverError(
                    f"{error}, {100.0 * done:.0f} % of the way from a solved neighbour"
                ) from error
            continue
        done += step
        increment = min(1.0, 2.0 * step)
    return state, solves
