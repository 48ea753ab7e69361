"""Bundle adjustment of views and a camera: poses, points and the camera's unknowns together.

The camera has a prior (Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000); poses and points are eliminated.
Residuals of one point in many images are alike, as are those of one image: deviations are those of clusters of
residuals by point and by image (Cameron and Miller, A Practitioner's Guide to Cluster-Robust Inference, 2015), not of
independent pixels. Errors of known size that are alike in all images are further unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.geometry import cross_matrix
from morph_dslam.slam.camera_terms import N_UNKNOWNS, changed, prior_std
from morph_dslam.slam.local_map import HUBER_RATIO, LEAST_HUBER_PX, MOST_HUBER_PX
from morph_dslam.slam.rigid_map import Indices
from morph_dslam.slam.rolling_shutter import after, row_times

Array = NDArray[np.float64]
#: Iterations at most, which end with a gain below this part.
ITERATIONS, LEAST_GAIN = 15, 1e-4
#: All images together count for so many independent points where they tell of error factors.
EFFECTIVE_POINTS = 30.0
#: Steps of the numerical derivatives: of a point, in depths, and of the camera's unknowns.
POINT_STEP, CAMERA_STEPS = 1e-5, np.array([1e-6, 1e-3, 1e-3, 1e-6, 1e-6, 1e-6, 1e-6])


@dataclass
class Views:
    """Chosen frames, what they saw, and where they and the points are.

    Attributes
    ----------
    poses : (f, 4, 4) camera_from_world.
    twists : (f, 6) per second; zero where unknown.
    points : (p, 3).
    frame_idx, point_idx : (o,), each pair once.
    recorded : (o, 2) pixels.
    off : (o, 2, c) by how much ``recorded`` is off, pixels, for each of c error factors, in their deviations.
    """

    poses: Array
    twists: Array
    points: Array
    frame_idx: Indices
    point_idx: Indices
    recorded: Array
    off: Array

    def local(self) -> Array:
        """Points (o, 3) in the axes of their cameras at the middle rows' instants."""
        poses = self.poses[self.frame_idx]
        return np.einsum("oij,oj->oi", poses[:, :3, :3], self.points[self.point_idx]) + poses[:, :3, 3]

    def residuals(self, given: Camera, unknowns: Array) -> Array:
        """(o, 2) pixels, of a camera changed by so much (8 + c,); of a point that it cannot see far off."""
        camera = changed(given, unknowns)
        seconds = camera.readout_s * row_times(self.recorded[:, 1], camera)
        seen = after(self.local(), self.twists[self.frame_idx], seconds)
        off = camera.project_recorded(seen) - self.recorded + self.off @ unknowns[N_UNKNOWNS:]
        return np.nan_to_num(off, nan=1e3)

    def moved(self, pose_steps: Array, point_steps: Array) -> Views:
        """With twists of the poses (f, 6) and shifts of the points (p, 3)."""
        poses = self.poses.copy()
        poses[:, :3] = Rotation.from_rotvec(pose_steps[:, :3]).as_matrix() @ poses[:, :3]
        poses[:, :3, 3] += pose_steps[:, 3:]
        return replace(self, poses=poses, points=self.points + point_steps)

    def derivatives(self, given: Camera, unknowns: Array) -> tuple[Array, Array, Array]:
        """Of the residuals by pose twists (o, 2, 6), points (o, 2, 3) and unknowns (o, 2, 8 + c)."""
        camera, twists, local = changed(given, unknowns), self.twists[self.frame_idx], self.local()
        times = row_times(self.recorded[:, 1], camera)
        seen = after(local, twists, camera.readout_s * times)
        steps = POINT_STEP * seen[:, 2:]
        by_seen = np.stack(
            [
                (camera.project_recorded(seen + steps * axis) - camera.project_recorded(seen - steps * axis))
                / (2.0 * steps)
                for axis in np.eye(3)
            ],
            axis=2,
        )
        by_local = by_seen @ Rotation.from_rotvec(twists[:, :3] * (camera.readout_s * times)[:, None]).as_matrix()
        by_pose = np.concatenate([-by_local @ cross_matrix(local), by_local], axis=2)
        by_point = by_local @ self.poses[self.frame_idx][:, :3, :3]
        by_camera = np.empty((len(local), 2, N_UNKNOWNS))
        for column, step in enumerate(CAMERA_STEPS):
            change = step * np.eye(len(unknowns))[column]
            upper, lower = changed(given, unknowns + change), changed(given, unknowns - change)
            by_camera[:, :, column] = (upper.project_recorded(seen) - lower.project_recorded(seen)) / (2.0 * step)
        velocity = np.cross(twists[:, :3], seen) + twists[:, 3:]
        by_camera[:, :, 7] = np.einsum("oij,oj->oi", by_seen, velocity) * times[:, None]
        by_unknowns = np.concatenate([by_camera, self.off], axis=2)
        return np.nan_to_num(by_pose), np.nan_to_num(by_point), np.nan_to_num(by_unknowns)


def _sums(groups: Indices, count: int, values: Array) -> Array:
    """Sums (count, ...) of the values (o, ...) of each group (o,)."""
    members = csr_array((np.ones(len(groups)), (groups, np.arange(len(groups)))), shape=(count, len(groups)))
    return (members @ values.reshape(len(values), -1)).reshape(count, *values.shape[1:])


class _Normal:
    """Normal equations of poses, points and camera; the points are eliminated where they are solved.

    Parameters
    ----------
    views : with f frames and p points
    residuals : (o, 2) and their ``weights`` (o,).
    derivatives : as of `Views.derivatives`, of the camera's s free unknowns only
    information : (s,) of the prior; ``offsets`` (s,) how far the unknowns are from it
    """

    def __init__(
        self,
        views: Views,
        residuals: Array,
        weights: Array,
        derivatives: tuple[Array, Array, Array],
        information: Array,
        offsets: Array,
    ) -> None:
        self._views, self._residuals, self._weights, self._derivatives = views, residuals, weights, derivatives
        (by_pose, by_point, by_camera), n_frames, n_points = derivatives, len(views.poses), len(views.points)
        frame, point, n = views.frame_idx, views.point_idx, 6 * n_frames
        self._n, size = n, n + by_camera.shape[2]
        scaled = weights[:, None, None] * by_pose, weights[:, None, None] * by_point
        blocks = _sums(frame, n_frames, by_pose.transpose(0, 2, 1) @ scaled[0])
        matrix = np.zeros((size, size))
        for f in range(n_frames):
            matrix[6 * f : 6 * f + 6, 6 * f : 6 * f + 6] = blocks[f]
        matrix[:n, n:] = _sums(frame, n_frames, scaled[0].transpose(0, 2, 1) @ by_camera).reshape(n, -1)
        matrix[n:, :n] = matrix[:n, n:].T
        matrix[n:, n:] = np.einsum("o,oki,okj->ij", weights, by_camera, by_camera) + np.diag(information)
        of_frames = _sums(frame, n_frames, -np.einsum("oki,ok->oi", scaled[0], residuals))
        of_camera = -np.einsum("o,oki,ok->i", weights, by_camera, residuals) - information * offsets
        cross = np.zeros((n_points, size, 3))
        cross[:, :n].reshape(n_points, n_frames, 6, 3)[point, frame] = by_pose.transpose(0, 2, 1) @ scaled[1]
        cross[:, n:] = _sums(point, n_points, by_camera.transpose(0, 2, 1) @ scaled[1])
        self._matrix, self._right, self._cross = matrix, np.append(of_frames.ravel(), of_camera), cross
        self._of_points = _sums(point, n_points, by_point.transpose(0, 2, 1) @ scaled[1])
        self._point_right = _sums(point, n_points, -np.einsum("oki,ok->oi", scaled[1], residuals))

    def _reduced(self, damping: float) -> tuple[Array, Array, Array]:
        """Matrix (n, n) and right-hand side (n,) without the points, and inverses (p, 3, 3) of the points' blocks."""
        of_points, matrix, cross = self._of_points, self._matrix, self._cross
        # A ridge as part of the mean keeps the scale, which nothing determines, where it is.
        ridge = 1e-9 * of_points.trace(axis1=1, axis2=2).mean() * np.eye(3)
        inverse: Array = np.linalg.inv(of_points + damping * of_points * np.eye(3) + ridge)
        carried = cross @ inverse
        eliminated = np.tensordot(carried, cross, axes=([0, 2], [0, 2]))
        reduced = matrix + np.diag((damping + 1e-9) * np.diag(matrix)) - eliminated
        right = self._right - np.tensordot(carried, self._point_right, axes=([0, 2], [0, 1]))
        # The first pose is held.
        reduced[:6], reduced[:, :6], right[:6] = 0.0, 0.0, 0.0
        reduced[range(6), range(6)] = 1.0
        return reduced, right, inverse

    def step(self, damping: float) -> tuple[Array, Array, Array]:
        """Twists of the poses (f, 6), shifts of the points (p, 3), change of the camera's unknowns (s,).

        ``damping`` : as a part of the diagonal.
        """
        reduced, right, inverse = self._reduced(damping)
        step = np.asarray(np.linalg.solve(reduced, right), dtype=np.float64)
        rest = self._point_right - np.einsum("pij,i->pj", self._cross, step)
        return step[: self._n].reshape(-1, 6), np.einsum("pij,pj->pi", inverse, rest), step[self._n :]

    def covariance(self, information: Array, deviations: Array) -> Array:
        """Of the unknowns (s, s), by clusters of residuals, and by a prior (s,) of such deviations and information."""
        views, (by_pose, by_point, by_camera) = self._views, self._derivatives
        size, n = len(self._matrix), self._n
        reduced, _, points_inverse = self._reduced(0.0)
        inverse = np.linalg.solve(reduced, np.eye(size)[:, n:])
        of_points = points_inverse @ (self._cross.transpose(0, 2, 1) @ inverse)
        influence = by_pose @ inverse[:n].reshape(len(views.poses), 6, size - n)[views.frame_idx]
        influence = influence + by_camera @ inverse[n:] - by_point @ of_points[views.point_idx]
        scores = np.einsum("o,oki,ok->oi", self._weights, influence, self._residuals)
        result = inverse[n:].T @ np.diag((information * deviations) ** 2) @ inverse[n:]
        n_residuals, n_unknowns = 2 * len(scores), 3 * len(views.points) + size
        for groups in (views.frame_idx, views.point_idx):
            sums = _sums(groups, groups.max() + 1, scores)
            result += sums.T @ sums * n_residuals / max(n_residuals - n_unknowns, 1)
        return result


@dataclass(frozen=True)
class Solution:
    """Views, the unknowns (8 + c,), the covariance (s, s) of those that were free, and the cost, px^2."""

    views: Views
    unknowns: Array
    covariance: Array
    cost: float


def solve(views: Views, given: Camera, unknowns: Array, free: Indices, huber_px: float | None = None) -> Solution:
    """Levenberg-Marquardt on the Huber cost, of the width that fits the errors by default, and the prior."""
    errors = np.linalg.norm(views.residuals(given, unknowns), axis=1)
    usual = float(np.median(errors))
    width = huber_px or min(max(HUBER_RATIO * usual, LEAST_HUBER_PX), MOST_HUBER_PX)
    # The median length of two normal deviations is 1.18 of their standard deviation.
    variance = max(usual / 1.18, 0.1) ** 2
    deviations = np.append(prior_std(given), np.ones(len(unknowns) - N_UNKNOWNS))[free]
    information = variance / deviations**2
    # What residuals have in common in all images tells less of the factors than as many independent ones would.
    information[free >= N_UNKNOWNS] *= max(len(views.recorded) / EFFECTIVE_POINTS, 1.0)

    def cost(views: Views, unknowns: Array) -> float:
        errors = np.linalg.norm(views.residuals(given, unknowns), axis=1)
        terms = np.where(errors < width, 0.5 * errors**2, width * (errors - 0.5 * width))
        return float(terms.sum() + 0.5 * information @ unknowns[free] ** 2)

    def normal() -> _Normal:
        residuals = views.residuals(given, unknowns)
        weights = np.minimum(1.0, width / np.maximum(np.linalg.norm(residuals, axis=1), 1e-12))
        by_pose, by_point, by_camera = views.derivatives(given, unknowns)
        derivatives = by_pose, by_point, by_camera[:, :, free]
        return _Normal(views, residuals, weights, derivatives, information, unknowns[free])

    damping, before, equations = 1e-4, cost(views, unknowns), normal()
    for _ in range(ITERATIONS):
        pose_steps, point_steps, step = equations.step(damping)
        new_views, new_unknowns = views.moved(pose_steps, point_steps), unknowns.copy()
        new_unknowns[free] += step
        now = cost(new_views, new_unknowns)
        if not now < before:
            damping *= 10.0
            continue
        gain, views, unknowns, before = (before - now) / before, new_views, new_unknowns, now
        damping, equations = max(0.1 * damping, 1e-9), normal()
        if gain < LEAST_GAIN:
            break
    return Solution(views, unknowns, equations.covariance(information, deviations), before)
