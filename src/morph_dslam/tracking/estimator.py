"""The estimator: pose and parameters of a frame by the least reprojection error, and how well they are known.

The unknowns are stacked as [parameters (d), rotation vector (3), translation (3)], as in `reprojection`.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.model import ReducedModel
from morph_dslam.model.model_errors import ModelDeviation
from morph_dslam.tracking.covariance import EIGENVALUE_FLOOR, huber_covariance
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.known_values import KnownParameters
from morph_dslam.tracking.levenberg_marquardt import Box, Minimum, minimise
from morph_dslam.tracking.load_prior import LoadOptions, LoadPrior
from morph_dslam.tracking.noise import Correlation, Observations, quadratic
from morph_dslam.tracking.option_values import CheckedOptions, NotNegative, Positive, PositiveCount
from morph_dslam.tracking.reprojection import linearise, project_with_jacobian, weighted_derivatives
from morph_dslam.tracking.state import BoundPoints, Prior, State, moved

Array = NDArray[np.float64]


#: What is known beforehand of an unknown that is hardly measured itself counts for this part of what is measured of the
#: best one at least: well above `EIGENVALUE_FLOOR`.
KNOWN_SHARE = 1e-6


@dataclass(frozen=True)
class LinearCost:
    """A cost about its minimum.

    Attributes
    ----------
    weighted_jacobian : (p, 2, n) by which an error of a pixel enters the gradient, in units of what a point
        of weight 1 is off by
    of_depths : (n, n), covariance of the gradient from errors of depths, and of what is known of unknown loads
    hessian : (n, n).
    scale : (n,) of the unknowns.
    correlation : (p, p) of the points' errors.
    in_common : (k, n) by which errors of whole outlines, each in its deviation, enter the gradient; the same in all
        frames.
    """

    weighted_jacobian: Array
    of_depths: Array
    hessian: Array
    scale: Array
    correlation: Correlation
    in_common: Array

    @classmethod
    def about(
        cls, measured: Observations, state: State, residuals: Array, camera: Camera, huber_px: float, scale: Array
    ) -> LinearCost:
        """That of the measurements of a frame, about a state that leaves these residuals (p, 2)."""
        points, seen = measured.points, (residuals, measured.weights, measured.normals, huber_px)
        weighted_jacobian, hessian, of_one_px = weighted_derivatives(*points.in_state(state), camera.intrinsics, *seen)
        of_depths = np.zeros_like(hessian)
        if measured.depths is not None:
            _, part, _, far = measured.depths.terms(points, state)
            hessian, of_depths = hessian + part, measured.depths.variance_px(far) * part
        in_common = measured.common_px * of_one_px
        return cls(weighted_jacobian, of_depths, hessian, scale, measured.correlation, in_common)

    def in_unknowns(self, chain: Array) -> LinearCost:
        """The same cost of other unknowns, whose increments ``chain`` (n, m) turns into these."""
        hessian, of_depths = (chain.T @ matrix @ chain for matrix in (self.hessian, self.of_depths))
        rows, in_common = self.weighted_jacobian @ chain, self.in_common @ chain
        return LinearCost(rows, of_depths, hessian, self.scale, self.correlation, in_common)

    def holding(self, indices: NDArray[np.int64]) -> LinearCost:
        """The same cost with the unknowns at ``indices`` (k,) known: how well the others are then."""
        rows, of_depths, hessian = self.weighted_jacobian.copy(), self.of_depths.copy(), self.hessian.copy()
        largest = float(np.max(np.diag(hessian) * self.scale**2))
        in_common = self.in_common.copy()
        rows[:, :, indices], in_common[:, indices] = 0.0, 0.0
        for matrix in (of_depths, hessian):
            matrix[indices], matrix[:, indices] = 0.0, 0.0
        hessian[indices, indices] = max(largest, 1e-30) / self.scale[indices] ** 2
        return LinearCost(rows, of_depths, hessian, self.scale, self.correlation, in_common)

    def with_known(self, hessian: Array) -> LinearCost:
        """The same cost with what is known of the unknowns beforehand in its Hessian (n, n).

        What is known far better than measured, as a pose that is held, does not make the rest seem to be seen. What is
        known but not measured at all is seen.
        """
        squared = self.scale**2
        measured, whole = np.diag(self.hessian) * squared, np.diag(hessian) * squared
        counts = np.maximum(measured, np.minimum(whole, measured.max(initial=0.0) * KNOWN_SHARE))
        shares = np.where((counts > 0.0) & (whole > counts), counts / np.where(whole > 0.0, whole, 1.0), 1.0)
        return replace(self, hessian=hessian, scale=self.scale * np.sqrt(shares))

    @staticmethod
    def joined(costs: Sequence[LinearCost], correlation: Correlation) -> LinearCost:
        """The sum of costs of the same unknowns, their points, with errors of this correlation, one after the other."""
        return LinearCost(
            np.concatenate([cost.weighted_jacobian for cost in costs]),
            np.sum([cost.of_depths for cost in costs], axis=0),
            np.sum([cost.hessian for cost in costs], axis=0),
            costs[0].scale,
            correlation,
            np.concatenate([cost.in_common for cost in costs]),
        )

    @cached_property
    def spread(self) -> Array:
        """The gradient's covariance (n, n) from errors of the points, of variance one at weight one."""
        return quadratic(self.weighted_jacobian, self.correlation)

    @cached_property
    def _spectrum(self) -> tuple[Array, Array, float]:
        """Eigenvalues and eigenvectors in scaled unknowns, and the least value that counts."""
        values, vectors = np.linalg.eigh(self.hessian * np.outer(self.scale, self.scale))
        return values, self.scale[:, None] * vectors, max(values[-1], 1e-30) * EIGENVALUE_FLOOR

    @cached_property
    def inverse(self) -> Array:
        """H^-1 (n, n); what is not seen at all gets the inverse of the least value."""
        values, vectors, floor = self._spectrum
        return (vectors / np.maximum(values, floor)) @ vectors.T

    @property
    def inverse_of_seen(self) -> Array:
        """H^-1 (n, n); nothing moves along what is not seen at all."""
        values, vectors, floor = self._spectrum
        return (vectors * np.where(values > floor, 1.0 / np.maximum(values, floor), 0.0)) @ vectors.T

    @property
    def unseen(self) -> Array:
        """The part (n, n) of `inverse` that is not seen at all."""
        values, vectors, floor = self._spectrum
        return (vectors * np.where(values > floor, 0.0, 1.0 / floor)) @ vectors.T


__all__ = ["BoundPoints", "Estimate", "EstimationOptions", "Estimator", "Prior", "State", "moved"]
#: A parameter nearer to its bound than this share of its range counts as being at the bound.
BOUND_SHARE = 1e-3


@dataclass(frozen=True)
class EstimationOptions(CheckedOptions):
    """When to stop, and what is too far off.

    Attributes
    ----------
    huber_px : residual length where Huber's cost turns linear; above what a model that is a little off leaves
        over wide parts of the surface, which are no outliers.
    tolerance : relative decrease of the cost below which the iteration ends. With some hundred residuals
        what is left to gain is then less than a tenth of a standard deviation.
    loads : how unknown loads are estimated, where the model has them.
    """

    huber_px: Positive = 3.0
    max_iterations: PositiveCount = 25
    tolerance: NotNegative = 1e-5
    loads: LoadOptions = field(default_factory=LoadOptions)


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
    at_bound : (d,) parameters that ended at a bound of the box, but for those that are known beforehand.
    iterations, converged : how the iteration ended.
    measured_covariance : the covariance without any prior on the parameters, and without what their ranges say of their
        errors; None where neither is in the other one.
    stated_covariance : the covariance before the residuals widen it, by what they show that model and reference are off
        by; None where they do not.
    by_model : what the model's own errors have added to the covariance; None where they have not.
    of_shape : (d + 6, d + 6), the covariance of shape and pose where ``by_model`` is not None.
    flat : (d,) variances that come to those of the parameters, but not to those of shape, stress and forces, because a
        parameter changes nothing on one side (`flat_sides`); None where all do.
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
    stated_covariance: Array | None = None
    by_model: ModelDeviation | None = None
    of_shape: Array | None = None
    flat: Array | None = None

    @property
    def image_covariance(self) -> Array:
        """The covariance (d + 6, d + 6) of shape and pose.

        The model's own errors make parameters wrong. Shape and pose they touch where a sensor holds a parameter.
        """
        return self.covariance if self.of_shape is None else self.of_shape

    @property
    def model_displacement(self) -> float:
        """What the model's own errors add to positions in the camera frame, root mean square length, metres."""
        return 0.0 if self.by_model is None else self.by_model.displacement

    @property
    def model_displacement_in_object(self) -> float:
        """What they add to the displacement in the object frame, where what the pose makes good is an error too."""
        return 0.0 if self.by_model is None else self.by_model.in_object

    @property
    def parameter_std(self) -> Array:
        """Standard deviations of the parameters (d,), SI; very large where the images do not tell."""
        variances = np.diag(self.covariance)[: len(self.state.parameters)]
        return np.sqrt(variances if self.flat is None else variances + self.flat)

    @property
    def stated_std(self) -> Array:
        """Standard deviations of the parameters (d,), SI, before the residuals widen them."""
        stated = self.covariance if self.stated_covariance is None else self.stated_covariance
        return np.sqrt(np.diag(stated)[: len(self.state.parameters)])

    @property
    def pose_std(self) -> Array:
        """Standard deviations (6,) of the rotation vector (rad) and the translation (m)."""
        return np.sqrt(np.diag(self.covariance)[len(self.state.parameters) :])


class Estimator:
    """Finds states from pixels of bound points, with one camera and one model."""

    def __init__(self, model: ReducedModel, camera: Camera, options: EstimationOptions | None = None) -> None:
        self.model, self.camera = model, camera
        self.options = options or EstimationOptions()
        self.box = Box.of(model)
        self.loads = None if model.energy is None else LoadPrior(model.energy, self.options.loads)
        self.known = KnownParameters(model)

    @property
    def _place_of_loads(self) -> slice:
        """Of the coefficients of unknown loads among the unknowns."""
        d = len(self.model.parameters)
        return slice(d - self.model.n_loads, d)

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
        points : p of them
        pixels : (p, 2)
        weights : (p,).
        normals : (p, 2), zero but for points on an outline.

        Returns
        -------
        Cost in squared pixels, Hessian (d + 6, d + 6), gradient (d + 6,), residuals (p, 2).
        """
        normals = np.zeros_like(pixels) if normals is None else normals
        cost, hessian, gradient, residuals = self.of_pixels(points, pixels, weights, state, normals)
        others = [] if prior is None else [prior.terms(state)]
        if depths is not None:
            others.append(depths.terms(points, state)[:3])
        for terms in others:
            cost, hessian, gradient = cost + terms[0], hessian + terms[1], gradient + terms[2]
        if self.loads is not None:
            of_loads, information, push = self.loads.terms(state.parameters)
            cost, place = cost + of_loads, self._place_of_loads
            hessian[place, place] += information
            gradient[place] += push
        if len(self.known.indices):
            of_known, information, push = self.known.terms(state.parameters)
            cost, rows = cost + of_known, self.known.indices
            hessian[rows, rows] += information
            gradient[rows] += push
        return cost, hessian, gradient, residuals

    def of_pixels(
        self, points: BoundPoints, pixels: Array, weights: Array, state: State, normals: Array
    ) -> tuple[float, Array, Array, Array]:
        """What `evaluate` gives of the pixels alone."""
        seen = pixels, weights, normals, self.options.huber_px
        return linearise(*points.in_state(state), self.camera.intrinsics, *seen)

    def jacobian(self, points: BoundPoints, state: State) -> Array:
        """Derivatives (p, 2, d + 6) of the points' pixels at a state; NaN behind the camera."""
        return project_with_jacobian(*points.in_state(state), self.camera.intrinsics)[1]

    def within(self, box: Box) -> Self:
        """The same, whose parameters stay in another box."""
        found = copy(self)
        found.box = box
        return found

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
        found = self.minimum(points, pixels, weights, start, normals, prior, depths)
        # A point on an outline gives one number, all others give two.
        return self.finished(found, weights, 2 - (normals != 0.0).any(axis=1))

    def minimum(
        self,
        points: BoundPoints,
        pixels: Array,
        weights: Array,
        start: State,
        normals: Array | None = None,
        prior: Prior | None = None,
        depths: PointDepths | None = None,
    ) -> Minimum:
        """The minimum that `estimate` finds, where nobody asks how exact it is."""
        normals = np.zeros_like(pixels) if normals is None else normals
        return minimise(
            lambda state: self.evaluate(points, pixels, weights, state, normals, prior, depths),
            start, self.known.bounded(self.box), self.options.max_iterations, self.options.tolerance,
        )  # fmt: skip

    def fit(self, measured: Observations, start: State, prior: Prior | None = None) -> Estimate:
        """`estimate` from all that was measured in a frame."""
        return self.finished(self.fitted(measured, start, prior), measured.weights, measured.numbers)

    def restated(self, measured: Observations, estimate: Estimate, prior: Prior | None = None) -> Estimate:
        """An estimate with deviations by its residuals, and by what is known now, not when it was made."""
        cost, hessian, _, _ = self.evaluated(measured, estimate.state, prior)
        minimum = Minimum(estimate.state, cost, hessian, estimate.residuals, estimate.iterations, estimate.converged)
        return self.finished(minimum, measured.weights, measured.numbers)

    def evaluated(
        self, measured: Observations, state: State, prior: Prior | None = None
    ) -> tuple[float, Array, Array, Array]:
        """`evaluate` of all that was measured in a frame."""
        return self.evaluate(
            measured.points, measured.pixels, measured.weights, state, measured.normals, prior, measured.depths
        )

    def fitted(self, measured: Observations, start: State, prior: Prior | None = None) -> Minimum:
        """`minimum` of all that was measured in a frame."""
        return self.minimum(
            measured.points, measured.pixels, measured.weights, start, measured.normals, prior, measured.depths
        )

    def linear(self, measured: Observations, estimate: Estimate) -> LinearCost:
        """The cost of what was measured, about an estimate made from it."""
        huber = self.options.huber_px
        linear = LinearCost.about(measured, estimate.state, estimate.residuals, self.camera, huber, self.scale)
        information, of_priors = self.known_information(estimate.state.parameters)
        return replace(linear, hessian=linear.hessian + information, of_depths=linear.of_depths + of_priors)

    def known_information(self, parameters: Array) -> tuple[Array, Array]:
        """What unknown loads and known parameters add to the Hessian at parameters (d,), and its covariance.

        Both (d + 6, d + 6): the second is that of the gradient by what is known.
        """
        hessian, of_priors = np.zeros((len(self.scale),) * 2), np.zeros((len(self.scale),) * 2)
        if self.loads is not None:
            information, place = self.loads.terms(parameters)[1], self._place_of_loads
            hessian[place, place] += information
            of_priors[place, place] += self.loads.squared_px * information
        rows, information = self.known.indices, self.known.terms(parameters)[1]
        hessian[rows, rows] += information
        of_priors[rows, rows] += self.known.squared_px * information
        return hessian, of_priors

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
            found.hessian, residuals[used], weights[used], numbers[used], self.options.huber_px, self.box.scale
        )
        margin = BOUND_SHARE * (model.upper - model.lower)
        at_bound = (state.parameters < model.lower + margin) | (state.parameters > model.upper - margin)
        at_bound[self.known.indices] = False  # a sensor or a clock says where they are
        return Estimate(state, found.cost, residuals, sigma, covariance, at_bound, found.iterations, found.converged)
