"""Building the map: a kept view's new points, culling, fusion, local bundle adjustment.

A view is worked in by steps, between which tracking goes on (`mapping_work`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.slam.descriptors import OCTAVES, describe
from morph_dslam.online.slam.frame_images import FrameView
from morph_dslam.online.slam.initialisation import MapStart
from morph_dslam.online.slam.keyframe_choice import KeyframeChoice, median_depth
from morph_dslam.online.slam.keyframe_culling import cull_keyframes
from morph_dslam.online.slam.local_adjustment import gather, local_window, put_back
from morph_dslam.online.slam.mapping_work import Work, do_all
from morph_dslam.online.slam.new_points import PointMaker, free_corners
from morph_dslam.online.slam.options import SlamOptions
from morph_dslam.online.slam.projection import inverse
from morph_dslam.online.slam.rigid_map import GOOD, NOWHERE, Followed, Indices, Keyframe, RigidMap
from morph_dslam.online.slam.tracking import Tracked

Array = NDArray[np.float64]

#: Map points that are found in a smaller share of the frames that should show them are taken out.
LEAST_FOUND = 0.1
#: Iterations of local bundle adjustment.
LOCAL_ITERATIONS = 10


class Mapper:
    """Adds views to a map and keeps it right.

    Parameters
    ----------
    hold_poses : whether the keyframes' poses are given, and only points are adjusted.
    unknown_depth : at which corners are taken to be while nothing else is known.
    """

    def __init__(
        self,
        rigid_map: RigidMap,
        intrinsics: Array,
        options: SlamOptions,
        hold_poses: bool = False,
        unknown_depth: float = 1.0,
    ) -> None:
        self._map, self._intrinsics, self._options = rigid_map, intrinsics, options
        self._hold_poses = hold_poses
        self._points = PointMaker(rigid_map, intrinsics, options)
        self._choice = KeyframeChoice(rigid_map, intrinsics, options, unknown_depth)

    def begin(self, start: MapStart) -> None:
        """Fill the empty map from three views, median depth 1 in the first."""
        scale = 1.0 / float(np.median(start.points[:, 2]))
        ids = self._map.add_points(scale * start.points, start.views[0].pixels, 0, GOOD)
        for view, pose in zip(start.views, start.poses, strict=True):
            scaled = pose.copy()
            scaled[:3, 3] *= scale
            self._map.add_keyframe(_keyframe(view.frame, scaled, Followed(ids.copy(), view.pixels)))
        self._adjust_locally()
        for number in (0, 1):
            self._describe(number, start.views[number].frame)
        do_all(self._finish(2, start.views[2].frame))

    def begin_at(self, view: FrameView, camera_from_world: Array) -> int:
        """Fill the empty map from one view at a pose (4, 4); returns how many points have a depth."""
        number = self._map.add_keyframe(_keyframe(view, camera_from_world, NOWHERE))
        do_all(self._finish(number, view))
        return int((self._map.state == GOOD).sum())

    def wants_keyframe(self, tracked: Tracked, frame_index: int) -> bool:
        """Whether the map should keep this view."""
        return self._choice.wants(tracked, frame_index)

    def insert(self, tracked: Tracked, view: FrameView) -> Work:
        """Keep a view: its points and the adjustment, then new corners, then its description.

        Points that have left the rigid scene are taken out: when an object comes back to where it was, its
        points must not hold the camera.
        """
        self._map.remove(tracked.moved)
        number = self._map.add_keyframe(_keyframe(view, tracked.pose.camera_from_world, tracked.points))
        self._points.place_by_depth(number, view.depth)
        self._points.triangulate(number)
        self._points.fuse(number)
        self._adjust_locally()
        self._cull()
        yield
        cull_keyframes(self._map)
        yield from self._finish(number, view)

    def adjust_all(self, iterations: int = 20) -> None:
        """Bundle adjustment of the whole map."""
        self._adjust(self._map.kept_keyframes, np.empty(0, dtype=np.int64), iterations)

    def _finish(self, number: int, view: FrameView) -> Work:
        """New corners to follow, and a description of what the view sees, so that it can be recognised."""
        keyframe = self._map.keyframes[number]
        corners = free_corners(keyframe.flat, keyframe.pixels, self._options)
        if len(corners):
            depth = median_depth(
                self._map,
                keyframe.camera_from_world,
                keyframe.point_ids,
                self._intrinsics,
                self._choice.unknown_depth,
            )
            self._points.add_candidates(number, corners, depth)
        self._points.place_by_depth(number, view.depth)
        self._choice.kept(number, view.index)
        yield
        self._describe(number, view)

    def _describe(self, number: int, view: FrameView) -> None:
        keyframe = self._map.keyframes[number]
        rows, descriptors = describe(view.grey, keyframe.pixels, OCTAVES)
        keyframe.described_ids, keyframe.descriptors = keyframe.point_ids[rows], descriptors

    def _adjust_locally(self) -> None:
        """Bundle adjustment of the newest keyframes that see the same points, held by others that do."""
        window, holders = local_window(self._map, self._options)
        self._adjust(window, holders, LOCAL_ITERATIONS)

    def _adjust(self, free: Indices, fixed: Indices, iterations: int) -> None:
        problem = gather(self._map, self._intrinsics, free, fixed, iterations, self._hold_poses)
        put_back(self._map, problem, problem.solve())

    def _cull(self) -> None:
        """Take out map points that are hardly ever found where they should be."""
        rigid_map = self._map
        rare = rigid_map.n_found < LEAST_FOUND * rigid_map.n_expected
        rigid_map.remove(np.flatnonzero((rigid_map.state == GOOD) & rare & (rigid_map.n_expected >= 20)))


def _keyframe(view: FrameView, pose: Array, seen: Followed) -> Keyframe:
    return Keyframe(view.index, view.timestamp, view.flat, pose, seen.ids, seen.pixels, seen.right)


def pose_in_keyframe(camera_from_world: Array, keyframe: Keyframe) -> Array:
    """The camera in a keyframe's frame (4, 4), which later adjustments of the keyframe carry along."""
    return camera_from_world @ inverse(keyframe.camera_from_world)
