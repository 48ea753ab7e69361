"""Anchored objects: the camera is found in the frozen map of the scene, and with it the objects' poses.

This is the paper's main case: camera_from_object = camera_from_world world_from_object, in metres by the
scale of the registration. What of an object can move under its model is taken out of the map, so that a
deformation does not draw the camera along; what cannot stays with the scene.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import RegistrationError
from morph_dslam.model import ReducedModel
from morph_dslam.model.surface_sampling import spread_over
from morph_dslam.online.anchored.known_pose import KnownPose
from morph_dslam.online.anchored.place_in_map import PlaceInMap
from morph_dslam.online.slam.rigid_map import RigidMap
from morph_dslam.online.slam.slam import Slam
from morph_dslam.online.slam.slam_frame import SlamFrame
from morph_dslam.online.start.registration import shape_starts

Array = NDArray[np.float64]

#: A map point this near to the surface, over the object's size, lies on it: that is what maps are good for.
ON_SURFACE = 0.03
#: Points that stand for the surface, much closer together than `ON_SURFACE`.
N_SAMPLES = 10_000
#: What moves by more than this part of the object's size over the parameter box is no part of the scene.
MOVES = 0.005
#: Two objects that share more than this part of one's movable points are in the same place.
SHARED = 0.5


def points_on_object(
    positions: Array, place: PlaceInMap, model: ReducedModel
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which map points (n, 3) lie on the object, and which of them (n,) where it can move under the model."""
    samples = spread_over(model.nodes, model.triangles, N_SAMPLES)
    size = float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
    field = model.restrict(samples)
    reach, undeformed = np.zeros(len(samples)), field.value(model.default)
    for shape in shape_starts(model):
        reach = np.maximum(reach, np.linalg.norm(field.value(shape) - undeformed, axis=1))
    in_object = place.world_from_object.inverse.apply(positions)
    distances, nearest = KDTree(model.rest_positions(samples)).query(in_object)
    on_object = distances < ON_SURFACE * size
    return on_object, on_object & (reach[nearest] > MOVES * size)


class Anchor:
    """Finds the poses of anchored objects by finding the camera in the map, once a frame for all of them.

    Parameters
    ----------
    rigid_map : of the scene with the undeformed objects; what can move is taken out of it.
    objects : by name, the place in the map and the model.

    Attributes
    ----------
    n_scene, n_movable : map points that stay, on an object or not, and those on one that were taken out.

    Raises
    ------
    RegistrationError
        If nobody knows how far a place is to be trusted, or two objects are in the same place.
    """

    def __init__(
        self,
        rigid_map: RigidMap,
        camera: PinholeCamera,
        objects: Mapping[str, tuple[PlaceInMap, ReducedModel]],
    ) -> None:
        if any(place.covariance is None for place, _ in objects.values()):
            raise RegistrationError(
                "the registration does not say how well the object's place is known, because the keyframes "
                "show too little texture on it: track it as a free object (--pose free)"
            )
        self._places, good = {name: place for name, (place, _) in objects.items()}, rigid_map.good
        positions = rigid_map.positions[good]
        movable = {name: points_on_object(positions, *placed)[1] for name, placed in objects.items()}
        _check_places(movable)
        taken = np.logical_or.reduce(list(movable.values()))
        self.n_movable, self.n_scene = int(taken.sum()), int((~taken).sum())
        rigid_map.remove(good[taken])
        self.slam = Slam(camera)
        self.slam.use_map(rigid_map)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the objects."""
        return tuple(self._places)

    def locate(
        self, image: NDArray[np.uint8], index: int, timestamp: float
    ) -> tuple[dict[str, KnownPose], SlamFrame]:
        """The objects by name in a frame (h, w, 3), none where the camera is lost in the map; the camera."""
        frame = self.slam.process_frame(image, index, timestamp)
        if frame.pose is None:
            return {}, frame
        return {name: place.known_pose(frame.pose) for name, place in self._places.items()}, frame


def _check_places(movable: Mapping[str, NDArray[np.bool_]]) -> None:
    """Raise RegistrationError if two objects have taken the same points (n,) of the map."""
    for (one, points), (other, others) in combinations(movable.items(), 2):
        fewest = min(int(points.sum()), int(others.sum()))
        if fewest and (points & others).sum() > SHARED * fewest:
            raise RegistrationError(
                f"'{one}' and '{other}' are registered in the same place of the map: register the second "
                "one beside the first (morph register --beside)"
            )
