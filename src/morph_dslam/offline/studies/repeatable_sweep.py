"""A solid's sweep whose solutions do not depend on what its worker solved before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.offline.mechanics.solid import SolidProblem
from morph_dslam.offline.solvers.newton import State
from morph_dslam.offline.studies.solid_sweep import SolidState, SolidSweep

Array = NDArray[np.float64]


class RepeatableSweep(SolidSweep):
    """Has the tangent of every start at hand: kept where this worker solved it last, or else made anew.

    Whether a solution is reached with one tangent or another shows in the last digits of the iteration's
    tolerance; so the numbers of a sweep are the same whatever the number of workers and their timing.
    """

    def __init__(self, problem: SolidProblem) -> None:
        super().__init__(problem)
        self._solved: Array | None = None

    def unpack(self, arrays: dict[str, Array]) -> SolidState:
        state = super().unpack(arrays)
        if self._solved is None or not np.array_equal(self._solved, state.dofs):
            self._tangent = None  # its memory is needed for the next one
            self._tangent = state.mu, self.problem.linearise(state.dofs, state.mu)
            self._solved = state.dofs
        return state

    def _with_slopes(self, state: State) -> SolidState:
        self._solved = None
        result = super()._with_slopes(state)
        self._solved = result.dofs
        return result
