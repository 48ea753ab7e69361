"""Parameters and pose from pixels: Levenberg-Marquardt with Huber weights inside the parameter box.

The steps are taken in scaled unknowns (half a parameter range, one radian, the object's size), so that the
damping treats them alike. Directions that the images cannot see get no step and a large standard deviation:
the damping has a floor relative to the best-seen direction, and the iteration ends when the model predicts no
worthwhile decrease. Bounds are kept by an active set (Nocedal & Wright, Numerical Optimization, ch. 16.7).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.model import ReducedModel
from morph_dslam.online.bounded_step import bounded_step
from morph_dslam.online.prior import Prior
from morph_dslam.online.reprojection import linearise
from morph_dslam.online.robust_covariance import huber_covariance
from morph_dslam.online.state import BoundPoints, State, moved

__all__ = ["BoundPoints", "Estimate", "EstimationOptions", "Estimator", "Prior", "State", "moved"]

Array = NDArray[np.float64]

#: Largest step of one iteration in scaled unknowns: keeps an unseen direction from crossing the box at once.
LARGEST_STEP = 1.0
#: Damping floor, relative to the best-seen direction.
DAMPING_FLOOR = 1e-6
#: A parameter nearer to its bound than this share of its range counts as being at the bound.
BOUND_SHARE = 1e-3


@dataclass(frozen=True)
class EstimationOptions:
    """When to stop, and what is too far off.

    Attributes
    ----------
    huber_px : residual length where Huber's cost turns linear; above what a model that is a little off leaves
        over wide parts of the surface, which are no outliers.
    tolerance : relative decrease of the cost below which the iteration ends.
    """

    huber_px: float = 3.0
    max_iterations: int = 25
    tolerance: float = 1e-6


@dataclass(frozen=True)
class Estimate:
    """The minimum that was found.

    Attributes
    ----------
    state : parameters and pose.
    cost : Huber cost and that of the prior, pixels squared.
    residuals : (p, 2) projected minus measured, pixels.
    sigma_px : robust standard deviation of one pixel coordinate's residual.
    covariance : (d + 6, d + 6) of [parameters, rotation vector, translation]; infinite when undetermined.
    at_bound : (d,) parameters that ended at a bound of the box.
    iterations, converged : how the iteration ended.
    measured_covariance : the covariance without any prior on the parameters; None where there was none.
    """

    state: State
    cost: float
    residuals: Array
    sigma_px: float
    covariance: Array
    at_bound: NDArray[np.bool_]
    iterations: int
    converged: bool
    measured_covariance: Array | None = None

    @property
    def parameter_std(self) -> Array:
        """Standard deviations of the parameters (d,), SI; very large where the images do not tell."""
        return np.sqrt(np.diag(self.covariance)[: len(self.state.parameters)])

    @property
    def pose_std(self) -> Array:
        """Standard deviations (6,) of the rotation vector (rad) and the translation (m)."""
        return np.sqrt(np.diag(self.covariance)[len(self.state.parameters) :])


class Estimator:
    """Finds states from pixels of bound points, with one camera and one model.

    ``linearise`` may be replaced by its numpy twin to compare them.
    """

    def __init__(
        self,
        model: ReducedModel,
        camera: PinholeCamera,
        options: EstimationOptions | None = None,
        linearise: Callable = linearise,
    ) -> None:
        self.model, self.camera = model, camera
        self.options = options or EstimationOptions()
        self._linearise = linearise
        size = float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
        half_ranges = 0.5 * (model.upper - model.lower)
        self.scale = np.concatenate([half_ranges, np.ones(3), np.full(3, size)])

    def evaluate(
        self,
        points: BoundPoints,
        pixels: Array,
        weights: Array,
        state: State,
        normals: Array | None = None,
        prior: Prior | None = None,
    ) -> tuple[float, Array, Array, Array]:
        """Cost, Hessian, gradient and residuals at a state; see `reprojection.linearise`."""
        pose = state.camera_from_object
        normals = np.zeros_like(pixels) if normals is None else normals
        cost, hessian, gradient, residuals = self._linearise(
            points.field.functions.rows(state.parameters), pose.rotation, pose.translation, points.rest,
            points.field.modes, self.camera.intrinsics, pixels, weights, normals, self.options.huber_px,
        )  # fmt: skip
        if prior is not None:
            terms = prior.terms(state)
            cost, hessian, gradient = cost + terms[0], hessian + terms[1], gradient + terms[2]
        return cost, hessian, gradient, residuals

    def estimate(
        self,
        points: BoundPoints,
        pixels: Array,
        weights: Array,
        start: State,
        normals: Array | None = None,
        prior: Prior | None = None,
    ) -> Estimate:
        """Minimise the Huber cost from ``start``.

        Parameters
        ----------
        pixels : (p, 2) measured, in the undistorted image.
        weights : (p,) non-negative; points of weight 0 are ignored (their residuals are still reported).
        normals : (p, 2), for points that count only along a direction; see `reprojection.linearise`.
        prior : what is known of the parameters and the pose beforehand; nothing by default.
        """
        options, scale = self.options, self.scale
        state = State(np.clip(start.parameters, self.model.lower, self.model.upper), start.camera_from_object)
        normals = np.zeros_like(pixels) if normals is None else normals
        cost, hessian, gradient, residuals = self.evaluate(points, pixels, weights, state, normals, prior)
        damping, iterations, converged = 1e-3, 0, False
        while iterations < options.max_iterations and not converged:
            iterations += 1
            step, predicted = self._damped_step(hessian, gradient, state, damping)
            if predicted <= options.tolerance * cost + 1e-14:
                # A damped step predicts little although much could be gained: believe it only undamped.
                converged = damping <= 1e-2
                damping = min(damping * 0.01, 1e-2)
                continue
            trial = self._inside(moved(state, step * scale))
            attempt = self.evaluate(points, pixels, weights, trial, normals, prior)
            if attempt[0] < cost:
                ratio = (cost - attempt[0]) / predicted
                state, (cost, hessian, gradient, residuals) = trial, attempt
                damping = max(damping * (0.1 if ratio > 0.5 else 1.0), 1e-9)
            else:
                damping *= 10.0
                converged = damping > 1e8
        # A point on an outline gives one number, all others give two.
        numbers = np.where((normals != 0.0).any(axis=1), 1, 2)
        return self._finish(state, cost, hessian, residuals, weights, numbers, iterations, converged)

    def estimate_from(
        self, points: BoundPoints, pixels: Array, weights: Array, starts: Sequence[State]
    ) -> list[Estimate]:
        """Minimise from several starts; the estimates in order of their cost."""
        found = [self.estimate(points, pixels, weights, start) for start in starts]
        return sorted(found, key=lambda estimate: estimate.cost)

    def _damped_step(
        self, hessian: Array, gradient: Array, state: State, damping: float
    ) -> tuple[Array, float]:
        """Step in scaled unknowns and the decrease of the cost that the quadratic model predicts for it."""
        scale, d = self.scale, len(state.parameters)
        scaled_hessian = hessian * np.outer(scale, scale)
        scaled_gradient = gradient * scale
        diagonal = np.diag(scaled_hessian)
        floor = max(diagonal.max() * DAMPING_FLOOR, 1e-30)
        damped = scaled_hessian + np.diag(damping * np.maximum(diagonal, floor) + 1e-3 * floor)
        lower, upper = np.full(d + 6, -LARGEST_STEP), np.full(d + 6, LARGEST_STEP)
        lower[:d] = np.maximum(lower[:d], (self.model.lower - state.parameters) / scale[:d])
        upper[:d] = np.minimum(upper[:d], (self.model.upper - state.parameters) / scale[:d])
        step = bounded_step(damped, scaled_gradient, lower, upper)
        predicted = -(scaled_gradient @ step + 0.5 * step @ scaled_hessian @ step)
        return step, float(predicted)

    def _inside(self, state: State) -> State:
        """Rounding may leave a parameter an ulp outside its range; bring it back exactly."""
        return replace(state, parameters=np.clip(state.parameters, self.model.lower, self.model.upper))

    def _finish(
        self,
        state: State,
        cost: float,
        hessian: Array,
        residuals: Array,
        weights: Array,
        numbers: NDArray[np.integer],
        iterations: int,
        converged: bool,
    ) -> Estimate:
        model = self.model
        used = (weights > 0.0) & np.isfinite(residuals).all(axis=1)
        sigma, covariance = huber_covariance(
            hessian, residuals[used], weights[used], numbers[used], self.options.huber_px, self.scale
        )
        margin = BOUND_SHARE * (model.upper - model.lower)
        at_bound = (state.parameters < model.lower + margin) | (state.parameters > model.upper - margin)
        return Estimate(state, cost, residuals, sigma, covariance, at_bound, iterations, converged)
