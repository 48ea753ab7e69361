"""Parameters and pose from pixels: Levenberg-Marquardt with Huber weights inside the parameter box."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.model import ReducedModel
from morph_dslam.online.estimation.depth_residuals import PointDepths
from morph_dslam.online.estimation.levenberg_marquardt import Box, Minimum, minimise
from morph_dslam.online.estimation.linear_cost import LinearCost
from morph_dslam.online.estimation.prior import Prior
from morph_dslam.online.estimation.reprojection import linearise
from morph_dslam.online.estimation.robust_covariance import huber_covariance
from morph_dslam.online.estimation.state import BoundPoints, State, moved
from morph_dslam.online.uncertainty.measurement_noise import Measured

__all__ = ["BoundPoints", "Estimate", "EstimationOptions", "Estimator", "Prior", "State", "moved"]

Array = NDArray[np.float64]

#: A parameter nearer to its bound than this share of its range counts as being at the bound.
BOUND_SHARE = 1e-3


@dataclass(frozen=True)
class EstimationOptions:
    """When to stop, and what is too far off.

    Attributes
    ----------
    huber_px : residual length where Huber's cost turns linear; above what a model that is a little off leaves
        over wide parts of the surface, which are no outliers.
    tolerance : relative decrease of the cost below which the iteration ends. With some hundred residuals
        what is left to gain is then less than a tenth of a standard deviation.
    """

    huber_px: float = 3.0
    max_iterations: int = 25
    tolerance: float = 1e-5


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
        self.box = Box.of(model)

    @property
    def scale(self) -> Array:
        """Of the unknowns (d + 6,): half a parameter range, one radian, the object's size."""
        return self.box.scale

    def evaluate(
        self,
        points: BoundPoints,
        pixels: Array,
        weights: Array,
        state: State,
        normals: Array | None = None,
        prior: Prior | None = None,
        depths: PointDepths | None = None,
    ) -> tuple[float, Array, Array, Array]:
        """Cost, Hessian, gradient and residuals of pixels at a state; see `reprojection.linearise`.

        Parameters
        ----------
        points : p of them. pixels : (p, 2). weights : (p,).
        normals : (p, 2), zero but for points on an outline.

        Returns
        -------
        Cost in squared pixels, Hessian (d + 6, d + 6), gradient (d + 6,), residuals (p, 2).
        """
        pose = state.camera_from_object
        normals = np.zeros_like(pixels) if normals is None else normals
        cost, hessian, gradient, residuals = self._linearise(
            points.field.functions.rows(state.parameters), pose.rotation, pose.translation, points.rest,
            points.field.modes, self.camera.intrinsics, pixels, weights, normals, self.options.huber_px,
        )  # fmt: skip
        others = [] if prior is None else [prior.terms(state)]
        if depths is not None:
            others.append(depths.terms(points, state)[:3])
        for terms in others:
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
        depths: PointDepths | None = None,
    ) -> Estimate:
        """Minimise the Huber cost from ``start``.

        Parameters
        ----------
        pixels : (p, 2) measured, in the undistorted image.
        weights : (p,) non-negative; points of weight 0 are ignored (their residuals are still reported).
        normals : (p, 2), for points that count only along a direction; see `reprojection.linearise`.
        prior : what is known of the parameters and the pose beforehand; nothing by default.
        depths : of the p points, where a depth camera saw them.
        """
        normals = np.zeros_like(pixels) if normals is None else normals

        def evaluate(state: State) -> tuple[float, Array, Array, Array]:
            return self.evaluate(points, pixels, weights, state, normals, prior, depths)

        found = minimise(evaluate, start, self.box, self.options.max_iterations, self.options.tolerance)
        # A point on an outline gives one number, all others give two.
        numbers = np.where((normals != 0.0).any(axis=1), 1, 2)
        return self.finished(found, weights, numbers)

    def fit(self, measured: Measured, start: State, prior: Prior | None = None) -> Estimate:
        """`estimate` from all that was measured in a frame."""
        return self.estimate(
            measured.points,
            measured.pixels,
            measured.weights,
            start,
            measured.normals,
            prior,
            measured.depths,
        )

    def linear(self, measured: Measured, estimate: Estimate) -> LinearCost:
        """The cost of what was measured, about an estimate made from it."""
        huber = self.options.huber_px
        return LinearCost.about(measured, estimate.state, estimate.residuals, self.camera, huber, self.scale)

    def estimate_from(
        self, points: BoundPoints, pixels: Array, weights: Array, starts: Sequence[State]
    ) -> list[Estimate]:
        """Minimise, as `estimate` does, from several starts; the estimates in order of their cost."""
        found = [self.estimate(points, pixels, weights, start) for start in starts]
        return sorted(found, key=lambda estimate: estimate.cost)

    def finished(self, found: Minimum, weights: Array, numbers: NDArray[np.integer]) -> Estimate:
        """The estimate at a minimum; ``numbers`` (p,) says how many each point gives."""
        model, state, residuals = self.model, found.state, found.residuals
        used = (weights > 0.0) & np.isfinite(residuals).all(axis=1)
        sigma, covariance = huber_covariance(
            found.hessian,
            residuals[used],
            weights[used],
            numbers[used],
            self.options.huber_px,
            self.box.scale,
        )
        margin = BOUND_SHARE * (model.upper - model.lower)
        at_bound = (state.parameters < model.lower + margin) | (state.parameters > model.upper - margin)
        return Estimate(
            state, found.cost, residuals, sigma, covariance, at_bound, found.iterations, found.converged
        )
