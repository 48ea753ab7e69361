"""Arc length continuation: paths through limit points, with any parameter as the path's own.

The unknowns are the dofs and one parameter; the added equation fixes the length of the step along the tangent (Keller,
"Numerical solution of bifurcation and nonlinear eigenvalue problems", 1977; Crisfield, Computers & Structures 13,
1981). The bordered system is solved by two solves of one factorisation, so that K itself keeps its symmetry and its
inertia gives the stability. Each converged point is linearised once, for its tangent; the same factorisation then
serves the next step's corrections as long as they shrink fast enough.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solvers.newton import (
    Equations,
    Linearisation,
    State,
    correction,
    refuse_large_turn,
    size,
    where,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ArcOptions:
    """Step control. Lengths and sizes are in units of `Equations.scale`; lengths are root mean squares.

    Attributes
    ----------
    first : step length.
    smallest : step length at which the path is given up.
    largest : step length.
    corrections : a step that takes so many is repeated at the same length; with fewer it grows.
    max_corrections : more than these, and the step is halved.
    contraction : the tangent is renewed where a correction is larger than this part of the one before.
    tolerance : size of the last correction.
    smallest_cosine : of the angle by which the path may turn in a step; more, and the step is halved.
    """

    first: float = 1e-3
    smallest: float = 1e-8
    largest: float = 0.1
    corrections: int = 5
    max_corrections: int = 20
    contraction: float = 0.3
    tolerance: float = 1e-8
    smallest_cosine: float = 0.9


@dataclass(frozen=True)
class PathPoint:
    """A converged point of a path.

    Attributes
    ----------
    state : parameters, dofs and negative pivots, these of the tangent at this very point.
    length : of the path from its start.
    tangent : (n,) derivative of the dofs by the length.
    rate : derivative of the path's parameter by the length.
    step : length of the step that led here, 0 at the start.
    corrections : back-substitutions that the step took.
    """

    state: State
    length: float
    tangent: Array
    rate: float
    step: float = 0.0
    corrections: int = 0


class ArcLength:
    """Follows the solutions of ``equations`` along one parameter, the others fixed.

    Parameters
    ----------
    equations : what is solved.
    parameter : index of the path's own parameter in mu.
    options : step control.
    """

    def __init__(self, equations: Equations, parameter: int = 0, options: ArcOptions | None = None) -> None:
        self.equations, self.parameter = equations, parameter
        self.options = options or ArcOptions()
        scale = np.broadcast_to(np.asarray(equations.scale, dtype=float), equations.n_dofs)
        self._weights = 1.0 / scale**2 / np.count_nonzero(np.isfinite(scale))
        self._latest: tuple[PathPoint, Linearisation, Array] | None = None

    def _product(self, a: Array, b: Array) -> float:
        return float(np.sum(self._weights * a * b))

    def _response(self, linearisation: Linearisation, x: Array, mu: Array) -> Array:
        """Derivative (n,) of the dofs by the path's parameter."""
        moved = self.equations.prescribed_slopes(mu)[self.parameter]
        load = self.equations.residual_slopes(x, mu)[self.parameter]
        return moved - linearisation.solve(load + linearisation.apply(moved))

    def _point(self, x: Array, mu: Array, forwards: Callable[[Array], float], **kept: float) -> PathPoint:
        """Linearise at a converged point; the sign of ``forwards`` is the sense of a tangent."""
        linearisation = self.equations.linearise(x, mu)
        response = self._response(linearisation, x, mu)
        rate = 1.0 / np.sqrt(self._product(response, response))
        rate = float(np.copysign(rate, forwards(response)))
        state = State(mu, x, linearisation.negative_pivots, 1)
        point = PathPoint(state, tangent=rate * response, rate=rate, **kept)  # type: ignore[arg-type]
        self._latest = point, linearisation, response
        return point

    def _linearised(self, point: PathPoint) -> tuple[Linearisation, Array]:
        if self._latest is None or self._latest[0] is not point:
            x, mu = point.state.dofs, point.state.mu
            linearisation = self.equations.linearise(x, mu)
            self._latest = point, linearisation, self._response(linearisation, x, mu)
        return self._latest[1:]

    def _between(self, point: PathPoint, following: PathPoint, length: float) -> tuple[Array, Array]:
        """Cubic interpolation of dofs and parameters at ``length`` along the tangent of ``point``."""
        whole = following.length - point.length
        t = length / whole
        # Derivatives by the length along the first tangent, not along the path itself.
        stretch = 1.0 / self._product(point.tangent, following.tangent)
        rates = [np.zeros_like(point.state.mu) for _ in "12"]
        rates[0][self.parameter], rates[1][self.parameter] = point.rate, stretch * following.rate
        ends = (point.state.dofs, following.state.dofs), (point.state.mu, following.state.mu)
        slopes = (point.tangent, stretch * following.tangent), rates
        x, mu = (
            (1.0 - t) ** 2 * ((1.0 + 2.0 * t) * a + t * whole * slope_a)
            + t**2 * ((3.0 - 2.0 * t) * b - (1.0 - t) * whole * slope_b)
            for (a, b), (slope_a, slope_b) in zip(ends, slopes, strict=True)
        )
        return x, mu

    def _correct(self, point: PathPoint, length: float, following: PathPoint | None = None) -> tuple[Array, Array, int]:
        """Dofs and parameters at ``length`` along the tangent of ``point``, and the corrections it took."""
        equations, options = self.equations, self.options
        origin, mu = point.state.dofs, point.state.mu.copy()
        linearisation, response = self._linearised(point)
        if following is None:
            x = origin + length * point.tangent
            mu[self.parameter] += length * point.rate
        else:
            x, mu = self._between(point, following, length)
        before = size(equations, length * point.tangent)
        for count in range(1, options.max_corrections + 1):
            residual = equations.residual(x, mu)
            if not np.all(np.isfinite(residual)):
                break
            gap = np.where(equations.free, 0.0, equations.prescribed(mu) - x)
            update = correction(linearisation, residual, gap)
            missing = length - self._product(point.tangent, x - origin + update)
            change = missing / self._product(point.tangent, response)
            # The dofs may stand still while the parameter still moves: both parts of the update count.
            largest = max(size(equations, update), size(equations, update + change * response))
            x += update + change * response
            mu[self.parameter] += change
            if largest <= options.tolerance:
                return x, mu, count
            if not largest < 10.0 * before:
                break
            if largest > options.contraction * before:
                linearisation = equations.linearise(x, mu)
                response = self._response(linearisation, x, mu)
            before = largest
        begin = where(equations, point.state.mu)
        raise SolverError(f"a step of {length:.1e} along the path does not converge from {begin}")

    def begin(self, start: State, sense: float = 1.0) -> PathPoint:
        """The path's first point, the parameter growing from there (``sense`` = 1) or falling (-1)."""
        return self._point(start.dofs, start.mu, lambda _: sense, length=0.0)

    def locate(self, point: PathPoint, length: float, following: PathPoint | None = None) -> State:
        """The solution at ``length`` along the tangent of ``point``, without a tangent or pivots of its own.

        Between two points of a path it costs a few corrections only, the first point's factorisation serving all: they
        begin from the cubic interpolation if the ``following`` point is given. Raises SolverError as `step` does.
        """
        x, mu, _ = self._correct(point, length, following)
        return State(mu, x)

    def step(self, point: PathPoint, length: float) -> PathPoint:
        """One step of ``length`` along the path.

        Raises SolverError if its corrections do not converge, or supports turn by too much (`newton.LARGEST_TURN`).
        """
        x, mu, count = self._correct(point, length)
        refuse_large_turn(self.equations, point.state.mu, mu)
        following = self._point(
            x,
            mu,
            lambda response: self._product(point.tangent, response),
            length=point.length + length,
            step=length,
            corrections=count,
        )
        if self._product(point.tangent, following.tangent) < self.options.smallest_cosine:
            last = where(self.equations, point.state.mu)
            raise SolverError(f"the path turns sharply, or was lost for another, beyond {last}")
        return following

    def follow(
        self, start: State | PathPoint, end: Callable[[State], float], sense: float = 1.0
    ) -> Iterator[PathPoint]:
        """Points of the path, its start first, with steps as long as they converge quickly.

        Raises SolverError for an ``end`` that is positive at the start or no number, and, naming the last parameters
        that converged, when steps become too short.

        Parameters
        ----------
        start : the path's first solution, or a point of a path to go on from.
        end : a function of the state that is negative before the path's end and grows through zero at it: the last
            point is where it vanishes. ``lambda state: state.mu[0] - target`` ends at a parameter.
        sense : whether the parameter first grows (1) or falls (-1); a point knows its own.
        """
        options = self.options
        point = self.begin(start, sense) if isinstance(start, State) else start
        before = end(point.state)
        if isinstance(before, bool | np.bool_):
            raise SolverError(
                f"`end` returns {before}: it has to return a number that is negative before the path's end and grows "
                "through zero there, as that of lambda state: state.mu[0] - target does"
            )
        if before > 0.0:
            begin = where(self.equations, point.state.mu)
            raise SolverError(f"`end` is positive at the path's start, {begin}: it has to grow through zero at the end")
        length = point.step or options.first
        yield point
        while True:
            try:
                following = self.step(point, length)
            except SolverError as error:
                length /= 2.0
                if length < options.smallest:
                    last = where(self.equations, point.state.mu)
                    raise SolverError(f"{error}; the last parameters that converged are {last}") from error
                continue
            if end(following.state) >= 0.0:
                yield self._landing(point, length, end)
                return
            growth = (options.corrections / following.corrections) ** 0.5
            length = min(options.largest, length * float(np.clip(growth, 0.5, 2.0)))
            point = following
            yield point

    def _landing(self, point: PathPoint, length: float, end: Callable[[State], float]) -> PathPoint:
        """The point within ``length`` of ``point`` where ``end`` vanishes."""

        def remaining(part: float) -> float:
            if part == 0.0:
                return end(point.state)
            return end(self.locate(point, part))

        return self.step(point, float(brentq(remaining, 0.0, length, xtol=1e-12, rtol=1e-9)))  # type: ignore[arg-type]


@dataclass(frozen=True)
class StabilityChange:
    """Negative pivots that change between neighbouring points: the path has met a bifurcation between them.

    Attributes
    ----------
    before : (d,) parameters of the first point.
    after : (d,) parameters of the second.
    pivots : negative pivots at the two.
    """

    before: Array
    after: Array
    pivots: tuple[int, int]

    def __str__(self) -> str:
        return (
            f"negative pivots change from {self.pivots[0]} to {self.pivots[1]} between {self.before} and "
            f"{self.after}: a bifurcation was passed; start from a buckling mode as imperfection to follow it"
        )


def missed_bifurcations(points: list[PathPoint]) -> tuple[StabilityChange, ...]:
    """Neighbours whose negative pivots differ although no limit point lies between them.

    At a limit point the parameter turns round and one pivot changes its sign. Any other change means that the path
    crossed another one, without branching off.
    """
    changes = []
    for before, after in pairwise(points):
        pivots = before.state.negative_pivots, after.state.negative_pivots
        if pivots[0] is None or pivots[1] is None:
            continue
        if abs(pivots[1] - pivots[0]) != int(before.rate * after.rate < 0.0):
            changes.append(StabilityChange(before.state.mu, after.state.mu, (pivots[0], pivots[1])))
    return tuple(changes)
