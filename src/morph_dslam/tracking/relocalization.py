"""Relocalisation: finding a lost object again from the features of its reference view, or as it is rendered.

Several places of a frame may look like the rendered object.
"""

from __future__ import annotations

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.slam.pose import ransac_pose
from morph_dslam.tracking.binding import View, bind_pixels
from morph_dslam.tracking.estimator import BoundPoints, Estimator, State
from morph_dslam.tracking.measurement import Rendering
from morph_dslam.tracking.patches import NEUTRAL, detect_orb, match_descriptors

Array = NDArray[np.float64]
#: Features of an image.
N_FEATURES = 1000
#: Reprojection error, pixels, that a match may have before its shape is estimated; the shape is only guessed then.
PNP_PX = 8.0
#: Fewer matches that agree are not accepted.
LEAST_MATCHES = 12
#: Images are halved until they are at most so wide, pixels: places only say where to measure.
MOST_WIDE = 400
#: Of all places so many, those that look most alike, and none that correlates with the rendering by less than this, or
#: by less than this share of what the best one does.
MOST_PLACES, LEAST_ALIKE, SHARE_OF_BEST = 9, 0.2, 0.5
#: Within so many pixels of the halved images two places are one.
APART = 3
#: Single precision makes a correlation larger than one by no more than this.
ROUNDING = 1e-3


class Relocalizer:
    """Descriptors of the reference view, bound to the mesh.

    Parameters
    ----------
    drawn : the model as it is drawn.
    grey : the reference image (h, w).
    mask : 255 where the object is seen.
    view : the drawn mesh in it.
    """

    def __init__(
        self, estimator: Estimator, drawn: ReducedModel, grey: NDArray[np.uint8], mask: NDArray[np.uint8], view: View
    ) -> None:
        self._estimator = estimator
        pixels, descriptors = detect_orb(grey, N_FEATURES, mask)
        surface, met = bind_pixels(drawn, estimator.camera, view, pixels)
        self._points = BoundPoints.from_surface(estimator.model, surface)
        self._descriptors = descriptors[met]
        self._detected: tuple[NDArray[np.uint8], tuple[Array, NDArray[np.uint8]]] | None = None

    def _features(self, grey: NDArray[np.uint8]) -> tuple[Array, NDArray[np.uint8]]:
        """Features of a frame, detected once for all searches in it."""
        if self._detected is None or self._detected[0] is not grey:
            self._detected = grey, detect_orb(grey, N_FEATURES)
        return self._detected[1]

    def find(
        self, grey: NDArray[np.uint8], shapes: list[Array], mask: NDArray[np.uint8] | None = None
    ) -> tuple[State | None, int]:
        """The object's state in a frame from matched features alone, and how many matches support it.

        Parameters
        ----------
        grey : (h, w).
        shapes : parameters (d,) to try the first pose with.
        mask : (h, w), 0 where not to look.

        Returns
        -------
        None in place of the state when fewer matches than `LEAST_MATCHES` agree on one.
        """
        pixels, descriptors = self._features(grey)
        if mask is not None:
            columns, rows = np.minimum(np.rint(pixels).astype(np.int64), [grey.shape[1] - 1, grey.shape[0] - 1]).T
            pixels, descriptors = pixels[mask[rows, columns] > 0], descriptors[mask[rows, columns] > 0]
        mine, theirs = match_descriptors(self._descriptors, descriptors)
        if len(mine) < LEAST_MATCHES:
            return None, len(mine)
        points = BoundPoints.from_surface(self._estimator.model, self._points.surface.take(mine))
        state, agreeing = state_from_matches(self._estimator, points, pixels[theirs], shapes)
        return state, int(agreeing.sum())


def state_from_matches(
    estimator: Estimator,
    points: BoundPoints,
    pixels: Array,
    shapes: list[Array],
    pnp_px: float = PNP_PX,
    least: int = LEAST_MATCHES,
) -> tuple[State | None, NDArray[np.bool_]]:
    """The object's state from matches of which many may be wrong, and which of them (k,) agree with it.

    Parameters
    ----------
    points, pixels : (k) and (k, 2).
    shapes : parameters (d,) to try the first pose with.

    Returns
    -------
    None in place of the state when fewer than ``least`` agree on one.
    """
    best, inliers = None, np.zeros(len(points), dtype=bool)
    for shape in shapes:
        positions = points.rest + points.field.value(shape)
        found = ransac_pose(positions, pixels, estimator.camera.matrix, pnp_px, cv2.SOLVEPNP_SQPNP, 200, 0.99)
        if found is not None and found[1].sum() > inliers.sum():
            best, inliers = State(shape, found[0]), found[1]
    if best is None or inliers.sum() < least:
        return None, inliers
    # Estimated from the agreeing matches, then once more from all that agree with the result.
    for _ in range(2):
        estimate = estimator.estimate(points, pixels, inliers.astype(float), best)
        best = estimate.state
        inliers = np.linalg.norm(estimate.residuals, axis=1) < pnp_px
    return (best if inliers.sum() >= least else None), inliers


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

    A place that has no contrast correlates with nothing: there OpenCV divides rounding errors by each other.
    """
    found = cv2.matchTemplate(field, shown, cv2.TM_CCOEFF_NORMED, mask=covered)
    known = np.isfinite(found) & (np.abs(found) <= 1.0 + ROUNDING)
    return np.clip(np.where(known, found, 0.0), -1.0, 1.0).astype(np.float32)
