"""Whether a frame, with the state estimated in it, is fit to become a reference view, and which part of it.

All that is measured against the view later is bound by this state in this image, so both must be good: the
points agree closely and nearly all of them, the surface's place is known, and the image is sharp.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.attempt import Attempt, Picture
from morph_dslam.online.estimation.estimator import Estimate
from morph_dslam.online.measuring.appearance import Rendering
from morph_dslam.online.reference.reference_view import ReferenceView
from morph_dslam.online.reference.surface_coverage import SurfaceSamples
from morph_dslam.online.tracker_options import TrackerOptions
from morph_dslam.online.uncertainty.confidence import position_std
from morph_dslam.online.uncertainty.systematic_errors import UNEXPLAINED_PX

Array = NDArray[np.float64]

#: Share of the visible points that must agree, and the largest robust spread of their residuals, pixels.
LEAST_AGREEING, LARGEST_SIGMA_PX = 0.6, 1.0
#: Largest standard deviation of the surface's position, root mean square, as a share of the object's size.
LARGEST_SPREAD = 0.05
#: An image whose edges are so much softer than those of the view it is compared with is blurred.
LEAST_SHARPNESS = 0.8
#: Around points that disagree something else may be in front of the object; so far, pixels, nothing is bound.
KEEP_OFF_PX = 12
#: How far the filters look that measure sharpness, pixels.
REACH_PX = 8


def surface_spread(samples: SurfaceSamples, stated: Estimate) -> float:
    """Root mean square standard deviation of the surface's position, metres."""
    return float(np.sqrt(np.mean(position_std(samples.model, stated) ** 2)))


def is_known_well(attempt: Attempt, spread: float, unexplained_px: float, options: TrackerOptions) -> bool:
    """Whether the state in a frame is known well enough for a reference view.

    Parameters
    ----------
    spread : see `surface_spread`, of the estimate with all errors, as a share of the object's size.
    unexplained_px : what the model leaves of the residuals.
    """
    agreeing, visible = int(attempt.inliers.sum()), int(attempt.measurement.visible.sum())
    if agreeing < max(options.least_inliers, LEAST_AGREEING * visible):
        return False
    if not attempt.estimate.sigma_px < LARGEST_SIGMA_PX or not unexplained_px < UNEXPLAINED_PX:
        return False
    return spread < LARGEST_SPREAD


def is_sharp(picture: Picture, attempt: Attempt, should_be: Rendering, half: int) -> bool:
    """Whether a frame is as sharp as the view that it was compared with.

    Parameters
    ----------
    should_be : that view in the state of the attempt. half : of the side of the squares about points in which
        sharpness is compared, pixels.
    """
    near = around(picture, attempt.measurement.pixels[attempt.inliers], half)
    return sharpness(picture.flat, near) > LEAST_SHARPNESS * sharpness(should_be.image, near)


def seen_part(
    picture: Picture, attempt: Attempt, should_be: Rendering, view: ReferenceView
) -> NDArray[np.bool_]:
    """Pixels (h, w) that show the object, and where nothing else may be before it.

    Parameters
    ----------
    attempt : made against ``view``. should_be : that view in the state of the attempt.
    """
    disagree = attempt.measurement.visible & ~attempt.inliers
    seen = np.isfinite(should_be.depth)
    seen &= ~around(picture, view.projected(attempt.estimate.state)[disagree], KEEP_OFF_PX)
    if picture.in_front is not None:
        seen &= picture.in_front >= should_be.depth
    return seen


def sharpness(flat: NDArray[np.uint8], where: NDArray[np.bool_]) -> float:
    """Squared slope of an image (h, w) over its variance ``where`` (h, w): blur lowers it, light does not."""
    if not where.any():
        return 0.0
    flat, where = _cut_out(flat, where)
    smooth = cv2.GaussianBlur(flat, (0, 0), 1.0).astype(np.float32)
    x, y = (cv2.Sobel(smooth, cv2.CV_32F, *order) / 8.0 for order in ((1, 0), (0, 1)))
    return float(np.mean((x**2 + y**2)[where]) / max(float(np.var(smooth[where])), 1e-6))


def _cut_out(
    flat: NDArray[np.uint8], where: NDArray[np.bool_]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The part of both (h, w) that holds all of ``where``, with as much around it as filters reach."""
    left, top, width, height = cv2.boundingRect(where.astype(np.uint8))
    rows = slice(max(top - REACH_PX, 0), top + height + REACH_PX)
    columns = slice(max(left - REACH_PX, 0), left + width + REACH_PX)
    return np.ascontiguousarray(flat[rows, columns]), where[rows, columns]


def around(picture: Picture, pixels: Array, half: int) -> NDArray[np.bool_]:
    """Pixels (h, w) in squares about points (p, 2)."""
    height, width = picture.flat.shape[:2]
    marks = np.zeros((height, width), np.uint8)
    places = np.rint(pixels).astype(np.int64).reshape(-1, 2)
    columns, rows = places[:, 0], places[:, 1]
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    marks[rows[inside], columns[inside]] = 1
    return cv2.dilate(marks, np.ones((2 * half + 1,) * 2, np.uint8)) > 0
