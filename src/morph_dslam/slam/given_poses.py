"""Whether given poses agree with the images that they are said to be of.

Corners are followed by the images alone. Whatever their depth, right poses have them on their epipolar lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.geometry import cross_matrix
from morph_dslam.io.trajectory import other_conventions
from morph_dslam.slam.frame_images import FrameView
from morph_dslam.slam.options import LEAST_CORRELATION, PATCH_HALF
from morph_dslam.slam.pose import epipolar_errors, inside, inverse
from morph_dslam.tracking.patches import FLOW_WINDOW, follow, patch_correlation, spread_corners

Array = NDArray[np.float64]
#: Corners are followed until they have moved this far, pixels, median: then wrong poses show. Right ones, good to a few
#: millimetres, have them within a pixel of their lines, a rolling shutter included; other axes miss by 4 and more.
MOTION_PX = 20.0
#: Corners that are followed, the fewest that tell anything, and the fewest pairs of frames.
N_CORNERS, LEAST_CORNERS, LEAST_PAIRS = 300, 50, 3
#: Poses that miss by more, pixels, are not those of the images; another convention is meant if it misses by so many
#: times less, and the given one by more than so many pixels.
MOST_MISS_PX, CLEARLY, LEAST_MISS_PX = 4.0, 3.0, 1.5


@dataclass
class _Start:
    """The view that corners (n, 2) are followed from, the row of its pose, and where they are (n, 2) in the newest."""

    view: FrameView
    row: int
    corners: Array
    newest: FrameView
    pixels: Array


class PoseCheck:
    """Compares poses, and what they are by other conventions, with what frames show.

    Parameters
    ----------
    world_from_camera : (n, 4, 4) as given
    intrinsics : (4,) of the undistorted images
    """

    def __init__(self, world_from_camera: Array, intrinsics: Array) -> None:
        self._given, self._intrinsics = world_from_camera, intrinsics
        self._others = other_conventions(world_from_camera)
        self._misses: list[list[float]] = []
        self._start: _Start | None = None

    def add(self, view: FrameView, row: int) -> None:
        """Take in the next frame, whose pose has this row."""
        if self._start is not None:
            self._follow(self._start, view, row)
        if self._start is None:
            everywhere = np.full(view.normalized.shape, 255, dtype=np.uint8)
            corners = spread_corners(view.normalized, everywhere, N_CORNERS)
            self._start = _Start(view, row, corners, view, corners)

    def fault(self) -> str | None:
        """What is wrong with the poses, to follow "they"; None if they agree with the frames, or these do not tell."""
        misses = np.array(self._misses).reshape(-1, 1 + len(self._others))
        misses = misses[np.isfinite(misses).all(axis=1)]
        if len(misses) < LEAST_PAIRS:
            return None
        given, *others = np.median(misses, axis=0).tolist()
        best = int(np.argmin(others))
        if given > max(CLEARLY * others[best], LEAST_MISS_PX):
            return (
                f"{list(self._others)[best]}. Corners then miss their epipolar lines by {others[best]:.1f} px, not by "
                f"{given:.1f}, while they move by {MOTION_PX:.0f}"
            )
        if given > MOST_MISS_PX:
            return (
                f"have corners {given:.1f} px beside their epipolar lines while these move by {MOTION_PX:.0f}. Check "
                "that poses are those of the camera, not of another body that it sits on, at the frames' timestamps, "
                "and the camera file"
            )
        return None

    def _follow(self, start: _Start, view: FrameView, row: int) -> None:
        """Follow the corners into a view; compare, and end, once they have moved far enough."""
        pixels, found = follow(start.newest.normalized, view.normalized, start.pixels, start.pixels)
        found &= inside(pixels, view.normalized.shape, FLOW_WINDOW)
        start.corners, start.pixels, start.newest = start.corners[found], pixels[found], view
        if len(start.corners) < LEAST_CORNERS:
            self._start = None
        elif np.median(np.linalg.norm(start.pixels - start.corners, axis=1)) > MOTION_PX:
            self._compare(start, row)
            self._start = None

    def _compare(self, start: _Start, row: int) -> None:
        """Note by how much corners miss their lines, median, as given and by each other convention."""
        first, second = start.view.normalized, start.newest.normalized
        alike = patch_correlation(first, second, start.corners, start.pixels, PATCH_HALF) > LEAST_CORRELATION
        if alike.sum() >= LEAST_CORNERS:
            pixels = start.corners[alike], start.pixels[alike]
            ways = (self._given, *self._others.values())
            self._misses.append([self._miss(poses[start.row], poses[row], *pixels) for poses in ways])

    def _miss(self, first: Array, second: Array, before: Array, after: Array) -> float:
        """Median distance in pixels; NaN between poses at the same place, which have no epipolar lines."""
        motion = inverse(second) @ first
        essential = cross_matrix(motion[:3, 3]) @ motion[:3, :3]
        if not np.abs(essential).max() > 0.0:
            return np.nan
        squared = epipolar_errors(essential, before, after, self._intrinsics)
        return float(np.median(np.sqrt(np.maximum(*squared))))
