"""Load stepping: from a solved state to new parameters, and from the undeformed body to its first loads.

Where a path has several steps, each starts from the polynomial through the solutions before (Allgower and Georg,
Numerical Continuation Methods, 1990, section 6.3). A smooth path then takes little more than one factorisation a step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solvers.arc_length import ArcLength, PathPoint
from morph_dslam.mechanics.solvers.newton import (
    LARGEST_TURN,
    TOLERANCE,
    Equations,
    Linearisation,
    State,
    in_contact,
    refuse_large_turn,
    size,
    solve,
    turn,
    where,
)

Array = NDArray[np.float64]
AnyState = TypeVar("AnyState")
#: Highest degree of the polynomial that predicts the next solution.
MOST_DEGREE = 4
#: The path is given up when an increment falls below this part of it, or of a stride.
SMALLEST_INCREMENT = 1.0 / 64.0
#: Points after which a path by arc length is given up.
MOST_POINTS = 150
#: Where it has passed a bifurcation, it is tried again in steps of this part, so many times.
RETREAT, MOST_RETREATS = 0.25, 5
#: Step of differences by the share of all loads.
SLOPE_STEP = 1e-5
LIMIT_POINT = (
    "A load that the body cannot carry (a limit point) needs arc length, or an imposed displacement in its place"
)


@runtime_checkable
class _History(Protocol):
    """Equations whose response depends on the path (internal variables): each accepted solution advances it."""

    def advance_history(self, x: Array, mu: Array) -> None: ...


@runtime_checkable
class _Turning(Equations, Protocol):
    """Equations with prescribed rotations, which grow by their angles while a body is loaded for the first time."""

    def turn_from(self, x: Array, mu: Array) -> float:
        """Angle, rad, by which supports that are at rest in ``x`` (n,) turn on the way to parameters (d,)."""
        ...

    def prescribed_on_the_way(self, x: Array, mu: Array, share: float) -> Array:
        """(n,) values at prescribed dofs on that share of the way from ``x`` (n,) to parameters (d,), 0 at free ones.

        Supports at rest in ``x`` turn by that share of their angle.
        """
        ...

    def turn_directions(self, share: float) -> None:
        """Turn directions that supports hold by that share of the angle that parameters give, until told otherwise."""
        ...


class PassageError(SolverError):
    """The body and an obstacle have passed through each other."""


class PathError(SolverError):
    """The path could not be followed to its end.

    Attributes
    ----------
    states : what was solved.
    passage : what would have passed through an obstacle further on; None if that is not what ends the path.
    """

    def __init__(self, message: str, states: list[State], passage: str | None = None) -> None:
        super().__init__(message)
        self.states, self.passage = states, passage


def refuse_passage(equations: Equations, before: State, after: State) -> None:
    """Raise PassageError if body and obstacles pass through each other between two solutions.

    Equations with obstacles say so by a method ``passage`` of both solutions: in words, or None. Contact sees where
    things are, not how they came there; so an increment that is too large may leave out what is between.
    """
    passage = getattr(equations, "passage", None)
    found = None if passage is None else passage(before, after)
    if found is not None:
        raise PassageError(f"{found} on the way from {where(equations, before.mu)} to {where(equations, after.mu)}")


def step_towards(attempt: Callable[[float, AnyState], AnyState], start: AnyState, strides: int = 1) -> AnyState:
    """The state at the end of a path, in one increment if possible; they shrink on failure and grow again.

    Raises SolverError if the increments become too small.

    Parameters
    ----------
    attempt : solves at a fraction of the path from a solved state.
    start : state at fraction 0.
    strides : the first increment is one of so many, and others may shrink to a share of that.
    """
    state, done, increment = start, 0.0, 1.0 / strides
    while done < 1.0:
        step = min(increment, 1.0 - done)
        try:
            state = attempt(done + step, state)
        except SolverError as error:
            increment = step / 2.0
            if increment * strides < SMALLEST_INCREMENT:
                raise SolverError(f"{error}, {100.0 * done:.0f} % of the way from a solved state") from error
            continue
        done += step
        increment = min(1.0, 2.0 * step)
    return state


class _Extrapolation:
    """Polynomials through the latest solutions on a path.

    Parameters
    ----------
    equations : what is solved.
    start : (n,) solution at place 0.
    """

    def __init__(self, equations: Equations, start: Array) -> None:
        self._equations = equations
        self._places, self._solutions, self._degree = [0.0], [start], 0

    def at(self, place: float) -> Array | None:
        """The solution (n,) to expect at a place further on; None where the latest one would do better."""
        return self._polynomial(self._degree, place) if self._degree else None

    def add(self, place: float, solution: Array) -> None:
        """Take the solution (n,) at a place, and the degree that would have foretold it best.

        Where that is the highest one there could be, it is raised: smooth paths end at `MOST_DEGREE`, rough ones at
        lower degrees.
        """
        tried = range(len(self._places))
        missed = [size(self._equations, self._polynomial(degree, place) - solution) for degree in tried]
        best = int(np.argmin(missed))
        self._degree = min(best + (best == tried[-1]), MOST_DEGREE)
        self._places = [*self._places, place][-MOST_DEGREE - 1 :]
        self._solutions = [*self._solutions, solution][-MOST_DEGREE - 1 :]

    def _polynomial(self, degree: int, place: float) -> Array:
        """Lagrange's polynomial through the latest ``degree`` + 1 solutions."""
        known = np.array(self._places[-degree - 1 :])
        others = ~np.eye(len(known), dtype=bool)
        ratios = (place - known[None]) / np.where(others, known[:, None] - known[None], 1.0)
        weights = np.prod(ratios, axis=1, where=others)
        return weights @ np.array(self._solutions[-degree - 1 :])


def advance(
    equations: Equations, start: State, target: Array, tolerance: float = TOLERANCE, remember: bool = True
) -> list[State]:
    """Solve at ``target``, along straight lines, in increments as large as converge.

    Equations with moving obstacles have a method ``strides`` of two parameter points: in how many parts of the line
    between them no obstacle moves by more than its radius. Increments may be as much smaller. No increment turns
    supports by more than `newton.LARGEST_TURN`.

    Raises PathError naming the last parameters that converged; it carries the states up to there.

    Parameters
    ----------
    equations : what is solved.
    start : a solution.
    target : (d,) parameters, or (k, d) ones to solve at in turn; best so that they are smooth in their number, for
        solutions are extrapolated over it.
    tolerance : of Newton's method.
    remember : whether equations with a history advance it by each solution; not where the way is no part of it.

    Returns
    -------
    The states along the way, ``start`` first: those at ``target``, and between them where increments were needed.
    """
    path = _Path(equations, start, tolerance, remember)
    try:
        for number, goal in enumerate(np.atleast_2d(np.asarray(target, dtype=float))):
            path.lead_to(goal, number)
    except SolverError as error:
        last = where(equations, path.states[-1].mu)
        passage = str(error.__cause__) if isinstance(error.__cause__, PassageError) else None
        message = f"{error}; the last parameters that converged are {last}"
        raise PathError(message if passage else f"{message}. {LIMIT_POINT}", path.states, passage) from error
    return path.states


class _Path:
    """Solutions one after another.

    Attributes
    ----------
    states : solved so far, the start first.
    """

    def __init__(self, equations: Equations, start: State, tolerance: float, remember: bool) -> None:
        self._equations, self._tolerance, self._remember, self.states = equations, tolerance, remember, [start]
        self._expected = _Extrapolation(equations, start.dofs)

    def lead_to(self, goal: Array, number: int) -> None:
        """Go on to the parameters ``goal`` (d,), the ``number``-th target, along a straight line."""
        origin = self.states[-1].mu

        def attempt(fraction: float, before: State) -> State:
            mu = origin + fraction * (goal - origin)
            refuse_large_turn(self._equations, before.mu, mu)
            return self._step(mu, number + fraction)

        strides = getattr(self._equations, "strides", None)
        turns = int(np.ceil(turn(self._equations, origin, goal) / LARGEST_TURN - 1e-9))
        step_towards(attempt, self.states[-1], max(1 if strides is None else strides(origin, goal), turns))

    def _step(self, mu: Array, place: float) -> State:
        state = self._solve(mu, self._expected.at(place))
        if self._remember and isinstance(self._equations, _History):
            self._equations.advance_history(state.dofs, state.mu)
        self.states.append(state)
        self._expected.add(place, state.dofs)
        return state

    def _solve(self, mu: Array, guess: Array | None) -> State:
        if guess is not None:
            try:
                return self._reached(mu, State(mu, guess))
            except SolverError:
                pass  # the path bends here: by its tangent it may go on
        return self._reached(mu, self.states[-1])

    def _reached(self, mu: Array, start: State) -> State:
        state = solve(self._equations, mu, start, self._tolerance)
        refuse_passage(self._equations, self.states[-1], state)
        return state


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
    problem itself. Prescribed rotations turn by the share s of their angle. `end` is due when the ramp is left.
    """

    def __init__(self, equations: Equations, full: Array, start: Array) -> None:
        self._equations, self._full = equations, full
        self.n_dofs, self.free, self.scale = equations.n_dofs, equations.free, equations.scale
        self.in_contact = in_contact(equations)
        self._turning = equations if isinstance(equations, _Turning) else None
        self._turn = self._turning.turn_from(start, full) if self._turning else 0.0
        self._turn_directions(0.0)
        self._missing = np.where(self.free, equations.residual(start, full), 0.0)
        self._begin = np.where(self.free, 0.0, start)
        self._motion = equations.prescribed(full) - self._begin

    def _turn_directions(self, share: float) -> None:
        if self._turning and self._turn:
            self._turning.turn_directions(share)

    def end(self) -> None:
        """Leave the equations as they were."""
        self._turn_directions(1.0)

    def turn(self, begin: Array, end: Array) -> float:
        return float(abs(end[0] - begin[0])) * self._turn

    def state_text(self, mu: Array) -> str:
        return f"{100.0 * mu[0]:.4g} % of all loads at {where(self._equations, self._full)}"

    def passage(self, before: State, after: State) -> str | None:
        passage = getattr(self._equations, "passage", None)
        ends = (replace(state, mu=self._full) for state in (before, after))
        return None if passage is None else passage(*ends)

    def prescribed(self, mu: Array) -> Array:
        if self._turning and self._turn:
            return self._turning.prescribed_on_the_way(self._begin, self._full, float(mu[0]))
        return self._begin + mu[0] * self._motion

    def prescribed_slopes(self, mu: Array) -> Array:
        return self._slope(self.prescribed, mu) if self._turn else self._motion[None]

    def residual(self, x: Array, mu: Array) -> Array:
        self._turn_directions(float(mu[0]))
        return self._equations.residual(x, self._full) - (1.0 - mu[0]) * self._missing

    def residual_slopes(self, x: Array, mu: Array) -> Array:
        return self._slope(lambda share: self.residual(x, share), mu) if self._turn else self._missing[None]

    @staticmethod
    def _slope(function: Callable[[Array], Array], mu: Array) -> Array:
        """(1, n) by central differences: sines of angles of a few turns are exact to 1e-8 or so."""
        return ((function(mu + SLOPE_STEP) - function(mu - SLOPE_STEP)) / (2.0 * SLOPE_STEP))[None]

    def linearise(self, x: Array, mu: Array) -> Linearisation:
        self._turn_directions(float(mu[0]))
        original = self._equations.linearise(x, self._full)
        return _Shifted(original, original.residual - (1.0 - mu[0]) * self._missing)


def loaded_state(equations: Equations, mu: Array, start: Array | None = None, tolerance: float = TOLERANCE) -> State:
    """Equilibrium at ``mu`` (d,), reached from the undeformed, stress-free body while all loads grow together.

    Prescribed rotations of sets that are at rest grow by their angles, not along the chords of their arcs. Raises
    SolverError if the loads cannot be carried.

    Parameters
    ----------
    equations : where ``applied_first`` makes others, what these have grows before the rest.
    start : (n,) where that has led already; None if nothing is applied yet.
    tolerance : of Newton's method.
    """
    if start is None:
        first = getattr(equations, "applied_first", None)
        start = np.zeros(equations.n_dofs) if first is None else loaded_state(first(), mu).dofs
    ramp = _LoadRamp(equations, mu, start)
    try:
        reached = advance(ramp, State(np.zeros(1), start), np.ones(1), tolerance)[-1]
    finally:
        ramp.end()
    return State(np.array(mu, dtype=float), reached.dofs, reached.negative_pivots, reached.iterations)


class _Line:
    """Equations in one parameter: the share s of the straight line from parameters (d,) to others."""

    def __init__(self, equations: Equations, begin: Array, end: Array) -> None:
        self._equations, self._begin, self._way = equations, begin, end - begin
        self.n_dofs, self.free, self.scale = equations.n_dofs, equations.free, equations.scale

    def _at(self, mu: Array) -> Array:
        return self._begin + mu[0] * self._way

    def turn(self, begin: Array, end: Array) -> float:
        return turn(self._equations, self._at(begin), self._at(end))

    def prescribed(self, mu: Array) -> Array:
        return self._equations.prescribed(self._at(mu))

    def prescribed_slopes(self, mu: Array) -> Array:
        return (self._way @ self._equations.prescribed_slopes(self._at(mu)))[None]

    def residual(self, x: Array, mu: Array) -> Array:
        return self._equations.residual(x, self._at(mu))

    def residual_slopes(self, x: Array, mu: Array) -> Array:
        return (self._way @ self._equations.residual_slopes(x, self._at(mu)))[None]

    def linearise(self, x: Array, mu: Array) -> Linearisation:
        return self._equations.linearise(x, self._at(mu))


def stable_state(equations: Equations, mu: Array, start: State | None = None) -> State | None:
    """The equilibrium at ``mu`` (d,) that a body comes to in small steps, by arc length.

    Parameters
    ----------
    equations : what is solved; nothing of it is applied first.
    mu : (d,) parameters.
    start : a stable solution; None for the undeformed body, from which all loads grow together.

    Returns
    -------
    None where the path passes a bifurcation, so that a body may go more than one way, or does not lead to ``mu``.
    """
    ramp, dofs = None, np.zeros(equations.n_dofs) if start is None else start.dofs
    if start is None:
        path = ramp = _LoadRamp(equations, mu, dofs)
    else:
        path = _Line(equations, start.mu, np.asarray(mu, dtype=float))
    try:
        point = _end_of_stable_path(ArcLength(path), State(np.zeros(1), dofs))
        found = None if point is None else solve(path, np.ones(1), point.state)
    except SolverError:
        return None
    finally:
        if ramp is not None:
            ramp.end()
    return None if found is None else State(np.array(mu, dtype=float), found.dofs, found.negative_pivots)


def _end_of_stable_path(arc: ArcLength, start: State) -> PathPoint | None:
    """The point of a path where its parameter is 1; None if it is not reached, or a bifurcation lies before it."""

    def end(state: State) -> float:
        return state.mu[0] - 1.0

    points, before, retreats = arc.follow(start, end), None, 0
    for _ in range(MOST_POINTS):
        point = next(points)
        # Beyond a limit point the parameter falls while a pivot is negative; beyond a bifurcation it does not.
        if point.state.negative_pivots and point.rate > 0.0:
            if before is None or retreats == MOST_RETREATS:
                return None
            # With a small imperfection a long step misses the bend of the path.
            retreats, before = retreats + 1, replace(before, step=RETREAT * point.step)
            points = arc.follow(before, end)
            next(points)
        elif abs(end(point.state)) < 1e-6:
            return point
        else:
            before = point
    return None
