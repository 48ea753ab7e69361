"""Similarity transforms, Sim(3): a scale, a rotation, and a translation; and the best fit to points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.geometry import RigidTransform

Array = NDArray[np.float64]


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

    def apply_to_pose(self, pose: RigidTransform) -> RigidTransform:
        """The pose of the same camera in the target: target_from_source applied to source_from_camera."""
        return RigidTransform(self.rotation @ pose.rotation, self.apply(pose.translation))


def fit_similarity(source: Array, target: Array, with_scale: bool = True) -> SimilarityTransform:
    """The transform target_from_source that moves points (n, 3) closest to others (n, 3) (Umeyama 1991).

    Minimises the sum of squared distances over rotations, translations and, ``with_scale``, scales. The
    rotation of points on one line is not unique; one of the best is returned.

    Raises
    ------
    ValueError
        If there is no point, or with a scale, the source points coincide.
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
