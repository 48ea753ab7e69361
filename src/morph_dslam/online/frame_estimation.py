"""Estimating the object's state in one frame from what is measured against the reference view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.attempt import Attempt, Picture
from morph_dslam.online.estimation.depth_residuals import PointDepths
from morph_dslam.online.estimation.estimator import Estimate, Estimator, Prior, State
from morph_dslam.online.estimation.shape_search import BoundSearch, ShapeSearch
from morph_dslam.online.measuring.measurement import Measurement
from morph_dslam.online.reference.reference_view import ReferenceView
from morph_dslam.online.timing import StageClock
from morph_dslam.online.tracker_options import TrackerOptions
from morph_dslam.online.uncertainty.measurement_noise import Measured, window_correlation
from morph_dslam.online.uncertainty.point_noise import PointNoise

#: Share of the cost below which another shape is a better explanation and not the same one.
CLEARLY_BETTER = 0.95
#: The least spread of residuals, pixels, that is believed when they are weighed against depths.
LEAST_SIGMA_PX = 0.1


class FrameEstimation:
    """Makes attempts at one frame after the other; priors are what the map tells of the pose, if anything."""

    def __init__(self, estimator: Estimator, reference: ReferenceView, options: TrackerOptions) -> None:
        self._estimator, self._reference, self._options = estimator, reference, options
        self._noise = PointNoise()
        self._search = ShapeSearch(estimator.model, options.searches)
        self._off_bound = BoundSearch(estimator.model, options.searches)
        brief = replace(options.estimation, max_iterations=10, tolerance=1e-3)
        self._scout = Estimator(estimator.model, estimator.camera, brief)

    def rough(self, followed: Measurement, start: State, prior: Prior | None) -> State:
        """The state by what was followed from the previous frame; only a start for `correct`."""
        weights = followed.valid.astype(float)
        return self._scout.estimate(
            self._reference.points, followed.pixels, weights, start, prior=prior
        ).state

    def correct(
        self,
        picture: Picture,
        state: State,
        followed: Measurement | None,
        prior: Prior | None,
        clock: StageClock,
    ) -> Attempt:
        """Measure against the reference view rendered in ``state`` and estimate from these measurements."""
        measurement = self._reference.measure(picture, state, followed, clock)
        with clock.stage("estimate"):
            return self._trimmed(measurement, state, prior)

    def _trimmed(self, measurement: Measurement, start: State, prior: Prior | None) -> Attempt:
        """Estimate from all valid measurements, then from those that agree with the first estimate."""
        estimate, used = None, measurement.valid
        for _ in range(2):
            estimate = self._estimate(measurement, used, start, prior)
            limit = np.clip(self._options.inlier_sigmas * estimate.sigma_px, *self._options.inlier_px)
            with np.errstate(invalid="ignore"):
                close = np.linalg.norm(estimate.residuals, axis=1) < limit
            agreeing = measurement.valid & close
            if (agreeing == used).all():
                break
            start, used = estimate.state, agreeing
        assert estimate is not None
        return Attempt(estimate, used, measurement, self._noise.weights(measurement.spread, used), prior)

    def _estimate(
        self, measurement: Measurement, used: NDArray[np.bool_], start: State, prior: Prior | None
    ) -> Estimate:
        weights = self._noise.weights(measurement.spread, used)
        return self._estimator.estimate(
            self._reference.points, measurement.pixels, weights, start, prior=prior
        )

    def learn(self, attempt: Attempt) -> None:
        """Take in how well the points agreed in a frame that is believed."""
        residuals = attempt.estimate.residuals[: len(attempt.inliers)]
        self._noise.learn(attempt.measurement.spread, residuals, attempt.inliers)

    def search_other_shapes(self, attempt: Attempt) -> Attempt:
        """The attempt, or a clearly better explanation of its measurements reached from another shape."""
        if not attempt.estimate.sigma_px < np.inf:
            return attempt
        starts = self._off_bound.next_starts(attempt.estimate)
        if starts:
            attempt = self.best_of(attempt, starts)
        if not self._options.search_above_px < attempt.estimate.sigma_px:
            return attempt
        return self.best_of(attempt, self._search.next_starts(attempt.estimate.state.camera_from_object))

    def best_of(self, attempt: Attempt, starts: list[State]) -> Attempt:
        """The attempt, or a clearly better explanation of its measurements reached from one of the starts."""
        measurement, estimate, prior = attempt.measurement, attempt.estimate, attempt.prior
        points, weights = self._reference.points, self._noise.weights(measurement.spread, measurement.valid)
        cost = self._estimator.evaluate(points, measurement.pixels, weights, estimate.state, prior=prior)[0]
        found = [
            self._scout.estimate(points, measurement.pixels, weights, start, prior=prior) for start in starts
        ]
        best = min(found, key=lambda other: other.cost, default=estimate)
        if best.cost > CLEARLY_BETTER * cost:
            return attempt
        return self._trimmed(measurement, best.state, prior)

    def fit_outline(self, picture: Picture, attempt: Attempt) -> Attempt:
        """Estimate from the supporting points and the outline together; searched far first, then near."""
        outline, options = self._reference.outline, self._options.outline
        if outline is None:
            return attempt
        estimate, count, seen = attempt.estimate, len(self._reference.points), None
        # After the first search the state only says where to look the second time: it need not be exact.
        for reach, estimator in ((options.reach_px, self._scout), (options.reach_px // 2, self._estimator)):
            seen = outline.measure(picture.grey, estimate.state, reach)
            estimate = estimator.estimate(
                self._reference.all_points,
                np.concatenate([attempt.measurement.pixels, seen.pixels]),
                np.concatenate([attempt.weights, np.where(seen.valid, options.weight, 0.0)]),
                estimate.state,
                np.concatenate([np.zeros((count, 2)), seen.normals]),
                attempt.prior,
            )
        return replace(attempt, estimate=estimate, outline=seen)

    def fit_depths(self, picture: Picture, attempt: Attempt) -> Attempt:
        """Estimate with the depths of the supporting points too, if a depth camera saw them."""
        if picture.depth is None:
            return attempt
        # Points whose windows overlap err alike in the image, and each counts for less than its depth does.
        squared_px = self._reference.redundancy * max(attempt.estimate.sigma_px, LEAST_SIGMA_PX) ** 2
        pixels, camera, options = attempt.measurement.pixels, self._estimator.camera, self._options.depth
        depths = PointDepths.sampled(
            picture.depth, pixels, attempt.inliers, camera, squared_px, options
        ).padded(len(self._reference.all_points))
        attempt = replace(attempt, depths=depths)
        seen = self.measured(attempt)
        estimate = self._estimator.estimate(
            seen.points,
            seen.pixels,
            seen.weights,
            attempt.estimate.state,
            seen.normals,
            attempt.prior,
            depths,
        )
        return replace(attempt, estimate=estimate)

    def measured(self, attempt: Attempt) -> Measured:
        """All that an attempt was made from, the outline's points after the others."""
        pixels, weights = attempt.measurement.pixels, attempt.weights
        normals, seen = np.zeros_like(pixels), attempt.outline
        if seen is not None:
            pixels, normals = np.concatenate([pixels, seen.pixels]), np.concatenate([normals, seen.normals])
            weights = np.concatenate([weights, np.where(seen.valid, self._options.outline.weight, 0.0)])
        correlation = window_correlation(pixels, self._options.measurement.window)
        return Measured(self._reference.all_points, pixels, weights, normals, correlation, attempt.depths)
