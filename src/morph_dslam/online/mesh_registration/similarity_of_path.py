"""The similarity between an object's frame and a map, from the keyframes' poses in both."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.geometry import RigidTransform, cross_matrix, rotation_log
from morph_dslam.online.mesh_registration.keyframe_adjustment import AdjustedKeyframes
from morph_dslam.online.mesh_registration.scene import camera_from_object
from morph_dslam.online.mesh_registration.texture_alignment import moved_similarity, similarity_jacobian
from morph_dslam.similarity import SimilarityTransform

Array = NDArray[np.float64]

ITERATIONS = 5


def similarity_of_path(
    adjusted: AdjustedKeyframes, start: SimilarityTransform, centre: Array, metric: bool = False
) -> tuple[SimilarityTransform, Array]:
    """The world_from_object that brings the map's keyframes nearest to the adjusted ones.

    It minimises the squares of what the cameras' places differ by, and of what the sights differ by at the
    object's distance.

    Parameters
    ----------
    start : near it. centre : (3,) the mean node, object frame. metric : keep the scale.

    Returns
    -------
    The similarity, and the covariance (7, 7) of log scale, rotation vector and translation about the centre,
    world. It holds that of the adjusted poses, what the fit makes of the path's own errors, and these errors
    as they are in a single keyframe: a camera that is found in the map has them.
    """
    transform, free = start, slice(1 if metric else 0, 7)
    size, count = start.scale, len(adjusted.poses)
    units = np.array([1.0] * 4 + [size] * 3)[free]
    covariance = np.zeros((7, 7))
    for _ in range(ITERATIONS):
        metrics, rows, misses = [], [], []
        for view, pose in zip(adjusted.views, adjusted.poses, strict=True):
            placed = camera_from_object(view, transform)
            metric_of_view = _metric(placed, centre)
            metrics.append(metric_of_view)
            rows.append(metric_of_view @ similarity_jacobian(placed, transform, centre)[:, free] * units)
            turn = rotation_log(pose.rotation @ placed.rotation.T)
            misses.append(metric_of_view @ np.concatenate([turn, pose.translation - placed.translation]))
        stacked = np.concatenate(rows)
        inverse = np.linalg.pinv(stacked.T @ stacked, rcond=1e-12, hermitian=True)
        solution = inverse @ stacked.T @ np.concatenate(misses)
        step = np.zeros(7)
        step[free] = solution * units
        left = np.concatenate(misses) - stacked @ solution
        scores = np.einsum("kij,ki->kj", stacked.reshape(count, 6, -1), left.reshape(count, 6))
        gain = np.concatenate([row.T @ m for row, m in zip(rows, metrics, strict=True)], axis=1)
        meat = scores.T @ scores + gain @ adjusted.covariance @ gain.T
        covariance[free, free] = inverse @ meat @ inverse * np.outer(units, units)
        transform = moved_similarity(transform, step, centre)
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


def _metric(pose: RigidTransform, centre: Array) -> Array:
    """What a pose's increment (6,) does to the sight at the object's distance and the camera's place."""
    result = np.zeros((6, 6))
    result[:3, :3] = float(np.linalg.norm(pose.apply(centre))) * np.eye(3)
    result[3:, :3] = cross_matrix(pose.translation)
    result[3:, 3:] = np.eye(3)
    return result
