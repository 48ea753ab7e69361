"""Estimating the object's state in one frame from what is measured against the reference view."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.timing import stage
from morph_dslam.tracking.compact_loads import LEAST_GAIN
from morph_dslam.tracking.covariance import trace_of_share
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.depth_weight import weighed_by_residuals
from morph_dslam.tracking.estimator import Estimate, Estimator, Prior, State
from morph_dslam.tracking.frame_starts import ShapeSearch
from morph_dslam.tracking.hypothesis import Image, PoseHypothesis, reject
from morph_dslam.tracking.known_values import LEAST_SIGMA_PX, KnownParameters
from morph_dslam.tracking.levenberg_marquardt import Minimum
from morph_dslam.tracking.measurement import PATCH_WINDOW, Followed, Measurement
from morph_dslam.tracking.motion_blur import ReferenceBlur, blurred_paths, path_length
from morph_dslam.tracking.noise import Correlation, Observations, PointNoise, block_diagonal, middle, window_correlation
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.other_tilt import LIKELIER, find_other_tilt
from morph_dslam.tracking.outcomes import DepthNotUsed
from morph_dslam.tracking.outline import REACH_PX, Outline, OutlineMeasurement, n_absent
from morph_dslam.tracking.outline_weight import OutlineBalance, beside_found, mean_square
from morph_dslam.tracking.patches import zero_where_unknown
from morph_dslam.tracking.reference import ReferenceView
from morph_dslam.tracking.reference_correction import CorrectionCheck, reference_correction
from morph_dslam.tracking.reference_misfit import Unexplained
from morph_dslam.tracking.row_motion import RowMotion
from morph_dslam.tracking.state import BoundPoints
from morph_dslam.tracking.systematic_errors import SystematicErrors

Array = NDArray[np.float64]
_Measured = tuple[BoundPoints, Array, Array]
#: How far an outline that is alone is searched for, pixels: the first after a loss only. That is for an object of this
#: extent in the image, pixels; where it is larger, so are its motion and what the model leaves, up to this factor.
REACHES, USUAL_EXTENT_PX, MOST_LARGER = (28, 14, 7, 4), 250.0, 2.5
#: Share of the cost below which another shape is a better explanation and not the same one; where the residuals are
#: small, so that noise may prefer another shape, it is better below the second share.
CLEARLY_BETTER, MUCH_BETTER = 0.95, 0.8
#: Other shapes are tried on at least so many points, where there are as many, and at most twice as many.
SCOUTED = 80
#: A shape is measured again where what windows miss of its change is more than this share of the noise of all points
#: together, a standard deviation of whatever they tell best; at most so often.
MISSED_SHARE, MOST_COMPARISONS = 0.5, 2
#: In the first frame with an outline its noise is learnt anew so often: each time the estimate is nearer to it.
FIRST_ROUNDS = 3
#: By depths the reference's error is found so often in a frame, each time nearer to where it is linear.
DEPTH_ROUNDS = 3
#: Depths this many times as far as the points have the object are in another unit, or of another camera.
MOST_TIMES = 1.5


class FrameEstimation:
    """Makes attempts at one frame after the other; priors are what the map tells of the pose, if anything."""

    def __init__(self, estimator: Estimator, reference: ReferenceView, options: TrackerOptions) -> None:
        self._estimator, self._reference, self._options = estimator, reference, options
        self._noise, self._balance = PointNoise(), OutlineBalance()
        self._reference_blur = ReferenceBlur()
        self._outline_check, self._depth_check = CorrectionCheck(), CorrectionCheck()
        self._search = ShapeSearch(estimator.model, options.searches)
        brief = replace(options.estimation, max_iterations=10, tolerance=1e-3)
        self._scout = Estimator(estimator.model, estimator.camera, brief)
        self._scout.loads, self._scout.known = estimator.loads, estimator.known
        energy = estimator.model.energy
        has_both = energy is not None and len(energy.model.parameters) > 0
        self._study_scout = Estimator(energy.model, estimator.camera, brief) if energy and has_both else None
        if self._study_scout is not None:
            self._study_scout.known = estimator.known
        self._last_joined: tuple[BoundPoints, BoundPoints] | None = None
        self._last_few_and_all: tuple[Measurement, tuple[_Measured, _Measured]] | None = None

    @property
    def known(self) -> KnownParameters:
        """What is known of parameters in the present frame."""
        return self._estimator.known

    def fitted(self, attempt: PoseHypothesis) -> Estimate:
        """The estimate from an attempt's measurements and what is known of parameters now."""
        return self._estimator.fit(self.measured(attempt, correlated=False), attempt.estimate.state, attempt.prior)

    def any_loads(self) -> AbstractContextManager[None]:
        """Meanwhile no unknown loads are likelier than others."""
        loads = self._estimator.loads
        return nullcontext() if loads is None else loads.set_aside()

    def restated(self, attempt: PoseHypothesis, estimate: Estimate) -> Estimate:
        """An estimate from an attempt's measurements with deviations by what is known now, see `Estimator.restated`."""
        return self._estimator.restated(self.measured(attempt, correlated=False), estimate, attempt.prior)

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
            estimate = self._estimate(measurement, used, start, prior)
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

    def _estimate(
        self, measurement: Measurement, used: NDArray[np.bool_], start: State, prior: Prior | None
    ) -> Estimate:
        weights = self._noise.weights(measurement.spread, used)
        return self._estimator.estimate(self._reference.points, measurement.pixels, weights, start, prior=prior)

    def learn(self, attempt: PoseHypothesis, picture: Image) -> None:
        """Take in how well the points agreed in a frame that is believed."""
        if attempt.outline_alone and attempt.outline is not None:
            seen, state = attempt.outline, attempt.estimate.state
            whole = self._estimator.evaluate(
                seen.points, seen.pixels, seen.weights, state, seen.normals, attempt.prior
            )[1]
            self._balance.learn_outline(seen, attempt.estimate.residuals, self._taken(seen, state, whole))
            if picture.has_grey and self._reference.outline is not None:
                shown = state if picture.motion is None else picture.motion.as_seen(state)
                self._reference.outline.take_brightness(picture.grey, shown)
            return
        residuals = attempt.estimate.residuals[: len(attempt.inliers)]
        self._noise.learn(attempt.measurement.spread, residuals, attempt.inliers)
        self._last_few_and_all = None  # the points weigh otherwise now

    def left_by_outline(self, attempt: PoseHypothesis) -> Unexplained:
        """What the model leaves of an outline that is alone."""
        assert attempt.outline is not None
        across = attempt.estimate.residuals[attempt.outline.valid]
        common = self._balance.in_common(attempt.outline, attempt.estimate.residuals)
        return Unexplained(common, float(np.sqrt(np.mean(np.sum(across**2, axis=1)))))

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
        measured = self.measured(replace(attempt, correction=None), correlated=False)
        n_numbers = int(measured.numbers[measured.weights > 0.0].sum())
        other = find_other_tilt(
            lambda state: self._scout.evaluated(measured, state)[0],
            lambda start: self._scout.fitted(measured, start),
            self._reference.points, attempt.estimate.state, n_numbers, self._reference.redundancy,
        )  # fmt: skip
        if other.ratio < -(LIKELIER**2):
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

        def is_better(cost: float, than: float) -> bool:
            return cost < max(CLEARLY_BETTER * than, than - enough)

        other = self._scout.minimum(*every, start, prior=prior)
        # The attempt is the best for the points that agree with it, and not quite for all.
        if not is_better(other.cost, self._cost(every, state, prior)) or not is_better(
            other.cost, self._scout.minimum(*every, state, prior=prior).cost
        ):
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

    def fit_outline(
        self, picture: Image, attempt: PoseHypothesis, systematic: SystematicErrors | None = None
    ) -> PoseHypothesis:
        """Estimate from the supporting points and the outline together.

        ``systematic`` : of the points; the outline then also tells of the error that the reference has given them,
        unless the frames so far have shown that something else sets both apart.
        """
        outline, check = self._reference.outline, self._outline_check
        if outline is None or attempt.outline_alone:
            return attempt
        if not self._makes_good(systematic, check):
            return self._beside(outline, picture, attempt)
        found = self._beside(outline, picture, attempt, systematic)
        self._is_possible(check, attempt, found)
        if check.is_refuted:
            self._balance = OutlineBalance()  # which was learnt with the correction
            found = self._beside(outline, picture, attempt)
        return found

    def _makes_good(self, systematic: SystematicErrors | None, check: CorrectionCheck) -> bool:
        """Whether what is measured beside the points may correct the reference's error.

        A pose that is held has the registration's error, too: together with the points' it leaves the shape as it is.
        """
        is_known = systematic is not None and systematic.knows_reference
        return is_known and self._options.pose != "fixed" and not check.is_refuted

    def _is_possible(self, check: CorrectionCheck, attempt: PoseHypothesis, found: PoseHypothesis) -> bool:
        """Whether the reference may be off by what this frame shows, and most so far do not speak against that.

        Parameters
        ----------
        check : that takes the frame in.
        attempt : without what corrects the points.
        found : with it.
        """
        if found.correction is None:
            return True
        rows, before = attempt.inliers, attempt.correction
        alone, beside = [one.estimate.residuals[: len(rows)][rows] for one in (attempt, found)]
        shift = found.correction.shift if before is None else found.correction.shift - before.shift
        asked = shift[rows], attempt.weights[rows], self._reference.redundancy, len(self._estimator.scale)
        return check.learn(alone, beside, *asked, found.correction.found) and not check.is_refuted

    def _beside(
        self, outline: Outline, picture: Image, attempt: PoseHypothesis, systematic: SystematicErrors | None = None
    ) -> PoseHypothesis:
        """As `fit_outline`; the outline is searched for far first, then near."""
        estimate, balance = attempt.estimate, self._balance
        if picture.has_grey and not outline.knows_brightness:
            outline.take_brightness(picture.grey, estimate.state)
        drawing, occluders = attempt.measurement.drawing, picture.occluder_depth
        motion = None if picture.motion is None else picture.motion.moving_as(estimate.state)
        seen = outline.measure(picture.grey, estimate.state, REACH_PX, occluders, drawing, motion)
        seen = self._uncovered(seen, attempt, estimate.state)
        is_first = balance.weight == 0.0
        anew = is_first and systematic is not None and balance.suppose_exact_outline(seen)
        if is_first:
            balance.learn_texture(*self._supporting(attempt, estimate.residuals))
        if is_first and not anew:
            offsets = self._estimator.camera.project(seen.points.in_camera(estimate.state)) - seen.pixels
            balance.learn_outline(seen, offsets, 0.0)
        # After the first search the state only says where to look the second time: it need not be exact.
        attempt = replace(attempt, outline=seen.weighted(balance.weight))
        attempt, found = self._corrected(attempt, estimate.state, systematic, self._scout)
        seen = outline.measure_again(picture.grey, found.state, REACH_PX // 2, occluders, motion)
        seen = self._uncovered(seen, attempt, found.state)
        for _ in range(FIRST_ROUNDS if anew else 1):
            seen = seen.weighted(balance.weight)
            attempt, found = self._corrected(replace(attempt, outline=seen), found.state, systematic, self._estimator)
            of_outline = found.residuals[-len(seen.weights) :]
            agreeing = seen.weighted(balance.weight, balance.agreeing(of_outline))
            taken = self._taken(seen, found.state, self._told(attempt, found))
            balance.learn_outline(seen, of_outline, taken, anew)
        balance.learn_texture(*self._supporting(attempt, found.residuals))
        attempt, found = self._corrected(replace(attempt, outline=agreeing), found.state, systematic, self._estimator)
        return replace(attempt, estimate=self._finished(attempt, found))

    def _finished(self, attempt: PoseHypothesis, found: Minimum) -> Estimate:
        """The estimate at a minimum of the points' and the outline's cost."""
        together = self.measured(attempt, correlated=False)
        return self._estimator.finished(found, together.weights, together.numbers)

    def _corrected(
        self, attempt: PoseHypothesis, start: State, systematic: SystematicErrors | None, estimator: Estimator
    ) -> tuple[PoseHypothesis, Minimum]:
        """The attempt with what its outline and depths tell of the reference's error, and the minimum then."""
        together, seen, depths = self.measured(attempt, correlated=False), attempt.outline, attempt.corrected_depths
        found, rows = estimator.fitted(together, start, attempt.prior), slice(len(attempt.inliers))
        squared_px = self._balance.texture.independent if depths is None else depths.squared_px
        tells = depths is not None or (seen is not None and seen.valid.any())
        if systematic is None or not tells or np.isnan(squared_px):
            return attempt, found
        pushed = systematic.pushed_texture(found.state, found.residuals[rows], attempt.weights, depths)
        asked = found, attempt.prior, pushed, squared_px, attempt.correction, self._balance.common_px
        attempt = replace(attempt, correction=reference_correction(self._estimator, together, *asked))
        return attempt, estimator.fitted(self.measured(attempt, correlated=False), found.state, attempt.prior)

    def _told(self, attempt: PoseHypothesis, found: Minimum) -> Array:
        """The Hessian (d + 6, d + 6) at a minimum, less what the reference's error takes from the points."""
        return found.hessian if attempt.correction is None else found.hessian - attempt.correction.information_lost

    def _uncovered(self, seen: OutlineMeasurement, attempt: PoseHypothesis, state: State) -> OutlineMeasurement:
        """The outline without what lies beside texture that should be seen and was not found.

        There something is before the object, and the edge that was found may be its own.
        """
        places = self._reference.projected(state)
        places[~attempt.measurement.visible] = np.nan
        return seen.weighted(1.0, beside_found(seen.pixels, places, attempt.measurement.valid))

    def by_outline(self, picture: Image, start: State, prior: Prior | None, lost: bool) -> PoseHypothesis:
        """Estimate from the outline alone: searched for far first, then nearer, from one state to the next.

        After a loss it is searched for farther off, and other shapes than the last are tried in turn.
        """
        best = self._along_contour(picture, start, prior, REACHES[0] if lost else REACHES[1])
        if lost and reject(best, self._options) is not None:
            others = self._search.spread(best.estimate, self._options.searches)
            for other in [*self._search.off_bound(best.estimate), *others]:
                moved = replace(other, camera_from_object=start.camera_from_object)
                found = self._along_contour(picture, moved, prior, REACHES[0])
                if found.counts[1] > best.counts[1]:
                    best = found
        if not lost or best.outline is None:
            return best
        return replace(best, n_absent=n_absent(picture.grey, best.outline))

    def _along_contour(self, picture: Image, start: State, prior: Prior | None, reach: int) -> PoseHypothesis:
        """The outline searched for from ``start``, at most ``reach`` pixels off."""
        outline, state = self._reference.outline, start
        assert outline is not None
        if picture.has_grey and not outline.knows_brightness:
            outline.take_brightness(picture.grey, state)
        empty = np.zeros((0, 2))
        nothing = Measurement(empty, empty, np.zeros(0, dtype=bool), np.zeros(0, dtype=bool), np.zeros(0))
        larger = np.clip(np.sqrt(outline.extent(start) / USUAL_EXTENT_PX), 1.0, MOST_LARGER)
        reaches = [int(larger * r) for r in REACHES if r <= reach]
        attempt = None
        for number, far in enumerate(reaches):
            last = number == len(reaches) - 1
            estimator = self._estimator if last else self._scout
            seen = outline.measure(picture.grey, state, far, picture.occluder_depth, motion=picture.motion)
            for _ in range(2):  # the second time without what does not agree
                together = Observations(seen.points, seen.pixels, seen.weights, seen.normals)
                estimate = estimator.fit(together, state, prior)
                attempt = PoseHypothesis(estimate, np.zeros(0, dtype=bool), nothing, np.zeros(0), prior, seen)
                state = estimate.state
                seen = seen.weighted(1.0, self._balance.agreeing_alone(seen, estimate.residuals, last))
        assert attempt is not None
        return attempt

    def _supporting(self, attempt: PoseHypothesis, residuals: Array) -> tuple[Array, Array, float]:
        """Pixels and residuals (p, 2) of the texture's points that support an attempt, and a number's variance.

        ``residuals`` : pixels, of all points, the texture's first.
        """
        rows, n_unknowns = attempt.inliers, len(self._estimator.scale)
        residuals = residuals[: len(rows)][rows]
        return attempt.measurement.pixels[rows], residuals, mean_square(residuals, attempt.weights[rows], n_unknowns)

    def _taken(self, seen: OutlineMeasurement, state: State, hessian: Array) -> float:
        """How many of the outline's numbers an estimate takes up: the trace of H^-1 H_outline.

        ``hessian`` (d + 6, d + 6) is that of all that the estimate was made from, H.
        """
        return trace_of_share(hessian, self._of_outline(seen, state), self._estimator.scale)

    def _of_outline(self, seen: OutlineMeasurement, state: State) -> Array:
        """The Hessian (d + 6, d + 6) of an outline's own cost."""
        return self._estimator.of_pixels(seen.points, seen.pixels, seen.weights, state, seen.normals)[1]

    def hessian_of_outline(self, attempt: PoseHypothesis) -> Array | None:
        """What an outline beside the points adds to the Hessian (d + 6, d + 6) of an attempt; None without one."""
        return None if attempt.outline is None else self._of_outline(attempt.outline, attempt.estimate.state)

    def fit_depths(
        self, picture: Image, attempt: PoseHypothesis, systematic: SystematicErrors | None = None
    ) -> PoseHypothesis:
        """Estimate with the depths of the supporting points too, if a depth camera saw them where they are.

        ``systematic`` : of the points, of which depths tell as in `fit_outline`.
        """
        if not self._options.use_depth or attempt.outline_alone:
            return attempt
        if picture.depth is None:
            return replace(attempt, depth_unused=DepthNotUsed())
        # Points whose windows overlap err alike in the image, and each counts for less than its depth does.
        squared_px = self._reference.redundancy * max(attempt.estimate.sigma_px, LEAST_SIGMA_PX) ** 2
        pixels, camera, sigma = attempt.measurement.recorded, self._estimator.camera, self._options.depth_sigma
        depths = PointDepths.sampled(picture.depth, pixels, attempt.inliers, camera, squared_px, sigma)
        ratio = depths.ratio_to(self._reference.points.in_camera(attempt.estimate.state)[:, 2])
        if ratio is None or not 1.0 / MOST_TIMES < ratio < MOST_TIMES:
            return replace(attempt, depth_unused=DepthNotUsed(ratio))
        attempt = replace(attempt, depths=depths.padded(len(self._reference.all_points)))
        if self._makes_good(systematic, self._depth_check):
            found, minimum = self._corrected(attempt, attempt.estimate.state, systematic, self._scout)
            for _ in range(DEPTH_ROUNDS - 1):
                found = replace(found, depths=self._weighed(replace(found, depths=attempt.depths), minimum.state))
                found, minimum = self._corrected(found, minimum.state, systematic, self._estimator)
            found = replace(found, estimate=self._finished(found, minimum))
            # Nothing was learnt with the correction, so that one frame can do without.
            if self._is_possible(self._depth_check, attempt, found):
                return found
        seen = self.measured(attempt, correlated=False)
        return replace(attempt, estimate=self._estimator.fit(seen, attempt.estimate.state, attempt.prior))

    def _weighed(self, attempt: PoseHypothesis, state: State) -> PointDepths:
        """The depths of an attempt by what they show in a state that they are off by, once they are corrected."""
        corrected, pixels = attempt.corrected_depths, attempt.measurement.pixels
        assert corrected is not None
        assert attempt.depths is not None
        residuals = corrected.linearised(self._reference.points, state)[0]
        seen = weighed_by_residuals(corrected, residuals, pixels).padded(len(attempt.depths.depths))
        return replace(seen, depths=attempt.depths.depths)

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

    def measured(self, attempt: PoseHypothesis, correlated: bool = True) -> Observations:
        """All that an attempt was made from, the outline's points after the others.

        ``correlated`` : whether their errors' correlation is wanted; it takes time.
        """
        points, pixels, weights = self._reference.points, attempt.measurement.pixels, attempt.weights
        if attempt.correction is not None:
            pixels = pixels - attempt.correction.shift
        normals, seen, depths = np.zeros_like(pixels), attempt.outline, attempt.depths
        if depths is not None and attempt.correction is not None:
            depths = attempt.correction.of_depths(depths)
        correlation: Correlation = np.zeros((0, 0))
        if correlated:
            alike = window_correlation(pixels, PATCH_WINDOW)
            correlation = alike if seen is None else block_diagonal([alike, self._balance.correlation(seen)])
        if seen is not None:
            points = self._joined(seen.points)
            pixels, normals = np.concatenate([pixels, seen.pixels]), np.concatenate([normals, seen.normals])
            weights = np.concatenate([weights, seen.weights])
        return Observations(points, pixels, weights, normals, correlation, depths)

    def _joined(self, outline: BoundPoints) -> BoundPoints:
        """The view's points followed by those of the outline, which mostly are those of the last call."""
        if self._last_joined is None or self._last_joined[0] is not outline:
            self._last_joined = outline, self._reference.points.joined(outline)
        return self._last_joined[1]
