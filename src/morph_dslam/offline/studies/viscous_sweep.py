"""A viscoelastic solid as the sweep sees it: every sample is followed through time from the start.

All parameters but the time keep their values from the beginning on: the body is loaded in an instant, and
then time runs. What it remembers depends on the whole path, so derivatives by the parameters at a fixed
memory would be wrong ones; snapshots carry none, and the functions of the parameters are fitted to values.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morph_dslam.offline.mechanics.solid import SolidProblem
from morph_dslam.offline.problem import Snapshot
from morph_dslam.offline.solvers.load_ramp import loaded_state
from morph_dslam.offline.solvers.newton import State
from morph_dslam.offline.studies.solid_sweep import follow, snapshot_fields, support_reactions

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ViscousSolution:
    """A solution and what the materials remember: parameters (d,), dofs (n,), internal variables (h,)."""

    mu: Array
    dofs: Array
    memory: Array


class ViscousSweep:
    """Solves a viscoelastic solid (`morph_dslam.offline.problem.SweepProblem`).

    Parameters
    ----------
    problem : at rest; its clock stands at the default of the time. clock : index of the parameter that is the
        time. step : longest increment of time, s.
    """

    def __init__(self, problem: SolidProblem, clock: int, step: float) -> None:
        self.problem, self._clock, self._step = problem, clock, step

    @cached_property
    def _loaded(self) -> ViscousSolution:
        """The default state, an instant after loading."""
        mu = self.problem.symbols.default
        state = loaded_state(self.problem, mu)
        self.problem.advance_history(state.dofs, mu)
        return self._with_memory(state)

    def first_state(self) -> ViscousSolution:
        """The response to the default loads an instant after they came."""
        return self._loaded

    def _with_memory(self, state: State) -> ViscousSolution:
        assert self.problem.history is not None
        return ViscousSolution(state.mu, state.dofs, self.problem.history.values())

    def pack(self, state: ViscousSolution) -> dict[str, Array]:
        return {"mu": state.mu, "dofs": state.dofs, "memory": state.memory}

    def unpack(self, arrays: dict[str, Array]) -> ViscousSolution:
        return ViscousSolution(arrays["mu"], arrays["dofs"], arrays["memory"])

    def advance(self, start: ViscousSolution, target: Array) -> ViscousSolution:
        """Follow time to ``target`` (d,): on from ``start`` where that is earlier on the same path."""
        assert self.problem.history is not None
        same_path = np.array_equal(np.delete(start.mu, self._clock), np.delete(target, self._clock))
        if not same_path or start.mu[self._clock] > target[self._clock]:
            start = self._loaded
        self.problem.history.restore(start.memory)
        state = State(start.mu, start.dofs)
        at_once = target.copy()
        at_once[self._clock] = start.mu[self._clock]
        if not np.array_equal(at_once, start.mu):
            state = follow(self.problem, state, at_once)
        begin, end = start.mu[self._clock], target[self._clock]
        count = int(np.ceil((end - begin) / self._step - 1e-9))
        for time in np.linspace(begin, end, count + 1)[1:]:
            at_time = target.copy()
            at_time[self._clock] = time
            state = follow(self.problem, state, at_time)
        return self._with_memory(State(target, state.dofs))

    def take_snapshot(self, state: ViscousSolution) -> Snapshot:
        """Displacement, Cauchy stress, Green-Lagrange strain and reactions; no derivatives."""
        assert self.problem.history is not None
        self.problem.history.restore(state.memory)
        return Snapshot(
            state.mu,
            snapshot_fields(self.problem.sample(state.dofs, state.mu)),
            outputs=support_reactions(self.problem, state.dofs, state.mu),
        )
