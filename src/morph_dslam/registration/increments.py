"""Small changes of poses and similarities, and what they do."""

from __future__ import annotations

import numpy as np
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
    camera_from_world = pose.rotation @ transform.rotation.T
    middle = pose.apply(centre)
    result = np.zeros((6, 7))
    result[3:, 0] = -middle
    result[:3, 1:4] = camera_from_world
    result[3:, 1:4] = cross_matrix(middle - pose.translation) @ camera_from_world
    result[3:, 4:] = camera_from_world / transform.scale
    return result
