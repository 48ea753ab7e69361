"""A keyframe's image as it would look from elsewhere, so that patches of it can be found there.

Lucas-Kanade follows shifts: between views that are turned about the optical axis, or nearer or farther, the
keyframe is first warped as if its scene were a plane at the points' median depth. What is left of parallax is
small within a patch (Klein and Murray 2007 warp each patch by itself).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.measuring.flow import NEUTRAL
from morph_dslam.online.slam.projection import inverse
from morph_dslam.online.slam.rigid_map import Keyframe

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

#: Patches that are turned by less and scaled by less, along either axis, are followed as they are.
MOST_TURN_DEG, MOST_STRETCH = 14.0, 1.25
#: A warped view is used again while what it lacks is this part of those.
REUSE = 0.5


def plane_homography(keyframe_pose: Array, pose: Array, depth: float, intrinsics: Array) -> Array:
    """Pixels from a keyframe's pixels (3, 3), for a plane at a depth that is parallel to its image.

    Poses (4, 4) are camera_from_world.
    """
    fx, fy, cx, cy = intrinsics
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    relative = pose @ inverse(keyframe_pose)
    plane = relative[:3, :3].copy()
    plane[:, 2] += relative[:3, 3] / depth
    return matrix @ plane @ np.linalg.inv(matrix)


def warp_pixels(homography: Array, pixels: Array) -> Array:
    """Pixels (n, 2) moved by a homography (3, 3)."""
    moved = pixels @ homography[:, :2].T + homography[:, 2]
    return moved[:, :2] / moved[:, 2:]


def local_change(homography: Array, pixel: Array) -> Array:
    """Derivative (2, 2) of a homography at a pixel (2,)."""
    x, y, w = homography @ [*pixel, 1.0]
    return np.array(
        [homography[0, :2] * w - x * homography[2, :2], homography[1, :2] * w - y * homography[2, :2]]
    ) / (w * w)


def is_small(change: Array, part: float = 1.0) -> bool:
    """Whether patches changed by this matrix (2, 2) can be followed as they are."""
    (a, b), (c, d) = change.tolist()
    # The turn of the nearest rotation, and the singular values of a 2 x 2 matrix.
    turn, sheared = math.hypot(a + d, c - b), math.hypot(a - d, c + b)
    largest, smallest = 0.5 * (turn + sheared), 0.5 * (turn - sheared)
    angle = abs(math.degrees(math.atan2(c - b, a + d)))
    limit = MOST_STRETCH**part
    return angle < part * MOST_TURN_DEG and largest < limit and smallest > 1.0 / limit


class WarpedViews:
    """Keyframes as seen from about where the camera is."""

    def __init__(self, intrinsics: Array) -> None:
        self._intrinsics = intrinsics
        self._views: dict[int, tuple[Array, Image]] = {}

    def view(self, number: int, keyframe: Keyframe, pose: Array, depth: float) -> tuple[Image, Array | None]:
        """The image (h, w) to look for patches of, and the homography (3, 3) from the keyframe's pixels.

        That is None where the keyframe itself will do. ``pose`` (4, 4) is camera from world, ``depth`` that
        of the points before the keyframe, in the map's unit.
        """
        now = plane_homography(keyframe.camera_from_world, pose, depth, self._intrinsics)
        centre = self._intrinsics[2:]
        change = local_change(now, centre)
        if is_small(change) or not np.isfinite(change).all() or np.linalg.det(change) <= 0.0:
            return keyframe.flat, None
        if number in self._views:
            before, image = self._views[number]
            if is_small(change @ np.linalg.inv(local_change(before, centre)), REUSE):
                return image, before
        image = cv2.warpPerspective(keyframe.flat, now, keyframe.flat.shape[::-1], borderValue=NEUTRAL)
        self._views[number] = now, np.asarray(image, dtype=np.uint8)
        return self._views[number][1], now
