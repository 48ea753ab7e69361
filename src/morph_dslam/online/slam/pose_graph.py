"""Pose graph optimisation: keyframes as similarity transforms that relative measurements hold together.

Each keyframe has a scale besides its pose, since the scale of a map made by one camera drifts (Strasdat,
Montiel and Davison, Scale Drift-Aware Large Scale Monocular SLAM, 2010). Gauss-Newton with a sparse solver.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Step of the numerical derivatives, and the step at which iterations end.
DIFFERENCE, LEAST_STEP = 1e-6, 1e-8


@dataclass(frozen=True)
class Similarities:
    """Transforms world_from_camera: scales (n,), rotations (n, 3, 3), translations (n, 3)."""

    scales: Array
    rotations: Array
    translations: Array

    @classmethod
    def of_poses(cls, camera_from_world: Array) -> Similarities:
        """The inverses of rigid poses (n, 4, 4)."""
        rotations = camera_from_world[:, :3, :3].transpose(0, 2, 1)
        translations = -np.einsum("nij,nj->ni", rotations, camera_from_world[:, :3, 3])
        return cls(np.ones(len(rotations)), rotations, translations)

    def __getitem__(self, rows: Indices) -> Similarities:
        return Similarities(self.scales[rows], self.rotations[rows], self.translations[rows])

    def __matmul__(self, other: Similarities) -> Similarities:
        return Similarities(
            self.scales * other.scales, self.rotations @ other.rotations, self.apply(other.translations)
        )

    @property
    def inverse(self) -> Similarities:
        """The transforms the other way round."""
        rotations = self.rotations.transpose(0, 2, 1)
        turned = np.einsum("nij,nj->ni", rotations, self.translations)
        return Similarities(1.0 / self.scales, rotations, -turned / self.scales[:, None])

    def apply(self, points: Array) -> Array:
        """Move points (n, 3), each by its own transform."""
        return self.scales[:, None] * np.einsum("nij,nj->ni", self.rotations, points) + self.translations

    def camera_from_world(self) -> Array:
        """Poses (n, 4, 4) of the cameras; their scales are left to the points."""
        poses = np.tile(np.eye(4), (len(self.scales), 1, 1))
        poses[:, :3, :3] = self.rotations.transpose(0, 2, 1)
        poses[:, :3, 3] = -np.einsum("nij,nj->ni", poses[:, :3, :3], self.translations)
        return poses


def _small(steps: Array) -> Similarities:
    """Transforms near the identity from rotation vector, translation and logarithm of the scale (n, 7)."""
    rotations = Rotation.from_rotvec(steps[:, :3]).as_matrix()
    return Similarities(np.exp(steps[:, 6]), rotations, steps[:, 3:6])


def _residuals(first: Similarities, second: Similarities, measured: Similarities) -> Array:
    """What is left (m, 7) between the measured second_from_first and the estimated one."""
    left = measured @ (first.inverse @ second).inverse
    turns = Rotation.from_matrix(left.rotations).as_rotvec()
    return np.column_stack([turns, left.translations, np.log(left.scales)])


def optimise(
    start: Similarities, edges: Indices, measured: Similarities, with_scale: bool, iterations: int = 20
) -> Similarities:
    """Transforms that agree best with the measured first_from_second of edges; the first one stays.

    Parameters
    ----------
    edges : (m, 2) rows of the first and the second transform of each edge. measured : (m,).
    with_scale : whether scales are unknown too.
    """
    n_free = 7 if with_scale else 6
    current = start
    for _ in range(iterations):
        residuals = _residuals(current[edges[:, 0]], current[edges[:, 1]], measured)
        jacobian = _jacobian(current, edges, measured, residuals, n_free)
        matrix = (jacobian.T @ jacobian).tocsc() + 1e-12 * sparse.identity(
            n_free * (len(start.scales) - 1), format="csc"
        )
        step = np.zeros((len(start.scales), 7))
        step[1:, :n_free] = -spsolve(matrix, jacobian.T @ residuals.ravel()).reshape(-1, n_free)
        current = current @ _small(step)
        if np.abs(step).max() < LEAST_STEP:
            break
    return current


def _jacobian(
    current: Similarities, edges: Indices, measured: Similarities, residuals: Array, n_free: int
) -> sparse.csr_array:
    """Derivatives (7 m, n_free (n - 1)) by steps of all transforms but the first, from the right."""
    rows, columns, values = [], [], []
    for end in (0, 1):
        free = edges[:, end] > 0
        for component in range(n_free):
            step = np.zeros((len(edges), 7))
            step[:, component] = DIFFERENCE
            ends = [current[edges[:, 0]], current[edges[:, 1]]]
            ends[end] = ends[end] @ _small(step)
            derivative = (_residuals(ends[0], ends[1], measured) - residuals) / DIFFERENCE
            rows.append((7 * np.flatnonzero(free)[:, None] + np.arange(7)).ravel())
            columns.append(np.repeat(n_free * (edges[free, end] - 1) + component, 7))
            values.append(derivative[free].ravel())
    shape = (7 * len(edges), n_free * (len(current.scales) - 1))
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_array(entries, shape=shape)
