"""Least squares over intrinsics, poses and the shape of the board, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.geometry import RigidTransform, cross_matrix, rotation_exp

Array = NDArray[np.float64]

MOST_ITERATIONS = 50

#: The sum of squares has converged when it falls by less than this part of itself.
LEAST_DECREASE = 1e-9


@dataclass(frozen=True)
class Estimate:
    """What is solved for: the camera, the poses (v) camera_from_board, the corners (n, 3), metres."""

    camera: PinholeCamera
    poses: tuple[RigidTransform, ...]
    points: Array

    def residuals(self, corners: Array) -> Array:
        """Found corners (v, n, 2) minus projected ones, pixels."""
        projected = [self.camera.project_recorded(pose.apply(self.points)) for pose in self.poses]
        return corners - np.array(projected)

    def moved(self, step: Array, free: NDArray[np.bool_]) -> Estimate:
        """The estimate after a step in the unknowns of `jacobian`."""
        camera = self.camera
        n_intrinsics = 4 + len(camera.distortion)
        fx, fy, cx, cy = (float(value) for value in camera.intrinsics + step[:4])
        coefficients = np.array(camera.distortion) + step[4:n_intrinsics]
        by_pose = step[n_intrinsics : n_intrinsics + 6 * len(self.poses)].reshape(-1, 6)
        poses = tuple(
            RigidTransform(rotation_exp(change[:3]) @ pose.rotation, pose.translation + change[3:])
            for pose, change in zip(self.poses, by_pose, strict=True)
        )
        points = self.points.copy()
        points[free] += step[n_intrinsics + 6 * len(self.poses) :]
        changed = replace(
            camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(float(value) for value in coefficients)
        )
        return Estimate(changed, poses, points)


def jacobian(estimate: Estimate, free: NDArray[np.bool_]) -> Array:
    """Derivative of all pixels (2 v n) by the unknowns.

    Parameters
    ----------
    free : (n, 3) which coordinates of the corners are unknown.

    Returns
    -------
    (2 v n, m); the columns are fx, fy, cx, cy, the distortion, a turn and a translation for each pose, and
    the free coordinates.
    """
    camera, poses, points = estimate.camera, estimate.poses, estimate.points
    n, n_intrinsics = len(points), 4 + len(camera.distortion)
    result = np.zeros((len(poses), 2 * n, n_intrinsics + 6 * len(poses) + int(free.sum())))
    for k, pose in enumerate(poses):
        moved = pose.apply(points)
        by_point = camera.recorded_jacobian(moved)
        # A turn e about the board's origin moves a point by e x (R p).
        turns = -cross_matrix(moved - pose.translation)
        by_pose = np.concatenate([by_point @ turns, by_point], axis=2)
        first = n_intrinsics + 6 * k
        result[k, :, :n_intrinsics] = _intrinsic_jacobian(camera, moved)
        result[k, :, first : first + 6] = by_pose.reshape(-1, 6)
        if free.any():
            by_shape = np.zeros((n, 2, n, 3))
            by_shape[np.arange(n), :, np.arange(n)] = by_point @ pose.rotation
            result[k, :, n_intrinsics + 6 * len(poses) :] = by_shape.reshape(2 * n, 3 * n)[:, free.ravel()]
    return result.reshape(-1, result.shape[2])


def _intrinsic_jacobian(camera: PinholeCamera, points: Array) -> Array:
    """Derivative (2 n, 4 + d) of the recorded pixels by fx, fy, cx, cy and the distortion."""
    pixels = camera.project_recorded(points)
    image = (pixels - camera.intrinsics[2:]) / camera.intrinsics[:2]
    u, v = np.eye(2)
    ones = np.ones((len(points), 1))
    columns = [image * u, image * v, ones * u, ones * v]
    for k in range(len(camera.distortion)):
        # The image is linear in each coefficient (up to the fifth), so that a step of one is exact.
        changed = list(camera.distortion)
        changed[k] += 1.0
        columns.append(replace(camera, distortion=tuple(changed)).project_recorded(points) - pixels)
    return np.stack([column.ravel() for column in columns], axis=1)


def adjust(estimate: Estimate, corners: Array, free: NDArray[np.bool_]) -> Estimate:
    """The estimate that fits corners (v, n, 2) best, by Levenberg-Marquardt from a good start."""
    damping = 1e-4
    residuals = estimate.residuals(corners).ravel()
    for _ in range(MOST_ITERATIONS):
        slopes = jacobian(estimate, free)
        normal, gradient = slopes.T @ slopes, slopes.T @ residuals
        step = np.asarray(np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient), dtype=float)
        candidate = estimate.moved(step, free)
        changed = candidate.residuals(corners).ravel()
        decrease = 1.0 - (changed @ changed) / (residuals @ residuals)
        if not decrease > 0.0:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        estimate, residuals, damping = candidate, changed, 0.1 * damping
        if decrease < LEAST_DECREASE:
            break
    return estimate


def focal_deviation(estimate: Estimate, corners: Array, free: NDArray[np.bool_]) -> tuple[float, float]:
    """Standard deviations of fx and fy, pixels, from the curvature of the sum of squares at its least."""
    residuals = estimate.residuals(corners)
    slopes = jacobian(estimate, free)
    # Columns differ by orders of magnitude; scaled, the pseudo-inverse drops only what is undetermined.
    scale = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    covariance = np.linalg.pinv((slopes / scale).T @ (slopes / scale), hermitian=True)
    variance = float((residuals**2).sum()) / max(residuals.size - slopes.shape[1], 1)
    fx, fy = np.sqrt(np.maximum(np.diag(covariance)[:2], 0.0) * variance) / scale[:2]
    return float(fx), float(fy)
