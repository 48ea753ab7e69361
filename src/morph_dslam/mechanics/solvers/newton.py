"""Newton's method for discretised equilibrium, from one parameter point to the next.

Any discretisation that offers `Equations` is solved: solids, shells, or three bars in a test. The first
iteration moves the prescribed dofs together with all others along the tangent (the linearised predictor), so
that supports may move by far more than an element's size. Damping follows Deuflhard's natural monotonicity
test (Newton Methods for Nonlinear Problems, 2004, section 3.3): the simplified correction, which reuses the
factorisation, must shrink. It does not depend on the scaling of the equations, which a test of the residual
does: stretching and bending residuals of a thin sheet differ by (length / thickness)^2. The simplified
correction also ends the iteration without the extra factorisation that would only confirm convergence.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solvers.continuation import step_towards

Array = NDArray[np.float64]


class Linearisation(Protocol):
    """Residual and tangent at one point; `linear_solver.AssembledLinearisation` is the usual one."""

    residual: Array
    """(n,) internal minus external forces at all dofs: reactions at prescribed ones."""

    @property
    def negative_pivots(self) -> int | None:
        """Negative eigenvalues of the free block of K; None if the solver cannot tell."""
        ...

    def solve(self, right: Array) -> Array:
        """K_ff^-1 right_f for (n,) or (k, n), zero at prescribed dofs."""
        ...

    def apply(self, vectors: Array) -> Array:
        """K times (n,) or (k, n), at all dofs."""
        ...


class Equations(Protocol):
    """Discretised equilibrium r(x, mu) = 0 at free dofs, with x given at prescribed ones.

    ``scale`` () or (n,) is what counts as a large change of each dof: the body's length for a displacement,
    infinity for a dof that follows from the others (a multiplier), whose change is not measured.
    """

    @property
    def n_dofs(self) -> int: ...

    @property
    def free(self) -> NDArray[np.bool_]: ...

    @property
    def scale(self) -> Array | float: ...

    def prescribed(self, mu: Array) -> Array:
        """(n,) values at prescribed dofs, 0 at free ones."""
        ...

    def prescribed_slopes(self, mu: Array) -> Array:
        """(d, n) derivatives of `prescribed` by mu."""
        ...

    def residual(self, x: Array, mu: Array) -> Array:
        """(n,) internal minus external forces at all dofs."""
        ...

    def linearise(self, x: Array, mu: Array) -> Linearisation: ...

    def residual_slopes(self, x: Array, mu: Array) -> Array:
        """(d, n) derivatives of the residual by mu at fixed x."""
        ...


@runtime_checkable
class History(Protocol):
    """Equations whose response depends on the path (internal variables): told of each accepted solution."""

    def advance_history(self, x: Array, mu: Array) -> None: ...


@dataclass(frozen=True)
class State:
    """A converged solution.

    Attributes
    ----------
    mu : (d,) parameters.
    dofs : (n,) solution.
    negative_pivots : of the last factorised tangent; None if the solver cannot tell.
    iterations : factorisations it took.
    """

    mu: Array
    dofs: Array
    negative_pivots: int | None = None
    iterations: int = 0


@dataclass(frozen=True)
class NewtonOptions:
    """When Newton's method has converged and when it is given up; sizes are in units of `Equations.scale`.

    Attributes
    ----------
    tolerance : size of the last correction.
    max_iterations : factorisations.
    diverged : size of an update that is certainly wrong.
    smallest_damping : a step damped further has stalled.
    most_chords : a tangent is kept where so many more corrections with it should do, judged by the last two.
    """

    tolerance: float = 1e-8
    max_iterations: int = 20
    diverged: float = 10.0
    smallest_damping: float = 1.0 / 64.0
    most_chords: int = 4


DEFAULT = NewtonOptions()

#: Repeated corrections with one tangent end at this part of the tolerance.
CHORD_TARGET = 0.01


def size(equations: Equations, update: Array) -> float:
    """Largest entry of ``update`` (n,) in units of `Equations.scale`."""
    return float(np.max(np.abs(update / equations.scale)))


def correction(linearisation: Linearisation, residual: Array, gap: Array) -> Array:
    """Newton's update: moves prescribed dofs by ``gap`` (n,) and brings the free residual to zero."""
    if gap.any():
        residual = residual + linearisation.apply(gap)
    return gap - linearisation.solve(residual)


def solve(equations: Equations, mu: Array, start: State, options: NewtonOptions = DEFAULT) -> State:
    """Equilibrium at ``mu`` (d,) by Newton's method from ``start``.

    Raises
    ------
    SolverError
        If it stalls, diverges, or meets values that are not finite; smaller increments may help.
    """
    mu = np.array(mu, dtype=float)
    x, target = start.dofs.copy(), equations.prescribed(mu)
    for iteration in range(1, options.max_iterations + 1):
        linearisation = equations.linearise(x, mu)
        gap = np.where(equations.free, 0.0, target - x)
        update = correction(linearisation, linearisation.residual, gap)
        _check_update(equations, update, options, mu)
        trial = _damped_step(equations, mu, x, update, gap, linearisation, options)
        if trial.whole:
            trial = _follow_chords(equations, mu, trial, linearisation, options)
            if min(trial.remaining, trial.length) <= options.tolerance:
                return State(mu, trial.x + trial.rest, linearisation.negative_pivots, iteration)
        x = trial.x
    raise SolverError(f"Newton's method has not converged in {options.max_iterations} iterations at {mu}")


def _check_update(equations: Equations, update: Array, options: NewtonOptions, mu: Array) -> None:
    largest = size(equations, update)
    if not largest < options.diverged:
        raise SolverError(f"Newton's method diverges at {mu}: an update of {largest:.1e} times the body's size")


@dataclass(frozen=True)
class _Trial:
    """A point ``x`` (n,) reached by an update of size ``length``, and what the same tangent asks for there.

    Attributes
    ----------
    rest : (n,) the simplified correction, and ``remaining`` its size.
    whole : whether the update was not damped.
    """

    x: Array
    length: float
    rest: Array
    remaining: float
    whole: bool = True


def _damped_step(
    equations: Equations,
    mu: Array,
    x: Array,
    update: Array,
    gap: Array,
    linearisation: Linearisation,
    options: NewtonOptions,
) -> _Trial:
    """The point along ``update`` that is accepted."""
    length, damping = size(equations, update), 1.0
    while damping >= options.smallest_damping:
        point = x + damping * update
        residual = equations.residual(point, mu)
        if np.all(np.isfinite(residual)):
            rest = correction(linearisation, residual, (1.0 - damping) * gap)
            remaining = size(equations, rest)
            # An update at the level of rounding need not shrink any further.
            if remaining <= (1.0 - damping / 4.0) * length or (damping == 1.0 and length <= options.tolerance):
                return _Trial(point, length, rest, remaining, damping == 1.0)
        damping /= 2.0
    raise SolverError(f"Newton's method stalls at {mu}: no part of its update brings the solution nearer")


def _follow_chords(
    equations: Equations, mu: Array, trial: _Trial, linearisation: Linearisation, options: NewtonOptions
) -> _Trial:
    """Repeat the simplified correction where few repetitions will do: each saves a factorisation.

    They converge linearly, so that they must go further than Newton's method for the same error.
    """
    no_gap, target = np.zeros_like(trial.x), CHORD_TARGET * options.tolerance
    while options.tolerance < trial.length and target < trial.remaining < trial.length:
        contraction = np.log(trial.remaining / trial.length)
        goal = options.tolerance if trial.remaining > options.tolerance else target
        if np.log(goal / trial.remaining) < options.most_chords * contraction:
            break
        point = trial.x + trial.rest
        residual = equations.residual(point, mu)
        if not np.all(np.isfinite(residual)):
            break
        rest = correction(linearisation, residual, no_gap)
        remaining = size(equations, rest)
        if not remaining < trial.remaining:
            break
        trial = _Trial(point, trial.remaining, rest, remaining)
    return trial


def sensitivities(equations: Equations, state: State, linearisation: Linearisation | None = None) -> Array:
    """Derivatives (d, n) of the solution by the parameters, by implicit differentiation.

    One factorisation and one back-substitution a parameter: K dx = -(dr/dmu + K dx_prescribed).

    Parameters
    ----------
    linearisation : at the state; made here if not given.
    """
    linearisation = linearisation or equations.linearise(state.dofs, state.mu)
    moved = equations.prescribed_slopes(state.mu)
    right = equations.residual_slopes(state.dofs, state.mu) + linearisation.apply(moved)
    return moved - linearisation.solve(right)


@dataclass(frozen=True)
class StabilityChange:
    """Negative pivots that change between neighbouring states: the path has met a bifurcation between them.

    Attributes
    ----------
    before, after : parameters (d,) of the two states.
    pivots : negative pivots at the two states.
    """

    before: Array
    after: Array
    pivots: tuple[int, int]

    def __str__(self) -> str:
        return (
            f"negative pivots change from {self.pivots[0]} to {self.pivots[1]} between {self.before} and "
            f"{self.after}: a bifurcation was passed; start from a buckling mode as imperfection to follow it"
        )


@dataclass(frozen=True)
class Path:
    """States along a path in order, the start included, and the bifurcations passed without branching off."""

    states: tuple[State, ...]
    missed_bifurcations: tuple[StabilityChange, ...] = ()


class PathError(SolverError):
    """The path could not be followed to its end; ``path`` keeps what was solved."""

    def __init__(self, message: str, path: Path) -> None:
        super().__init__(message)
        self.path = path


def stability_change(before: State, after: State, expected: int = 0) -> StabilityChange | None:
    """Compare the negative pivots of neighbours, of which limit points explain ``expected`` changes."""
    if before.negative_pivots is None or after.negative_pivots is None:
        return None
    if abs(after.negative_pivots - before.negative_pivots) == expected:
        return None
    return StabilityChange(before.mu, after.mu, (before.negative_pivots, after.negative_pivots))


def advance(equations: Equations, start: State, target: Array, options: NewtonOptions = DEFAULT) -> Path:
    """Solve at ``target`` (d,) along the straight line from ``start``, in increments as large as converge.

    Raises
    ------
    PathError
        Naming the last parameters that converged; it carries the states up to there.
    """
    origin, goal = start.mu, np.asarray(target, dtype=float)
    states: list[State] = [start]

    def attempt(fraction: float, nearby: State) -> State:
        state = solve(equations, origin + fraction * (goal - origin), nearby, options)
        if isinstance(equations, History):
            equations.advance_history(state.dofs, state.mu)
        states.append(state)
        return state

    try:
        step_towards(attempt, start)
    except SolverError as error:
        raise PathError(
            f"{error}; the last parameters that converged are {states[-1].mu}. A load that the body cannot "
            "carry (a limit point) needs arc length, or an imposed displacement in its place",
            _path(states),
        ) from error
    return _path(states)


def _path(states: list[State]) -> Path:
    changes = (stability_change(before, after) for before, after in pairwise(states))
    return Path(tuple(states), tuple(change for change in changes if change))


# The chord method: Newton's iteration with the tangent of a nearby solution, factorised already.
# For a step small enough it converges linearly and fast, and each iteration costs a residual and a
# back-substitution in place of a tangent and its factorisation (Kelley, Iterative Methods for Linear and
# Nonlinear Equations, 1995, section 5.4).


#: Two iterations must shrink the correction to this part, or the tangent is too far off to be worth keeping.
#: Single ones need not: bending and stretching of thin walls converge in turns.
CONTRACTION = 0.2

MAX_ITERATIONS = 14

MAX_TANGENTS = 2

#: The error left is about as large as the last correction times the contraction, so stop later than Newton.
TOLERANCE = 0.1 * DEFAULT.tolerance


def solve_with_kept_tangent(
    equations: Equations, mu: Array, guess: Array, tangent: Linearisation | None
) -> State | None:
    """Equilibrium at ``mu`` (d,) from ``guess`` (n,), or None where this does not lead there.

    Parameters
    ----------
    tangent : linearisation at a solution nearby; None for one at the guess. Where it has served its turn, it
        is made anew at the point reached; two are used in all.
    """
    x = np.where(equations.free, guess, equations.prescribed(mu))
    first = np.inf
    for _ in range(MAX_TANGENTS):
        tangent = tangent or equations.linearise(x, mu)
        reached, lengths = _iterate(equations, mu, x, tangent)
        if not lengths or not lengths[0] < first:
            return None
        if lengths[-1] <= TOLERANCE:
            return State(mu, reached, None, len(lengths))
        if len(lengths) < 2 or lengths[-1] < lengths[0]:
            x, first = reached, lengths[0]
        tangent = None
    return None


def _iterate(equations: Equations, mu: Array, x: Array, tangent: Linearisation) -> tuple[Array, list[float]]:
    """The point reached from ``x`` with one tangent while that converges well, and each correction's size."""
    lengths: list[float] = []
    while len(lengths) < MAX_ITERATIONS:
        residual = equations.residual(x, mu)
        if not np.all(np.isfinite(residual)):
            return x, []
        correction = -tangent.solve(residual)
        length = size(equations, correction)
        if len(lengths) > 1 and not length < CONTRACTION * lengths[-2]:
            break
        x = x + correction
        lengths.append(length)
        if length <= TOLERANCE:
            break
    return x, lengths


# From the undeformed body to a loaded first state: all loads and supports grow together.
# The residual r(x) - (1 - s) r(0) is that of the share s of every dead load (Newton's homotopy; Allgower and
# Georg, Numerical Continuation Methods, 1990, section 1.2): x = 0 solves it at s = 0, and s = 1 is the
# problem itself.


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


class LoadRamp:
    """Equations in one parameter: the share of all loads and motions at the parameters ``full``."""

    def __init__(self, equations: Equations, full: Array) -> None:
        self._equations, self._full = equations, full
        self.n_dofs, self.free, self.scale = equations.n_dofs, equations.free, equations.scale
        self._unloaded = np.where(self.free, equations.residual(np.zeros(self.n_dofs), full), 0.0)

    def prescribed(self, mu: Array) -> Array:
        return mu[0] * self._equations.prescribed(self._full)

    def prescribed_slopes(self, mu: Array) -> Array:
        return self._equations.prescribed(self._full)[None]

    def residual(self, x: Array, mu: Array) -> Array:
        return self._equations.residual(x, self._full) - (1.0 - mu[0]) * self._unloaded

    def residual_slopes(self, x: Array, mu: Array) -> Array:
        return self._unloaded[None]

    def linearise(self, x: Array, mu: Array) -> Linearisation:
        original = self._equations.linearise(x, self._full)
        return _Shifted(original, original.residual - (1.0 - mu[0]) * self._unloaded)


def loaded_state(equations: Equations, mu: Array) -> State:
    """Equilibrium at ``mu`` (d,), reached from the undeformed, stress-free body.

    Raises
    ------
    SolverError
        If the loads cannot be carried.
    """
    ramp = LoadRamp(equations, mu)
    start = State(np.zeros(1), np.zeros(equations.n_dofs))
    reached = advance(ramp, start, np.ones(1)).states[-1]
    return State(np.array(mu, dtype=float), reached.dofs, reached.negative_pivots, reached.iterations)
