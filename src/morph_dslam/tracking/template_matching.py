"""Template matching: places of a frame that look like the object as it is rendered, of which there may be several."""

from __future__ import annotations

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from morph_dslam.tracking.measurement import Rendering
from morph_dslam.tracking.patches import NEUTRAL

Array = NDArray[np.float64]
#: Images are halved until they are at most so wide, pixels: places only say where to measure.
MOST_WIDE = 400
#: Of all places so many, those that look most alike, and none that correlates with the rendering by less than this, or
#: by less than this share of what the best one does.
MOST_PLACES, LEAST_ALIKE, SHARE_OF_BEST = 9, 0.2, 0.5
#: Within so many pixels of the halved images two places are one.
APART = 3


def matching_shifts(frame: NDArray[np.uint8], rendering: Rendering) -> Array:
    """By how much (k, 2) the rendered object would have to be moved in the image, pixels, the likeliest first.

    Parameters
    ----------
    frame : (h, w), contrast-normalized.
    rendering : of the object in a state.
    """
    shown, covered = rendering.image, np.isfinite(rendering.depth).astype(np.uint8)
    halvings = 0
    while frame.shape[1] > MOST_WIDE:
        frame, shown, covered, halvings = cv2.pyrDown(frame), cv2.pyrDown(shown), covered[::2, ::2], halvings + 1  # type: ignore[assignment]
    if not covered.any():
        return np.empty((0, 2))
    x, y, width, height = cv2.boundingRect(np.ascontiguousarray(covered))
    window = slice(y, y + height), slice(x, x + width)
    above, beside = height // 2, width // 2  # half of it may be outside of the frame
    field = cv2.copyMakeBorder(frame, above, above, beside, beside, cv2.BORDER_CONSTANT, value=(NEUTRAL,))
    alike = _correlation(field, np.ascontiguousarray(shown[window]), np.ascontiguousarray(covered[window]))
    around = np.ones((2 * APART + 1, 2 * APART + 1), np.uint8)
    peaks = (alike >= cv2.dilate(alike, around)) & (alike > max(LEAST_ALIKE, SHARE_OF_BEST * float(alike.max())))
    rows, columns = np.nonzero(peaks)
    first = np.argsort(-alike[rows, columns])[:MOST_PLACES]
    moved = np.stack([columns[first] - beside - x, rows[first] - above - y], axis=1)
    return 2.0**halvings * moved.astype(np.float64)


def _correlation(field: MatLike, shown: MatLike, covered: MatLike) -> NDArray[np.float32]:
    """Normalized cross-correlation of what is shown with every place of a field, where it is covered alone.

    A place that has no contrast correlates with nothing.
    """
    found = cv2.matchTemplate(field, shown, cv2.TM_CCOEFF_NORMED, mask=covered)
    return np.where(np.isfinite(found) & (np.abs(found) <= 1.0), found, 0.0).astype(np.float32)
