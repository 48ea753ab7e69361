"""Points of a new keyframe: corners to follow, depth from a frame or from two views, points mapped twice."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.measuring.features import spread_corners
from morph_dslam.online.slam.depth import FrameDepth, depth_of
from morph_dslam.online.slam.options import SlamOptions
from morph_dslam.online.slam.projection import project, rays, world_points
from morph_dslam.online.slam.rigid_map import CANDIDATE, GOOD, Followed, Indices, Keyframe, RigidMap
from morph_dslam.online.slam.two_view import check_points, triangulate

Array = NDArray[np.float64]

#: Points that miss a view by more than this multiple of the usual error are at no place; bounds in pixels.
MISS_RATIO, LEAST_MISS_PX, MOST_MISS_PX = 4.0, 1.5, 4.0
#: Points of one place: this near in the image, pixels, and their depths alike to this part.
SAME_PIXEL, SAME_DEPTH = 2.0, 0.1
#: Fewer missing corners than this are not worth a search.
LEAST_MISSING = 10


def free_corners(flat: NDArray[np.uint8], taken: Array, options: SlamOptions) -> Array:
    """Corners (c, 2) of a flattened image, as many as are missing, away from the pixels (n, 2) taken."""
    missing = options.map_corners - len(taken)
    if missing < LEAST_MISSING:
        return np.empty((0, 2))
    mask = np.full(flat.shape, 255, dtype=np.uint8)
    columns, rows = np.rint(taken).astype(int).clip(0, np.array(mask.shape[::-1]) - 1).T
    mask[rows, columns] = 0
    reach = 2 * options.corner_distance_px + 1
    mask = np.asarray(cv2.erode(mask, np.ones((reach, reach), np.uint8)), dtype=np.uint8)
    border = options.flow.window
    mask[:border], mask[-border:], mask[:, :border], mask[:, -border:] = 0, 0, 0, 0
    return spread_corners(flat, mask, missing)


class PointMaker:
    """Adds the points that a keyframe makes known to a map."""

    def __init__(self, rigid_map: RigidMap, intrinsics: Array, options: SlamOptions) -> None:
        self._map, self._intrinsics, self._options = rigid_map, intrinsics, options

    def add_candidates(self, number: int, corners: Array, depth: float) -> None:
        """Follow corners (c, 2) of a keyframe; their depth is a guess until they are triangulated."""
        pose = self._map.keyframes[number].camera_from_world
        positions = world_points(pose, corners, depth, self._intrinsics)
        ids = self._map.add_points(positions, corners, number, CANDIDATE)
        self._map.extend_keyframe(number, Followed(ids, corners))

    def place_by_depth(self, number: int, depth: FrameDepth | None) -> None:
        """Make map points of the candidates of a view that are near enough for their depth to be measured."""
        rigid_map, keyframe = self._map, self._map.keyframes[number]
        if depth is None or not rigid_map.is_metric:
            return
        rows = np.flatnonzero(rigid_map.state[keyframe.point_ids] == CANDIDATE)
        right = depth.right_columns(keyframe.pixels[rows])
        near = keyframe.pixels[rows, 0] - right >= self._options.least_disparity_px
        rows, right = rows[near], right[near]
        columns = keyframe.right.copy()
        columns[rows] = right
        keyframe.right = columns
        ids, pixels = keyframe.point_ids[rows], keyframe.pixels[rows]
        depths = depth_of(pixels, right, rigid_map.baseline_px)
        rigid_map.positions[ids] = world_points(keyframe.camera_from_world, pixels, depths, self._intrinsics)
        rigid_map.state[ids] = GOOD

    def triangulate(self, number: int) -> None:
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
        most = min(max(MISS_RATIO * self._map.usual_rms_px, LEAST_MISS_PX), MOST_MISS_PX)
        good = check_points(points, [start, now], seen, self._intrinsics, most)
        chosen = ids[open_enough]
        poses = np.array([self._map.pose_of(k) for k in range(len(self._map.keyframes))])
        good &= self._map.passing.agree(chosen, points, poses, self._intrinsics, most)
        self._map.positions[chosen[good]] = points[good]
        self._map.state[chosen[good]] = GOOD
        return chosen[~good]

    def fuse(self, number: int) -> None:
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
