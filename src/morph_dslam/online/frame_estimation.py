"""Estimating the object's state in one frame from what is measured against the reference view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.attempt import Attempt, Picture
from morph_dslam.online.estimation import Estimate, Estimator, Prior, State
from morph_dslam.online.measurement import Measurement
from morph_dslam.online.reference_view import ReferenceView
from morph_dslam.online.shape_search import ShapeSearch
from morph_dslam.online.timing import StageClock
from morph_dslam.online.tracker_options import TrackerOptions

#: Share of the cost below which another shape is a better explanation and not the same one.
CLEARLY_BETTER = 0.95


class FrameEstimation:
    """Makes attempts at one frame after the other; priors are what the map tells of the pose, if anything."""

    def __init__(self, estimator: Estimator, reference: ReferenceView, options: TrackerOptions) -> None:
        self._estimator, self._reference, self._options = estimator, reference, options
        self._search = ShapeSearch(estimator.model, options.searches)
        brief = replace(options.estimation, max_iterations=10, tolerance=1e-3)
        self._scout = Estimator(estimator.model, estimator.camera, brief)

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
        return Attempt(estimate, used, measurement, prior)

    def _estimate(
        self, measurement: Measurement, used: NDArray[np.bool_], start: State, prior: Prior | None
    ) -> Estimate:
        return self._estimator.estimate(
            self._reference.points, measurement.pixels, used.astype(float), start, prior=prior
        )

    def search_other_shapes(self, attempt: Attempt) -> Attempt:
        """The attempt, or a clearly better explanation of its measurements reached from another shape."""
        measurement, estimate, prior = attempt.measurement, attempt.estimate, attempt.prior
        if not self._options.search_above_px < estimate.sigma_px < np.inf:
            return attempt
        points, weights = self._reference.points, measurement.valid.astype(float)
        cost = self._estimator.evaluate(points, measurement.pixels, weights, estimate.state, prior=prior)[0]
        starts = self._search.next_starts(estimate.state.camera_from_object)
        found = [
            self._scout.estimate(points, measurement.pixels, weights, start, prior=prior) for start in starts
        ]
        best = min(found, key=lambda other: other.cost)
        if best.cost > CLEARLY_BETTER * cost:
            return attempt
        return self._trimmed(measurement, best.state, prior)

    def fit_outline(self, picture: Picture, attempt: Attempt) -> Attempt:
        """Estimate from the supporting points and the outline together; searched far first, then near."""
        outline, options = self._reference.outline, self._options.outline
        if outline is None:
            return attempt
        estimate, count, seen = attempt.estimate, len(self._reference.points), None
        for reach in (options.reach_px, options.reach_px // 2):
            seen = outline.measure(picture.grey, estimate.state, reach)
            estimate = self._estimator.estimate(
                self._reference.all_points,
                np.concatenate([attempt.measurement.pixels, seen.pixels]),
                np.concatenate([attempt.inliers, options.weight * seen.valid]).astype(float),
                estimate.state,
                np.concatenate([np.zeros((count, 2)), seen.normals]),
                attempt.prior,
            )
        return replace(attempt, estimate=estimate, outline=seen)
