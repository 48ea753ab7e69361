"""Whether a frame, with the state estimated in it, is fit to become a reference view, and which part of it.

All that is measured against the view later is bound by this state in this image, so both must be good: the
points agree closely and nearly all of them, the surface's place is known, and the image is sharp.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.attempt import Attempt, Picture
from morph_dslam.online.confidence import position_std
from morph_dslam.online.estimation import Estimate
from morph_dslam.online.reference_view import ReferenceView
from morph_dslam.online.systematic_errors import UNEXPLAINED_PX
from morph_dslam.online.tracker_options import TrackerOptions

Array = NDArray[np.float64]

#: Share of the visible points that must agree, and the largest robust spread of their residuals, pixels.
LEAST_AGREEING, LARGEST_SIGMA_PX = 0.6, 1.0
#: Largest standard deviation of the surface's position, root mean square, as a share of the object's size.
LARGEST_SPREAD = 0.05
#: An image whose edges are so much softer than those of the view it is compared with is blurred.
LEAST_SHARPNESS = 0.8
#: Around points that disagree something else may be in front of the object; so far, pixels, nothing is bound.
KEEP_OFF_PX = 12


def surface_spread(view: ReferenceView, stated: Estimate) -> float:
    """Root mean square standard deviation of the position of the surface's nodes, metres."""
    return float(np.sqrt(np.mean(position_std(view.surface.model, stated) ** 2)))


def is_fit(
    picture: Picture,
    attempt: Attempt,
    stated: Estimate,
    unexplained_px: float,
    view: ReferenceView,
    options: TrackerOptions,
) -> bool:
    """Whether a frame can be a reference view.

    Parameters
    ----------
    attempt : made against ``view``. stated : its estimate with all errors in its covariance.
    unexplained_px : what the model leaves of the residuals.
    """
    agreeing, visible = int(attempt.inliers.sum()), int(attempt.measurement.visible.sum())
    if agreeing < max(options.least_inliers, LEAST_AGREEING * visible):
        return False
    if not attempt.estimate.sigma_px < LARGEST_SIGMA_PX or not unexplained_px < UNEXPLAINED_PX:
        return False
    nodes = view.surface.model.nodes
    if not surface_spread(view, stated) < LARGEST_SPREAD * np.linalg.norm(np.ptp(nodes, axis=0)):
        return False
    around = _around(picture, attempt.measurement.pixels[attempt.inliers], options.measurement.patch_half)
    should_be = view.rendered(stated.state)
    return sharpness(picture.flat, around) > LEAST_SHARPNESS * sharpness(should_be, around)


def hidden_part(picture: Picture, attempt: Attempt, view: ReferenceView) -> NDArray[np.bool_]:
    """Pixels (h, w) where something else may be before the object; the attempt was made against ``view``."""
    state, disagree = attempt.estimate.state, attempt.measurement.visible & ~attempt.inliers
    hidden = _around(picture, view.projected(state)[disagree], KEEP_OFF_PX)
    if picture.in_front is not None:
        hidden |= picture.in_front < view.depth(state)
    return hidden


def sharpness(flat: NDArray[np.uint8], where: NDArray[np.bool_]) -> float:
    """Squared slope of an image (h, w) over its variance ``where`` (h, w): blur lowers it, light does not."""
    smooth = cv2.GaussianBlur(flat, (0, 0), 1.0).astype(np.float32)
    x, y = (cv2.Sobel(smooth, cv2.CV_32F, *order) / 8.0 for order in ((1, 0), (0, 1)))
    if not where.any():
        return 0.0
    return float(np.mean((x**2 + y**2)[where]) / max(float(np.var(smooth[where])), 1e-6))


def _around(picture: Picture, pixels: Array, half: int) -> NDArray[np.bool_]:
    """Pixels (h, w) in squares about points (p, 2)."""
    height, width = picture.flat.shape[:2]
    marks = np.zeros((height, width), np.uint8)
    places = np.rint(pixels).astype(np.int64).reshape(-1, 2)
    columns, rows = places[:, 0], places[:, 1]
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    marks[rows[inside], columns[inside]] = 1
    return cv2.dilate(marks, np.ones((2 * half + 1,) * 2, np.uint8)) > 0
