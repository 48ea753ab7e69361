"""What a run starts from, read from files and checked: cameras, objects, and the map that they are in."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from morph_dslam.camera import Camera
from morph_dslam.errors import CameraError, RegistrationError, TrackingError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.camera_files import load_camera, load_rig
from morph_dslam.io.landmarks import Landmarks, load_landmarks
from morph_dslam.model import ReducedModel, load_model
from morph_dslam.model.inner_structure import InnerStructure, load_inner_structures
from morph_dslam.notices import Remark
from morph_dslam.registration.guess import GuessInitializer
from morph_dslam.registration.initialization import Initializer, register_by_initializer
from morph_dslam.registration.landmarks import CLICK_PX, register_landmarks
from morph_dslam.registration.registration import Registration, in_scene
from morph_dslam.registration.registration_file import load_registration, read_content
from morph_dslam.slam.rigid_map import Keyframe
from morph_dslam.slam.scene import Scene, load_scene
from morph_dslam.sources import Frame
from morph_dslam.tracking.known_values import KnownTime, KnownValues
from morph_dslam.tracking.named_points import NamedPoints
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.rig import RigCamera
from morph_dslam.tracking.run_options import ObjectOptions, TrackOptions
from morph_dslam.tracking.synchronized import own_number
from morph_dslam.tracking.views import registered_keyframes


@dataclass(frozen=True)
class TrackedObject:
    """An object, and what says where it is at first.

    Attributes
    ----------
    name : by which messages and results call it; its run folder.
    model : of its file, with the angle that its registration leaves open, if any.
    start : its registration in a map, or landmarks or an initializer that give it in the reference frame.
    options : what is measured, and what earlier frames add.
    inner : structures inside of it.
    keyframes : of the map that it is registered in, by frame; none where a frame has to be the reference.
    reregister_at : frames in which to register it anew, with landmarks there, or None for the initializer.
    click_px : standard deviation of a landmark's pixel.
    at_rest : whether it is undeformed in the frame of its landmarks.
    snap : whether its outline in the frame of landmarks corrects them.
    points : places of it that are followed by name; None where there are none.
    known : parameters that something else measures; None where there are none.
    time_zero : time of the recording at which the model's time begins, seconds; None where it is not known.
    other_landmarks : in what the second camera of a rig saw in the reference frame, the third, and so on.
    """

    name: str
    model: ReducedModel
    start: Registration | Landmarks | Initializer
    options: TrackerOptions = field(default_factory=TrackerOptions)
    inner: tuple[InnerStructure, ...] = ()
    keyframes: Mapping[int, Keyframe] = field(default_factory=dict)
    reregister_at: Mapping[int, Landmarks | None] = field(default_factory=dict)
    click_px: float = CLICK_PX
    at_rest: bool = False
    snap: bool = False
    points: NamedPoints | None = None
    known: KnownValues | None = None
    time_zero: float | None = None
    other_landmarks: tuple[Landmarks, ...] = ()

    @property
    def scene(self) -> Scene | None:
        """That it is anchored in; None if it is free."""
        return self.start.scene if isinstance(self.start, Registration) and self.options.pose != "free" else None

    @property
    def initializer(self) -> Initializer | None:
        """What finds the object in any frame; None where landmarks or a registration give it in one."""
        return None if isinstance(self.start, Registration | Landmarks) else self.start

    def register(
        self, cameras: Sequence[RigCamera], frames: Sequence[Frame], landmarks: Landmarks | None = None
    ) -> Registration:
        """The object in the frames of an instant, by camera, by these landmarks, or by what it starts from.

        Raises
        ------
        RegistrationError
            If it cannot be registered there.
        """
        start, frame = landmarks or self.start, frames[0]
        if isinstance(start, Registration):
            return start
        camera = cameras[0].camera
        if isinstance(start, Landmarks):
            others = list(zip(cameras[1:], self.other_landmarks, strict=False)) if start is self.start else []
            # Each camera's recording has its own numbers.
            for number, (each, seen) in enumerate(zip((start, *(seen for _, seen in others)), frames, strict=False)):
                _check_frame(each, own_number(seen), number)
            # Several cameras show how far away the object is.
            depth = frame.depth if self.options.use_depth and not others else None
            at_rest = self.at_rest and start is self.start
            image = np.asarray(frame.image, dtype=np.uint8) if self.snap else None
            return register_landmarks(
                self.model,
                camera,
                start,
                self.click_px,
                depth,
                self.options.depth_sigma,
                at_rest,
                image=image,
                others=others,
                depth_scale_std=self.options.depth_scale_std,
            )
        return register_by_initializer(start, self.model, camera, np.asarray(frame.image, dtype=np.uint8))

    def tracker_options(self, registration: Registration) -> TrackerOptions:
        """The options with what the registration leaves open."""
        names = dict.fromkeys((*registration.per_sequence, *self.options.per_sequence))
        return replace(self.options, per_sequence=tuple(names))


def _check_frame(landmarks: Landmarks, frame: int, camera: int = 0) -> None:
    """Raise RegistrationError if landmarks in a camera of a rig say that they were set in another frame."""
    others = [] if landmarks.frames is None else sorted({*landmarks.frames.tolist()} - {frame})
    if others:
        whose = f"landmarks of camera {camera}" if camera else "landmarks"
        raise RegistrationError(
            f"{whose} that were set in frame {others[0]} are used in {_name_of(frame)}: give those of that frame, "
            "choose the other one (--reference-frame), or leave out the column of frames if they belong there"
        )


def check_guess(start: Registration | Landmarks | Initializer, frame: int) -> None:
    """Raise RegistrationError if a guess says that it is of another frame than this one, the reference.

    Where it registers an object anew, in a later frame, the picture alone decides.
    """
    guessed = start.guess.frame if isinstance(start, GuessInitializer) else None
    if guessed is not None and guessed != frame:
        raise RegistrationError(
            f"a guess of frame {guessed} is used in {_name_of(frame)}: give one of that frame, choose the other one "
            "(--reference-frame), or leave out its line 'frame' if it belongs there"
        )


def _name_of(frame: int) -> str:
    return f"frame {frame}" if frame >= 0 else "the reference image"


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
        raise CameraError(
            f"{name} has {len(cameras)} cameras, but there are {count} recordings: name one of each camera in their "
            "order, or leave a camera out of a copy of the file, whose T_cn_cnm1 are relative to the camera before"
        )
    recordings = [str(recording) for recording in (run.frames, *run.other_cameras)]
    twice = [recording for recording in set(recordings) if recordings.count(recording) > 1]
    if twice:
        raise TrackingError(f"{twice[0]} is given for two cameras: name what each of them recorded")
    return tuple(RigCamera(camera, pose) for camera, pose in cameras)


def load_objects(run: TrackOptions, camera: Camera) -> list[TrackedObject]:
    """All objects of a run.

    Parameters
    ----------
    run : the options.
    camera : the first one.
    """
    scene_of = cache(partial(load_scene, camera=camera))  # objects mostly share one
    first, *more = (
        _load_object(str(name), part, run, scene_of) for name, part in zip(run.folders, run.objects, strict=True)
    )
    return [replace(first, other_landmarks=tuple(load_landmarks(path) for path in run.other_landmarks)), *more]


def _load_object(name: str, part: ObjectOptions, run: TrackOptions, scene_of: Callable[[Path], Scene]) -> TrackedObject:
    initializer, model = part.initializer.load(), load_model(part.model)
    inner = load_inner_structures(part.inner, model)
    points = NamedPoints.of(model, part.points)
    known = None if part.known is None else KnownValues.read(part.known, model)
    again = {n: None if path is None else load_landmarks(path) for n, path in part.reregister_at}
    for number, landmarks in again.items():
        if landmarks is not None:
            _check_frame(landmarks, number)
    if part.time_zero is not None:
        _check_clock(KnownTime.of(model, part.time_zero), known)
    made = partial(
        TrackedObject,
        name,
        options=part.tracker,
        inner=inner,
        reregister_at=again,
        click_px=run.click_px,
        points=points,
        known=known,
        time_zero=part.time_zero,
    )
    if part.registration is None:
        start = initializer if part.landmarks is None else load_landmarks(part.landmarks)
        assert start is not None
        return made(model, start, at_rest=part.at_rest, snap=part.snap)
    registration, path = load_registration(part.registration, model), map_of(part.registration, run.map_path)
    if path is None and part.tracker.pose != "free":
        note = "no map was given or found beside the registration: the object is tracked as a free one"
        registration = replace(registration, warnings=(*registration.warnings, Remark(note)))
    if path is not None:
        registration = in_scene(registration, scene_of(path))
    # A free object is not where the map has it, but looks as in the map's keyframes.
    # Not the model of the file: beside a copy with an open angle it would be kept for nothing.
    return made(registration.model, registration, keyframes=registered_keyframes(registration))


def _check_clock(clock: KnownTime, known: KnownValues | None) -> None:
    """Raise TrackingError if a table has the parameter of time as well."""
    if known is not None and clock.index in known.indices:
        raise TrackingError(
            f"'{clock.parameter.name}' is in the table of known parameters, and --time-zero gives it too: leave out one"
        )


def map_of(registration: Path, given: Path | None) -> Path | None:
    """The map: as given, as the registration names it, or beside it; None if there is none."""
    if given is not None:
        return given
    beside = [registration.with_name("map.h5")]
    named = read_content(registration).get("map")
    if named:
        beside.insert(0, registration.parent / named)
    return next((path for path in beside if path.is_file()), None)
