"""Load stepping: from a solved state to new parameters, and from the undeformed body to its first loads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solvers.newton import TOLERANCE, Equations, Linearisation, State, in_contact, solve

Array = NDArray[np.float64]
AnyState = TypeVar("AnyState")
#: The path is given up when an increment falls below this part of it.
SMALLEST_INCREMENT = 1.0 / 64.0


@runtime_checkable
class _History(Protocol):
    """Equations whose response depends on the path (internal variables): each accepted solution advances it."""

    def advance_history(self, x: Array, mu: Array) -> None: ...


class PathError(SolverError):
    """The path could not be followed to its end; ``states`` keeps what was solved."""

    def __init__(self, message: str, states: list[State]) -> None:
        super().__init__(message)
        self.states = states


def step_towards(attempt: Callable[[float, AnyState], AnyState], start: AnyState) -> AnyState:
    """The state at the end of a path, in one increment if possible; they shrink on failure and grow again.

    Raises SolverError if the increments become too small.

    Parameters
    ----------
    attempt : solves at a fraction of the path from a solved state.
    start : state at fraction 0.
    """
    state, done, increment = start, 0.0, 1.0
    while done < 1.0:
        step = min(increment, 1.0 - done)
        try:
            state = attempt(done + step, state)
        except SolverError as error:
            increment = step / 2.0
            if increment < SMALLEST_INCREMENT:
                raise SolverError(f"{error}, {100.0 * done:.0f} % of the way from a solved state") from error
            continue
        done += step
        increment = min(1.0, 2.0 * step)
    return state


def advance(equations: Equations, start: State, target: Array, tolerance: float = TOLERANCE) -> list[State]:
    """Solve at ``target`` (d,) along the straight line from ``start``, in increments as large as converge.

    Raises PathError naming the last parameters that converged; it carries the states up to there.

    Returns
    -------
    The states along the line, ``start`` first.
    """
    origin, goal = start.mu, np.asarray(target, dtype=float)
    states: list[State] = [start]

    def attempt(fraction: float, nearby: State) -> State:
        state = solve(equations, origin + fraction * (goal - origin), nearby, tolerance)
        if isinstance(equations, _History):
            equations.advance_history(state.dofs, state.mu)
        states.append(state)
        return state

    try:
        step_towards(attempt, start)
    except SolverError as error:
        raise PathError(
            f"{error}; the last parameters that converged are {states[-1].mu}. A load that the body cannot "
            "carry (a limit point) needs arc length, or an imposed displacement in its place",
            states,
        ) from error
    return states


@dataclass
class _Shifted:
    """A linearisation with another residual."""

    original: Linearisation
    residual: Array

    @property
    def negative_pivots(self) -> int | None:
        return self.original.negative_pivots

    def solve(self, right: Array) -> Array:
        return self.original.solve(right)

    def apply(self, vectors: Array) -> Array:
        return self.original.apply(vectors)


class _LoadRamp:
    """Equations in one parameter: the share s of all loads and motions at ``full`` that are still missing in ``start``.

    The residual r(x) - (1 - s) r(start) is that of the share s of every missing dead load (Newton's homotopy; Allgower
    and Georg, Numerical Continuation Methods, 1990, section 1.2): ``start`` solves it at s = 0, and s = 1 is the
    problem itself.
    """

    def __init__(self, equations: Equations, full: Array, start: Array) -> None:
        self._equations, self._full = equations, full
        self.n_dofs, self.free, self.scale = equations.n_dofs, equations.free, equations.scale
        self.in_contact = in_contact(equations)
        self._missing = np.where(self.free, equations.residual(start, full), 0.0)
        self._begin = np.where(self.free, 0.0, start)
        self._motion = equations.prescribed(full) - self._begin

    def prescribed(self, mu: Array) -> Array:
        return self._begin + mu[0] * self._motion

    def prescribed_slopes(self, mu: Array) -> Array:
        return self._motion[None]

    def residual(self, x: Array, mu: Array) -> Array:
        return self._equations.residual(x, self._full) - (1.0 - mu[0]) * self._missing

    def residual_slopes(self, x: Array, mu: Array) -> Array:
        return self._missing[None]

    def linearise(self, x: Array, mu: Array) -> Linearisation:
        original = self._equations.linearise(x, self._full)
        return _Shifted(original, original.residual - (1.0 - mu[0]) * self._missing)


def loaded_state(equations: Equations, mu: Array, start: Array | None = None) -> State:
    """Equilibrium at ``mu`` (d,), reached from the undeformed, stress-free body while all loads grow together.

    Raises SolverError if the loads cannot be carried.

    Parameters
    ----------
    equations : where ``applied_first`` makes others, what these have grows before the rest.
    start : (n,) where that has led already; None if nothing is applied yet.
    """
    if start is None:
        first = getattr(equations, "applied_first", None)
        start = np.zeros(equations.n_dofs) if first is None else loaded_state(first(), mu).dofs
    reached = advance(_LoadRamp(equations, mu, start), State(np.zeros(1), start), np.ones(1))[-1]
    return State(np.array(mu, dtype=float), reached.dofs, reached.negative_pivots, reached.iterations)
