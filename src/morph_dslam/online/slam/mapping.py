"""Building the map: when to keep a view, new points, culling, fusion, local bundle adjustment."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.features import spread_corners
from morph_dslam.online.slam.bundle_adjustment import Observations, adjust
from morph_dslam.online.slam.depth import FrameDepth, depth_of
from morph_dslam.online.slam.descriptors import OCTAVES, describe
from morph_dslam.online.slam.frame_images import FrameView
from morph_dslam.online.slam.initialisation import MapStart
from morph_dslam.online.slam.options import SlamOptions
from morph_dslam.online.slam.pose import reprojection_errors
from morph_dslam.online.slam.projection import inverse, project, rays, world_points
from morph_dslam.online.slam.rigid_map import CANDIDATE, GOOD, Followed, Indices, Keyframe, RigidMap
from morph_dslam.online.slam.tracking import Tracked
from morph_dslam.online.slam.two_view import camera_centre, check_points, triangulate

Array = NDArray[np.float64]

#: Observations that miss by more after adjustment are taken out, pixels.
MOST_ERROR_PX = 4.0
#: Points of one place: this near in the image, pixels, and their depths alike to this part.
SAME_PIXEL, SAME_DEPTH = 2.0, 0.1
#: Map points that are found in a smaller share of the frames that should show them are taken out.
LEAST_FOUND = 0.1


class Mapper:
    """Adds views to a map and keeps it right."""

    def __init__(self, rigid_map: RigidMap, intrinsics: Array, options: SlamOptions) -> None:
        self._map = rigid_map
        self._intrinsics = intrinsics
        self._options = options
        self._n_at_keyframe, self._last_index = 0, -options.least_frames_between

    def begin(self, start: MapStart) -> Followed:
        """Fill the empty map from three views, median depth 1 in the first; returns what the last sees."""
        scale = 1.0 / float(np.median(start.points[:, 2]))
        ids = self._map.add_points(scale * start.points, start.views[0].pixels, 0, GOOD)
        for view, pose in zip(start.views, start.poses, strict=True):
            scaled = pose.copy()
            scaled[:3, 3] *= scale
            self._map.add_keyframe(_keyframe(view.frame, scaled, Followed(ids.copy(), view.pixels)))
        self._adjust_locally()
        for number in (0, 1):
            self._describe(number, start.views[number].frame)
        return self._finish(2, start.views[2].frame)

    def begin_metric(self, view: FrameView) -> Followed | str:
        """Fill the empty map from one view whose corners' depths are measured, or say why it cannot be."""
        nothing = Followed(np.empty(0, dtype=np.int64), np.empty((0, 2)))
        self._map.add_keyframe(_keyframe(view, np.eye(4), nothing))
        points = self._finish(0, view)
        n, least = self._n_at_keyframe, self._options.least_start_points
        return points if n >= least else f"only {n} corners with depth, {least} are needed"

    def wants_keyframe(self, tracked: Tracked, frame_index: int) -> bool:
        """Whether the map should keep this view."""
        options, last = self._options, self._map.keyframes[-1]
        if frame_index - self._last_index < options.least_frames_between:
            return False
        if tracked.n_inliers < max(options.urgent_share * self._n_at_keyframe, 4 * options.least_inliers):
            return True
        if tracked.image_motion_px > options.quiet_px:
            return False
        if tracked.n_inliers < options.keyframe_share * self._n_at_keyframe:
            return True
        rows, seen = last.rows_of(tracked.points.ids)
        if not seen.any():
            return True
        motion = np.linalg.norm(tracked.points.pixels[seen] - last.pixels[rows[seen]], axis=1)
        centres = [camera_centre(p) for p in (tracked.pose.camera_from_world, last.camera_from_world)]
        baseline = np.linalg.norm(centres[0] - centres[1]) / self._median_depth(
            tracked.pose.camera_from_world, tracked.points.ids
        )
        return bool(np.median(motion) > options.keyframe_motion_px or baseline > options.keyframe_baseline)

    def insert(self, tracked: Tracked, view: FrameView) -> Followed:
        """Keep a view; returns the points to follow from it."""
        number = self._map.add_keyframe(_keyframe(view, tracked.pose.camera_from_world, tracked.points))
        self._place_by_depth(number, view.depth)
        self._triangulate(number)
        self._fuse(number)
        self._adjust_locally()
        self._cull()
        return self._finish(number, view)

    def adjust_all(self, iterations: int = 20) -> None:
        """Bundle adjustment of the whole map."""
        everything = np.arange(len(self._map.keyframes))
        self._adjust(everything, np.empty(0, dtype=np.int64), iterations)

    def _finish(self, number: int, view: FrameView) -> Followed:
        self._add_candidates(number)
        self._place_by_depth(number, view.depth)
        self._describe(number, view)
        keyframe, self._last_index = self._map.keyframes[number], view.index
        self._n_at_keyframe = int((self._map.state[keyframe.point_ids] == GOOD).sum())
        return Followed(keyframe.point_ids.copy(), keyframe.pixels.copy())

    def _describe(self, number: int, view: FrameView) -> None:
        """Describe what a view sees, so that it can be recognised."""
        keyframe = self._map.keyframes[number]
        rows, keyframe.descriptors = describe(view.grey, keyframe.pixels, OCTAVES)
        keyframe.described_ids = keyframe.point_ids[rows]

    def _place_by_depth(self, number: int, depth: FrameDepth | None) -> None:
        """Make map points of the candidates of a view that are near enough for their depth to be measured."""
        rigid_map, keyframe = self._map, self._map.keyframes[number]
        if depth is None or not rigid_map.is_metric:
            return
        rows = np.flatnonzero(rigid_map.state[keyframe.point_ids] == CANDIDATE)
        right = depth.right_columns(keyframe.pixels[rows])
        near = keyframe.pixels[rows, 0] - right >= self._options.least_disparity_px
        rows, right = rows[near], right[near]
        keyframe.right[rows] = right
        ids, pixels = keyframe.point_ids[rows], keyframe.pixels[rows]
        depths = depth_of(pixels, right, rigid_map.baseline_px)
        rigid_map.positions[ids] = world_points(keyframe.camera_from_world, pixels, depths, self._intrinsics)
        rigid_map.state[ids] = GOOD

    def _median_depth(self, pose: Array, ids: Indices) -> float:
        known = ids[self._map.state[ids] == GOOD]
        _, depths = project(pose, self._map.positions[known], self._intrinsics)
        return max(float(np.median(depths)), 1e-6) if len(depths) else 1.0

    def _add_candidates(self, number: int) -> None:
        """Corners where nothing is followed yet; their depth is a guess until they are triangulated."""
        keyframe, options = self._map.keyframes[number], self._options
        missing = options.map_corners - len(keyframe.point_ids)
        if missing < 10:
            return
        mask = np.full(keyframe.flat.shape, 255, dtype=np.uint8)
        taken = np.rint(keyframe.pixels).astype(int).clip(0, np.array(mask.shape[::-1]) - 1)
        mask[taken[:, 1], taken[:, 0]] = 0
        reach = 2 * options.corner_distance_px + 1
        mask = np.asarray(cv2.erode(mask, np.ones((reach, reach), np.uint8)), dtype=np.uint8)
        border = options.flow.window
        mask[:border], mask[-border:], mask[:, :border], mask[:, -border:] = 0, 0, 0, 0
        corners = spread_corners(keyframe.flat, mask, missing)
        pose = keyframe.camera_from_world
        depth = self._median_depth(pose, keyframe.point_ids)
        ids = self._map.add_points(
            world_points(pose, corners, depth, self._intrinsics), corners, number, CANDIDATE
        )
        self._map.extend_keyframe(number, Followed(ids, corners))

    def _triangulate(self, number: int) -> None:
        """Turn candidates whose rays have opened into map points; drop those that fit none, or were lost."""
        keyframe, rigid_map = self._map.keyframes[number], self._map
        waiting = np.flatnonzero(rigid_map.state == CANDIDATE)
        rows, seen = keyframe.rows_of(waiting)
        lost = waiting[~seen]
        waiting, pixels = waiting[seen], keyframe.pixels[rows[seen]]
        wrong = []
        for first in np.unique(rigid_map.first_keyframe[waiting]):
            of_first = rigid_map.first_keyframe[waiting] == first
            wrong.append(self._triangulate_from(int(first), waiting[of_first], keyframe, pixels[of_first]))
        rigid_map.remove(np.concatenate([lost, *wrong]))

    def _triangulate_from(self, first: int, ids: Indices, keyframe: Keyframe, pixels: Array) -> Indices:
        """Triangulate between two keyframes; returns the points that fit no place."""
        start = self._map.keyframes[first].camera_from_world
        first_pixels, now = self._map.first_pixels[ids], keyframe.camera_from_world
        first_rays, second_rays = rays(first_pixels, self._intrinsics), rays(pixels, self._intrinsics)
        a, b = first_rays @ start[:3, :3], second_rays @ now[:3, :3]
        cosine = np.einsum("nx,nx->n", a, b) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
        open_enough = cosine < np.cos(np.radians(self._options.triangulation_deg))
        if not open_enough.any():
            return ids[:0]
        points = triangulate(start, now, first_rays[open_enough], second_rays[open_enough])
        seen = [first_pixels[open_enough], pixels[open_enough]]
        good = check_points(points, [start, now], seen, self._intrinsics, MOST_ERROR_PX)
        chosen = ids[open_enough]
        self._map.positions[chosen[good]] = points[good]
        self._map.state[chosen[good]] = GOOD
        return chosen[~good]

    def _fuse(self, number: int) -> None:
        """Make map points that this view sees at one place one; candidates there are dropped."""
        keyframe, rigid_map = self._map.keyframes[number], self._map
        pixels, ids = keyframe.pixels, keyframe.point_ids
        order = np.argsort(pixels[:, 0], kind="stable")
        ends = np.searchsorted(pixels[order, 0], pixels[order, 0] + SAME_PIXEL)
        pairs = [
            (ids[order[i]], ids[order[j]])
            for i in range(len(order))
            for j in range(i + 1, ends[i])
            if np.abs(pixels[order[i], 1] - pixels[order[j], 1]) < SAME_PIXEL
        ]
        _, depths = project(keyframe.camera_from_world, rigid_map.positions, self._intrinsics)
        for pair in pairs:
            older, newer = min(pair), max(pair)
            if rigid_map.state[older] == GOOD and rigid_map.state[newer] == CANDIDATE:
                rigid_map.remove(np.array([newer]))
            elif rigid_map.state[older] == CANDIDATE and rigid_map.state[newer] == GOOD:
                rigid_map.remove(np.array([older]))
            elif (
                rigid_map.state[older] == GOOD
                and rigid_map.state[newer] == GOOD
                and abs(depths[older] / depths[newer] - 1.0) < SAME_DEPTH
            ):
                rigid_map.merge(int(older), int(newer))

    def _adjust_locally(self) -> None:
        """Bundle adjustment of the newest keyframes that see the same points, held by others that do."""
        rigid_map, options = self._map, self._options
        newest = len(rigid_map.keyframes) - 1
        ids = rigid_map.keyframes[newest].point_ids
        shared = rigid_map.shared_points(ids[rigid_map.state[ids] == GOOD])
        shared[newest] = np.iinfo(np.int64).max
        window = np.argsort(-shared, kind="stable")[: options.window]
        window = window[shared[window] > 0]
        local = np.unique(np.concatenate([rigid_map.keyframes[k].point_ids for k in window]))
        around = rigid_map.shared_points(local[rigid_map.state[local] == GOOD])
        around[window] = 0
        holders = np.argsort(-around, kind="stable")[: options.fixed_window]
        self._adjust(np.sort(window), np.sort(holders[around[holders] > 0]), 10)

    def _adjust(self, free: Indices, fixed: Indices, iterations: int) -> None:
        """Adjust keyframes and their points; the oldest free one is held where nothing else is."""
        rigid_map = self._map
        numbers = np.concatenate([fixed, free])
        held = np.arange(len(numbers)) < max(len(fixed), 1)
        wanted = np.zeros(len(rigid_map.state), dtype=bool)
        for k in free:
            wanted[rigid_map.keyframes[k].point_ids] = True
        wanted &= rigid_map.state == GOOD
        ids = np.flatnonzero(wanted)
        local = np.full(len(wanted), -1)
        local[ids] = np.arange(len(ids))
        chosen = [wanted[rigid_map.keyframes[k].point_ids] for k in numbers]
        observations = Observations(
            np.repeat(np.arange(len(numbers)), [int(rows.sum()) for rows in chosen]),
            np.concatenate(
                [local[rigid_map.keyframes[k].point_ids[r]] for k, r in zip(numbers, chosen, strict=True)]
            ),
            np.concatenate([rigid_map.keyframes[k].pixels[r] for k, r in zip(numbers, chosen, strict=True)]),
            np.concatenate([rigid_map.keyframes[k].right[r] for k, r in zip(numbers, chosen, strict=True)]),
        )
        poses = np.array([rigid_map.keyframes[k].camera_from_world for k in numbers])
        result = adjust(
            poses,
            rigid_map.positions[ids],
            observations,
            self._intrinsics,
            held,
            rigid_map.baseline_px,
            huber_px=1.5,
            iterations=iterations,
            tolerance=1e-4,
        )
        rigid_map.positions[ids] = result.points
        for k, pose in zip(numbers, result.camera_from_world, strict=True):
            rigid_map.keyframes[k].camera_from_world = pose
        self._drop_misses(free)

    def _drop_misses(self, numbers: Indices) -> None:
        """Take out the observations that contradict the map, then points that fewer than two views see."""
        rigid_map = self._map
        for k in numbers:
            keyframe = rigid_map.keyframes[k]
            ids = keyframe.point_ids
            errors = reprojection_errors(
                keyframe.camera_from_world, rigid_map.positions[ids], keyframe.pixels, self._intrinsics
            )
            keyframe.keep((errors < MOST_ERROR_PX) | (rigid_map.state[ids] != GOOD))
            self._drop_wrong_depths(keyframe)
        seen = rigid_map.n_observations()
        rigid_map.remove(np.flatnonzero((rigid_map.state == GOOD) & (seen < 2)))

    def _drop_wrong_depths(self, keyframe: Keyframe) -> None:
        """Forget the columns in the right image that contradict the map."""
        if not self._map.is_metric:
            return
        points = self._map.positions[keyframe.point_ids]
        pixels, depths = project(keyframe.camera_from_world, points, self._intrinsics)
        with np.errstate(divide="ignore", invalid="ignore"):
            misses = np.abs(pixels[:, 0] - self._map.baseline_px / depths - keyframe.right)
            wrong = (misses > MOST_ERROR_PX) & (self._map.state[keyframe.point_ids] == GOOD)
        keyframe.right[wrong] = np.nan

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
