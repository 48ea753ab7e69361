"""What one frame told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.geometry import RigidTransform
from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.registration.registration import PosePrior
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.estimator import Estimate, Prior
from morph_dslam.tracking.measurement import Measurement
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outline import OutlineMeasurement

Array = NDArray[np.float64]

#: The stages of a frame that are timed, in order; "locate" finds the camera in the map.
STAGES = (
    "locate",
    "prepare",
    "flow",
    "estimate",
    "render",
    "correct",
    "search",
    "recover",
    "outline",
    "depth",
    "fuse",
    "discrepancy",
    "views",
)

FOLLOWED = "followed from the previous frame"

FOUND_AGAIN = "found again where it was last seen"

RECOVERED = "recovered from the reference view's features"

#: Follows the reason of a frame in which the model, not noise, is what is left of the residuals.
UNEXPLAINED = "the model does not explain the images"

#: Follows the reason of a frame in which few points agree, and less closely than usual.
FEW_AGREE = "few points agree, and less closely than usual"

#: Follows the reason of frames by which the object is longer or shorter than the model along an axis.
DIMENSIONS_OFF = "it looks as if the object had not got the model's dimensions"

#: Follows the reason of a frame as long as the frames do not exclude that.
UNCHECKED = "no view so far could show whether the object has the model's dimensions"

#: Follows the reason of frames by which the reference state is worse known than it was stated.
REFERENCE_WORSE = "the frames contradict the reference state"

#: Follows the reason of frames in which the object cannot be told from another one with its print.
MAY_BE_ANOTHER = "it may be another one like it"

#: Follows the reason of frames in which an anchored object is away from its place.
HAS_MOVED = "the object has moved from its place in the map"


@dataclass(frozen=True)
class FrameResult:
    """What one frame told.

    Attributes
    ----------
    status : "tracked"; "hidden", where the map tells the pose but too few points the parameters; or "lost".
    reason : how it was found, or why it was not.
    estimate : None unless tracked.
    residual_rms_px : root mean square of the inliers' residuals, NaN when lost.
    n_points, n_inliers : points that the object itself does not hide, and those that support the estimate.
    timings_ms : by stage, milliseconds. total_ms : the whole frame. recovered : found again after a loss.
    unexplained_px : what the model leaves of the residuals, see `systematic_errors`; NaN when lost.
    reference_worse : by how much larger than stated the deviation of the reference state is, by all frames so
        far; see `reference_misfit`.
    dimensions_off : along which axis of the object, and by how much, it is longer or shorter than the model,
        against the others, as all frames so far show it; "" where they do not.
    pose_from : "points", "points and map", "map" where it is hidden, or "" where there is no pose.
    known : the pose by the map, where that alone tells it.
    view : number of the reference view that the frame was compared with, 0 for the first.
    made_view : whether the frame has become a reference view itself.
    discrepancy : what the object's shape has beyond the model's; None where it was not looked for.
    """

    status: str
    reason: str
    estimate: Estimate | None
    residual_rms_px: float
    n_points: int
    n_inliers: int
    timings_ms: dict[str, float]
    total_ms: float
    recovered: bool = False
    unexplained_px: float = float("nan")
    reference_worse: float = 1.0
    dimensions_off: str = ""
    pose_from: str = ""
    known: PosePrior | None = None
    view: int = 0
    made_view: bool = False
    discrepancy: Discrepancy | None = None

    @classmethod
    def hidden(
        cls, why: str, known: PosePrior, n_points: int, n_inliers: int, timings_ms: dict[str, float], total_ms: float
    ) -> FrameResult:
        """The map tells where the object is, but it is covered there, or gone."""
        reason = f"hidden: {why}; its place is known from the map, its parameters are not"
        return cls(
            "hidden", reason, None, float("nan"), n_points, n_inliers, timings_ms, total_ms,
            pose_from="map", known=known,
        )  # fmt: skip

    @property
    def pose(self) -> RigidTransform | None:
        """camera_from_object; None when lost."""
        if self.estimate is not None:
            return self.estimate.state.camera_from_object
        return None if self.known is None else self.known.pose

    @property
    def pose_std(self) -> Array:
        """Standard deviations (6,) of the pose's rotation vector (rad) and translation (m); NaN when lost."""
        if self.estimate is not None:
            return self.estimate.pose_std
        return np.full(6, np.nan) if self.known is None else np.sqrt(np.diag(self.known.covariance))


# What a frame is made into, what an attempt to find the object in it gave, and whether to believe it.


#: Where less than this share of all points agree, they must agree closely.
MOST_AGREE = 0.5


@dataclass(frozen=True)
class Image:
    """A frame made ready.

    Attributes
    ----------
    grey : the undistorted image (h, w). normalized : contrast-normalized.
    depth : (h, w) of a depth camera, as recorded, metres, NaN where unknown; None without one.
    occluder_depth : (h, w) depth of other objects, metres, infinite where there are none; None if none is
        known.
    """

    grey: NDArray[np.uint8]
    normalized: NDArray[np.uint8]
    depth: NDArray[np.float32] | None = None
    occluder_depth: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class PoseHypothesis:
    """An estimate, which measurements support it (p,), and all the measurements.

    Attributes
    ----------
    weights : (p,) that the measurements counted with, zero for those that do not support it.
    prior : what was known of the pose from the map when it was made; None if nothing was.
    depths : of the points that support it, where a depth camera saw them.
    discrepancy : what the shape has beyond the model's, once it was looked for.
    """

    estimate: Estimate
    inliers: NDArray[np.bool_]
    measurement: Measurement
    weights: Array
    prior: Prior | None = None
    outline: OutlineMeasurement | None = None
    depths: PointDepths | None = None
    discrepancy: Discrepancy | None = None


def refusal(attempt: PoseHypothesis, options: TrackerOptions) -> str:
    """Why an attempt is not to be believed; empty when it is.

    What covers an object may look like it by chance in places, but these do not agree closely. With a pose
    from the map the parameters alone are left to be found, which few points can tell. They must agree closely
    then, and be most of those that were found: what looks alike by chance does neither.
    """
    measurement, count = attempt.measurement, int(attempt.inliers.sum())
    needed = min(options.least_inliers, int(np.ceil(options.least_share * len(attempt.inliers))))
    visible, spread = int(measurement.visible.sum()), attempt.estimate.sigma_px
    if count >= needed:
        by_chance = count < MOST_AGREE * len(attempt.inliers) and spread > options.few_sigma_px
        return f"{count} of {visible} points agree, but only by {spread:.1f} px" if by_chance else ""
    if attempt.prior is None:
        return f"{count} of {visible} points agree, at least {needed} needed"
    if count < options.least_anchored:
        return f"{count} of {visible} points agree, at least {options.least_anchored} needed"
    found = int(measurement.valid.sum())
    if spread < options.few_sigma_px and count >= options.anchored_share * found:
        return ""
    return f"of {found} points found only {count} agree on a shape, by {spread:.1f} px"
