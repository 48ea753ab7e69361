"""Keyframes placed about an object, and the object's place in the map by them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.geometry import RigidTransform, SimilarityTransform, cross_matrix, rotation_log
from morph_dslam.registration.increments import moved_similarity, similarity_jacobian
from morph_dslam.registration.scene import View, camera_from_object

Array = NDArray[np.float64]
#: Errors of all poses together are given by so many error factors: the registration's seven, and one more.
N_FACTORS = 8
#: Iterations in which a similarity is brought to the adjusted path.
PATH_ITERATIONS = 5


@dataclass(frozen=True)
class AdjustedKeyframes:
    """Keyframes placed about the object.

    Attributes
    ----------
    views : those adjusted.
    poses : camera_from_object of each, metres.
    covariance : (6 K, 6 K) of all poses together, in the increments of `pose_jacobian`. The turn about an
        axis of revolution is not in it.
    rms_px : how far the images agree.
    """

    views: list[View]
    poses: list[RigidTransform]
    covariance: Array
    rms_px: float

    def covariance_of(self, view: int) -> Array:
        """That of one pose, (6, 6)."""
        part = slice(6 * view, 6 * view + 6)
        return self.covariance[part, part]

    def error_factors(self) -> Array:
        """How each pose is off (K, 6, c) by the few error factors that most of the errors have in common.

        What is a keyframe's own is added to that, in its own directions: a pose's rows times their transpose
        are its whole covariance.
        """
        size = len(self.covariance)
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        values, vectors = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        leading = np.arange(size) >= size - N_FACTORS
        roots = vectors[:, leading] * np.sqrt(np.maximum(values[leading], 0.0))
        error_factors = (scale[:, None] * roots).reshape(-1, 6, roots.shape[1])
        return np.stack([_filled_up(part, self.covariance_of(view)) for view, part in enumerate(error_factors)])


def _filled_up(error_factors: Array, covariance: Array) -> Array:
    """Error factors (6, c), c >= 6, changed as little as can be so that they make up a covariance (6, 6)."""
    values, vectors = np.linalg.eigh(covariance)
    roots = np.sqrt(np.maximum(values, 0.0))
    # Nothing is known of the turn about an axis, and nothing of it is in either.
    weights = np.where(roots > 1e-9 * roots[-1], 1.0 / np.maximum(roots, 1e-300), 0.0)
    left, _, right = np.linalg.svd(weights[:, None] * (vectors.T @ error_factors), full_matrices=False)
    return np.asarray((vectors * roots) @ left @ right, dtype=np.float64)


def similarity_of_path(
    adjusted: AdjustedKeyframes, start: SimilarityTransform, centre: Array, scale_std: float = np.inf
) -> tuple[SimilarityTransform, Array]:
    """The world_from_object that brings the map's keyframes nearest to the adjusted ones.

    It minimises the squares of what the cameras' places differ by, and of what the sights differ by at the
    object's distance.

    Parameters
    ----------
    adjusted : the keyframes about the object.
    start : near the similarity.
    centre : (3,) the mean node, object frame, metres.
    scale_std : standard deviation of the logarithm of the scale about 1, as of a metric map.

    Returns
    -------
    The similarity, and the covariance (7, 7) of log scale, rotation vector and translation about the centre,
    world. It holds that of the adjusted poses, what the fit makes of the path's own errors, and these errors
    as they are in a single keyframe: a camera that is found in the map has them.
    """
    transform, size, count = start, start.scale, len(adjusted.poses)
    units = np.array([1.0] * 4 + [size] * 3)
    covariance = np.zeros((7, 7))
    for _ in range(PATH_ITERATIONS):
        metrics, rows, misses = [], [], []
        for view, pose in zip(adjusted.views, adjusted.poses, strict=True):
            placed = camera_from_object(view, transform)
            metric_of_view = sight_metric(placed, centre)
            metrics.append(metric_of_view)
            rows.append(metric_of_view @ similarity_jacobian(placed, transform, centre) * units)
            turn = rotation_log(pose.rotation @ placed.rotation.T)
            misses.append(metric_of_view @ np.concatenate([turn, pose.translation - placed.translation]))
        stacked = np.concatenate(rows)
        inverse = np.linalg.pinv(stacked.T @ stacked, rcond=1e-12, hermitian=True)
        solution = inverse @ stacked.T @ np.concatenate(misses)
        left = np.concatenate(misses) - stacked @ solution
        gradients = np.einsum("kij,ki->kj", stacked.reshape(count, 6, -1), left.reshape(count, 6))
        gain = np.concatenate([row.T @ m for row, m in zip(rows, metrics, strict=True)], axis=1)
        meat = gradients.T @ gradients + gain @ adjusted.covariance @ gain.T
        covariance = inverse @ meat @ inverse * np.outer(units, units)
        transform = moved_similarity(transform, solution * units, centre)
    if np.isfinite(scale_std):
        gained = covariance[0] / (covariance[0, 0] + scale_std**2)
        transform = moved_similarity(transform, -np.log(transform.scale) * gained, centre)
        covariance = covariance - np.outer(gained, covariance[0])
    covariance[1:, 1:] += _scatter(adjusted, transform, centre)
    return transform, covariance


def _scatter(adjusted: AdjustedKeyframes, transform: SimilarityTransform, centre: Array) -> Array:
    """Mean square (6, 6) of what the object is turned and moved by, in the world, between the two paths."""
    misses = []
    for view, pose in zip(adjusted.views, adjusted.poses, strict=True):
        placed, world_from_camera = camera_from_object(view, transform), view.camera_from_world.rotation.T
        turn = rotation_log(pose.rotation @ placed.rotation.T)
        shift = transform.scale * (pose.apply(centre) - placed.apply(centre))
        misses.append(np.concatenate([world_from_camera @ turn, world_from_camera @ shift]))
    return np.array(misses).T @ np.array(misses) / len(misses)


def sight_metric(pose: RigidTransform, centre: Array) -> Array:
    """What a pose's increment (6,) does to the sight at the object's distance and the camera's place."""
    result = np.zeros((6, 6))
    result[:3, :3] = float(np.linalg.norm(pose.apply(centre))) * np.eye(3)
    result[3:, :3] = cross_matrix(pose.translation)
    result[3:, 3:] = np.eye(3)
    return result
