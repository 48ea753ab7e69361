"""The pictures of an object in the scan that it was registered in: the map's keyframes."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import MapError, RegistrationError, TrackingError
from morph_dslam.geometry import RigidTransform, rotation_log
from morph_dslam.io.camera_files import load_camera
from morph_dslam.io.landmarks import Landmarks, load_landmarks
from morph_dslam.model import ReducedModel, load_model
from morph_dslam.model.inner_structure import CarriedStructure, InnerStructure, load_inner_structure
from morph_dslam.notices import Remark
from morph_dslam.registration.initialization import Initializer, InitializerFiles, register_by_initializer
from morph_dslam.registration.landmarks import CLICK_PX, register_landmarks
from morph_dslam.registration.registration import Registration, load_registration
from morph_dslam.slam.map_files import load_map
from morph_dslam.sources import Frame
from morph_dslam.tracking.anchoring import Anchor
from morph_dslam.tracking.discrepancy import DiscrepancyOptions
from morph_dslam.tracking.estimator import Estimator, State
from morph_dslam.tracking.hypothesis import Image
from morph_dslam.tracking.options import StartFrom, TrackerOptions
from morph_dslam.tracking.outline import rim
from morph_dslam.tracking.reference import PosedImage
from morph_dslam.tracking.result import FrameResult
from morph_dslam.tracking.tracker import Tracker
from morph_dslam.tracking.views import KeyframeViews, choose_keyframe_views
from morph_dslam.units import to_si

#: Keyframes are placed anew by the registration, but never by so much: rad, and share of the distance.
OTHER_MAP_TURN, OTHER_MAP_SHIFT = 0.1, 0.1


@dataclass(frozen=True)
class KeyframeImage:
    """A keyframe: its image made ready, and the camera's pose (4, 4), metres times the map's scale."""

    picture: Image
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


def pictures_of(path: Path, camera: Camera, registration: Registration) -> dict[int, KeyframeImage]:
    """The keyframes that the registration is for; their images are contrast-normalized, which is all that is needed.

    Raises
    ------
    MapError
        If the map cannot be read, or is not that of the registration.
    """
    wanted, pictures = {registration.frame, *(view.frame for view in registration.views)}, {}
    for keyframe in load_map(path, camera).keyframes:
        if keyframe.index not in wanted:
            continue
        picture = Image(keyframe.normalized, keyframe.normalized)
        pictures[keyframe.index] = KeyframeImage(picture, keyframe.camera_from_world)
        if keyframe.index == registration.frame and registration.map_registration is not None:
            _check_pose(path, registration, registration.map_registration.pose_in(keyframe.camera_from_world))
    if registration.frame not in pictures:
        raise MapError(f"{path} is not the map of the registration: it has no keyframe {registration.frame}")
    return pictures


def views_of(
    registration: Registration, pictures: Mapping[int, KeyframeImage], seen: Mapping[int, NDArray[np.bool_]]
) -> list[PosedImage]:
    """The undeformed object in those keyframes whose errors are known, that of the registration first.

    ``seen`` (h, w) says of some keyframes where they show the object.
    """
    d = len(registration.model.parameters)
    return [
        PosedImage(
            pictures[view.frame].picture,
            State(registration.model.default, view.pose),
            np.vstack([np.zeros((d, view.error_factors.shape[1])), view.error_factors]),
            seen=seen.get(view.frame),
            frame=view.frame,
        )
        for view in registration.views
        if view.frame in pictures
    ]


def _check_pose(path: Path, registration: Registration, by_map: RigidTransform) -> None:
    """Raise MapError if the map has the keyframe of the registration elsewhere than the registration."""
    pose = registration.state.camera_from_object
    turn = np.linalg.norm(rotation_log(by_map.rotation @ pose.rotation.T))
    shift = np.linalg.norm(by_map.translation - pose.translation)
    if turn > OTHER_MAP_TURN or shift > OTHER_MAP_SHIFT * np.linalg.norm(pose.translation):
        raise MapError(
            f"{path} is not the map of the registration: by the map the object is {1e3 * shift:.0f} mm and "
            f"{np.degrees(turn):.0f} deg from where the registration has it in keyframe {registration.frame}"
        )


# What tracking starts from, recorded or live: model, camera, the object's place, the map of the scene.


#: How an object's pose is found: by the map and its points, by the map alone, by its points alone.
PoseFrom = Literal["map", "fixed", "free"]


@dataclass(frozen=True)
class ObjectOptions:
    """The object, its place and the camera.

    Attributes
    ----------
    model, camera : files.
    landmarks : file of landmarks in the reference frame; or registration : registration.json of
        `morph register`; or initializer : another way to find it there.
    map_path : map.h5 that the object was registered in; by default the one that the registration names, or
        the one beside it, if there is one.
    pose : "map": the object is anchored and the camera is found in the map, "fixed": and the map's pose is
        taken as exact, "free": it may be anywhere.
    use_outline, use_depth : let the object's outline, and the frames' depth images, count beside its texture.
    use_discrepancy : look in every frame for what the object's shape has beyond the model's.
    inner : files of inner structures (`morph inner`), whose positions are written and drawn.
    per_sequence : names of the parameters that are one over the whole sequence, beside those that the
        registration leaves open.
    random_walk : names of parameters and the standard deviation of their change from frame to frame, in the
        parameter's own unit. start : see `TrackerOptions`.
    """

    model: Path
    camera: Path
    landmarks: Path | None = None
    registration: Path | None = None
    initializer: InitializerFiles = field(default_factory=InitializerFiles)
    map_path: Path | None = None
    pose: PoseFrom = "map"
    use_outline: bool = False
    use_depth: bool = False
    use_discrepancy: bool = False
    inner: tuple[Path, ...] = ()
    per_sequence: tuple[str, ...] = ()
    random_walk: tuple[tuple[str, float], ...] = ()
    start: StartFrom = "previous"
    click_px: float = CLICK_PX
    tracker: TrackerOptions = field(default_factory=TrackerOptions)


@dataclass(frozen=True)
class Setup:
    """The inputs, read and checked.

    Attributes
    ----------
    model : as it is in its file. registration : None as long as the frame that landmarks belong to is not there.
    map_path : of the map that the object is anchored in; None if it is free.
    keyframes : of that map, by frame, in which the object is; none where a frame has to be the reference.
    initializer : that places the object in the reference frame; None if something else does.
    seen : (h, w) by frame, where it shows the object, if other objects hide some of it there.
    """

    options: ObjectOptions
    model: ReducedModel
    camera: Camera
    landmarks: Landmarks | None
    inner: tuple[InnerStructure, ...]
    registration: Registration | None
    map_path: Path | None
    keyframes: Mapping[int, KeyframeImage]
    initializer: Initializer | None = None
    seen: Mapping[int, NDArray[np.bool_]] = field(default_factory=dict)

    @property
    def reference(self) -> Image | None:
        """The keyframe that the object is placed in; None where a frame has to be it."""
        if self.registration is None or self.registration.frame is None:
            return None
        keyframe = self.keyframes.get(self.registration.frame)
        return None if keyframe is None else keyframe.picture

    @cached_property
    def further(self) -> KeyframeViews | None:
        """Other keyframes that show more of the object, where it is known how they are off with the first."""
        registration = self.registration
        if registration is None or not registration.views or not self.options.tracker.further_views:
            return None
        views = views_of(registration, self.keyframes, self.seen)
        if len(views) < 2:
            return None
        estimator = Estimator(registration.model, self.camera)
        return choose_keyframe_views(estimator, views[0], views[1:], self.tracker_options(registration))

    @property
    def reference_keyframes(self) -> list[int]:
        """Numbers of the map's keyframes that the object is compared with, the one it is placed in first."""
        if self.registration is None or self.registration.frame is None or self.reference is None:
            return []
        others = [] if self.further is None else [view.frame for view in self.further.views]
        return [self.registration.frame, *(frame for frame in others if frame is not None)]

    def placed(self, image: NDArray[np.uint8] | Image, depth: NDArray[np.float32] | None = None) -> Registration:
        """The registration; raises RegistrationError as `register_landmarks` and `Initializer.register` do.

        Parameters
        ----------
        image : (h, w, 3) the reference frame. depth : (h, w) there, metres, where there is any.
        """
        if self.registration is not None:
            return self.registration
        if self.initializer is not None:
            assert not isinstance(image, Image)
            return register_by_initializer(self.initializer, self.model, self.camera, image)
        assert self.landmarks is not None
        options = self.options
        return register_landmarks(
            self.model, self.camera, self.landmarks, options.click_px, depth, options.tracker.depth_sigma
        )

    def carried(self, model: ReducedModel) -> list[CarriedStructure]:
        """The inner structures in the model that is tracked with."""
        return [structure.carried_by(model) for structure in self.inner]

    def tracker_options(self, registration: Registration) -> TrackerOptions:
        """The options with what the registration leaves open."""
        options = self.options
        return replace(
            options.tracker,
            per_sequence=tuple(dict.fromkeys((*registration.per_sequence, *options.per_sequence))),
            use_outline=options.use_outline,
            use_depth=options.use_depth,
            discrepancy=(options.tracker.discrepancy or DiscrepancyOptions()) if options.use_discrepancy else None,
            random_walk=tuple((name, _in_si(registration, name, step)) for name, step in options.random_walk),
            start=options.start,
            hold_pose=options.pose == "fixed",
        )

    def new_tracker(
        self,
        registration: Registration,
        reference: NDArray[np.uint8] | Image,
        in_sequence: bool,
        seen: NDArray[np.bool_] | None = None,
        anchored: bool = True,
    ) -> Tracker:
        """A tracker at its beginning; see `Tracker` for the arguments.

        An object in a map is known by further keyframes too.
        """
        by_map = self.reference is not None and reference is self.reference
        return Tracker(
            registration.model,
            self.camera,
            registration,
            self.tracker_options(registration),
            reference=reference,
            in_sequence=in_sequence,
            anchor=self.new_anchor({self.model.name: registration}) if anchored else None,
            seen=seen,
            keyframes=self.further if by_map else None,
        )

    def new_anchor(self, registrations: Mapping[str, Registration]) -> Anchor | None:
        """The map with this object, and others by name, in it; None for a free object."""
        if self.map_path is None:
            return None
        objects = {
            name: (p.map_registration, p.model) for name, p in registrations.items() if p.map_registration is not None
        }
        return Anchor(load_map(self.map_path, self.camera), self.camera, objects)

    def warm_up(self, registration: Registration, reference: NDArray[np.uint8] | Image) -> None:
        """Compile the inner loops, so that the first frame takes no longer than the others."""
        warm_up(self.new_tracker(registration, reference, True).track, reference)


def warm_up(process: Callable[[Frame], object], reference: NDArray[np.uint8] | Image) -> None:
    """Compile the inner loops of what processes frames, by the reference view."""
    print("preparing: compiling the inner loops (half a minute the first time) ...", file=sys.stderr)
    image = reference
    if isinstance(image, Image):
        image = np.asarray(cv2.cvtColor(image.grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    for number in range(2):
        process(Frame(number, float(number), image))


def _in_si(registration: Registration, name: str, value: float) -> float:
    """A value in a parameter's own unit; of a name that is none it stays as it is, to be refused later."""
    known = {parameter.name: parameter for parameter in registration.model.parameters}
    return to_si(value, known[name].unit, known[name].quantity) if name in known else value


def load_setup(options: ObjectOptions) -> Setup:
    """Read and check the inputs.

    Raises
    ------
    MorphError
        If one cannot be used (ModelFileError, CameraError, MapError, RegistrationError), or they do not fit
        together (TrackingError).
    """
    initializer = options.initializer.load()
    if sum(start is not None for start in (options.landmarks, options.registration, initializer)) != 1:
        raise TrackingError(
            "say where the object is, in one way: by landmarks, a registration in a map, a board, a picture or a guess"
        )
    if options.registration is None and options.map_path is not None:
        raise TrackingError("a map needs the object's place in it: --registration registration.json")
    if options.registration is None and options.pose == "fixed":
        raise TrackingError("a pose is held fixed by a map: give the object's place in it, --registration")
    model, camera = load_model(options.model), load_camera(options.camera)
    if options.use_outline and not len(rim(model.triangles)):
        raise TrackingError(f"the surface of '{model.name}' is closed and has no rim: track it without the outline")
    inner = tuple(load_inner_structure(path) for path in options.inner)
    for structure in inner:
        structure.carried_by(model)  # says so before the tracking if it is not for this model
    if options.registration is None:
        landmarks = None if options.landmarks is None else load_landmarks(options.landmarks)
        return Setup(options, model, camera, landmarks, inner, None, None, {}, initializer)
    registration, path = load_registration(options.registration, model), map_of(options.registration, options.map_path)
    free = options.pose == "free"
    if path is None and not free:
        note = "no map was given or found beside the registration: the object is tracked as a free one"
        registration = replace(registration, warnings=(*registration.warnings, Remark(note)))
    keyframes: dict[int, KeyframeImage] = {}
    if path is not None and not options.use_outline:
        keyframes = pictures_of(path, camera, registration)
    # A free object is not where the map has it, but looks as in the map's pictures.
    return Setup(options, model, camera, None, inner, registration, None if free else path, keyframes)


# Placing an object anew in mid-sequence: where the user says so, or by its initializer after a long loss.


#: After so many lost frames on end the initializer is tried, and again after as many more.
LONG_LOSS = 30


class Reregistration:
    """Decides before each frame which chain goes on.

    Parameters
    ----------
    at : frames in which to place the object anew, and the landmarks there; None for the run's own initializer.
    begin : the reference frame; frames before it are not waited for.

    Raises
    ------
    TrackingError
        If a frame has no landmarks and the run no initializer.
    RegistrationError
        If a file of landmarks cannot be read.
    """

    def __init__(
        self, setup: Setup, registration: Registration, at: Sequence[tuple[int, Path | None]], begin: int = 0
    ) -> None:
        if setup.initializer is None and any(landmarks is None for _, landmarks in at):
            raise TrackingError(
                "to place the object anew give landmarks of that frame (--reregister-at N=FILE), or start "
                "from a board, a picture or a guess, which are looked for there again"
            )
        self._setup, self._registration, self._n_lost = setup, registration, 0
        self._before = begin
        self._at = {frame: None if path is None else load_landmarks(path) for frame, path in at}
        self._notes: list[str] = []

    @property
    def notes(self) -> list[str]:
        """What was done, and where it was to be done and was not, for the reader of the run."""
        return [*self._notes, *(f"not placed anew in frame {n}: it was not tracked" for n in self._at)]

    def chain(self, frame: Frame, chain: Tracker) -> Tracker:
        """The chain that processes the frame: the one so far, or a new one whose reference is this frame."""
        due = self._due(frame.index)
        after_loss = self._setup.initializer is not None and self._n_lost > 0 and self._n_lost % LONG_LOSS == 0
        if not due and not after_loss:
            return chain
        given = [self._at.pop(n) for n in due]
        try:
            placed = self._placed(frame, next((found for found in given if found is not None), None))
            tracker = self._setup.new_tracker(placed, frame.image, True, anchored=False)
        except RegistrationError as error:
            if due:
                self._notes.append(f"not placed anew in frame {frame.index}: {error}")
            return chain
        self._notes += [f"placed anew in frame {frame.index}", *(warning.text for warning in placed.warnings)]
        self._n_lost = 0
        tracker.anchor = chain.anchor
        return tracker

    def _due(self, frame: int) -> list[int]:
        """The numbers for which this frame is the one; the initializer may be late where live frames were dropped."""
        before, self._before = self._before, frame
        return [n for n, landmarks in self._at.items() if n == frame or (landmarks is None and before < n < frame)]

    def take_in(self, result: FrameResult) -> None:
        """Count the frames that are lost on end."""
        self._n_lost = self._n_lost + 1 if result.status == "lost" else 0

    def _placed(self, frame: Frame, landmarks: Landmarks | None) -> Registration:
        """The object in the frame, with the model and what else the run began with."""
        model, camera, options = self._registration.model, self._setup.camera, self._setup.options
        if landmarks is not None:
            found = register_landmarks(model, camera, landmarks, options.click_px)
        else:
            assert self._setup.initializer is not None
            image = np.asarray(frame.image, dtype=np.uint8)
            found = register_by_initializer(self._setup.initializer, model, camera, image)
        return replace(
            found, per_sequence=self._registration.per_sequence, map_registration=self._registration.map_registration
        )
