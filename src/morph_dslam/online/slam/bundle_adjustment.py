"""Bundle adjustment: camera poses and map points together, from their pixels.

Levenberg-Marquardt on the Huber cost of reprojection errors. Points are eliminated by the Schur complement
(Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, section 6), so that the linear system has six
unknowns for each free camera. Where a camera measures depth (stereo, RGB-D), the column of the point in a
right image at a known baseline is a third residual (Mur-Artal and Tardós, ORB-SLAM2, 2017).
The compiled part holds no interpreter lock: a mapper can adjust while a tracker runs. Its plain twin is
scipy's least squares, with which the tests compare it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.geometry import rotation_exp
from morph_dslam.online.slam.small_algebra import cholesky_solve, inverse_3x3, orthonormal, turned_and_shifted

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Damping of the first iteration, as a part of the diagonal, and its bounds.
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-9, 1e8
#: A point's block is kept invertible by this much: a point seen once has no depth of its own, px^2/m^2.
POINT_RIDGE = 1e-9
#: Points nearer to the camera plane than this part of a unit depth do not count.
LEAST_DEPTH = 1e-6


@njit(cache=True, nogil=True)
def _residual(pose, point, pixel, camera, out):
    """Reprojection error (3,) into ``out``; returns the rows that count: 0 behind the camera, 2, or 3."""
    x = pose[0, 0] * point[0] + pose[0, 1] * point[1] + pose[0, 2] * point[2] + pose[0, 3]
    y = pose[1, 0] * point[0] + pose[1, 1] * point[1] + pose[1, 2] * point[2] + pose[1, 3]
    z = pose[2, 0] * point[0] + pose[2, 1] * point[1] + pose[2, 2] * point[2] + pose[2, 3]
    if z < LEAST_DEPTH:
        return 0
    u = camera[0] * x / z + camera[2]
    out[0] = u - pixel[0]
    out[1] = camera[1] * y / z + camera[3] - pixel[1]
    if np.isnan(pixel[2]):
        return 2
    out[2] = u - camera[4] / z - pixel[2]
    return 3


@njit(cache=True, nogil=True)
def _jacobians(pose, point, camera, by_pose, by_point):
    """Derivatives of `_residual` by the pose's twist (rotation, translation; from the left) and the point."""
    x = pose[0, 0] * point[0] + pose[0, 1] * point[1] + pose[0, 2] * point[2] + pose[0, 3]
    y = pose[1, 0] * point[0] + pose[1, 1] * point[1] + pose[1, 2] * point[2] + pose[1, 3]
    z = pose[2, 0] * point[0] + pose[2, 1] * point[1] + pose[2, 2] * point[2] + pose[2, 3]
    for row in range(3):
        gx, gy = (0.0, camera[1] / z) if row == 1 else (camera[0] / z, 0.0)
        gz = -(gx * x + gy * y) / z + (camera[4] / (z * z) if row == 2 else 0.0)
        by_pose[row, 0] = gz * y - gy * z
        by_pose[row, 1] = gx * z - gz * x
        by_pose[row, 2] = gy * x - gx * y
        by_pose[row, 3], by_pose[row, 4], by_pose[row, 5] = gx, gy, gz
        for k in range(3):
            by_point[row, k] = gx * pose[0, k] + gy * pose[1, k] + gz * pose[2, k]


@njit(cache=True, nogil=True)
def _huber(error, width):
    """Cost and weight of an error's length."""
    if error <= width:
        return 0.5 * error * error, 1.0
    return width * (error - 0.5 * width), width / error


@njit(cache=True, nogil=True)
def total_cost(poses, points, camera_idx, point_idx, pixels, camera, width):
    """Huber cost of all observations; one that falls behind its camera costs as much as a miss of 1000 px."""
    cost, residual = 0.0, np.zeros(3)
    for o in range(len(pixels)):
        rows = _residual(poses[camera_idx[o]], points[point_idx[o]], pixels[o], camera, residual)
        square = 0.0
        for row in range(rows):
            square += residual[row] ** 2
        cost += _huber(np.sqrt(square) if rows else 1000.0, width)[0]
    return cost


@njit(cache=True, nogil=True)
def _normal_equations(poses, points, slot, camera_idx, point_idx, pixels, camera, width):
    """Blocks of the normal equations: poses and their right-hand side, points and theirs, observations."""
    n_free = slot.max() + 1
    pose_block, pose_right = np.zeros((n_free, 6, 6)), np.zeros((n_free, 6))
    point_block, point_right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    cross = np.zeros((len(pixels), 6, 3))
    residual, by_pose, by_point = np.zeros(3), np.zeros((3, 6)), np.zeros((3, 3))
    for o in range(len(pixels)):
        c, p = camera_idx[o], point_idx[o]
        rows = _residual(poses[c], points[p], pixels[o], camera, residual)
        if rows == 0:
            continue
        square = 0.0
        for row in range(rows):
            square += residual[row] ** 2
        weight = _huber(np.sqrt(square), width)[1]
        _jacobians(poses[c], points[p], camera, by_pose, by_point)
        free = slot[c]
        for row in range(rows):
            for i in range(3):
                point_right[p, i] -= weight * by_point[row, i] * residual[row]
                for j in range(3):
                    point_block[p, i, j] += weight * by_point[row, i] * by_point[row, j]
            if free < 0:
                continue
            for i in range(6):
                pose_right[free, i] -= weight * by_pose[row, i] * residual[row]
                for j in range(6):
                    pose_block[free, i, j] += weight * by_pose[row, i] * by_pose[row, j]
                for j in range(3):
                    cross[o, i, j] += weight * by_pose[row, i] * by_point[row, j]
    return pose_block, pose_right, point_block, point_right, cross


@njit(cache=True, nogil=True)
def _reduced_system(pose_block, pose_right, point_inverse, point_right, cross, slot, camera_idx, start):
    """Schur complement (6 c, 6 c) and right-hand side (6 c,) of the free cameras."""
    n_free = len(pose_block)
    system, right = np.zeros((6 * n_free, 6 * n_free)), np.zeros(6 * n_free)
    for c in range(n_free):
        system[6 * c : 6 * c + 6, 6 * c : 6 * c + 6] = pose_block[c]
        right[6 * c : 6 * c + 6] = pose_right[c]
    half = np.zeros((6, 3))
    for p in range(len(point_inverse)):
        for first in range(start[p], start[p + 1]):
            row = slot[camera_idx[first]]
            if row < 0:
                continue
            for i in range(6):
                for j in range(3):
                    half[i, j] = 0.0
                    for k in range(3):
                        half[i, j] += cross[first, i, k] * point_inverse[p, k, j]
                for j in range(3):
                    right[6 * row + i] -= half[i, j] * point_right[p, j]
            for second in range(start[p], first + 1):
                column = slot[camera_idx[second]]
                if column < 0:
                    continue
                for i in range(6):
                    for j in range(6):
                        value = 0.0
                        for k in range(3):
                            value += half[i, k] * cross[second, j, k]
                        system[6 * row + i, 6 * column + j] -= value
                        if second < first:
                            system[6 * column + j, 6 * row + i] -= value
    return system, right


@njit(cache=True, nogil=True)
def _moved(poses, points, slot, pose_step, point_step):
    """Poses turned and shifted by their twists (6 c,), points by theirs."""
    new_poses, new_points = poses.copy(), points + point_step
    for c in range(len(poses)):
        if slot[c] >= 0:
            twist = pose_step[6 * slot[c] : 6 * slot[c] + 6]
            turned_and_shifted(poses[c], rotation_exp(twist[:3]), twist[3:], new_poses[c])
    return new_poses, new_points


@njit(cache=True, nogil=True)
def _step(blocks, slot, camera_idx, start, damping):
    """Damped Gauss-Newton step: twists of the free cameras (6 c,) and point shifts (p, 3)."""
    pose_block, pose_right, point_block, point_right, cross = blocks
    damped_points, point_inverse = point_block.copy(), np.empty_like(point_block)
    for p in range(len(point_block)):
        for i in range(3):
            damped_points[p, i, i] += damping * point_block[p, i, i] + POINT_RIDGE
        inverse_3x3(damped_points[p], point_inverse[p])
    damped = pose_block.copy()
    for c in range(len(damped)):
        for i in range(6):
            damped[c, i, i] += damping * damped[c, i, i] + POINT_RIDGE
    system, right = _reduced_system(
        damped, pose_right, point_inverse, point_right, cross, slot, camera_idx, start
    )
    pose_step = cholesky_solve(system, right)
    point_step, rest = np.zeros_like(point_right), np.empty(3)
    for p in range(len(point_inverse)):
        rest[:] = point_right[p]
        for o in range(start[p], start[p + 1]):
            free = slot[camera_idx[o]]
            if free < 0:
                continue
            for i in range(3):
                for j in range(6):
                    rest[i] -= cross[o, j, i] * pose_step[6 * free + j]
        for i in range(3):
            for j in range(3):
                point_step[p, i] += point_inverse[p, i, j] * rest[j]
    return pose_step, point_step


@njit(cache=True, nogil=True)
def _adjust(poses, points, slot, camera_idx, point_idx, start, pixels, camera, width, iterations, tolerance):
    cost = total_cost(poses, points, camera_idx, point_idx, pixels, camera, width)
    damping, done = FIRST_DAMPING, 0
    blocks = _normal_equations(poses, points, slot, camera_idx, point_idx, pixels, camera, width)
    while done < iterations and damping < MOST_DAMPING:
        done += 1
        pose_step, point_step = _step(blocks, slot, camera_idx, start, damping)
        new_poses, new_points = _moved(poses, points, slot, pose_step, point_step)
        new_cost = total_cost(new_poses, new_points, camera_idx, point_idx, pixels, camera, width)
        if not new_cost < cost:
            damping *= 10.0
            continue
        gain = (cost - new_cost) / cost
        poses, points, cost = new_poses, new_points, new_cost
        damping = max(0.1 * damping, LEAST_DAMPING)
        if gain < tolerance:
            break
        blocks = _normal_equations(poses, points, slot, camera_idx, point_idx, pixels, camera, width)
    return poses, points, cost, done


@dataclass(frozen=True)
class Observations:
    """What cameras saw of points.

    Attributes
    ----------
    camera_idx, point_idx : (o,). pixels : (o, 2), undistorted.
    right_columns : (o,) column of the point in the right image, NaN where depth was not measured; None if
        nowhere.
    """

    camera_idx: Indices
    point_idx: Indices
    pixels: Array
    right_columns: Array | None = None

    def rows(self) -> Array:
        """(o, 3): pixel and right column."""
        right = np.full(len(self.pixels), np.nan) if self.right_columns is None else self.right_columns
        return np.column_stack([self.pixels, right])


@dataclass(frozen=True)
class Adjustment:
    """Adjusted ``camera_from_world`` (c, 4, 4) and ``points`` (p, 3), Huber costs in px^2, iterations."""

    camera_from_world: Array
    points: Array
    initial_cost: float
    cost: float
    iterations: int


def adjust(
    camera_from_world: Array,
    points: Array,
    observations: Observations,
    intrinsics: Array,
    fixed: NDArray[np.bool_],
    baseline_px: float = 0.0,
    huber_px: float = 2.0,
    iterations: int = 15,
    tolerance: float = 1e-6,
) -> Adjustment:
    """Refine poses and points together.

    Parameters
    ----------
    camera_from_world : (c, 4, 4). points : (p, 3) in the world.
    intrinsics : (4,) fx, fy, cx, cy, of all cameras.
    fixed : (c,) cameras that stay; without depth at least two of them, or the scale is free.
    baseline_px : focal length times baseline, px m, for observations with depth.
    huber_px : errors longer than this count linearly.
    tolerance : ends when an iteration lowers the cost by less than this part.
    """
    order = np.argsort(observations.point_idx, kind="stable")
    camera_idx = np.ascontiguousarray(observations.camera_idx[order], dtype=np.int64)
    point_idx = np.ascontiguousarray(observations.point_idx[order], dtype=np.int64)
    start = np.searchsorted(point_idx, np.arange(len(points) + 1))
    slot = np.where(fixed, -1, np.cumsum(~fixed) - 1)
    pixels = np.ascontiguousarray(observations.rows()[order])
    camera = np.append(np.asarray(intrinsics, dtype=np.float64), baseline_px)
    poses = np.ascontiguousarray(camera_from_world, dtype=np.float64)
    points = np.ascontiguousarray(points, dtype=np.float64)
    before = total_cost(poses, points, camera_idx, point_idx, pixels, camera, huber_px)
    poses, points, cost, done = _adjust(
        poses, points, slot, camera_idx, point_idx, start, pixels, camera, huber_px, iterations, tolerance
    )
    poses[~fixed] = orthonormal(poses[~fixed])
    return Adjustment(poses, points, float(before), float(cost), int(done))
