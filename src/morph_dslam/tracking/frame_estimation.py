"""Estimating the object's state in one frame from what is measured against the reference view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.timing import stage
from morph_dslam.tracking.beside_texture import BesideTexture
from morph_dslam.tracking.compact_loads import LEAST_GAIN
from morph_dslam.tracking.estimator import Estimator, Prior, State
from morph_dslam.tracking.frame_starts import ShapeSearch
from morph_dslam.tracking.hypothesis import Image, PoseHypothesis, reject
from morph_dslam.tracking.measurement import Followed, Measurement
from morph_dslam.tracking.motion_blur import ReferenceBlur, blurred_paths, path_length
from morph_dslam.tracking.noise import PointNoise, middle
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.other_tilt import LIKELIER, find_other_tilt
from morph_dslam.tracking.outline_alone import OutlineAlone
from morph_dslam.tracking.outline_weight import OutlineBalance
from morph_dslam.tracking.patches import zero_where_unknown
from morph_dslam.tracking.reference import ReferenceView
from morph_dslam.tracking.row_motion import RowMotion
from morph_dslam.tracking.state import BoundPoints
from morph_dslam.tracking.systematic_errors import SystematicErrors

Array = NDArray[np.float64]
_Measured = tuple[BoundPoints, Array, Array]
#: Share of the cost below which another shape is a better explanation and not the same one; where the residuals are
#: small, so that noise may prefer another shape, it is better below the second share.
CLEARLY_BETTER, MUCH_BETTER = 0.95, 0.8
#: Other shapes are tried on at least so many points, where there are as many, and at most twice as many.
SCOUTED = 80
#: A shape is measured again where what windows miss of its change is more than this share of the noise of all points
#: together, a standard deviation of whatever they tell best; at most so often.
MISSED_SHARE, MOST_COMPARISONS = 0.5, 2


class FrameEstimation:
    """Makes attempts at one frame after the other; priors are what the map tells of the pose, if anything.

    `correct` makes one from the points, and `with_all` adds what else the frame shows.

    Attributes
    ----------
    beside : adds outline and depths to an attempt.
    alone : makes attempts where the outline is all there is.
    """

    def __init__(self, estimator: Estimator, reference: ReferenceView, options: TrackerOptions) -> None:
        self._estimator, self._reference, self._options = estimator, reference, options
        self._noise, self._reference_blur = PointNoise(), ReferenceBlur()
        brief = replace(options.estimation, max_iterations=10, tolerance=1e-3)
        self._scout = Estimator(estimator.model, estimator.camera, brief)
        self._scout.loads, self._scout.known = estimator.loads, estimator.known
        self._search, balance = ShapeSearch(estimator.model, options.searches), OutlineBalance()
        made_by = estimator, self._scout, reference, options, balance
        self.beside, self.alone = BesideTexture(*made_by), OutlineAlone(*made_by, self._search)
        self._study_scout: Estimator | None = None
        if (energy := estimator.model.energy) is not None and len(energy.model.parameters) > 0:
            self._study_scout = Estimator(energy.model, estimator.camera, brief)
            self._study_scout.known = estimator.known
        self._last_few_and_all: tuple[Measurement, tuple[_Measured, _Measured]] | None = None

    def rough(self, followed: Followed, start: State, prior: Prior | None) -> State:
        """The state by what was followed from the previous frame; only a start for `correct`."""
        weights = followed.valid.astype(float)
        return self._scout.minimum(self._reference.points, followed.pixels, weights, start, prior=prior).state

    def correct(self, picture: Image, state: State, offsets: Array | None, prior: Prior | None) -> PoseHypothesis:
        """Measure against the reference view rendered in ``state`` and estimate from these measurements.

        ``offsets`` : see `ReferenceView.measure`.
        """
        measurement = self._reference.measure(picture, state, offsets)
        with stage("estimate"):
            motion = None if picture.motion is None else picture.motion.of_points
            return self._trimmed(measurement, state, prior, motion)

    def with_all(self, picture: Image, attempt: PoseHypothesis, systematic: SystematicErrors | None) -> PoseHypothesis:
        """An attempt that is accepted, by all that the frame shows: points, outline and depths, in the likelier tilt.

        ``systematic`` : of the points, which outline and depths tell of.
        """
        self.weigh_known(attempt)
        with stage("search"):  # of one that was found otherwise than from the last state, too
            attempt = self.in_likelier_tilt(attempt)
        if not attempt.outline_alone:
            attempt = replace(attempt, by_points=attempt.estimate.state)
        with stage("outline"):
            attempt = self.beside.fit_outline(picture, attempt, systematic)
        with stage("depth"):
            attempt = self.beside.fit_depths(picture, attempt, systematic)
        with stage("search"):
            return self.with_other_tilt(attempt)

    def correct_shape(self, picture: Image, attempt: PoseHypothesis) -> PoseHypothesis:
        """Measure again in the state that was found, as long as windows miss a part of the change that would show.

        A window shows the mean of what moves in it. Of a change of shape that varies from one patch to the next, a
        share is missing after each comparison: after the next one, that share of the share. One that would be rejected
        does not take the place of the one before.
        """
        for _ in range(MOST_COMPARISONS):
            state, found = attempt.estimate.state, attempt.measurement
            if found.drawing is None or attempt.outline_alone or reject(attempt, self._options) is not None:
                break
            projected = self._reference.projected(state)
            change = projected - self._reference.projected(found.drawing.state)
            per_metre = self._estimator.camera.fx / middle(self._reference.points.in_camera(state)[:, 2])
            missed = self._reference.window_means.missed(change, per_metre)[attempt.inliers]
            noise = np.sqrt(self._reference.redundancy) * attempt.estimate.sigma_px
            if np.linalg.norm(missed) <= MISSED_SHARE * noise:
                break
            offsets = np.where(attempt.inliers[:, None], zero_where_unknown(found.recorded - projected), 0.0)
            again = self.correct(picture, state, offsets, attempt.prior)
            if reject(again, self._options) is not None:
                self.weigh_known(attempt)
                break
            attempt = again
        return attempt

    def weigh_known(self, attempt: PoseHypothesis) -> None:
        """Weigh what is known of parameters by an attempt that is kept: others may have been made after it."""
        if not attempt.outline_alone:
            self._estimator.known.learn(attempt.estimate.sigma_px)

    def _trimmed(
        self, measurement: Measurement, start: State, prior: Prior | None, motion: RowMotion | None = None
    ) -> PoseHypothesis:
        """Estimate from all valid measurements, then from those that agree with the first estimate.

        ``motion`` : by which pixels are moved to the middle row's instant; None to leave them.
        """
        estimate, used = None, measurement.valid
        for _ in range(2):
            if motion is not None:
                shift = motion.shift(self._reference.projected, start, measurement.recorded)
                measurement = replace(measurement, pixels=measurement.recorded - shift)
            weights = self._noise.weights(measurement.spread, used)
            estimate = self._estimator.estimate(self._reference.points, measurement.pixels, weights, start, prior=prior)
            self._estimator.known.learn(estimate.sigma_px)
            limit = np.clip(self._options.inlier_sigmas * estimate.sigma_px, *self._options.inlier_px)
            with np.errstate(invalid="ignore"):
                close = np.linalg.norm(estimate.residuals, axis=1) < limit
            agreeing = measurement.valid & close
            if motion is None and (agreeing == used).all():
                break
            start, used = estimate.state, agreeing
        assert estimate is not None
        return PoseHypothesis(estimate, used, measurement, self._noise.weights(measurement.spread, used), prior)

    def learn(self, attempt: PoseHypothesis, picture: Image) -> None:
        """Take in how well the points agreed in a frame that is believed."""
        if attempt.outline_alone:
            self.alone.learn(attempt, picture)
            return
        residuals = attempt.estimate.residuals[: len(attempt.inliers)]
        self._noise.learn(attempt.measurement.spread, residuals, attempt.inliers)
        self._last_few_and_all = None  # the points weigh otherwise now

    def search_other_shapes(self, attempt: PoseHypothesis) -> PoseHypothesis:
        """The attempt, or a clearly better explanation of its measurements reached from another shape."""
        estimate = attempt.estimate
        if attempt.outline_alone or not estimate.sigma_px < np.inf:
            return attempt
        off_bound = self._search.off_bound(estimate)
        if estimate.sigma_px > self._options.search_above_px or self._loads_hide_much(attempt):
            starts = [*off_bound, *self._search.spread(estimate, self._options.searches)]
            if self._study_scout is not None:
                return self._with_other_loads(attempt, self._by_study_alone(self._study_scout, attempt, starts))
            return self.best_of(attempt, starts)
        attempt = self.best_of(attempt, off_bound)
        if self._study_scout is not None:
            return attempt
        # A wrong shape may fit nearly as well at first, such as that of a load that has not yet made a contact.
        return self.best_of(attempt, self._search.spread(attempt.estimate, 1), MUCH_BETTER)

    def in_likelier_tilt(self, attempt: PoseHypothesis) -> PoseHypothesis:
        """The attempt, or a clearly likelier explanation in the mirrored tilt; with both if neither is excluded.

        Its points are asked once, and where something else knows the pose there is nothing to ask.
        """
        is_known = attempt.prior is not None or attempt.tilt_asked
        if is_known or attempt.outline_alone or not attempt.estimate.sigma_px < np.inf:
            return attempt
        for measured in self._few_and_all(attempt):
            points, n_numbers = measured[0], 2 * int(attempt.measurement.valid.sum())
            other = find_other_tilt(
                lambda state, measured=measured: self._cost(measured, state, None),
                lambda start, measured=measured: self._scout.minimum(*measured, start),
                points, attempt.estimate.state, n_numbers, self._reference.redundancy,
            )  # fmt: skip
            if other.is_excluded:
                return replace(attempt, tilt_asked=True)
        if other.ratio < -(LIKELIER**2):
            taken, other = other.state, other.left(attempt.estimate.state)
            attempt = self._trimmed(attempt.measurement, taken, None)
        return replace(attempt, tilt_asked=True, other_tilt=None if other.is_excluded else other)

    def with_other_tilt(self, attempt: PoseHypothesis) -> PoseHypothesis:
        """The attempt, or what is clearly likelier by all that was measured, outline and depth too, in the other tilt.

        With both if neither is excluded.
        """
        if attempt.other_tilt is None or attempt.prior is not None:
            return replace(attempt, other_tilt=None)
        # The reference's error was found for the one tilt: either is asked without it.
        measured = self.beside.measured(replace(attempt, correction=None))
        n_numbers = int(measured.numbers[measured.weights > 0.0].sum())
        other = find_other_tilt(
            lambda state: self._scout.evaluated(measured, state)[0],
            lambda start: self._scout.fitted(measured, start),
            self._reference.points, attempt.estimate.state, n_numbers, self._reference.redundancy,
        )  # fmt: skip
        # The state here is not where the cost without a correction is least: what leads back to it is no other tilt.
        if not other.is_excluded and other.ratio < -(LIKELIER**2):
            taken, other = other.state, other.left(attempt.estimate.state)
            estimate = self._estimator.fit(measured, taken)
            attempt = replace(attempt, estimate=estimate, correction=None, by_points=estimate.state)
        return replace(attempt, other_tilt=None if other.is_excluded else other)

    def _loads_hide_much(self, attempt: PoseHypothesis) -> bool:
        """Whether unknown loads take up more of the image than is left: then they may do what a parameter should."""
        estimate, rows = attempt.estimate, attempt.inliers
        if self._study_scout is None:
            return False
        parameters = estimate.state.parameters.copy()
        parameters[-self._estimator.model.n_loads :] = 0.0
        unloaded = self._reference.points.in_camera(replace(estimate.state, parameters=parameters))
        left = self._estimator.camera.project(unloaded)[rows] - attempt.measurement.pixels[rows]
        return float(np.mean(left**2)) > 2.0 * float(np.mean(estimate.residuals[: len(rows)][rows] ** 2))

    def _by_study_alone(self, scout: Estimator, attempt: PoseHypothesis, starts: list[State]) -> State:
        """What explains the measurements best without unknown loads, reached from the attempt or one of the starts.

        Where unknown loads have taken over from the study's own load, no small step leads back.
        """
        d, n_loads, prior = len(scout.model.parameters), self._estimator.model.n_loads, attempt.prior
        few, _ = self._few_and_all(attempt)
        points = BoundPoints.from_surface(scout.model, few[0].surface)
        if prior is not None:
            prior = replace(prior, mean=prior.mean[:d], information=prior.information[:d, :d])
        own = [replace(start, parameters=start.parameters[:d]) for start in [attempt.estimate.state, *starts]]
        best = min((scout.minimum(points, *few[1:], start, prior=prior) for start in own), key=lambda one: one.cost)
        return replace(best.state, parameters=np.concatenate([best.state.parameters, np.zeros(n_loads)]))

    def _with_other_loads(self, attempt: PoseHypothesis, start: State) -> PoseHypothesis:
        """The attempt, or a clearly better explanation, loads' prior included, reached from a start.

        All points count from the beginning: a few do not determine as many loads.
        """
        _, every = self._few_and_all(attempt)
        state, prior, loads = attempt.estimate.state, attempt.prior, self._estimator.loads
        enough = 0.0 if loads is None else LEAST_GAIN * loads.squared_px

        other = self._scout.minimum(*every, start, prior=prior)

        def beats(cost: float) -> bool:
            return other.cost < max(CLEARLY_BETTER * cost, cost - enough)

        # The attempt is the best for the points that agree with it, and not quite for all.
        if not (beats(self._cost(every, state, prior)) and beats(self._scout.minimum(*every, state, prior=prior).cost)):
            return attempt
        return self._trimmed(attempt.measurement, other.state, prior)

    def _few_and_all(self, attempt: PoseHypothesis) -> tuple[_Measured, _Measured]:
        """Some of the valid measurements, and all of them, with what they weigh together.

        Mostly those of the last call: several explanations are sought of one frame.
        """
        measurement, last = attempt.measurement, self._last_few_and_all
        if last is not None and last[0] is measurement:
            return last[1]
        weights, valid = self._noise.weights(measurement.spread, measurement.valid), np.flatnonzero(measurement.valid)
        points, pixels = self._reference.points, measurement.pixels
        rows = valid[:: 1 + len(valid) // SCOUTED]
        # So many times the weight, lest a prior count for more among few.
        few = (points.take(rows), pixels[rows], weights[rows] * (len(valid) / max(len(rows), 1)))
        self._last_few_and_all = measurement, (few, (points, pixels, weights))
        return self._last_few_and_all[1]

    def best_of(self, attempt: PoseHypothesis, starts: list[State], share: float = CLEARLY_BETTER) -> PoseHypothesis:
        """The attempt, or what explains its measurements at less than a share of its cost, from one of the starts."""
        if not starts:
            return attempt
        prior, state = attempt.prior, attempt.estimate.state
        few, every = self._few_and_all(attempt)
        best = min((self._scout.minimum(*few, start, prior=prior) for start in starts), key=lambda other: other.cost)
        for points in (few, every):
            if self._cost(points, best.state, prior) > share * self._cost(points, state, prior):
                return attempt
        return self._trimmed(attempt.measurement, best.state, prior)

    def _cost(self, measured: _Measured, state: State, prior: Prior | None) -> float:
        return self._estimator.evaluate(*measured, state, prior=prior)[0]

    def with_blur(
        self, picture: Image, attempt: PoseHypothesis, last: State, warped: Callable[[State, Array], Array] | None
    ) -> PoseHypothesis:
        """The attempt with the paths over which motion since the ``last`` state by the points blurs the picture.

        With ``warped``, which leads motions (p, 2) of points in the reference view to a frame, also with what the frame
        tells of the reference picture.
        """
        seen, rows = attempt.measurement, attempt.inliers
        if seen.rendered is None or seen.drawing is None:
            return attempt
        places, before = self._reference.projected(seen.drawing.state), self._reference.projected(last)
        rows = rows & np.isfinite(before).all(axis=1)
        if warped is not None:
            self._reference_blur.learn(zero_where_unknown(places - before))
            pictures = seen.rendered, picture.normalized, places, seen.recorded
            paths = self._reference_blur.paths(lambda ways: warped(attempt.estimate.state, ways), *pictures, rows)
            attempt = replace(attempt, reference_blur_px=0.0 if paths is None else path_length(paths))
        asked = seen.rendered, picture.normalized, places[rows], seen.recorded[rows], (places - before)[rows]
        if (paths := blurred_paths(*asked)) is None:
            return attempt
        blurred = np.zeros_like(places)
        blurred[rows] = paths
        return replace(attempt, blurred=blurred)
