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
from morph_dslam.tracking.state import State

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def bounded_step(hessian, gradient, lower, upper):
    """Minimiser of the quadratic model, with unknowns that would leave [lower, upper] held at the bound.

    Starts with all unknowns free and holds those that violate a bound until none does; unknowns already at a
    bound (zero distance) that the gradient pushes outwards are thereby held from the start.

    Parameters
    ----------
    hessian, gradient : (n, n), positive definite, and (n,)
    lower, upper : (n,) of the step.

    Returns
    -------
    The step (n,).
    """
    n = len(gradient)
    step = np.zeros(n)
    free = np.ones(n, dtype=np.bool_)
    for k in range(n):
        free[k] = not ((lower[k] == 0.0 and gradient[k] > 0.0) or (upper[k] == 0.0 and gradient[k] < 0.0))
    while free.any():
        rows = np.flatnonzero(free)
        matrix, right = np.empty((len(rows), len(rows))), np.empty(len(rows))
        for a in range(len(rows)):
            right[a] = -gradient[rows[a]]
            for k in range(n):
                if not free[k]:
                    right[a] -= hessian[rows[a], k] * step[k]
            for b in range(len(rows)):
                matrix[a, b] = hessian[rows[a], rows[b]]
        found = np.linalg.solve(matrix, right)
        kept = True
        for a in range(len(rows)):
            k = rows[a]
            step[k] = min(max(found[a], lower[k]), upper[k])
            if step[k] != found[a]:
                free[k], kept = False, False
        if kept:
            break
    return step


#: Largest step of one iteration in scaled unknowns: keeps an unseen direction from crossing the box at once.
LARGEST_STEP = 1.0
#: Damping floor, relative to the best-seen direction.
DAMPING_FLOOR = 1e-6
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
    state, bounds = box.nearest(State(start.parameters, pose)), (box.lower, box.upper, box.scale)
    cost, hessian, gradient, residuals = evaluate(state)
    damping, iterations, converged = 1e-3, 0, False
    while iterations < max_iterations and not converged:
        iterations += 1
        pose = state.camera_from_object
        predicted, *trial = damped_trial(
            hessian, gradient, state.parameters, pose.rotation, pose.translation, *bounds, damping
        )
        if predicted <= tolerance * cost + 1e-14:
            # A damped step predicts little although much could be gained: believe it only undamped.
            converged = damping <= 1e-2
            damping = min(damping * 0.01, 1e-2)
            continue
        parameters, rotation, translation = trial
        moved = State(parameters, RigidTransform(rotation, translation))
        attempt = evaluate(moved)
        if attempt[0] < cost:
            ratio = (cost - attempt[0]) / predicted
            state, (cost, hessian, gradient, residuals) = moved, attempt
            damping = max(damping * (0.1 if ratio > 0.5 else 1.0), 1e-9)
        else:
            damping *= 10.0
            converged = damping > 1e8
    return Minimum(state, cost, hessian, residuals, iterations, converged)


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
    scaled, slope = np.empty((n, n)), gradient * scale
    for a in range(n):
        for b in range(n):
            scaled[a, b] = hessian[a, b] * scale[a] * scale[b]
    damped = scaled.copy()
    floor = max(np.diag(scaled).max() * DAMPING_FLOOR, 1e-30)
    for a in range(n):
        damped[a, a] += damping * max(scaled[a, a], floor) + 1e-3 * floor
    lower, upper = np.full(n, -LARGEST_STEP), np.full(n, LARGEST_STEP)
    for k in range(d):
        lower[k] = max(lower[k], (lowest[k] - parameters[k]) / scale[k])
        upper[k] = min(upper[k], (highest[k] - parameters[k]) / scale[k])
    step = bounded_step(damped, slope, lower, upper)
    return step, -(slope @ step + 0.5 * step @ (scaled @ step))


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
    step, d = step * scale, len(parameters)
    # Rounding may leave a parameter an ulp outside its range.
    there = np.minimum(np.maximum(parameters + step[:d], lowest), highest)
    return predicted, there, rotation_exp(step[d : d + 3]) @ rotation, translation + step[d + 3 :]
