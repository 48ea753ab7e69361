"""The reference state refined by a depth image: landmarks of one view hardly tell how far the object is.

As in iterative closest points, surface points are paired with what the depth camera measured along their own
sight lines, and the pairs are made anew after each estimate.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import RegistrationError
from morph_dslam.online.estimation.depth_residuals import DepthOptions, PointDepths
from morph_dslam.online.estimation.estimator import BoundPoints, Estimate, Estimator, State
from morph_dslam.online.measuring.binding import bind_pixels, draw_view, view_of

Array = NDArray[np.float64]

#: Points that are paired, how often, and how many are needed.
POINTS, ROUNDS, LEAST = 600, 5, 30
#: Depths farther from the surface than this share of the object's size are of something else.
LARGEST_DISTANCE = 0.05
#: Depth within this many pixels of the object's rim may belong to what is behind it.
RIM_PX = 4


def refine_by_depth(
    estimator: Estimator,
    landmarks: BoundPoints,
    pixels: Array,
    state: State,
    sigma_px: float,
    image: NDArray[np.float32],
    options: DepthOptions,
) -> Estimate:
    """The state of an object from landmarks and a depth image of the same view.

    Parameters
    ----------
    landmarks : p of them, bound. pixels : (p, 2) of them in the undistorted image.
    state : as the landmarks have it. sigma_px : how exactly they were set.
    image : (h, w) as recorded, metres, NaN where unknown.

    Raises
    ------
    RegistrationError
        If there is hardly any depth where the landmarks have the object.
    """
    found = None
    for _ in range(ROUNDS):
        points, places = _surface_in_view(estimator, state)
        seen = np.ones(len(points), dtype=bool)
        depths = PointDepths.sampled(image, places, seen, estimator.camera, sigma_px**2, options)
        size = float(np.linalg.norm(np.ptp(estimator.model.nodes, axis=0)))
        near = np.abs(depths.depths - points.in_camera(state)[:, 2]) < LARGEST_DISTANCE * size
        depths = depths.only(near)
        if depths.count < LEAST:
            raise RegistrationError(
                f"only {depths.count} of {len(points)} points on the object have a depth near the one that "
                "the landmarks give: is the depth registered to this camera, and in its unit?"
            )
        found = estimator.estimate(
            points.joined(landmarks),
            np.concatenate([places, pixels]),
            np.concatenate([np.zeros(len(points)), np.ones(len(landmarks))]),
            state,
            depths=depths.padded(len(points) + len(landmarks)),
        )
        state = found.state
    assert found is not None
    return found


def _surface_in_view(estimator: Estimator, state: State) -> tuple[BoundPoints, Array]:
    """Points spread over what the camera sees of the surface, and their pixels (p, 2)."""
    model, camera = estimator.model, estimator.camera
    view = view_of(model, camera, state)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * RIM_PX + 1,) * 2)
    covered = cv2.erode(draw_view(view, model.triangles, camera).covered.astype(np.uint8), disc)
    rows, columns = np.nonzero(covered)
    chosen = np.random.default_rng(0).permutation(len(rows))[:POINTS]
    pixels = np.column_stack([columns[chosen], rows[chosen]]).astype(float)
    surface, met = bind_pixels(model, camera, view, pixels)
    return BoundPoints.from_surface(model, surface), pixels[met]
