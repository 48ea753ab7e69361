"""What one frame told."""

from __future__ import annotations

from dataclasses import dataclass

from morph_dslam.online.estimation import Estimate

#: The stages of a frame that are timed, in order.
STAGES = ("prepare", "flow", "estimate", "render", "correct", "search", "recover", "outline", "fuse")

FOLLOWED = "followed from the previous frame"
FOUND_AGAIN = "found again where it was last seen"
RECOVERED = "recovered from the reference view's features"
#: Follows the reason of a frame in which the model, not noise, is what is left of the residuals.
UNEXPLAINED = "the model does not explain the images"


@dataclass(frozen=True)
class FrameResult:
    """What one frame told.

    Attributes
    ----------
    status : "tracked" or "lost". reason : how it was found, or why it was not.
    estimate : None when lost.
    residual_rms_px : root mean square of the inliers' residuals, NaN when lost.
    n_points, n_inliers : points that the object itself does not hide, and those that support the estimate.
    timings_ms : by stage, milliseconds. total_ms : the whole frame. recovered : found again after a loss.
    unexplained_px : what the model leaves of the residuals, see `systematic_errors`; NaN when lost.
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
