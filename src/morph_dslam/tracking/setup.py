"""What a run starts from, read from files and checked: cameras, objects, and the map that they are in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import CameraError, MapError
from morph_dslam.geometry import RigidTransform, rotation_log
from morph_dslam.io.camera_files import load_camera, load_rig
from morph_dslam.io.landmarks import Landmarks, load_landmarks
from morph_dslam.model import ReducedModel, load_model
from morph_dslam.model.inner_structure import InnerStructure, load_inner_structure
from morph_dslam.notices import Remark
from morph_dslam.registration.initialization import Initializer, register_by_initializer
from morph_dslam.registration.landmarks import CLICK_PX, register_landmarks
from morph_dslam.registration.registration import Registration, load_registration
from morph_dslam.slam.map_files import load_map
from morph_dslam.sources import Frame
from morph_dslam.tracking.hypothesis import Image
from morph_dslam.tracking.multi_camera import RigCamera
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.run_options import ObjectOptions, TrackOptions

#: Keyframes are placed anew by the registration, but never by so much: rad, and share of the distance.
OTHER_MAP_TURN, OTHER_MAP_SHIFT = 0.1, 0.1


@dataclass(frozen=True)
class KeyframeImage:
    """A keyframe of a map.

    Attributes
    ----------
    image : made ready.
    camera_from_world : (4, 4), metres times the map's scale.
    """

    image: Image
    camera_from_world: NDArray[np.float64]


@dataclass(frozen=True)
class TrackedObject:
    """An object, and what says where it is at first.

    Attributes
    ----------
    name : by which messages and results call it; its run folder.
    model : as it is in its file.
    start : its registration in a map, or landmarks or an initializer that give it in the reference frame.
    options : what is measured, and what earlier frames add.
    inner : structures inside of it.
    map_path : of the map that it is anchored in; None if it is free.
    keyframes : of the map that it is registered in, by frame; none where a frame has to be the reference.
    reregister_at : frames in which to register it anew, with landmarks there, or None for the initializer.
    click_px : standard deviation of a landmark's pixel.
    """

    name: str
    model: ReducedModel
    start: Registration | Landmarks | Initializer
    options: TrackerOptions = field(default_factory=TrackerOptions)
    inner: tuple[InnerStructure, ...] = ()
    map_path: Path | None = None
    keyframes: Mapping[int, KeyframeImage] = field(default_factory=dict)
    reregister_at: Mapping[int, Landmarks | None] = field(default_factory=dict)
    click_px: float = CLICK_PX

    @property
    def initializer(self) -> Initializer | None:
        """What finds the object in any frame; None where landmarks or a registration give it in one."""
        return None if isinstance(self.start, Registration | Landmarks) else self.start

    def register(self, camera: Camera, frame: Frame, landmarks: Landmarks | None = None) -> Registration:
        """The object in a frame, by these landmarks, or by what it starts from.

        Raises
        ------
        RegistrationError
            If it cannot be registered there.
        """
        start = landmarks or self.start
        if isinstance(start, Registration):
            return start
        if isinstance(start, Landmarks):
            depth = frame.depth if self.options.use_depth else None
            return register_landmarks(self.model, camera, start, self.click_px, depth, self.options.depth_sigma)
        return register_by_initializer(start, self.model, camera, np.asarray(frame.image, dtype=np.uint8))

    def tracker_options(self, registration: Registration) -> TrackerOptions:
        """The options with what the registration leaves open."""
        names = dict.fromkeys((*registration.per_sequence, *self.options.per_sequence))
        return replace(self.options, per_sequence=tuple(names))


def load_cameras(run: TrackOptions) -> tuple[RigCamera, ...]:
    """The camera, or those of the camchain that the first one was named of, ``camchain.yaml#cam0``."""
    if not run.other_cameras:
        return (RigCamera(load_camera(Path(run.camera)), RigidTransform.identity()),)
    name, _, chosen = str(run.camera).partition("#")
    if chosen != "cam0":
        raise CameraError(
            f"{run.camera} does not say where several cameras are: give the first camera of a Kalibr camchain, "
            "camchain.yaml#cam0"
        )
    cameras, count = load_rig(Path(name)), 1 + len(run.other_cameras)
    if len(cameras) != count:
        raise CameraError(f"{name} has {len(cameras)} cameras, but there are {count} recordings")
    return tuple(RigCamera(camera, pose) for camera, pose in cameras)


def load_objects(run: TrackOptions, camera: Camera) -> list[TrackedObject]:
    """All objects of a run.

    Parameters
    ----------
    run : the options.
    camera : the first one.
    """
    return [_load_object(str(folder), part, run, camera) for folder, part in zip(run.folders, run.objects, strict=True)]


def _load_object(name: str, part: ObjectOptions, run: TrackOptions, camera: Camera) -> TrackedObject:
    initializer, model = part.initializer.load(), load_model(part.model)
    inner = tuple(load_inner_structure(path) for path in part.inner)
    for structure in inner:
        structure.carried_by(model)  # raises before the tracking if it is not for this model
    again = {n: None if path is None else load_landmarks(path) for n, path in part.reregister_at}
    options = replace(part.tracker, hold_pose=part.pose == "fixed")
    if part.registration is None:
        start = initializer if part.landmarks is None else load_landmarks(part.landmarks)
        assert start is not None
        return TrackedObject(name, model, start, options, inner, reregister_at=again, click_px=run.click_px)
    registration, path = load_registration(part.registration, model), map_of(part.registration, run.map_path)
    if path is None and part.pose != "free":
        note = "no map was given or found beside the registration: the object is tracked as a free one"
        registration = replace(registration, warnings=(*registration.warnings, Remark(note)))
    # The outline is looked for in grey values, which keyframes have not.
    has_images = path is not None and not options.use_outline
    keyframes = keyframes_of(path, camera, registration) if path is not None and has_images else {}
    # A free object is not where the map has it, but looks as in the map's keyframes.
    anchored_in = None if part.pose == "free" else path
    return TrackedObject(
        name, model, registration, options, inner, anchored_in, keyframes, again, click_px=run.click_px
    )


def map_of(registration: Path, given: Path | None) -> Path | None:
    """The map: as given, as the registration names it, or beside it; None if there is none."""
    if given is not None:
        return given
    beside = [registration.with_name("map.h5")]
    named = json.loads(registration.read_text()).get("map")
    if named:
        beside.insert(0, registration.parent / named)
    return next((path for path in beside if path.is_file()), None)


def keyframes_of(path: Path, camera: Camera, registration: Registration) -> dict[int, KeyframeImage]:
    """The keyframes that the registration is for; they have contrast-normalized images only."""
    wanted, keyframes = {registration.frame, *(view.frame for view in registration.views)}, {}
    for keyframe in load_map(path, camera).keyframes:
        if keyframe.index not in wanted:
            continue
        image = Image(keyframe.normalized, keyframe.normalized)
        keyframes[keyframe.index] = KeyframeImage(image, keyframe.camera_from_world)
        if keyframe.index == registration.frame and registration.map_registration is not None:
            _check_pose(path, registration, registration.map_registration.pose_in(keyframe.camera_from_world))
    if registration.frame not in keyframes:
        raise MapError(f"{path} is not the map of the registration: it has no keyframe {registration.frame}")
    return keyframes


def _check_pose(path: Path, registration: Registration, by_map: RigidTransform) -> None:
    """Raise MapError if the map has the object elsewhere than the registration."""
    pose = registration.state.camera_from_object
    turn = np.linalg.norm(rotation_log(by_map.rotation @ pose.rotation.T))
    shift = np.linalg.norm(by_map.translation - pose.translation)
    if turn > OTHER_MAP_TURN or shift > OTHER_MAP_SHIFT * np.linalg.norm(pose.translation):
        raise MapError(
            f"{path} is not the map of the registration: by the map the object is {1e3 * shift:.0f} mm and "
            f"{np.degrees(turn):.0f} deg from where the registration has it in keyframe {registration.frame}"
        )
