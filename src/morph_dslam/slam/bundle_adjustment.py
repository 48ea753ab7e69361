"""Bundle adjustment: camera poses and map points together, from their pixels, in compiled loops.

Levenberg-Marquardt on the Huber cost of reprojection errors; points are eliminated by the Schur complement (Triggs et
al., Bundle Adjustment - A Modern Synthesis, 2000, section 6). Where a camera measures depth, the column of the point in
a right image at a known baseline is a third residual (Mur-Artal and Tardós, ORB-SLAM2, 2017). No interpreter lock is
held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.geometry import rotation_exp
from morph_dslam.small_arrays import cholesky_solve


@njit(cache=True, nogil=True)
def inverse_3x3(matrix, out):
    """The inverse of a symmetric (3, 3) matrix into ``out``, by cofactors."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    out[0, 0], out[0, 1], out[0, 2] = d * f - e * e, c * e - b * f, b * e - c * d
    out[1, 1], out[1, 2], out[2, 2] = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * out[0, 0] + b * out[0, 1] + c * out[0, 2]
    for i in range(3):
        for j in range(i, 3):
            out[i, j] /= determinant
            out[j, i] = out[i, j]


@njit(cache=True, nogil=True)
def turned_and_shifted(pose, rotation, shift, out):
    """``rotation`` (3, 3) times the rows of ``pose`` (4, 4), plus ``shift`` (3,), into ``out`` (4, 4)."""
    for i in range(3):
        for j in range(4):
            value = 0.0
            for k in range(3):
                value += rotation[i, k] * pose[k, j]
            out[i, j] = value
        out[i, 3] += shift[i]


@njit(cache=True, nogil=True)
def make_orthonormal(pose):
    """Make the rotation of a rigid transform (4, 4) the one nearest to what rounding has made of it.

    A prediction that multiplies poses by transposed ones would double what is off in every frame. Two steps of Newton's
    iteration for the polar decomposition (Higham, Functions of Matrices, 2008, section 8.3), which squares the error.
    """
    for _ in range(2):
        square = np.zeros((3, 3))
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    square[i, j] += pose[k, i] * pose[k, j]
        for row in pose[:3]:
            old = row[:3].copy()
            for j in range(3):
                row[j] = 1.5 * old[j]
                for k in range(3):
                    row[j] -= 0.5 * old[k] * square[k, j]


Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Damping of the first iteration, as a part of the diagonal, and its bounds.
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-9, 1e8
#: A point's block is kept invertible by this much: a point seen once has no depth of its own, px^2/m^2.
POINT_RIDGE = 1e-9
#: Points nearer to the camera plane than this part of a unit depth do not count.
LEAST_DEPTH = 1e-6


@njit(cache=True, nogil=True)
def in_camera(poses, c, points, p):
    """A point in the axes of a camera, three numbers."""
    x = poses[c, 0, 0] * points[p, 0] + poses[c, 0, 1] * points[p, 1] + poses[c, 0, 2] * points[p, 2]
    y = poses[c, 1, 0] * points[p, 0] + poses[c, 1, 1] * points[p, 1] + poses[c, 1, 2] * points[p, 2]
    z = poses[c, 2, 0] * points[p, 0] + poses[c, 2, 1] * points[p, 1] + poses[c, 2, 2] * points[p, 2]
    return x + poses[c, 0, 3], y + poses[c, 1, 3], z + poses[c, 2, 3]


@njit(cache=True, nogil=True)
def residual(x, y, z, pixels, o, camera):
    """Reprojection error of a point before the camera: column, row, right column (0 if not measured)."""
    u = camera[0] * x / z + camera[2]
    in_right = 0.0 if np.isnan(pixels[o, 2]) else u - camera[4] / z - pixels[o, 2]
    return u - pixels[o, 0], camera[1] * y / z + camera[3] - pixels[o, 1], in_right


@njit(cache=True, nogil=True)
def jacobians(x, y, z, poses, c, camera, by_pose, by_point):
    """Derivatives of `residual` by the pose's twist (rotation, translation; from the left) and the point."""
    for row in range(3):
        gx, gy = (0.0, camera[1] / z) if row == 1 else (camera[0] / z, 0.0)
        gz = -(gx * x + gy * y) / z + (camera[4] / (z * z) if row == 2 else 0.0)
        by_pose[row, 0] = gz * y - gy * z
        by_pose[row, 1] = gx * z - gz * x
        by_pose[row, 2] = gy * x - gx * y
        by_pose[row, 3], by_pose[row, 4], by_pose[row, 5] = gx, gy, gz
        for k in range(3):
            by_point[row, k] = gx * poses[c, 0, k] + gy * poses[c, 1, k] + gz * poses[c, 2, k]


@njit(cache=True, nogil=True)
def huber(error, width):
    """Cost and weight of an error's length."""
    if error <= width:
        return 0.5 * error * error, 1.0
    return width * (error - 0.5 * width), width / error


@njit(cache=True, nogil=True)
def total_cost(poses, points, camera_idx, point_idx, pixels, camera, width):
    """Huber cost of all observations; one that falls behind its camera costs as much as a miss of 1000 px."""
    cost = 0.0
    for o in range(len(pixels)):
        x, y, z = in_camera(poses, camera_idx[o], points, point_idx[o])
        error = 1000.0
        if z >= LEAST_DEPTH:
            first, second, third = residual(x, y, z, pixels, o, camera)
            error = np.sqrt(first * first + second * second + third * third)
        cost += huber(error, width)[0]
    return cost


@njit(cache=True, nogil=True)
def _normal_equations(poses, points, slot, camera_idx, point_idx, pixels, camera, width):
    """Blocks of the normal equations: poses and their right-hand side, points and theirs, observations.

    Of the poses' blocks only the lower half is filled, of the points' the upper one.
    """
    n_free = slot.max() + 1
    pose_block, pose_right = np.zeros((n_free, 6, 6)), np.zeros((n_free, 6))
    point_block, point_right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    cross = np.zeros((len(pixels), 3, 6))
    misses, by_pose, by_point = np.zeros(3), np.zeros((3, 6)), np.zeros((3, 3))
    for o in range(len(pixels)):
        c, p = camera_idx[o], point_idx[o]
        x, y, z = in_camera(poses, c, points, p)
        if z < LEAST_DEPTH:
            continue
        misses[0], misses[1], misses[2] = residual(x, y, z, pixels, o, camera)
        square = misses[0] ** 2 + misses[1] ** 2 + misses[2] ** 2
        weight = huber(np.sqrt(square), width)[1]
        jacobians(x, y, z, poses, c, camera, by_pose, by_point)
        free = slot[c]
        for row in range(2 if np.isnan(pixels[o, 2]) else 3):
            for i in range(3):
                weighted = weight * by_point[row, i]
                point_right[p, i] -= weighted * misses[row]
                for j in range(i, 3):
                    point_block[p, i, j] += weighted * by_point[row, j]
            if free < 0:
                continue
            for i in range(6):
                weighted = weight * by_pose[row, i]
                pose_right[free, i] -= weighted * misses[row]
                for j in range(i + 1):
                    pose_block[free, i, j] += weighted * by_pose[row, j]
                for j in range(3):
                    cross[o, j, i] += weighted * by_point[row, j]
    return pose_block, pose_right, point_block, point_right, cross


@njit(cache=True, nogil=True)
def _reduced_system(pose_block, pose_right, point_inverse, point_right, cross, slot, camera_idx, start):
    """Schur complement (6 c, 6 c) of the free cameras, its lower half, and right-hand side (6 c,)."""
    n_free = len(pose_block)
    blocks, right = np.zeros((n_free, n_free, 6, 6)), np.zeros(6 * n_free)
    # Entry by entry: numba takes seconds to compile the assignment of one array to a part of another.
    for c in range(n_free):
        for i in range(6):
            right[6 * c + i] = pose_right[c, i]
            for j in range(6):
                blocks[c, c, i, j] = pose_block[c, i, j]
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
                        half[i, j] += cross[first, k, i] * point_inverse[p, k, j]
                for j in range(3):
                    right[6 * row + i] -= half[i, j] * point_right[p, j]
            # Observations of a point are in the order of their cameras: these blocks are the lower ones.
            for second in range(start[p], first + 1):
                column = slot[camera_idx[second]]
                if column < 0:
                    continue
                block, other = blocks[row, column], cross[second]
                for i in range(6):
                    by_x, by_y, by_z = half[i, 0], half[i, 1], half[i, 2]
                    for j in range(6):
                        block[i, j] -= by_x * other[0, j] + by_y * other[1, j] + by_z * other[2, j]
    system = np.zeros((6 * n_free, 6 * n_free))
    for c in range(n_free):
        for d in range(c + 1):
            for i in range(6):
                for j in range(6):
                    system[6 * c + i, 6 * d + j] = blocks[c, d, i, j]
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
    system, right = _reduced_system(damped, pose_right, point_inverse, point_right, cross, slot, camera_idx, start)
    pose_step = cholesky_solve(system, right)
    point_step, rest = np.zeros_like(point_right), np.empty(3)
    for p in range(len(point_inverse)):
        for i in range(3):
            rest[i] = point_right[p, i]
        for o in range(start[p], start[p + 1]):
            free = slot[camera_idx[o]]
            if free < 0:
                continue
            for i in range(3):
                for j in range(6):
                    rest[i] -= cross[o, i, j] * pose_step[6 * free + j]
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
    camera_idx, point_idx : (o,).
    pixels : (o, 2), undistorted.
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
    """Adjusted ``camera_from_world`` (c, 4, 4) and ``points`` (p, 3), Huber cost in px^2, iterations."""

    camera_from_world: Array
    points: Array
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
    camera_from_world : (c, 4, 4).
    points : (p, 3) in the world.
    intrinsics : (4,) fx, fy, cx, cy, of all cameras.
    fixed : (c,) cameras that stay; without depth at least two of them, or the scale is free.
    baseline_px : focal length times baseline, px m, for observations with depth.
    huber_px : errors longer than this count linearly.
    tolerance : ends when an iteration lowers the cost by less than this part.
    """
    order = np.lexsort([observations.camera_idx, observations.point_idx])
    camera_idx = np.ascontiguousarray(observations.camera_idx[order], dtype=np.int64)
    point_idx = np.ascontiguousarray(observations.point_idx[order], dtype=np.int64)
    start = np.searchsorted(point_idx, np.arange(len(points) + 1))
    slot = np.where(fixed, -1, np.cumsum(~fixed) - 1)
    pixels = np.ascontiguousarray(observations.rows()[order])
    camera = np.append(np.asarray(intrinsics, dtype=np.float64), baseline_px)
    poses = np.ascontiguousarray(camera_from_world, dtype=np.float64)
    points = np.ascontiguousarray(points, dtype=np.float64)
    poses, points, cost, done = _adjust(
        poses, points, slot, camera_idx, point_idx, start, pixels, camera, huber_px, iterations, tolerance
    )
    for c in np.flatnonzero(~fixed):
        make_orthonormal(poses[c])
    return Adjustment(poses, points, float(cost), int(done))
