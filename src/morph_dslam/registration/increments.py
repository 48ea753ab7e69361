"""Small changes of poses and similarities, and what they do."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.geometry import RigidTransform, SimilarityTransform, cross_matrix, rotation_exp

Array = NDArray[np.float64]


def moved_pose(pose: RigidTransform, step: Array) -> RigidTransform:
    """The pose after an increment (6,) as of `tracking.state.moved`: rotation vector, translation."""
    return RigidTransform(rotation_exp(step[:3]) @ pose.rotation, pose.translation + step[3:])


def pose_jacobian(points: Array, pose: RigidTransform) -> Array:
    """How points (p, 3) in the camera frame move with the increment of a pose, (p, 3, 6).

    The object turns about its origin as the camera's axes stand.
    """
    identity = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    return np.concatenate([-cross_matrix(points - pose.translation), identity], axis=2)


def moved_similarity(transform: SimilarityTransform, step: Array, centre: Array) -> SimilarityTransform:
    """A world_from_object moved by log scale, rotation vector and translation (7,) about ``centre``, world."""
    scale = transform.scale * float(np.exp(step[0]))
    rotation = rotation_exp(step[1:4]) @ transform.rotation
    place = transform.apply(centre) + step[4:]
    return SimilarityTransform(scale, rotation, place - scale * rotation @ centre)


def similarity_jacobian(pose: RigidTransform, transform: SimilarityTransform, centre: Array) -> Array:
    """How a view's camera_from_object, metres, moves with the similarity, (6, 7).

    Of the increments of `pose_jacobian` and `moved_similarity`: where the object grows in the map, the camera
    comes nearer to it in metres.
    """
    return _similarity_jacobian(pose.rotation, pose.translation, transform.rotation, transform.scale, centre)


@njit(cache=True, nogil=True)
def _similarity_jacobian(rotation, translation, of_object, scale, centre):
    """`similarity_jacobian`, compiled: a tenth of the time."""
    result, arm, camera_from_world = np.zeros((6, 7)), np.zeros(3), np.zeros((3, 3))
    for i in range(3):
        for k in range(3):
            arm[i] += rotation[i, k] * centre[k]
            for j in range(3):
                camera_from_world[i, j] += rotation[i, k] * of_object[j, k]
    for j in range(3):
        x, y, z = camera_from_world[0, j], camera_from_world[1, j], camera_from_world[2, j]
        result[0, 1 + j], result[1, 1 + j], result[2, 1 + j] = x, y, z
        result[3, 1 + j], result[4, 1 + j] = arm[1] * z - arm[2] * y, arm[2] * x - arm[0] * z
        result[5, 1 + j] = arm[0] * y - arm[1] * x
        result[3, 4 + j], result[4, 4 + j], result[5, 4 + j] = x / scale, y / scale, z / scale
        result[3 + j, 0] = -(arm[j] + translation[j])
    return result
