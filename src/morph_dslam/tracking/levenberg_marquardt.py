"""Levenberg-Marquardt in a box of parameters; each step minimises a quadratic model by an active set.

The active set is that of Nocedal & Wright, ch. 16.7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import ReducedModel
from morph_dslam.small_arrays import cholesky_solve, scaled
from morph_dslam.tracking.state import State

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def bounded_step(hessian, gradient, lower, upper):
    """Minimiser of the quadratic model between bounds, by a primal active set.

    It begins with all unknowns held that leave their bounds at once, which mostly are those that matter. From there it
    moves towards the minimiser of the unknowns that are free, up to the first bound on the way, which is then held; at
    that minimiser the held unknown that gains most by leaving its bound is freed.

    Parameters
    ----------
    hessian, gradient : (n, n), positive definite, and (n,)
    lower, upper : (n,) of the step; 0 lies between them.

    Returns
    -------
    The step (n,).
    """
    n = len(gradient)
    step = np.zeros(n)
    free = np.ones(n, dtype=np.bool_)
    for k in range(n):
        free[k] = not ((lower[k] == 0.0 and gradient[k] > 0.0) or (upper[k] == 0.0 and gradient[k] < 0.0))
    leaves = True
    while leaves:
        target, leaves = _minimiser_of_free(hessian, gradient, step, free), False
        for k in range(n):
            step[k] = min(max(target[k], lower[k]), upper[k])
            if free[k] and step[k] != target[k]:
                free[k], leaves = False, True
    # Each bound is left a few times at most: the limit only guards against rounding.
    for _ in range(4 * n + 4):
        gained, best = 0.0, -1
        for k in range(n):
            gained += gradient[k] * step[k]
        gain = 1e-14 * abs(gained)
        for k in range(n):
            slope = gradient[k]
            for other in range(n):
                slope += hessian[k, other] * step[other]
            inwards = -slope if step[k] <= lower[k] else slope
            if not free[k] and lower[k] < upper[k] and inwards**2 / hessian[k, k] > gain and inwards > 0.0:
                gain, best = inwards**2 / hessian[k, k], k
        if best < 0:
            break
        free[best] = True
        first = 0
        while first >= 0:
            target = _minimiser_of_free(hessian, gradient, step, free)
            share, first = 1.0, -1
            for k in range(n):
                bound = lower[k] if target[k] < lower[k] else upper[k]
                if target[k] < lower[k] or target[k] > upper[k]:
                    part = (bound - step[k]) / (target[k] - step[k])
                    if part < share:
                        share, first = part, k
            for k in range(n):  # rounding may leave it an ulp outside
                step[k] = min(max(step[k] + share * (target[k] - step[k]), lower[k]), upper[k])
            if first >= 0:
                step[first] = lower[first] if target[first] < lower[first] else upper[first]
                free[first] = False
    return step


@njit(cache=True, nogil=True)
def _minimiser_of_free(hessian, gradient, step, free):
    """The step (n,) whose free unknowns minimise the quadratic model, the others as they are."""
    n, count = len(gradient), 0
    rows = np.empty(n, np.int64)
    for k in range(n):
        if free[k]:
            rows[count] = k
            count += 1
    matrix, right = np.empty((count, count)), np.empty(count)
    for a in range(count):
        right[a] = -gradient[rows[a]]
        for k in range(n):
            if not free[k]:
                right[a] -= hessian[rows[a], k] * step[k]
        for b in range(count):
            matrix[a, b] = hessian[rows[a], rows[b]]
    target, found = step.copy(), cholesky_solve(matrix, right)
    for a in range(count):
        target[rows[a]] = found[a]
    return target


#: Largest step of one iteration in scaled unknowns: keeps an unseen direction from crossing the box at once.
LARGEST_STEP = 1.0
#: Damping floor, relative to the best-seen direction.
DAMPING_FLOOR = 1e-6
#: Steps back to the bottom of a valley, after one that raised the cost.
STEPS_BACK = 5
#: At a state: cost, Gauss-Newton Hessian (d + 6, d + 6), gradient (d + 6,), and residuals of any shape.
Evaluate = Callable[[State], tuple[float, Array, Array, Array]]


@dataclass(frozen=True)
class Box:
    """Where parameters may be, and the scale of all unknowns.

    Attributes
    ----------
    lower, upper : (d,), SI
    scale : (d + 6,) half a parameter range, one radian, the object's size.
    """

    lower: Array
    upper: Array
    scale: Array

    @classmethod
    def of(cls, model: ReducedModel) -> Box:
        """The box of a model's parameters; rotations are of the size of a radian, shifts of the object's."""
        size = float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
        half_ranges = 0.5 * (model.upper - model.lower)
        return cls(model.lower, model.upper, np.concatenate([half_ranges, np.ones(3), np.full(3, size)]))

    @property
    def n_unknowns(self) -> int:
        """How many there are: parameters whose values are left open, and the pose."""
        return int((self.upper > self.lower).sum()) + 6

    def nearest(self, state: State) -> State:
        """The state with its parameters inside the box."""
        inside = np.minimum(np.maximum(state.parameters, self.lower), self.upper)
        return State(inside, state.camera_from_object)


@dataclass(frozen=True)
class Minimum:
    """Where the iteration ended: the state and what `Evaluate` gives there but the gradient."""

    state: State
    cost: float
    hessian: Array
    residuals: Array
    iterations: int
    converged: bool


def minimise(evaluate: Evaluate, start: State, box: Box, max_iterations: int = 25, tolerance: float = 1e-6) -> Minimum:
    """Minimise a cost from ``start``, until it would decrease by less than ``tolerance`` of itself."""
    known = start.camera_from_object
    pose = RigidTransform(np.ascontiguousarray(known.rotation), np.ascontiguousarray(known.translation))
    state = box.nearest(State(start.parameters, pose))
    cost, hessian, gradient, residuals = evaluate(state)
    damping, iterations, converged = 1e-3, 0, False
    while iterations < max_iterations and not converged:
        iterations += 1
        predicted, moved = _stepped(state, hessian, gradient, box, damping)
        if predicted <= tolerance * cost + 1e-14:
            # A damped step predicts little although much could be gained: believe it only undamped.
            converged = damping <= 1e-2
            damping = min(damping * 0.01, 1e-2)
            continue
        moved, attempt = _back_into_valley(evaluate, moved, cost, box, damping)
        if attempt[0] < cost:
            ratio = (cost - attempt[0]) / predicted
            state, (cost, hessian, gradient, residuals) = moved, attempt
            damping = max(damping * (0.1 if ratio > 0.5 else 1.0), 1e-9)
        else:
            damping *= 4.0
            converged = damping > 1e8
    return Minimum(state, cost, hessian, residuals, iterations, converged)


def _stepped(state: State, hessian: Array, gradient: Array, box: Box, damping: float) -> tuple[float, State]:
    """The decrease that a damped step from a state is to bring, and the state that it leads to."""
    pose = state.camera_from_object
    predicted, parameters, rotation, translation = damped_trial(
        hessian, gradient, state.parameters, pose.rotation, pose.translation, box.lower, box.upper, box.scale, damping
    )
    return predicted, State(parameters, RigidTransform(rotation, translation))


def _back_into_valley(
    evaluate: Evaluate, state: State, cost: float, box: Box, damping: float
) -> tuple[State, tuple[float, Array, Array, Array]]:
    """A state that a step has led to and what `Evaluate` gives there, or where further steps lower the cost enough.

    Parameters that pictures hardly tell apart leave a narrow, curved valley: a straight step along it ends on its
    side. From there a few more steps lead back to its bottom, farther on (the watchdog of Nocedal & Wright, ch. 15.6).
    They are made as long as each promises to come below ``cost``.
    """
    there = evaluate(state)
    for _ in range(STEPS_BACK):
        if there[0] < cost:
            break
        predicted, moved = _stepped(state, there[1], there[2], box, damping)
        if not there[0] - predicted < cost:
            break
        state, there = moved, evaluate(moved)
    return state, there


@njit(cache=True, nogil=True)
def damped_step(hessian, gradient, parameters, lowest, highest, scale, damping):
    """Step in scaled unknowns and the decrease of the cost that the quadratic model predicts for it.

    Parameters
    ----------
    hessian, gradient : (n, n) and (n,) of the cost, SI
    parameters : (d,), the first of the unknowns.
    lowest, highest : (d,) their box
    scale : (n,) of the unknowns
    damping : relative to the diagonal.
    """
    n, d = len(gradient), len(parameters)
    whole, slope, largest = scaled(hessian, scale), np.empty(n), -np.inf
    damped, lower, upper = whole.copy(), np.empty(n), np.empty(n)
    for a in range(n):
        slope[a], largest = gradient[a] * scale[a], max(largest, whole[a, a])
    floor = max(largest * DAMPING_FLOOR, 1e-30)
    for a in range(n):
        damped[a, a] += damping * max(whole[a, a], floor) + 1e-3 * floor
        lower[a], upper[a] = -LARGEST_STEP, LARGEST_STEP
        if a < d:
            lower[a] = max(lower[a], (lowest[a] - parameters[a]) / scale[a])
            upper[a] = min(upper[a], (highest[a] - parameters[a]) / scale[a])
    step, change = bounded_step(damped, slope, lower, upper), 0.0
    for a in range(n):
        change += slope[a] * step[a]
        for b in range(n):
            change += 0.5 * step[a] * whole[a, b] * step[b]
    return step, -change


@njit(cache=True, nogil=True)
def damped_trial(hessian, gradient, parameters, rotation, translation, lowest, highest, scale, damping):
    """`damped_step`, and the state that it leads to, as `moved` makes it, in the box.

    Parameters
    ----------
    hessian, gradient, parameters, lowest, highest, scale, damping : as of `damped_step`.
    rotation, translation : (3, 3) and (3,) of camera_from_object.

    Returns
    -------
    predicted : decrease of the cost.
    parameters, rotation, translation : of the state, as above.
    """
    step, predicted = damped_step(hessian, gradient, parameters, lowest, highest, scale, damping)
    d, turned, shifted = len(parameters), np.zeros((3, 3)), np.empty(3)
    for k in range(len(step)):
        step[k] *= scale[k]
    there, turn = np.empty(d), rotation_exp(step[d : d + 3])
    for k in range(d):  # rounding may leave a parameter an ulp outside its range
        there[k] = min(max(parameters[k] + step[k], lowest[k]), highest[k])
    for i in range(3):
        shifted[i] = translation[i] + step[d + 3 + i]
        for j in range(3):
            for k in range(3):
                turned[i, j] += turn[i, k] * rotation[k, j]
    return predicted, there, turned, shifted
