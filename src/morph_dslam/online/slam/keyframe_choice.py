"""Which views the map keeps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.slam.options import SlamOptions
from morph_dslam.online.slam.projection import project
from morph_dslam.online.slam.rigid_map import GOOD, Indices, RigidMap
from morph_dslam.online.slam.tracking import Tracked
from morph_dslam.online.slam.two_view import camera_centre

Array = NDArray[np.float64]


def median_depth(rigid_map: RigidMap, pose: Array, ids: Indices, intrinsics: Array, unknown: float) -> float:
    """Median depth of the map points among some, seen from a pose (4, 4); ``unknown`` without any."""
    known = ids[rigid_map.state[ids] == GOOD]
    _, depths = project(pose, rigid_map.positions[known], intrinsics)
    return max(float(np.median(depths)), 1e-6) if len(depths) else unknown


class KeyframeChoice:
    """Tells when a view is worth keeping.

    Attributes
    ----------
    unknown_depth : depth of a scene of which nothing is known.
    """

    def __init__(
        self, rigid_map: RigidMap, intrinsics: Array, options: SlamOptions, unknown_depth: float
    ) -> None:
        self._map, self._intrinsics, self._options = rigid_map, intrinsics, options
        self.unknown_depth = unknown_depth
        self._n_points, self._frame_index = 0, -options.least_frames_between

    def kept(self, number: int, frame_index: int) -> int:
        """Note a new keyframe; returns how many map points it sees."""
        ids, self._frame_index = self._map.keyframes[number].point_ids, frame_index
        self._n_points = int((self._map.state[ids] == GOOD).sum())
        return self._n_points

    def wants(self, tracked: Tracked, frame_index: int) -> bool:
        """Whether the map should keep this view."""
        options = self._options
        if frame_index - self._frame_index < options.least_frames_between:
            return False
        if tracked.n_inliers < max(options.urgent_share * self._n_points, 4 * options.least_inliers):
            return True
        if tracked.image_motion_px > options.quiet_px:
            return False
        return tracked.n_inliers < options.keyframe_share * self._n_points or self._has_moved_on(tracked)

    def _has_moved_on(self, tracked: Tracked) -> bool:
        """Whether points, or the camera, have moved far since the last keyframe."""
        options, last, pose = self._options, self._map.keyframes[-1], tracked.pose.camera_from_world
        rows, seen = last.rows_of(tracked.points.ids)
        if not seen.any():
            return True
        motion = np.linalg.norm(tracked.points.pixels[seen] - last.pixels[rows[seen]], axis=1)
        baseline = np.linalg.norm(camera_centre(pose) - camera_centre(last.camera_from_world))
        depth = median_depth(self._map, pose, tracked.points.ids, self._intrinsics, self.unknown_depth)
        return bool(
            np.median(motion) > options.keyframe_motion_px or baseline / depth > options.keyframe_baseline
        )
