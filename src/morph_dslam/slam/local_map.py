"""Points of a new keyframe, and bundle adjustment of the part of the map around it.

The adjustment is gathered from the map, solved apart from it, and put back; a tracker may go on in between.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.slam.bundle_adjustment import Adjustment, Observations, adjust
from morph_dslam.slam.frame_images import FrameDepth, depth_of
from morph_dslam.slam.options import LEAST_INLIERS
from morph_dslam.slam.pose import check_points, project, rays, reprojection_errors, triangulate, world_points
from morph_dslam.slam.rigid_map import CANDIDATE, GOOD, UNKNOWN_TWIST, Followed, Indices, Keyframe, RigidMap
from morph_dslam.slam.rolling_shutter import refined, seen_at_middle_row, velocities
from morph_dslam.tracking.patches import FLOW_WINDOW, spread_corners

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
#: Disparity from which the depth of a point in one frame makes it a map point, pixels; the baseline of depth images
#: counts as 8 cm.
LEAST_DISPARITY_PX = 10.0
#: Points and candidates that a keyframe is filled up to, and how far new corners keep from followed points, pixels.
MAP_CORNERS, CORNER_DISTANCE_PX = 450, 9
#: Angle between rays from which a candidate becomes a map point.
TRIANGULATION_DEG = 1.2
#: Points that miss a view by more than this multiple of the usual error are at no place; bounds in pixels.
NEW_POINT_MISS_RATIO, NEW_POINT_LEAST_MISS_PX, NEW_POINT_MOST_MISS_PX = 4.0, 1.5, 4.0
#: Points of one place: this near in the image, pixels, and their depths alike to this part.
SAME_PIXEL, SAME_DEPTH = 2.0, 0.1
#: Fewer missing corners than this are not worth a search.
LEAST_MISSING = 10


def free_corners(normalized: NDArray[np.uint8], taken: Array) -> Array:
    """Corners (c, 2) of a contrast-normalized image, as many as are missing, away from the pixels (n, 2) taken."""
    missing = MAP_CORNERS - len(taken)
    if missing < LEAST_MISSING:
        return np.empty((0, 2))
    mask = np.full(normalized.shape, 255, dtype=np.uint8)
    columns, rows = np.rint(taken).astype(int).clip(0, np.array(mask.shape[::-1]) - 1).T
    mask[rows, columns] = 0
    reach = 2 * CORNER_DISTANCE_PX + 1
    mask = np.asarray(cv2.erode(mask, np.ones((reach, reach), np.uint8)), dtype=np.uint8)
    border = FLOW_WINDOW
    mask[:border], mask[-border:], mask[:, :border], mask[:, -border:] = 0, 0, 0, 0
    return spread_corners(normalized, mask, missing)


class PointMaker:
    """Adds the points that a keyframe makes known to a map."""

    def __init__(self, rigid_map: RigidMap, intrinsics: Array) -> None:
        self._map, self._intrinsics = rigid_map, intrinsics

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
        near = keyframe.pixels[rows, 0] - right >= LEAST_DISPARITY_PX
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
        open_enough = cosine < np.cos(np.radians(TRIANGULATION_DEG))
        if not open_enough.any():
            return ids[:0]
        points = triangulate(start, now, first_rays[open_enough], second_rays[open_enough])
        seen = [first_pixels[open_enough], pixels[open_enough]]
        most = min(max(NEW_POINT_MISS_RATIO * self._map.usual_rms_px, NEW_POINT_LEAST_MISS_PX), NEW_POINT_MOST_MISS_PX)
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


#: Observations that miss by more than this multiple of the median error after adjustment are taken out, and
#: those beyond a smaller multiple before it count linearly; within bounds, in pixels. With bounds alone a few
#: wrong points would bend an otherwise exact map.
MISS_RATIO, LEAST_MISS_PX, MOST_MISS_PX = 6.0, 1.5, 4.0
HUBER_RATIO, LEAST_HUBER_PX, MOST_HUBER_PX = 2.0, 0.2, 1.5
TOLERANCE = 1e-4
#: Keyframes that local bundle adjustment moves, and those that hold it.
WINDOW, FIXED_WINDOW = 8, 6


@dataclass(frozen=True)
class MapProblem:
    """Keyframes and points to adjust together.

    Attributes
    ----------
    numbers : (k,) keyframes, of which ``held`` (k,) stay where they are.
    free : those whose points count.
    ids : (n,) points.
    camera_from_world : (k, 4, 4).
    positions : (n, 3).
    """

    numbers: Indices
    free: Indices
    held: NDArray[np.bool_]
    ids: Indices
    camera_from_world: Array
    positions: Array
    observations: Observations
    camera: Camera
    baseline_px: float
    iterations: int

    def solve(self) -> Adjustment:
        """Adjusted poses and points; touches no map."""
        usual = usual_error(self.errors(self.camera_from_world, self.positions))
        return adjust(
            self.camera_from_world,
            self.positions,
            self.observations,
            self.camera.intrinsics,
            self.held,
            self.baseline_px,
            huber_px=min(max(HUBER_RATIO * usual, LEAST_HUBER_PX), MOST_HUBER_PX),
            iterations=self.iterations,
            tolerance=TOLERANCE,
        )

    def after(self, result: Adjustment, iterations: int) -> MapProblem:
        """The same from where some iterations have led, with so many more to come."""
        poses, points = result.camera_from_world, result.points
        return replace(self, camera_from_world=poses, positions=points, iterations=iterations)

    def errors(self, camera_from_world: Array, positions: Array) -> Array:
        """Distances (o,) in pixels between the observations and the projected points."""
        seen = self.observations
        poses, points = camera_from_world[seen.camera_idx], positions[seen.point_idx]
        local = np.einsum("oij,oj->oi", poses[:, :3, :3], points) + poses[:, :3, 3]
        return reprojection_errors(np.eye(4), local, seen.pixels, self.camera.intrinsics)


def usual_error(errors: Array) -> float:
    """Median of some errors (n,), which outliers do not raise; infinite without any."""
    return float(np.median(errors)) if len(errors) else float("inf")


def local_window(rigid_map: RigidMap) -> tuple[Indices, Indices]:
    """The newest keyframe and those that see the same points, to be adjusted, and others to hold them."""
    newest = len(rigid_map.keyframes) - 1
    shared = rigid_map.shared_points(rigid_map.good_in(newest))
    shared[newest] = np.iinfo(np.int64).max
    window = np.argsort(-shared, kind="stable")[:WINDOW]
    window = window[shared[window] > 0]
    around = rigid_map.shared_points(np.unique(np.concatenate([rigid_map.good_in(k) for k in window])))
    around[window] = 0
    holders = np.argsort(-around, kind="stable")[:FIXED_WINDOW]
    return np.sort(window), np.sort(holders[around[holders] > 0])


def gather(
    rigid_map: RigidMap, camera: Camera, free: Indices, fixed: Indices, iterations: int, hold_poses: bool = False
) -> MapProblem:
    """The problem of ``free`` keyframes (numbers) and their points, held by ``fixed`` ones.

    With a rolling shutter, points are where they would be seen at the instant of the middle row. Where nothing else is
    held, the oldest free one is; with ``hold_poses`` all are, and only points move.
    """
    numbers = np.concatenate([fixed, free])
    held = np.arange(len(numbers)) < (len(numbers) if hold_poses else max(len(fixed), 1))
    keyframes = [rigid_map.keyframes[k] for k in numbers]
    wanted = np.zeros(len(rigid_map.state), dtype=bool)
    for k in free:
        wanted[rigid_map.keyframes[k].point_ids] = True
    wanted &= rigid_map.state == GOOD
    ids = np.flatnonzero(wanted)
    local = np.full(len(wanted), -1)
    local[ids] = np.arange(len(ids))
    seen = [_at_middle_row(rigid_map, camera, k, wanted[k.point_ids]) for k in keyframes]
    observations = Observations(
        np.repeat(np.arange(len(numbers)), [len(each.ids) for each in seen]),
        np.concatenate([local[each.ids] for each in seen]),
        np.concatenate([each.pixels for each in seen]),
        np.concatenate([each.right for each in seen]),
    )
    return MapProblem(
        numbers,
        free,
        held,
        ids,
        np.array([keyframe.camera_from_world for keyframe in keyframes]),
        rigid_map.positions[ids],
        observations,
        camera,
        rigid_map.baseline_px,
        iterations,
    )


def _at_middle_row(rigid_map: RigidMap, camera: Camera, keyframe: Keyframe, rows: Mask) -> Followed:
    """Those of a keyframe's points, at the middle row's instant."""
    seen = keyframe.seen[rows]
    pose, twist = keyframe.camera_from_world, keyframe.twist
    return seen_at_middle_row(camera, pose, twist, rigid_map.positions[seen.ids], seen)


def _take_over(rigid_map: RigidMap, problem: MapProblem, result: Adjustment) -> None:
    rigid_map.positions[problem.ids] = result.points
    for k, pose in zip(problem.numbers, result.camera_from_world, strict=True):
        rigid_map.keyframes[k].camera_from_world = pose


def put_back(rigid_map: RigidMap, problem: MapProblem, result: Adjustment) -> None:
    """Take over the adjusted poses and points, and take out what contradicts them."""
    _take_over(rigid_map, problem, result)
    usual = usual_error(problem.errors(result.camera_from_world, result.points))
    most = min(max(MISS_RATIO * usual, LEAST_MISS_PX), MOST_MISS_PX)
    _drop_misses(rigid_map, problem.free, problem.camera, most)


def _drop_misses(rigid_map: RigidMap, numbers: Indices, camera: Camera, most_px: float) -> None:
    """Take out the observations that contradict the map, then points that fewer than two views see."""
    for k in numbers:
        keyframe = rigid_map.keyframes[k]
        ids, pose = keyframe.point_ids, keyframe.camera_from_world
        pixels = _at_middle_row(rigid_map, camera, keyframe, np.ones(len(ids), dtype=bool)).pixels
        errors = reprojection_errors(pose, rigid_map.positions[ids], pixels, camera.intrinsics)
        keyframe.keep((errors < most_px) | (rigid_map.state[ids] != GOOD))
        _drop_wrong_depths(rigid_map, keyframe, camera.intrinsics)
    seen = rigid_map.n_observations()
    rigid_map.remove(np.flatnonzero((rigid_map.state == GOOD) & (seen < 2)))


def _drop_wrong_depths(rigid_map: RigidMap, keyframe: Keyframe, intrinsics: Array) -> None:
    """Forget the columns in the right image that contradict the map."""
    if not rigid_map.is_metric:
        return
    points = rigid_map.positions[keyframe.point_ids]
    pixels, depths = project(keyframe.camera_from_world, points, intrinsics)
    with np.errstate(divide="ignore", invalid="ignore"):
        misses = np.abs(pixels[:, 0] - rigid_map.baseline_px / depths - keyframe.right)
        wrong = (misses > MOST_MISS_PX) & (rigid_map.state[keyframe.point_ids] == GOOD)
    keyframe.right = np.where(wrong, np.nan, keyframe.right)


def correct_map(rigid_map: RigidMap, camera: Camera, trajectory: Trajectory, n_known: int = 0) -> None:
    """Adjust keyframes and points to the middle rows' instants, with the velocities of the camera's path.

    Keyframes whose velocity the path does not tell take no part; they follow where the points have gone. The first
    ``n_known`` are of another recording, and have velocities of their own.
    """
    rows = {index: row for row, index in enumerate(trajectory.indices.tolist())}
    twists = velocities(trajectory.timestamps, trajectory.camera_from_world)
    kept = rigid_map.kept_keyframes
    for k in kept[kept >= n_known]:
        keyframe = rigid_map.keyframes[k]
        keyframe.twist = twists[rows[keyframe.index]] if keyframe.index in rows else UNKNOWN_TWIST
    known = np.array([np.isfinite(rigid_map.keyframes[k].twist).all() for k in kept], dtype=bool)
    if known.sum() < 2:
        return
    problem = gather(rigid_map, camera, kept[known], kept[:0], iterations=25)
    _take_over(rigid_map, problem, problem.solve())
    for k in kept[~known]:
        keyframe = rigid_map.keyframes[k]
        seen = rigid_map.good_of(keyframe.seen)
        if len(seen.ids) >= LEAST_INLIERS:
            keyframe.camera_from_world = refined(rigid_map, camera, keyframe.camera_from_world, UNKNOWN_TWIST, seen)
