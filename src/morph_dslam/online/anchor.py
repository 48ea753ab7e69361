"""Anchored objects: the camera is found in the frozen map of the scene, and with it the object's pose.

This is the paper's main case: camera_from_object = camera_from_world world_from_object, in metres by the
scale of the registration. What of the object can move under the model is taken out of the map, so that a
deformation does not draw the camera along; what cannot stays with the scene.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import RegistrationError
from morph_dslam.model import ReducedModel
from morph_dslam.online.known_pose import KnownPose
from morph_dslam.online.place_in_map import PlaceInMap
from morph_dslam.online.registration import shape_starts
from morph_dslam.online.slam.rigid_map import RigidMap
from morph_dslam.online.slam.slam import Slam
from morph_dslam.online.slam.slam_frame import SlamFrame

Array = NDArray[np.float64]

#: A map point this near to the surface, over the object's size, lies on it: that is what maps are good for.
ON_SURFACE = 0.03
#: What moves by more than this part of the object's size over the parameter box is no part of the scene.
MOVES = 0.005


def movable_points(positions: Array, place: PlaceInMap, model: ReducedModel) -> NDArray[np.bool_]:
    """Which map points (n, 3) lie on the object where it can move under the model."""
    nodes = np.unique(model.triangles)
    rest, size = model.nodes[nodes], float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
    distances, nearest = KDTree(rest).query(place.world_from_object.inverse.apply(positions))
    reach = np.zeros(len(nodes))
    undeformed = model.displacement.value(model.default)[nodes]
    for shape in shape_starts(model):
        moved = np.linalg.norm(model.displacement.value(shape)[nodes] - undeformed, axis=1)
        reach = np.maximum(reach, moved)
    return (distances < ON_SURFACE * size) & (reach[nearest] > MOVES * size)


class Anchor:
    """Finds an anchored object's pose by finding the camera in the map.

    Parameters
    ----------
    rigid_map : of the scene with the undeformed object; what can move is taken out of it.

    Attributes
    ----------
    n_scene, n_movable : map points that stay, on the object or not, and those on it that were taken out.

    Raises
    ------
    RegistrationError
        If nobody knows how far the place is to be trusted.
    """

    def __init__(
        self, rigid_map: RigidMap, camera: PinholeCamera, place: PlaceInMap, model: ReducedModel
    ) -> None:
        if place.covariance is None:
            raise RegistrationError(
                "the registration does not say how well the object's place is known, because the keyframes "
                "show too little texture on it: track it as a free object (--pose free)"
            )
        self.place, good = place, rigid_map.good
        movable = movable_points(rigid_map.positions[good], place, model)
        self.n_movable, self.n_scene = int(movable.sum()), int((~movable).sum())
        rigid_map.remove(good[movable])
        self.slam = Slam(camera)
        self.slam.use_map(rigid_map)

    def locate(
        self, image: NDArray[np.uint8], index: int, timestamp: float
    ) -> tuple[KnownPose | None, SlamFrame]:
        """The object in a frame (h, w, 3) by the map, None where the camera is lost; and the camera."""
        frame = self.slam.process_frame(image, index, timestamp)
        return (None if frame.pose is None else self.place.known_pose(frame.pose)), frame
