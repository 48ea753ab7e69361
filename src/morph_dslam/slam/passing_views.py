"""Frames between keyframes, kept while candidates have to show that they belong to the rigid scene.

A candidate gets its depth from two keyframes. Two views alone cannot tell a point that stands still from one
that moves along its epipolar line, as a point on an object that moves with or against the camera nearly does:
it only gets a wrong depth. Where it was in between tells, unless it keeps to the camera's pace.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.slam.pose import inverse, reprojection_errors

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

#: A frame is kept when the points have moved this far since the last one kept (median), pixels.
LEAST_MOTION_PX = 2.0
#: Frames kept at most; then every other one is left out.
MOST_VIEWS = 16
#: A point has to fit this share of the frames that it was followed in.
LEAST_SHARE = 0.75


@dataclass(frozen=True)
class _View:
    """A frame by its place in a keyframe's frame (4, 4), and where points (n,) were in it (n, 2)."""

    keyframe: int
    from_keyframe: Array
    ids: Indices
    pixels: Array


class PassingViews:
    """The frames, and where points without depth were in them.

    Copies stay what they are while the original goes on: lists of frames are replaced, not changed.
    """

    def __init__(self, views: list[_View] | None = None) -> None:
        self._views = views or []

    def copy(self) -> PassingViews:
        """The same views, to which others can be added apart."""
        return PassingViews(self._views)

    def note(self, keyframe: int, at: Array, camera_from_world: Array, ids: Indices, pixels: Array) -> None:
        """Keep a frame and its points without depth (n,) at pixels (n, 2), if these have moved on.

        ``at`` is the pose (4, 4) of the keyframe, whose later adjustments carry the frame along. Frames that
        show none of these points are not needed any more.
        """
        if not len(ids) or not self._has_moved_on(ids, pixels):
            return
        views = [view for view in self._views if np.isin(view.ids, ids).any()]
        views = views[::2] if len(views) >= MOST_VIEWS else views
        self._views = [*views, _View(keyframe, camera_from_world @ inverse(at), ids, pixels)]

    def agree(self, ids: Indices, points: Array, keyframe_poses: Array, intrinsics: Array, most_px: float) -> Mask:
        """Which points (n,), put at ``points`` (n, 3), are where they were seen; all that were never seen.

        ``keyframe_poses`` (k, 4, 4) are what the map has now.
        """
        seen, fitting = np.zeros(len(ids)), np.zeros(len(ids))
        order = np.argsort(ids)
        for view in self._views:
            common, rows, there = np.intersect1d(ids[order], view.ids, return_indices=True)
            if not len(common):
                continue
            rows = order[rows]
            pose = view.from_keyframe @ keyframe_poses[view.keyframe]
            errors = reprojection_errors(pose, points[rows], view.pixels[there], intrinsics)
            seen[rows] += 1
            fitting[rows] += errors < most_px
        return fitting >= LEAST_SHARE * seen

    def _has_moved_on(self, ids: Indices, pixels: Array) -> bool:
        if not self._views:
            return True
        last = self._views[-1]
        common, now, before = np.intersect1d(ids, last.ids, return_indices=True)
        if not len(common):
            return True
        moved = np.linalg.norm(pixels[now] - last.pixels[before], axis=1)
        return bool(np.median(moved) > LEAST_MOTION_PX)
