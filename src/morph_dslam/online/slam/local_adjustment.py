"""Bundle adjustment of a part of the map: gathered from it, solved apart from it, and put back.

In between, a tracker may go on with the map as it was: only putting back changes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.slam.bundle_adjustment import Adjustment, Observations, adjust
from morph_dslam.online.slam.options import SlamOptions
from morph_dslam.online.slam.pose import reprojection_errors
from morph_dslam.online.slam.projection import project
from morph_dslam.online.slam.rigid_map import GOOD, Indices, Keyframe, RigidMap

Array = NDArray[np.float64]

#: Observations that miss by more than this multiple of the median error after adjustment are taken out, and
#: those beyond a smaller multiple before it count linearly; within bounds, in pixels. With bounds alone a few
#: wrong points would bend an otherwise exact map.
MISS_RATIO, LEAST_MISS_PX, MOST_MISS_PX = 6.0, 1.5, 4.0
HUBER_RATIO, LEAST_HUBER_PX, MOST_HUBER_PX = 2.0, 0.2, 1.5
TOLERANCE = 1e-4


@dataclass(frozen=True)
class MapProblem:
    """Keyframes and points to adjust together.

    Attributes
    ----------
    numbers : (k,) keyframes, of which ``held`` (k,) stay where they are. free : those whose points count.
    ids : (n,) points. camera_from_world : (k, 4, 4). positions : (n, 3).
    """

    numbers: Indices
    free: Indices
    held: NDArray[np.bool_]
    ids: Indices
    camera_from_world: Array
    positions: Array
    observations: Observations
    intrinsics: Array
    baseline_px: float
    iterations: int

    def solve(self) -> Adjustment:
        """Adjusted poses and points; touches no map."""
        usual = usual_error(self.errors(self.camera_from_world, self.positions))
        return adjust(
            self.camera_from_world,
            self.positions,
            self.observations,
            self.intrinsics,
            self.held,
            self.baseline_px,
            huber_px=min(max(HUBER_RATIO * usual, LEAST_HUBER_PX), MOST_HUBER_PX),
            iterations=self.iterations,
            tolerance=TOLERANCE,
        )

    def errors(self, camera_from_world: Array, positions: Array) -> Array:
        """Distances (o,) in pixels between the observations and the projected points."""
        seen = self.observations
        poses, points = camera_from_world[seen.camera_idx], positions[seen.point_idx]
        local = np.einsum("oij,oj->oi", poses[:, :3, :3], points) + poses[:, :3, 3]
        return reprojection_errors(np.eye(4), local, seen.pixels, self.intrinsics)


def usual_error(errors: Array) -> float:
    """Median of some errors (n,), which outliers do not raise; infinite without any."""
    return float(np.median(errors)) if len(errors) else float("inf")


def local_window(rigid_map: RigidMap, options: SlamOptions) -> tuple[Indices, Indices]:
    """The newest keyframe and those that see the same points, to be adjusted, and others to hold them."""
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
    return np.sort(window), np.sort(holders[around[holders] > 0])


def gather(
    rigid_map: RigidMap,
    intrinsics: Array,
    free: Indices,
    fixed: Indices,
    iterations: int,
    hold_poses: bool = False,
) -> MapProblem:
    """The problem of ``free`` keyframes (numbers) and their points, held by ``fixed`` ones; intrinsics (4,).

    Where nothing else is held, the oldest free one is; with ``hold_poses`` all are, and only points move.
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
    chosen = [wanted[keyframe.point_ids] for keyframe in keyframes]
    observations = Observations(
        np.repeat(np.arange(len(numbers)), [int(rows.sum()) for rows in chosen]),
        np.concatenate([local[k.point_ids[rows]] for k, rows in zip(keyframes, chosen, strict=True)]),
        np.concatenate([k.pixels[rows] for k, rows in zip(keyframes, chosen, strict=True)]),
        np.concatenate([k.right[rows] for k, rows in zip(keyframes, chosen, strict=True)]),
    )
    return MapProblem(
        numbers,
        free,
        held,
        ids,
        np.array([keyframe.camera_from_world for keyframe in keyframes]),
        rigid_map.positions[ids],
        observations,
        intrinsics,
        rigid_map.baseline_px,
        iterations,
    )


def put_back(rigid_map: RigidMap, problem: MapProblem, result: Adjustment) -> None:
    """Take over the adjusted poses and points, and take out what contradicts them."""
    rigid_map.positions[problem.ids] = result.points
    for k, pose in zip(problem.numbers, result.camera_from_world, strict=True):
        rigid_map.keyframes[k].camera_from_world = pose
    usual = usual_error(problem.errors(result.camera_from_world, result.points))
    most = min(max(MISS_RATIO * usual, LEAST_MISS_PX), MOST_MISS_PX)
    _drop_misses(rigid_map, problem.free, problem.intrinsics, most)


def _drop_misses(rigid_map: RigidMap, numbers: Indices, intrinsics: Array, most_px: float) -> None:
    """Take out the observations that contradict the map, then points that fewer than two views see."""
    for k in numbers:
        keyframe = rigid_map.keyframes[k]
        ids = keyframe.point_ids
        errors = reprojection_errors(
            keyframe.camera_from_world, rigid_map.positions[ids], keyframe.pixels, intrinsics
        )
        keyframe.keep((errors < most_px) | (rigid_map.state[ids] != GOOD))
        _drop_wrong_depths(rigid_map, keyframe, intrinsics)
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
