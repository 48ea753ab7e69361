"""A frame made ready, an estimate of the object in it, and whether to accept that estimate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.estimator import Estimate, Prior
from morph_dslam.tracking.measurement import PATCH_WINDOW, Measurement
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.other_tilt import OtherTilt
from morph_dslam.tracking.outcomes import DepthNotUsed, Rejection, RejectionReason
from morph_dslam.tracking.outline import OutlineMeasurement
from morph_dslam.tracking.outline_weight import MEDIAN_OF_NUMBER
from morph_dslam.tracking.reference_correction import ReferenceCorrection
from morph_dslam.tracking.row_motion import RowMotion
from morph_dslam.tracking.state import State

#: Where less than this share of all points agree, they must agree closely.
MOST_AGREE = 0.5
#: Of the contour's points so many must be found, and this share of them. Their residuals must spread less than this,
#: pixels, or than this share of its extent in the image: a body that is elsewhere leaves its contour by more.
LEAST_OF_CONTOUR, CONTOUR_SHARE, CONTOUR_PX, EXTENT_SHARE = 20, 0.4, 3.0, 0.004
#: An object of whose contour a larger share shows what is beside it is torn or cut.
ABSENT_SHARE = 0.2
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Image:
    """A frame made ready.

    Attributes
    ----------
    grey : (h, w), the undistorted image.
    normalized : (h, w), the same with contrast normalized.
    depth : (h, w) of a depth camera, as recorded, metres, NaN where unknown; None without one.
    occluder_depth : (h, w) of other objects, metres, infinite where there are none; None if none is known.
    motion : of the object while a rolling shutter recorded the frame; None where it is not known, or of a global one.
    is_taken : whether another object stands where this one would stand in a state; None where no other is known.
    """

    grey: NDArray[np.uint8]
    normalized: NDArray[np.uint8]
    depth: NDArray[np.float32] | None = None
    occluder_depth: NDArray[np.float32] | None = None
    motion: RowMotion | None = None
    is_taken: Callable[[State], bool] | None = None

    @cached_property
    def half(self) -> NDArray[np.uint8]:
        """The contrast-normalized image in half of its size."""
        return cv2.pyrDown(self.normalized)  # type: ignore[return-value]

    @property
    def has_grey(self) -> bool:
        """Whether it has grey values; a keyframe of a map has normalized contrast alone."""
        return self.grey is not self.normalized


@dataclass(frozen=True)
class PoseHypothesis:
    """An estimate of the object in a frame, and all the measurements that it was made from.

    Attributes
    ----------
    estimate : pose and parameters.
    inliers : (p,) which measurements support it.
    measurement : of all points.
    weights : (p,) that the measurements counted with, zero for those that do not support the estimate.
    prior : what was known of the pose from the map; None if nothing was.
    outline : of the object's rim, where it counts.
    correction : what outline and depths tell of the reference's error; None where they do not.
    depths : of the points that support it, where a depth camera saw them.
    depth_unused : why there are none, where they are asked for.
    discrepancy : what the shape has beyond the model's, once it was estimated.
    n_absent : points of an outline that is alone where what is beside the object is seen in its place (`n_absent`);
        asked after a loss only.
    blurred : (p, 2), the paths over which motion smears the points that support it, pixels, see `blurred_paths`; None
        where it does no harm, or is not known.
    other_tilt : the mirrored tilt, where what was measured does not exclude it.
    tilt_asked : whether the points were asked for it.
    reference_blur_px : the root mean square length of the paths over which motion smears the reference picture, pixels;
        0 where it does no harm, or is not known.
    by_points : the state by the texture's points alone, before anything else counted; None where it is the estimate's.
    """

    estimate: Estimate
    inliers: NDArray[np.bool_]
    measurement: Measurement
    weights: Array
    prior: Prior | None = None
    outline: OutlineMeasurement | None = None
    correction: ReferenceCorrection | None = None
    depths: PointDepths | None = None
    depth_unused: DepthNotUsed | None = None
    discrepancy: Discrepancy | None = None
    n_absent: int = 0
    blurred: Array | None = None
    other_tilt: OtherTilt | None = None
    tilt_asked: bool = False
    reference_blur_px: float = 0.0
    by_points: State | None = None

    @property
    def points_state(self) -> State:
        """The state in which the texture's points were found, with the error that their reference gives them."""
        return self.estimate.state if self.by_points is None else self.by_points

    @property
    def point_depths(self) -> PointDepths | None:
        """The depths (p,) of the reference view's points, without those of an outline; None if there are none."""
        return None if self.depths is None else self.depths.take(np.arange(len(self.inliers)))

    @property
    def corrected_depths(self) -> PointDepths | None:
        """`point_depths`, with what is known of the reference's error made good."""
        depths = self.point_depths
        return depths if depths is None or self.correction is None else self.correction.of_depths(depths)

    @property
    def outline_alone(self) -> bool:
        """Whether it was made from the outline, without any texture."""
        return not len(self.inliers) and self.outline is not None

    @property
    def supporting(self) -> NDArray[np.bool_]:
        """Which of the residuals (p,) are of measurements that support it; the outline's where that is alone."""
        return self.outline.valid if self.outline_alone and self.outline is not None else self.inliers

    @property
    def counts(self) -> tuple[int, int]:
        """Points that the picture shows and the object itself does not occlude, and those that support the estimate."""
        if self.outline_alone and self.outline is not None:
            return int(self.outline.expected.sum()), int(self.outline.valid.sum())
        return int(self.measurement.visible.sum()), int(self.inliers.sum())


def agree(hypothesis: PoseHypothesis, share: float) -> bool:
    """Whether this share of all points support a hypothesis, also those that it has out of sight."""
    return int(hypothesis.inliers.sum()) >= share * len(hypothesis.inliers)


def reject(hypothesis: PoseHypothesis, options: TrackerOptions) -> Rejection | None:
    """Why a hypothesis is not accepted; None when it is.

    What occludes an object may look like it by chance in places, but such points do not agree closely; nor do they err
    as their neighbours do, as points of an object do that the model does not quite describe. With a pose prior from the
    map only the parameters are left to be found, which few points can tell. These must agree closely then, and be most
    of those that were found.
    """
    visible, count = hypothesis.counts
    if hypothesis.outline_alone:
        return _reject_outline(hypothesis, visible, count)
    needed = min(options.least_inliers, int(np.ceil(options.least_share * len(hypothesis.inliers))))
    spread = hypothesis.estimate.sigma_px
    if count >= needed:
        few, limit = not agree(hypothesis, MOST_AGREE), options.few_sigma_px
        if few and spread > limit and _own_spread(hypothesis) > limit:
            return Rejection(RejectionReason.LOOSE_AGREEMENT, count, visible, spread_px=spread)
        return None
    if hypothesis.prior is None:
        return Rejection(RejectionReason.FEW_POINTS, count, visible, needed)
    if count < options.least_anchored:
        return Rejection(RejectionReason.FEW_POINTS, count, visible, options.least_anchored)
    found = int(hypothesis.measurement.valid.sum())
    if spread < options.few_sigma_px and count >= options.anchored_share * found:
        return None
    return Rejection(RejectionReason.NO_COMMON_SHAPE, count, found, spread_px=spread)


def _own_spread(hypothesis: PoseHypothesis) -> float:
    """Robust standard deviation of a pixel coordinate of the supporting points, without what neighbours have in common.

    It is that of the difference between a point and the nearest one whose window does not overlap its own, over the
    root of two: overlapping windows show the same texture, and err alike wherever it was found.
    """
    rows = hypothesis.inliers
    pixels, residuals = hypothesis.measurement.pixels[rows], hypothesis.estimate.residuals[: len(rows)][rows]
    between = pixels[:, None] - pixels
    apart = np.abs(between).max(axis=2) >= PATCH_WINDOW
    squared = np.where(apart, np.sum(between**2, axis=2), np.inf)
    has_one = apart.any(axis=1)
    if not has_one.any():
        return hypothesis.estimate.sigma_px
    differences = (residuals - residuals[squared.argmin(axis=1)])[has_one]
    return float(np.median(np.abs(differences)) / MEDIAN_OF_NUMBER / np.sqrt(2.0))


def _reject_outline(hypothesis: PoseHypothesis, visible: int, count: int) -> Rejection | None:
    """Why a hypothesis from the outline alone is not accepted."""
    needed = max(LEAST_OF_CONTOUR, int(np.ceil(CONTOUR_SHARE * visible)))
    if count < needed:
        return Rejection(RejectionReason.FEW_POINTS, count, visible, needed)
    if hypothesis.n_absent > ABSENT_SHARE * visible:
        return Rejection(RejectionReason.PART_ABSENT, hypothesis.n_absent, visible)
    assert hypothesis.outline is not None
    extent = float(np.linalg.norm(np.ptp(hypothesis.outline.pixels[hypothesis.outline.valid], axis=0)))
    if not hypothesis.estimate.sigma_px < max(CONTOUR_PX, EXTENT_SHARE * extent):
        return Rejection(RejectionReason.LOOSE_AGREEMENT, count, visible, spread_px=hypothesis.estimate.sigma_px)
    return None
