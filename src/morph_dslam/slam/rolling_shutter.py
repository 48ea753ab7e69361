"""Rolling shutter: the rows of an image are recorded one after the other, while the camera moves on.

A pose is that of the middle row's instant. Around it the camera keeps its velocity, which follows from the frames
before and after (Hedborg et al., Rolling Shutter Bundle Adjustment, 2012, with central differences instead of an
interpolation). A point's pixel is moved to where it would be at the middle row's instant; every method for a global
shutter then applies.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.geometry import rotation_log
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.slam.options import INLIER_PX, LEAST_INLIERS
from morph_dslam.slam.pose import inverse, refine_pose
from morph_dslam.slam.rigid_map import Followed, RigidMap

Array = NDArray[np.float64]
#: Frames farther apart say nothing of the velocity in between, seconds; nor do those whose stamps are rounded to one.
MOST_GAP_S, LEAST_GAP_S = 0.15, 1e-4
#: Rounds in which pixels are moved with the poses of the round before.
ROUNDS = 3


def velocities(timestamps: Array, camera_from_world: Array, span_s: float = 0.0) -> Array:
    """Twists (n, 6) of cameras per second, by the poses before and after each.

    Rotation (rad/s), then translation, from the left: the camera's own axes. NaN where no other pose is near, or all
    have one stamp.

    Parameters
    ----------
    timestamps : (n,) seconds, ascending
    camera_from_world : (n, 4, 4)
    span_s : poses about so much before and after, seconds, where there are closer ones too: over less, errors of the
        poses become errors of the velocity
    """
    n, order = len(timestamps), np.arange(len(timestamps))
    result = np.full((n, 6), np.nan)
    before = np.minimum(_nearest(timestamps, timestamps - span_s), order - 1)
    after = np.maximum(_nearest(timestamps, timestamps + span_s), order + 1)
    for k in range(n):
        ends = (int(before[k]), k, int(after[k]))
        near = [j for j in ends if 0 <= j < n and abs(timestamps[j] - timestamps[k]) < MOST_GAP_S]
        first, last = near[0], near[-1]
        if timestamps[last] - timestamps[first] >= LEAST_GAP_S:
            moved = camera_from_world[last] @ inverse(camera_from_world[first])
            result[k] = twist_of(moved, timestamps[last] - timestamps[first])
    return result


def _nearest(timestamps: Array, wanted: Array) -> NDArray[np.int64]:
    """Numbers (m,) of the stamps (n,), ascending, that are nearest to other ones (m,)."""
    middles = 0.5 * (timestamps[1:] + timestamps[:-1])
    return np.searchsorted(middles, wanted)


def twist_of(moved: Array, seconds: float) -> Array:
    """The velocity (6,) of a motion (4, 4), from the left, in some time: rotation vector, then translation."""
    turn = rotation_log(np.ascontiguousarray(moved[:3, :3]))
    return np.concatenate([turn, moved[:3, 3]]) / seconds


def row_times(rows: Array, camera: Camera) -> Array:
    """Instants (n,) of rows (n,) of the recorded image, in readout times after the middle row's."""
    return (rows - 0.5 * (camera.height - 1)) / camera.height


def after(points: Array, twists: Array, seconds: Array) -> Array:
    """Points (n, 3) in the axes of cameras that have moved on by twists (n, 6) for some time (n,)."""
    turned = Rotation.from_rotvec(twists[:, :3] * seconds[:, None]).apply(points)
    return turned + twists[:, 3:] * seconds[:, None]


def middle_row_pixels(camera: Camera, camera_from_world: Array, twist: Array, points: Array, pixels: Array) -> Array:
    """Undistorted pixels (n, 2) at the middle row's instant of points (n, 3), which were seen at ``pixels`` (n, 2).

    Parameters
    ----------
    camera : with its readout time
    camera_from_world : (4, 4) at the middle row's instant
    twist : (6,) the camera's velocity, NaN if unknown: then the pixels stay
    """
    if not camera.readout_s or not np.isfinite(twist).all() or not len(points):
        return pixels
    local = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    seconds = camera.readout_s * row_times(camera.distort_pixels(pixels)[:, 1], camera)
    moved = after(local, np.broadcast_to(twist, (len(local), 6)), seconds)
    return pixels + np.nan_to_num(camera.project(local) - camera.project(moved))


def seen_at_middle_row(
    camera: Camera, camera_from_world: Array, twist: Array, points: Array, seen: Followed
) -> Followed:
    """Where map points, at ``points`` (n, 3), would be seen at the middle row's instant; as of `middle_row_pixels`."""
    if not camera.readout_s:
        return seen
    pixels = middle_row_pixels(camera, camera_from_world, twist, points, seen.pixels)
    # Disparities stay what they were.
    return Followed(seen.ids, pixels, seen.right + pixels[:, 0] - seen.pixels[:, 0])


class MiddleRowPoses:
    """Poses of a camera at the middle rows' instants, frame by frame; its velocity is that since the frame before.

    Parameters
    ----------
    rigid_map : of points that stand still
    camera : with its readout time
    """

    def __init__(self, rigid_map: RigidMap, camera: Camera) -> None:
        self._map, self._camera = rigid_map, camera
        self._time, self._pose = -np.inf, np.eye(4)

    def add(self, timestamp: float, pose: Array, seen: Followed) -> Array:
        """The pose (4, 4) of the next frame, by that as of a global shutter (4, 4) and where it saw map points."""
        gap, before = timestamp - self._time, inverse(self._pose)
        for _ in range(ROUNDS if LEAST_GAP_S <= gap < MOST_GAP_S and len(seen.ids) >= LEAST_INLIERS else 0):
            pose = refined(self._map, self._camera, pose, twist_of(pose @ before, gap), seen)
        self._time, self._pose = timestamp, pose
        return pose


def correct_path(rigid_map: RigidMap, camera: Camera, trajectory: Trajectory, seen: list[Followed]) -> Trajectory:
    """The path at the middle rows' instants.

    Parameters
    ----------
    trajectory : as of a global shutter
    seen : map points in each of its frames
    """
    poses = trajectory.camera_from_world
    for _ in range(ROUNDS if camera.readout_s and len(poses) else 0):
        twists = velocities(trajectory.timestamps, poses)
        for row, points in enumerate(seen):
            if len(points.ids) >= LEAST_INLIERS:
                poses[row] = refined(rigid_map, camera, poses[row], twists[row], points)
    return Trajectory(
        trajectory.timestamps, np.array([inverse(pose) for pose in poses]).reshape(-1, 4, 4), trajectory.indices
    )


def refined(rigid_map: RigidMap, camera: Camera, pose: Array, twist: Array, seen: Followed) -> Array:
    """The pose (4, 4) at the middle row's instant by where a frame saw map points; ``pose`` if by too few."""
    at_middle = seen_at_middle_row(camera, pose, twist, rigid_map.positions[seen.ids], seen)
    estimate = refine_pose(
        pose,
        rigid_map.positions[seen.ids],
        at_middle.pixels,
        camera.intrinsics,
        inlier_px=INLIER_PX,
        right=at_middle.right,
        baseline_px=rigid_map.baseline_px,
    )
    return estimate.camera_from_world if estimate.inliers.sum() >= LEAST_INLIERS else pose
