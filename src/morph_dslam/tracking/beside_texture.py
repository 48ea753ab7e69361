"""Estimating the object's state in a frame from its points and what else is measured: outline and depths.

Both tell of the error that the reference has given the points, by one mechanism: see `reference_correction`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.even_rows import evenly
from morph_dslam.tracking.covariance import trace_of_share
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.estimator import Estimator, LinearCost, State
from morph_dslam.tracking.hypothesis import Image, PoseHypothesis
from morph_dslam.tracking.known_values import LEAST_SIGMA_PX
from morph_dslam.tracking.levenberg_marquardt import Minimum
from morph_dslam.tracking.measurement import PATCH_WINDOW
from morph_dslam.tracking.noise import Correlation, Observations, block_diagonal, window_correlation
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outcomes import DepthNotUsed
from morph_dslam.tracking.outline import REACH_PX, Outline, OutlineMeasurement
from morph_dslam.tracking.outline_weight import (
    MOST_COMPARED,
    ErrorComponent,
    OutlineBalance,
    beside_found,
    mean_square,
    near_products,
)
from morph_dslam.tracking.reference import ReferenceView
from morph_dslam.tracking.reference_correction import CorrectionCheck, ReferenceCorrection, reference_correction
from morph_dslam.tracking.refinement import EFFECTIVE_POINTS
from morph_dslam.tracking.state import BoundPoints
from morph_dslam.tracking.systematic_errors import SystematicErrors

Array = NDArray[np.float64]
#: In the first frame with an outline its noise is learnt anew so often: each time the estimate is nearer to it.
FIRST_ROUNDS = 3
#: By depths the reference's error is found so often in a frame, each time nearer to where it is linear.
DEPTH_ROUNDS = 3
#: Depths this many times as far as the points have the object are in another unit, or of another camera.
MOST_TIMES = 1.5


@dataclass
class BesideTexture:
    """Adds to attempts at one frame after the other what is measured beside the points.

    Attributes
    ----------
    scout : an estimator in brief, for what is found again.
    balance : what is learnt of texture and outline.
    """

    estimator: Estimator
    scout: Estimator
    reference: ReferenceView
    options: TrackerOptions
    balance: OutlineBalance
    _outline_check: CorrectionCheck = field(default_factory=CorrectionCheck)
    _depth_check: CorrectionCheck = field(default_factory=CorrectionCheck)
    _last_joined: tuple[BoundPoints, BoundPoints] | None = None

    def fit_outline(
        self, picture: Image, attempt: PoseHypothesis, systematic: SystematicErrors | None
    ) -> PoseHypothesis:
        """Estimate from the supporting points and the outline together.

        ``systematic`` : of the points; the outline then also tells of the error that the reference has given them,
        unless the frames so far have shown that something else sets both apart.
        """
        outline, check = self.reference.outline, self._outline_check
        if outline is None or attempt.outline_alone:
            return attempt
        if self._makes_good(systematic, check):
            found = self._beside(outline, picture, attempt, systematic)
            self._is_possible(check, attempt, found)
            if not check.is_refuted:
                return found
            # Which were learnt with the correction.
            self.balance.texture, self.balance.outline = ErrorComponent(), ErrorComponent()
        return self._beside(outline, picture, attempt, None)

    def fit_depths(
        self, picture: Image, attempt: PoseHypothesis, systematic: SystematicErrors | None
    ) -> PoseHypothesis:
        """Estimate with the depths of the supporting points too, if a depth camera saw them where they are.

        ``systematic`` : of the points, of which depths tell as in `fit_outline`.
        """
        if not self.options.use_depth or attempt.outline_alone:
            return attempt
        if picture.depth is None:
            return replace(attempt, depth_unused=DepthNotUsed())
        # Points whose windows overlap err alike in the image, and each counts for less than its depth does.
        squared_px = self.reference.redundancy * max(attempt.estimate.sigma_px, LEAST_SIGMA_PX) ** 2
        pixels, camera, sigma = attempt.measurement.recorded, self.estimator.camera, self.options.depth_sigma
        depths = PointDepths.sampled(picture.depth, pixels, attempt.inliers, camera, squared_px, sigma)
        ratio = depths.ratio_to(self.reference.points.in_camera(attempt.estimate.state)[:, 2])
        if ratio is None or not 1.0 / MOST_TIMES < ratio < MOST_TIMES:
            return replace(attempt, depth_unused=DepthNotUsed(ratio))
        attempt = replace(attempt, depths=depths.padded(len(self.reference.all_points)))
        if systematic is not None and attempt.correction is not None:
            attempt = _with_depths_corrected(attempt, attempt.correction, systematic)
        tells = systematic is not None and systematic.told_by_depths
        if tells and self._makes_good(systematic, self._depth_check):
            found, minimum = self._corrected(attempt, attempt.estimate.state, systematic, self.scout)
            for _ in range(DEPTH_ROUNDS - 1):
                found = self._weighed(replace(found, depths=attempt.depths), minimum.state)
                found, minimum = self._corrected(found, minimum.state, systematic, self.estimator)
            found = self._finished(found, minimum)
            # Nothing was learnt with the correction, so that one frame can do without.
            if self._is_possible(self._depth_check, attempt, found):
                return found
        return self._finished(*self._corrected(attempt, attempt.estimate.state, None, self.estimator))

    def _beside(
        self, outline: Outline, picture: Image, attempt: PoseHypothesis, systematic: SystematicErrors | None
    ) -> PoseHypothesis:
        """As `fit_outline`; the outline is searched for far first, then near."""
        estimate, balance = attempt.estimate, self.balance
        if picture.has_grey and not outline.knows_brightness:
            outline.take_brightness(picture.grey, estimate.state)
        drawing, occluders = attempt.measurement.drawing, picture.occluder_depth
        motion = None if picture.motion is None else picture.motion.moving_as(estimate.state)
        seen = outline.measure(picture.grey, estimate.state, REACH_PX, occluders, drawing, motion)
        seen = self._uncovered(seen, attempt, estimate.state)
        is_first = balance.weight == 0.0
        anew = is_first and systematic is not None and balance.suppose_exact_outline(seen)
        if is_first:
            self._learn_texture(attempt, estimate.residuals)
        if is_first and not anew:
            offsets = self.estimator.camera.project(seen.points.in_camera(estimate.state)) - seen.pixels
            balance.learn_outline(seen, offsets, 0.0)
        # After the first search the state only says where to look the second time: it need not be exact.
        attempt = replace(attempt, outline=seen.weighted(balance.weight))
        attempt, found = self._corrected(attempt, estimate.state, systematic, self.scout)
        seen = outline.measure_again(picture.grey, found.state, REACH_PX // 2, occluders, motion)
        seen = self._uncovered(seen, attempt, found.state)
        for _ in range(FIRST_ROUNDS if anew else 1):
            seen = seen.weighted(balance.weight)
            attempt, found = self._corrected(replace(attempt, outline=seen), found.state, systematic, self.estimator)
            of_outline = found.residuals[-len(seen.weights) :]
            agreeing = seen.weighted(balance.weight, balance.agreeing(of_outline))
            balance.learn_outline(seen, of_outline, self._taken(attempt, found), anew)
        self._learn_texture(attempt, found.residuals)
        attempt = replace(attempt, outline=agreeing)
        return self._finished(*self._corrected(attempt, found.state, systematic, self.estimator))

    def _corrected(
        self, attempt: PoseHypothesis, start: State, systematic: SystematicErrors | None, estimator: Estimator
    ) -> tuple[PoseHypothesis, Minimum]:
        """The attempt with what its outline and depths tell of the reference's error, and the minimum then."""
        together, seen, depths = self.measured(attempt), attempt.outline, attempt.corrected_depths
        found, rows = estimator.fitted(together, start, attempt.prior), slice(len(attempt.inliers))
        squared_px = self.balance.texture.independent if depths is None else depths.squared_px
        tells = depths is not None or (seen is not None and seen.valid.any())
        if systematic is None or not tells or np.isnan(squared_px):
            return attempt, found
        pushed = systematic.pushed_texture(found.state, found.residuals[rows], attempt.weights, depths)
        asked = found, pushed, squared_px, attempt.correction, self.balance.common_px
        attempt = replace(attempt, correction=reference_correction(self.estimator, together, *asked))
        return attempt, estimator.fitted(self.measured(attempt), found.state, attempt.prior)

    def _finished(self, attempt: PoseHypothesis, found: Minimum) -> PoseHypothesis:
        """The attempt with the estimate at a minimum of its cost."""
        together = self.measured(attempt)
        return replace(attempt, estimate=self.estimator.finished(found, together.weights, together.numbers))

    def _makes_good(self, systematic: SystematicErrors | None, check: CorrectionCheck) -> bool:
        """Whether what is measured beside the points may correct the reference's error.

        A pose that is held has the registration's error, too: together with the points' it leaves the shape as it is.
        """
        is_known = systematic is not None and systematic.knows_reference
        return is_known and self.options.pose != "fixed" and not check.is_refuted

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
        asked = shift[rows], attempt.weights[rows], self.reference.redundancy, len(self.estimator.scale)
        return check.learn(alone, beside, *asked, found.correction.found) and not check.is_refuted

    def _uncovered(self, seen: OutlineMeasurement, attempt: PoseHypothesis, state: State) -> OutlineMeasurement:
        """The outline without what lies beside texture that should be seen and was not found.

        There something is before the object, and the edge that was found may be its own.
        """
        places = self.reference.projected(state)
        places[~attempt.measurement.visible] = np.nan
        return seen.weighted(1.0, beside_found(seen.pixels, places, attempt.measurement.valid))

    def _learn_texture(self, attempt: PoseHypothesis, residuals: Array) -> None:
        """Take in the residuals (p, 2) of all points, the texture's first, of those that support an attempt."""
        rows = attempt.inliers
        residuals = residuals[: len(rows)][rows]
        variance = mean_square(residuals, attempt.weights[rows], len(self.estimator.scale))
        self.balance.texture.learn(attempt.measurement.pixels[rows], residuals, variance)

    def _taken(self, attempt: PoseHypothesis, found: Minimum) -> float:
        """How many of the outline's numbers a minimum takes up: the trace of H^-1 H_outline.

        H is the Hessian (d + 6, d + 6) there, less what the reference's error takes from the points.
        """
        told, own = found.hessian, self.hessian_of_outline(attempt, found.state)
        assert own is not None
        told = told if attempt.correction is None else told - attempt.correction.information_lost
        return trace_of_share(told, own, self.estimator.scale)

    def hessian_of_outline(self, attempt: PoseHypothesis, state: State) -> Array | None:
        """What an outline beside the points adds to the Hessian (d + 6, d + 6) at a state; None without one."""
        if (seen := attempt.outline) is None:
            return None
        return self.estimator.of_pixels(seen.points, seen.pixels, seen.weights, state, seen.normals)[1]

    def whole_outline(self, attempt: PoseHypothesis, state: State) -> Array | None:
        """How what an outline beside the points is off by as a whole enters the gradient (3, d + 6) at a state.

        As of `LinearCost`; None without one.
        """
        if (seen := attempt.outline) is None:
            return None
        residuals = self.estimator.of_pixels(seen.points, seen.pixels, seen.weights, state, seen.normals)[3]
        measured = Observations(seen.points, seen.pixels, seen.weights, seen.normals, common_px=self.balance.common_px)
        options, camera, scale = self.estimator.options, self.estimator.camera, self.estimator.scale
        return LinearCost.about(measured, state, residuals, camera, options.huber_px, scale).in_common

    def _weighed(self, attempt: PoseHypothesis, state: State) -> PoseHypothesis:
        """The attempt whose depths count by what they show in a state that they are off by, once corrected."""
        depths, corrected = attempt.depths, attempt.corrected_depths
        assert depths is not None
        assert corrected is not None
        residuals = corrected.linearised(self.reference.points, state)[0]
        seen = weighed_by_residuals(corrected, residuals, attempt.measurement.pixels).padded(len(depths.depths))
        return replace(attempt, depths=replace(seen, depths=depths.depths))

    def measured(self, attempt: PoseHypothesis, correlated: bool = False) -> Observations:
        """All that an attempt was made from, the outline's points after the others.

        ``correlated`` : whether their errors' correlation is wanted; it takes time.
        """
        points, pixels, weights = self.reference.points, attempt.measurement.pixels, attempt.weights
        seen, depths = attempt.outline, attempt.depths
        if attempt.correction is not None:
            pixels = pixels - attempt.correction.shift
            depths = None if depths is None else attempt.correction.of_depths(depths)
        normals = np.zeros_like(pixels)
        correlation: Correlation = np.zeros((0, 0))
        if correlated:
            alike = window_correlation(pixels, PATCH_WINDOW)
            correlation = alike if seen is None else block_diagonal([alike, self.balance.correlation(seen)])
        if seen is not None:
            if self._last_joined is None or self._last_joined[0] is not seen.points:  # mostly it is, in a frame
                self._last_joined = seen.points, points.joined(seen.points)
            points = self._last_joined[1]
            pixels, normals = np.concatenate([pixels, seen.pixels]), np.concatenate([normals, seen.normals])
            weights = np.concatenate([weights, seen.weights])
        common_px = 0.0 if seen is None else self.balance.common_px
        return Observations(points, pixels, weights, normals, correlation, depths, common_px)


def _with_depths_corrected(
    attempt: PoseHypothesis, correction: ReferenceCorrection, systematic: SystematicErrors
) -> PoseHypothesis:
    """The attempt whose depths are corrected, as its points are, by what an outline has told of the reference's error.

    The points lie where the reference state has them on the surface: what moves them there moves both.
    """
    estimate, rows = attempt.estimate, slice(len(attempt.inliers))
    asked = estimate.state, estimate.residuals[rows], attempt.weights, attempt.point_depths
    depths = systematic.pushed_texture(*asked).depths
    assert depths is not None
    return replace(attempt, correction=replace(correction, nearer=depths.metres @ correction.found))


def weighed_by_residuals(depths: PointDepths, residuals: Array, pixels: Array) -> PointDepths:
    """Depths that count by what an independent one of them is worth; never for more than by their noise.

    The noise of a depth camera is taken for granted. Beside it depths are off by what lens, sensor and mesh make, which
    is alike over wide parts of the surface and does not average out over points. Neighbours have that in common in
    their residuals, and the noise not: the variance of a mean over n points is that of the noise over n, and the common
    one over as many parts as a keyframe counts for (`EFFECTIVE_POINTS`).

    Parameters
    ----------
    depths : (p,) weighed by their noise.
    residuals : (p,) that an estimate leaves of them, pixels.
    pixels : (p, 2) of the points.
    """
    rows = np.flatnonzero(depths.weights > 0.0)
    sizes = depths.bounded(residuals) / np.sqrt(depths.squared_px)
    some = rows[evenly(len(rows), MOST_COMPARED)]
    variance = float(np.sum(sizes[rows] ** 2)) / max(len(rows), 1)
    common = float(np.clip(near_products(pixels[some], sizes[some, None])[0], 0.0, variance))
    worth = variance - common + common * max(len(rows) / EFFECTIVE_POINTS, 1.0)
    root = float(np.sqrt(1.0 / max(worth, 1.0)))
    return replace(depths, weights=root * depths.weights, huber_px=root * depths.huber_px)
