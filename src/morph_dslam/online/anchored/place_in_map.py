"""Where a registered object is in a map, and from there in a camera that was found in the map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform, cross_matrix
from morph_dslam.model import ReducedModel
from morph_dslam.online.anchored.known_pose import KnownPose
from morph_dslam.online.slam.pose import PoseEstimate
from morph_dslam.similarity import SimilarityTransform

Array = NDArray[np.float64]

#: No number of a registration is meant to be larger.
LARGEST = 1e20
#: Mean nodes that are farther apart than this share of the size belong to different objects.
OTHER_OBJECT = 0.1


@dataclass(frozen=True)
class PlaceInMap:
    """Where an undeformed object is in a map.

    Attributes
    ----------
    world_from_object : metres to the map's unit. centre : (3,) the mean node, object frame, metres.
    covariance : (7, 7) of log scale, rotation vector and translation about ``centre``, in the map; None where
        nobody knows.
    """

    world_from_object: SimilarityTransform
    centre: Array
    covariance: Array | None

    @classmethod
    def from_content(cls, content: dict[str, Any]) -> PlaceInMap:
        """From the content of a registration.json; raises KeyError, TypeError or ValueError if it is none."""
        matrix = numbers_of(content["world_from_object"], (4, 4))
        scale, covariance = float(content["map_units_per_metre"]), content["covariance"]
        if not scale > 0.0 or not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T / scale**2, np.eye(3)):
            raise ValueError("world_from_object is no rotation scaled by map_units_per_metre")
        return cls(
            SimilarityTransform(scale, matrix[:3, :3] / scale, matrix[:3, 3]),
            numbers_of(content["mean_node_m"], (3,)),
            None if covariance is None else numbers_of(covariance, (7, 7)),
        )

    def check_model(self, model: ReducedModel, path: Path) -> None:
        """Refuse a registration of another object; one of a finer mesh of the same object will do.

        Raises
        ------
        RegistrationError
            If the mean nodes of the two are farther apart than `OTHER_OBJECT` of the object's size.
        """
        nodes = model.positions(model.default)
        apart = np.linalg.norm(nodes.mean(axis=0) - self.centre)
        if apart > OTHER_OBJECT * np.linalg.norm(np.ptp(nodes, axis=0)):
            raise RegistrationError(
                f"{path} places another object than '{model.name}': their mean nodes are {1e3 * apart:.1f} "
                "mm apart; give the model that was registered, or register this one"
            )

    def slopes(self, pose: RigidTransform) -> Array:
        """How the increment (6,) of the object's ``pose`` in a camera depends on the registration: (6, 7).

        The registration's turn is about the mean node. An object that is larger in the map is nearer to the
        camera, since its true size is known.
        """
        placed = self.world_from_object
        camera_from_world = pose.rotation @ placed.rotation.T
        arm = pose.rotation @ self.centre
        result = np.zeros((6, 7))
        result[:3, 1:4] = camera_from_world
        result[3:, 0] = -(pose.translation + arm)
        result[3:, 1:4] = cross_matrix(arm) @ camera_from_world
        result[3:, 4:] = camera_from_world / placed.scale
        return result

    def pose_covariance(self, pose: RigidTransform) -> Array | None:
        """(6, 6) of the object's ``pose`` in an exactly known camera; None where nobody knows."""
        if self.covariance is None:
            return None
        slopes = self.slopes(pose)
        return slopes @ self.covariance @ slopes.T

    def pose_in(self, camera_from_world: Array) -> RigidTransform:
        """The object's pose in a camera of pose (4, 4) in the map, metres."""
        placed = self.world_from_object
        turn, shift = camera_from_world[:3, :3], camera_from_world[:3, 3]
        return RigidTransform(turn @ placed.rotation, (turn @ placed.translation + shift) / placed.scale)

    def known_pose(self, camera: PoseEstimate) -> KnownPose:
        """The object's pose in a camera found in the map, metres; ValueError without a covariance."""
        if self.covariance is None:
            raise ValueError("the place has no covariance")
        pose = self.pose_in(camera.camera_from_world)
        # The camera's twist turns everything about the camera, and shifts it in the map's unit.
        by_camera = np.eye(6)
        by_camera[3:, :3] = -cross_matrix(pose.translation)
        by_camera[3:, 3:] = np.eye(3) / self.world_from_object.scale
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return KnownPose(pose, by_camera @ camera.covariance @ by_camera.T, self.slopes(pose) @ root)


def numbers_of(values: Any, shape: tuple[int, ...]) -> Array:
    """An array of a registration.json; raises ValueError if its shape is another, or a number absurd."""
    array = np.array(values, dtype=np.float64)
    if array.shape != shape or not (np.abs(array) < LARGEST).all():
        raise ValueError(f"an array of shape {shape} was expected")
    return array
