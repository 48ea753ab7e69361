"""The pictures of an object in the scan that it was registered in: the map's keyframes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import MapError
from morph_dslam.geometry import RigidTransform, rotation_log
from morph_dslam.online.attempt import Picture
from morph_dslam.online.estimation.estimator import State
from morph_dslam.online.reference.reference_view import KnownView
from morph_dslam.online.slam.map_file import load_map
from morph_dslam.online.start.placement import Placement

#: Keyframes are placed anew by the registration, but never by so much: rad, and share of the distance.
OTHER_MAP_TURN, OTHER_MAP_SHIFT = 0.1, 0.1


@dataclass(frozen=True)
class ScanPicture:
    """A keyframe: its image made ready, and the camera's pose (4, 4), metres times the map's scale."""

    picture: Picture
    camera_from_world: NDArray[np.float64]


def map_of(registration: Path, given: Path | None) -> Path | None:
    """The map: as given, as the registration names it, or beside it; None if there is none."""
    if given is not None:
        return given
    beside = [registration.with_name("map.h5")]
    named = json.loads(registration.read_text()).get("map")
    if named:
        beside.insert(0, registration.parent / named)
    return next((path for path in beside if path.is_file()), None)


def pictures_of(path: Path, camera: PinholeCamera, placement: Placement) -> dict[int, ScanPicture]:
    """The keyframes that the placement is for; their images are flattened, which is all that is needed.

    Raises
    ------
    MapError
        If the map cannot be read, or is not that of the registration.
    """
    wanted, pictures = {placement.frame, *(view.frame for view in placement.views)}, {}
    for keyframe in load_map(path, camera).keyframes:
        if keyframe.index not in wanted:
            continue
        picture = Picture(keyframe.flat, keyframe.flat)
        pictures[keyframe.index] = ScanPicture(picture, keyframe.camera_from_world)
        if keyframe.index == placement.frame and placement.place is not None:
            _check_pose(path, placement, placement.place.pose_in(keyframe.camera_from_world))
    if placement.frame not in pictures:
        raise MapError(f"{path} is not the map of the registration: it has no keyframe {placement.frame}")
    return pictures


def views_of(
    placement: Placement, pictures: Mapping[int, ScanPicture], seen: Mapping[int, NDArray[np.bool_]]
) -> list[KnownView]:
    """The undeformed object in those keyframes whose errors are known, that of the placement first.

    ``seen`` (h, w) says of some keyframes where they show the object.
    """
    d = len(placement.model.parameters)
    return [
        KnownView(
            pictures[view.frame].picture,
            State(placement.model.default, view.pose),
            np.vstack([np.zeros((d, view.causes.shape[1])), view.causes]),
            seen=seen.get(view.frame),
            frame=view.frame,
        )
        for view in placement.views
        if view.frame in pictures
    ]


def _check_pose(path: Path, placement: Placement, by_map: RigidTransform) -> None:
    """Raise MapError if the map has the keyframe of the placement elsewhere than the registration."""
    pose = placement.state.camera_from_object
    turn = np.linalg.norm(rotation_log(by_map.rotation @ pose.rotation.T))
    shift = np.linalg.norm(by_map.translation - pose.translation)
    if turn > OTHER_MAP_TURN or shift > OTHER_MAP_SHIFT * np.linalg.norm(pose.translation):
        raise MapError(
            f"{path} is not the map of the registration: by the map the object is {1e3 * shift:.0f} mm and "
            f"{np.degrees(turn):.0f} deg from where the registration has it in keyframe {placement.frame}"
        )
