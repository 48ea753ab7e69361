"""A viscoelastic solid as the sweep sees it: paths in time, each with the history of its own parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.continuation import loaded_state
from morph_dslam.mechanics.solvers.newton import State
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studies.solid_sweep import follow, solid_snapshot

Array = NDArray[np.float64]
#: Each increment of time of a rest is so many times the one before.
GROWTH = 1.2


def _forget(problem: SolidProblem, time: float) -> None:
    """Let viscous materials remember a body that has rested for ever, at this time (s)."""
    assert problem.history is not None
    memory = np.zeros_like(problem.history.values())
    memory[-1] = time
    problem.history.restore(memory)


def _moved_at_once(problem: SolidProblem, start: State, mu: Array) -> State:
    """The state that loading in an instant leads to at ``mu`` (d,), found from ``start`` and remembered.

    Nothing is remembered of the way: a Prony series that changes along it would leave stress that no loading does.
    """
    state = start if np.array_equal(start.mu, mu) else follow(problem, start, mu, remember=False)
    problem.advance_history(state.dofs, mu)
    return state


@dataclass(frozen=True)
class _ViscousSolution:
    """A solution and what the materials remember.

    Attributes
    ----------
    mu : (d,).
    dofs : (n,).
    memory : (h,) internal variables.
    before : where the last whole increment of time ended, from which the path goes on; None if that is here. Which
        samples lie on the way so changes no solution.
    """

    mu: Array
    dofs: Array
    memory: Array
    before: _ViscousSolution | None = None


class ViscousSweep:
    """Solves a viscoelastic solid (`morph_dslam.studies.problem.SweepProblem`).

    All parameters but the time keep their values from the beginning on, that of a rest too: the body is loaded in an
    instant, and then time runs. The way from one such instant to that of other parameters leaves no memory. What is
    remembered depends on the whole path, so derivatives by the parameters at a fixed memory would be wrong ones;
    snapshots carry none, and the functions of the parameters are fitted to values.

    Parameters
    ----------
    problem : at rest; its clock stands at the default of the time.
    clock : index of the parameter that is the time.
    ends : (n,) of the increments of time, s, from its lower end to its upper end.
    rest : how long what is applied first has acted when all else comes, s.
    """

    def __init__(self, problem: SolidProblem, clock: int, ends: Array, rest: float = 0.0) -> None:
        self.problem, self._clock, self._ends, self._rest = problem, clock, ends, rest

    @cached_property
    def _first(self) -> SolidProblem | None:
        """What is applied first, where it rests."""
        return self.problem.applied_first() if self.problem.applied_first is not None and self._rest else None

    def _rested(self, mu: Array) -> Array | None:
        """Dofs (n,) of what is applied first, after its rest, whose memory the problem takes; None without a rest."""
        first, history = self._first, self.problem.history
        if first is None:
            return None
        assert history is not None
        assert first.history is not None
        # Increments grow with the age of the load, as relaxation slows down.
        count = int(np.ceil(np.log1p((GROWTH - 1.0) * self._rest / np.diff(self._ends).min()) / np.log(GROWTH)))
        ages = self._rest * (GROWTH ** np.arange(count + 1) - 1.0) / (GROWTH**count - 1.0)
        moments = [self._at_time(mu, mu[self._clock] - self._rest + age) for age in ages]
        begin = self._at_time(self.problem.symbols.default, moments[0][self._clock])
        _forget(first, begin[self._clock])
        state = _moved_at_once(first, loaded_state(first, begin), moments[0])
        state = follow(first, state, np.array(moments[1:]))
        history.restore(first.history.values())
        return state.dofs

    @cached_property
    def _loaded(self) -> State:
        """The default state, an instant after loading; what rests has not rested."""
        _forget(self.problem, self.problem.symbols.default[self._clock])
        return loaded_state(self.problem, self.problem.symbols.default)

    def _loaded_at(self, mu: Array) -> _ViscousSolution:
        """The state at ``mu`` (d,) an instant after loading, whose memory is that of these parameters alone."""
        rested = self._rested(mu)
        if rested is None:
            start = self._loaded
            _forget(self.problem, mu[self._clock])
            state = _moved_at_once(self.problem, start, mu)
        else:
            state = loaded_state(self.problem, mu, rested)
            self.problem.advance_history(state.dofs, mu)
        return self._with_memory(State(mu, state.dofs))

    @cached_property
    def _default_state(self) -> _ViscousSolution:
        return self._loaded_at(self.problem.symbols.default)

    def first_state(self) -> _ViscousSolution:
        """The response to the default loads an instant after they came."""
        return self._default_state

    def _with_memory(self, state: State) -> _ViscousSolution:
        assert self.problem.history is not None
        return _ViscousSolution(state.mu, state.dofs, self.problem.history.values())

    def pack(self, state: _ViscousSolution) -> dict[str, Array]:
        own = {"mu": state.mu, "dofs": state.dofs, "memory": state.memory}
        return own if state.before is None else own | {f"before_{k}": v for k, v in self.pack(state.before).items()}

    def unpack(self, arrays: dict[str, Array]) -> _ViscousSolution:
        last = None
        if "before_mu" in arrays:
            last = self.unpack({k: arrays[f"before_{k}"] for k in ("mu", "dofs", "memory")})
        return _ViscousSolution(arrays["mu"], arrays["dofs"], arrays["memory"], last)

    def advance(self, start: _ViscousSolution, target: Array) -> _ViscousSolution:
        """Follow time to ``target`` (d,): on from ``start`` where that is earlier on the same path."""
        assert self.problem.history is not None
        start = start.before or start
        same_path = np.array_equal(np.delete(start.mu, self._clock), np.delete(target, self._clock))
        if not same_path or start.mu[self._clock] > target[self._clock]:
            start = self._loaded_at(self._at_time(target, self.problem.symbols.default[self._clock]))
        self.problem.history.restore(start.memory)
        whole, rest = self._times(start.mu[self._clock], target[self._clock])
        state, before = State(start.mu, start.dofs), start
        if len(whole):
            state = follow(self.problem, state, np.array([self._at_time(target, time) for time in whole]))
            before = self._with_memory(state)
        if not rest:
            return replace(before, mu=target)
        state = follow(self.problem, state, target)
        return replace(self._with_memory(State(target, state.dofs)), before=before)

    def finer_in_time(self, problem: SolidProblem) -> ViscousSweep:
        """The sweep of a finer problem of the same study, in half the increments of time."""
        middles = (self._ends[1:] + self._ends[:-1]) / 2.0
        return ViscousSweep(problem, self._clock, np.sort(np.concatenate([self._ends, middles])), self._rest)

    def moments(self, mu: Array, count: int) -> list[Array]:
        """Moments (d,) of the path that leads to ``mu`` (d,), evenly spaced, the first at its beginning."""
        begin = self.problem.symbols.default[self._clock]
        return [self._at_time(mu, float(time)) for time in np.linspace(begin, mu[self._clock], count + 1)]

    def _times(self, begin: float, end: float) -> tuple[Array, bool]:
        """Ends of the whole increments of time from ``begin`` to ``end``, s, and whether a part of one is left."""
        rounding = 1e-9 * (self._ends[-1] - self._ends[0])
        whole = self._ends[(self._ends > begin + rounding) & (self._ends < end + rounding)]
        return whole, end > (whole[-1] if len(whole) else begin) + rounding

    def _at_time(self, mu: Array, time: float) -> Array:
        moment = mu.copy()
        moment[self._clock] = time
        return moment

    def take_snapshot(self, state: _ViscousSolution) -> Snapshot:
        """Fields at the nodes and reactions; no derivatives."""
        assert self.problem.history is not None
        self.problem.history.restore(state.memory)
        return solid_snapshot(self.problem, state.dofs, state.mu)
