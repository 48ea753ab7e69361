"""Rotations, rigid and similarity transforms, named target_from_source: ``a_from_b @ p_b`` is in frame a."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def rotation_exp(rotation_vector):
    """Rotation matrix (3, 3) of a rotation vector (3,) in radians (Rodrigues' formula)."""
    x, y, z = rotation_vector[0], rotation_vector[1], rotation_vector[2]
    squared = x * x + y * y + z * z
    angle = np.sqrt(squared)
    if angle < 1e-7:
        # Taylor series: the closed form divides by zero here.
        a, b = 1.0 - squared / 6.0, 0.5 - squared / 24.0
    else:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / squared
    result = np.empty((3, 3))
    result[0, 0] = 1.0 - b * (y * y + z * z)
    result[1, 1] = 1.0 - b * (x * x + z * z)
    result[2, 2] = 1.0 - b * (x * x + y * y)
    result[0, 1] = -a * z + b * x * y
    result[1, 0] = a * z + b * x * y
    result[0, 2] = a * y + b * x * z
    result[2, 0] = -a * y + b * x * z
    result[1, 2] = -a * x + b * y * z
    result[2, 1] = a * x + b * y * z
    return result


@njit(cache=True, nogil=True)
def rotation_log(rotation):
    """Rotation vector (3,) in radians of a rotation matrix (3, 3); the inverse of `rotation_exp` up to pi.

    By way of the unit quaternion, of which the largest component is found first (Shepperd 1978).
    """
    trace = rotation[0, 0] + rotation[1, 1] + rotation[2, 2]
    vector, best = np.empty(3), 3
    largest = trace
    for k in range(3):
        if rotation[k, k] > largest:
            largest, best = rotation[k, k], k
    if best == 3:
        w = 1.0 + trace
        vector[0] = rotation[2, 1] - rotation[1, 2]
        vector[1] = rotation[0, 2] - rotation[2, 0]
        vector[2] = rotation[1, 0] - rotation[0, 1]
    else:
        i, j, k = best, (best + 1) % 3, (best + 2) % 3
        w = rotation[k, j] - rotation[j, k]
        vector[i] = 1.0 - trace + 2.0 * rotation[i, i]
        vector[j] = rotation[j, i] + rotation[i, j]
        vector[k] = rotation[k, i] + rotation[i, k]
    if w < 0.0:
        w, vector = -w, -vector
    sine = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    # For small angles 2 atan(sine / w) / sine is 2 / w.
    return vector * (2.0 / w if sine < 1e-10 * w else 2.0 * np.arctan2(sine, w) / sine)


def cross_matrix(vectors: Array) -> Array:
    """The matrices [v]x (..., 3, 3) of vectors (..., 3), with [v]x w = v x w.

    A small turn e moves a turned point v by e x v, so the derivative by the turn is -[v]x.
    """
    x, y, z = np.moveaxis(vectors, -1, 0)
    result = np.zeros((*vectors.shape, 3))
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -z, y, -x
    result[..., 1, 0], result[..., 2, 0], result[..., 2, 1] = z, -y, x
    return result


@dataclass(frozen=True)
class RigidTransform:
    """A rotation (3, 3) followed by a translation (3,) in metres."""

    rotation: Array
    translation: Array

    @classmethod
    def identity(cls) -> RigidTransform:
        """The transform that moves nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: Array) -> RigidTransform:
        """From a homogeneous matrix (4, 4) or (3, 4)."""
        return cls(np.array(matrix[:3, :3], dtype=float), np.array(matrix[:3, 3], dtype=float))

    @property
    def matrix(self) -> Array:
        """The homogeneous matrix (4, 4)."""
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = self.rotation, self.translation
        return result

    @property
    def inverse(self) -> RigidTransform:
        """b_from_a of a_from_b."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        return RigidTransform(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def apply(self, points: Array) -> Array:
        """Move points (..., 3)."""
        return points @ self.rotation.T + self.translation


@dataclass(frozen=True)
class SimilarityTransform:
    """A point is scaled, rotated by ``rotation`` (3, 3), and moved by ``translation`` (3,), target's unit."""

    scale: float
    rotation: Array
    translation: Array

    @classmethod
    def identity(cls) -> SimilarityTransform:
        """The transform that moves nothing."""
        return cls(1.0, np.eye(3), np.zeros(3))

    @property
    def matrix(self) -> Array:
        """The homogeneous matrix (4, 4), with the scale in its upper left block."""
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = self.scale * self.rotation, self.translation
        return result

    @property
    def inverse(self) -> SimilarityTransform:
        """b_from_a of a_from_b."""
        rotation = self.rotation.T
        return SimilarityTransform(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def __matmul__(self, other: SimilarityTransform) -> SimilarityTransform:
        return SimilarityTransform(
            self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation)
        )

    def apply(self, points: Array) -> Array:
        """Move points (..., 3)."""
        return self.scale * (points @ self.rotation.T) + self.translation


def fit_similarity(source: Array, target: Array, with_scale: bool = True) -> SimilarityTransform:
    """The transform target_from_source that moves points (n, 3) closest to others (n, 3) (Umeyama 1991).

    Minimises the sum of squared distances over rotations, translations and, ``with_scale``, scales. The
    rotation of points on one line is not unique; one of the best is returned.

    Raises ValueError if there is no point, or with a scale, the source points coincide.
    """
    if not len(source):
        raise ValueError("a similarity cannot be fitted to no points")
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    centred, goal = source - source_mean, target - target_mean
    u, singular, vt = np.linalg.svd(goal.T @ centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    scale = 1.0
    if with_scale:
        spread = float((centred**2).sum())
        if spread == 0.0:
            raise ValueError("a scale cannot be fitted to points that coincide")
        scale = float(singular @ signs) / spread
    return SimilarityTransform(scale, rotation, target_mean - scale * rotation @ source_mean)
