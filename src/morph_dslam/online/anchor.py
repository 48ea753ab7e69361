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
from morph_dslam.model import ReducedModel, SurfacePoints
from morph_dslam.online.known_pose import KnownPose
from morph_dslam.online.place_in_map import PlaceInMap
from morph_dslam.online.registration import shape_starts
from morph_dslam.online.slam.rigid_map import RigidMap
from morph_dslam.online.slam.slam import Slam
from morph_dslam.online.slam.slam_frame import SlamFrame

Array = NDArray[np.float64]

#: A map point this near to the surface, over the object's size, lies on it: that is what maps are good for.
ON_SURFACE = 0.03
#: Points that stand for the surface.
N_SAMPLES = 10_000
#: What moves by more than this part of the object's size over the parameter box is no part of the scene.
MOVES = 0.005


def movable_points(positions: Array, place: PlaceInMap, model: ReducedModel) -> NDArray[np.bool_]:
    """Which map points (n, 3) lie on the object where it can move under the model."""
    samples, size = _spread_over(model), float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
    field = model.restrict(samples)
    reach, undeformed = np.zeros(len(samples)), field.value(model.default)
    for shape in shape_starts(model):
        reach = np.maximum(reach, np.linalg.norm(field.value(shape) - undeformed, axis=1))
    in_object = place.world_from_object.inverse.apply(positions)
    distances, nearest = KDTree(model.rest_positions(samples)).query(in_object)
    return (distances < ON_SURFACE * size) & (reach[nearest] > MOVES * size)


def _spread_over(model: ReducedModel) -> SurfacePoints:
    """Points spread evenly over the surface, much closer together than `ON_SURFACE`."""
    rng = np.random.default_rng(0)
    a, b, c = (model.nodes[model.triangles[:, corner]] for corner in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(areas), N_SAMPLES, p=areas / areas.sum())
    return SurfacePoints(chosen, rng.dirichlet(np.ones(3), N_SAMPLES))


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
