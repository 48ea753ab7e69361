"""Objects in their reference frames: where each is, in which images it is known, and what occludes it there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError, SourceError, TrackingError
from morph_dslam.model import ReducedModel
from morph_dslam.model.inner_structure import CarriedStructure
from morph_dslam.model.unknown_loads import with_unknown_loads
from morph_dslam.registration.registration import Registration
from morph_dslam.slam.frame_images import FrameImages
from morph_dslam.sources import Frame, open_source
from morph_dslam.tracking.anchoring import Anchor
from morph_dslam.tracking.binding import DrawnSurface
from morph_dslam.tracking.estimator import Estimator, State
from morph_dslam.tracking.hypothesis import Image
from morph_dslam.tracking.known_values import KnownParameters, KnownTime, registered_with
from morph_dslam.tracking.multi_camera import RigTracker
from morph_dslam.tracking.occlusion import drawn_depth
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.rig import RigCamera
from morph_dslam.tracking.run_options import TrackOptions
from morph_dslam.tracking.run_results import RunResults
from morph_dslam.tracking.setup import TrackedObject, check_guess
from morph_dslam.tracking.synchronized import SynchronizedFrames
from morph_dslam.tracking.tracker import Tracker
from morph_dslam.tracking.tracker_inputs import widened
from morph_dslam.tracking.views import KeyframeViews, choose_keyframe_views, image_of, registered_images

#: Correlation of two contrast-normalized images that are the same but for the compression.
SAME_IMAGE = 0.8
ReferenceImage = NDArray[np.uint8] | Image
#: The frames of all cameras of this number, or the first ones.
FramesAt = Callable[[int | None], tuple[Frame, ...]]


@dataclass(frozen=True)
class PlacedObject:
    """An object in its reference frame.

    Attributes
    ----------
    object : what is tracked.
    cameras : that see it.
    registration : where it is, in the first camera.
    images : by camera, the reference frame, or, of the first camera, a keyframe of the map.
    frame : its number.
    in_sequence : whether the frames to track begin with it.
    seen : by camera, where (h, w) the reference frame shows the object; None for all that it covers.
    keyframes : by camera, other images of the object as it is there; None where only the reference is known.
    depth : (h, w) of the first camera's reference frame in the scale that the registration found, metres, NaN where
        unknown; None where it does not count.
    timestamp : of the reference frame, seconds; None where the recording that is tracked does not tell it.
    """

    object: TrackedObject
    cameras: tuple[RigCamera, ...]
    registration: Registration
    images: tuple[ReferenceImage, ...]
    frame: int
    in_sequence: bool = False
    seen: tuple[NDArray[np.bool_] | None, ...] = ()
    keyframes: tuple[KeyframeViews, ...] | None = None
    depth: NDArray[np.float32] | None = None
    timestamp: float | None = None

    @property
    def name(self) -> str:
        """By which messages and results call it."""
        return self.object.name

    @property
    def model(self) -> ReducedModel:
        """That it is tracked with."""
        return self.registration.model

    @property
    def camera(self) -> Camera:
        """The first one."""
        return self.cameras[0].camera

    @property
    def options(self) -> TrackerOptions:
        """That it is tracked with."""
        return self.object.tracker_options(self.registration)

    @property
    def depth_scale_std(self) -> float:
        """Standard deviation of what all depths are off by together, a share."""
        scale = self.registration.depth_scale
        return self.options.depth_scale_std if scale is None else scale.std

    @cached_property
    def inner(self) -> list[CarriedStructure]:
        """The structures inside of it, carried by the model."""
        return [structure.carried_by(self.model) for structure in self.object.inner]

    @cached_property
    def surface(self) -> ReducedModel:
        """What of the model is drawn."""
        return DrawnSurface.of(self.model).model

    @property
    def is_by_keyframe(self) -> bool:
        """Whether the first camera's reference image is a keyframe of the map."""
        return isinstance(self.images[0], Image)

    @property
    def reference_keyframes(self) -> list[int]:
        """Numbers of the map's keyframes that the first camera's frames are compared with, from the beginning."""
        if not self.is_by_keyframe:
            return []
        views = self.keyframes[0].views if self.keyframes else ()
        return [self.frame, *(view.frame for view in views if view.frame is not None)]

    def new_results(self, refined: bool = False) -> RunResults:
        """Results of no frame so far."""
        return RunResults(
            self.model,
            self.frame,
            refined,
            self.options.per_sequence,
            self.registration.per_sequence,
            self.options.modulus_std,
            self.object.points,
            self.object.at_rest,
        )

    def new_tracker(self) -> Tracker | RigTracker:
        """A tracker at its beginning; raises RegistrationError if the object shows too few corners."""
        seen = self.seen or (None,) * len(self.cameras)
        registration = self.registration
        if not self.is_by_keyframe:  # a keyframe may be of another recording
            known = KnownParameters(self.model)
            self._tell_all_frames(known)
            known.begin(self.frame, self.timestamp)
            registration = registered_with(registration, known)
        if len(self.cameras) > 1:
            tracker = RigTracker(
                self.model,
                self.cameras,
                registration,
                self.options,
                references=self.images,
                in_sequence=self.in_sequence,
                seen=seen,
                keyframes=self.keyframes,
            )
        else:
            tracker = Tracker(
                self.model,
                self.camera,
                registration,
                self.options,
                reference=self.images[0],
                in_sequence=self.in_sequence,
                seen=seen[0],
                keyframes=None if self.keyframes is None else self.keyframes[0],
            )
        self._tell_all_frames(tracker.estimator.known)
        return tracker

    def _tell_all_frames(self, known: KnownParameters) -> None:
        """Make known what the recording's table and the times of its frames tell."""
        zero = self.object.time_zero
        known.values, known.clock = self.object.known, None if zero is None else KnownTime.of(known.model, zero)

    def in_frames(self, registration: Registration, frames: Sequence[Frame]) -> PlacedObject:
        """The same object, registered anew in the frames of an instant."""
        images = tuple(frame.image for frame in frames)
        registration = replace(
            registration,
            per_sequence=self.registration.per_sequence,
            map_registration=self.registration.map_registration,
        )
        index, time = frames[0].index, frames[0].timestamp
        return PlacedObject(self.object, self.cameras, registration, images, index, in_sequence=True, timestamp=time)

    def state_in(self, frame: int, keyframe_of: TrackedObject) -> State | None:
        """The object in a frame, or in a keyframe of another object's map; None where nobody knows."""
        if frame == self.frame:
            return self.registration.state
        pose = next((view.pose for view in self.registration.views if view.frame == frame), None)
        keyframe, in_map = keyframe_of.keyframes.get(frame), self.registration.map_registration
        if pose is None and self.object.scene is not None and in_map is not None and keyframe is not None:
            pose = in_map.pose_in(keyframe.camera_from_world)
        return None if pose is None else State(self.model.default, pose)


def new_anchor(placed: Sequence[PlacedObject]) -> Anchor | None:
    """The map with the anchored objects in it; None if all are free."""
    anchored = {part.name: part.registration for part in placed if part.object.scene is not None}
    return Anchor.of(anchored, placed[0].camera) if anchored else None


def frame_at(
    path: Path | str, number: int | None, depth_per_metre: float | None = None, fps: float | None = None
) -> Frame:
    """A frame of a recording, the first one by default; raises SourceError if it is not there."""
    for frame in open_source(path, number, number, fps, depth_per_metre):
        return frame
    raise SourceError(f"{path} holds no frame {number} to take as the reference")


def place(part: TrackedObject, cameras: Sequence[RigCamera], frames_at: FramesAt, run: TrackOptions) -> PlacedObject:
    """An object in its reference frame.

    Parameters
    ----------
    part : the object.
    cameras : that see it.
    frames_at : gives the frames to take as the reference.
    run : the options.
    """
    start, camera = part.start, cameras[0].camera
    number = start.frame if isinstance(start, Registration) else run.reference_frame
    if isinstance(start, Registration) and number is not None and number in part.keyframes:
        image = image_of(part.keyframes[number])
        others = _beside_keyframe(image, number, camera, frames_at) if len(cameras) > 1 else []
        # The frames may be those of another recording: the object is looked for as after a loss.
        return PlacedObject(part, tuple(cameras), with_loads(start, part.options), (image, *others), number)
    frames = frames_at(number)
    where = f"frame {frames[0].index} of {run.frames}" if run.reference_image is None else str(run.reference_image)
    camera.check_image(frames[0].image, where)
    check_guess(start, frames[0].index)
    registration, images = part.register(cameras, frames), tuple(frame.image for frame in frames)
    # A sequence that does not begin with the reference frame is entered as if the object had been lost.
    in_sequence = not run.live and (number is None or number == _first_number(run))
    placed = with_loads(registration, part.options)
    depth, scale = frames[0].depth if part.options.use_depth else None, registration.depth_scale
    if depth is not None and scale is not None:
        depth = scale.corrected(depth)
    time = frames[0].timestamp if run.reference_image is None else None
    return PlacedObject(part, tuple(cameras), placed, images, frames[0].index, in_sequence, depth=depth, timestamp=time)


def _first_number(run: TrackOptions) -> int:
    """Number of the frame that a recording is tracked from."""
    return frame_at(run.frames, None).index if run.first is None else run.first


def with_loads(registration: Registration, options: TrackerOptions) -> Registration:
    """The registration with unknown loads among its parameters, none of which acts then; itself if none are sought."""
    if not options.use_unknown_loads:
        return registration
    model, covariance = with_unknown_loads(registration.model, options.estimation.loads.work), registration.covariance
    d, m = len(registration.model.parameters), model.n_loads
    if covariance is not None:
        covariance = np.insert(np.insert(covariance, [d] * m, 0.0, axis=0), [d] * m, 0.0, axis=1)
    state = replace(registration.state, parameters=np.append(registration.state.parameters, np.zeros(m)))
    return replace(registration, model=model, state=state, covariance=covariance)


def _beside_keyframe(keyframe: Image, number: int, camera: Camera, frames_at: FramesAt) -> list[NDArray[np.uint8]]:
    """What the other cameras saw of the undeformed object, in the instant of the map's keyframe."""
    try:
        first, *others = frames_at(number)
        view = FrameImages(camera).prepare(first.image, number, 0.0)
        is_keyframe = np.corrcoef(view.normalized.ravel(), keyframe.normalized.ravel())[0, 1] > SAME_IMAGE
    except SourceError:
        is_keyframe, others = False, []
    if not is_keyframe:
        raise TrackingError(
            f"the recordings do not show the map's keyframe {number}, so it is not known when the other cameras "
            "saw the undeformed object: name a frame of these recordings in which it is undeformed, "
            "--reference-frame"
        )
    return [frame.image for frame in others]


def place_by_map(part: TrackedObject, camera: Camera, frame: Frame) -> TrackedObject:
    """An anchored object that starts from a frame of the recording, in which it is undeformed; others as they are."""
    registration = part.start
    if not isinstance(registration, Registration):
        return part
    anchor = Anchor.of({part.name: registration}, camera)
    poses, found = anchor.locate(frame.image, frame.index, frame.timestamp)
    if part.name not in poses:
        raise RegistrationError(
            f"the camera is not found in the map in frame {frame.index} ({found.reason}): take another "
            "--reference-frame"
        )
    d = len(registration.model.parameters)
    covariance = np.zeros((d + 6, d + 6))
    covariance[d:, d:] = poses[part.name].covariance
    state = State(registration.model.default, poses[part.name].pose)
    return replace(
        part, start=replace(registration, frame=frame.index, state=state, covariance=covariance), keyframes={}
    )


def with_other_images(placed: Sequence[PlacedObject], recorded: SynchronizedFrames | None) -> list[PlacedObject]:
    """The objects with what else shows them undeformed, without what others occlude of them there.

    Parameters
    ----------
    placed : all objects of the run.
    recorded : what all cameras of a rig recorded, whose frames of the scan are used as well; None of one camera.
    """
    return [_with_other_images(own, [other for other in placed if other is not own], recorded) for own in placed]


def _with_other_images(
    own: PlacedObject, others: Sequence[PlacedObject], recorded: SynchronizedFrames | None
) -> PlacedObject:
    seen = tuple(seen_part(own, others, part, own.frame) for part in own.cameras)
    own = replace(own, seen=seen)
    keyframes = own.object.keyframes
    images = {v.frame: image_of(keyframes[v.frame]) for v in own.registration.views if v.frame in keyframes}
    if not own.is_by_keyframe or len(images) < 2 or not own.options.further_views:
        return own
    found = [_keyframe_views(own, others, own.cameras[0], images)]
    if recorded is not None:
        for number, part in enumerate(own.cameras[1:], start=1):
            seen_then = images_from(recorded.of_camera(number), part.camera, list(images))
            found.append(_keyframe_views(own, others, part, seen_then))
    return replace(own, keyframes=tuple(found))


def _keyframe_views(
    own: PlacedObject, others: Sequence[PlacedObject], part: RigCamera, images: dict[int, Image]
) -> KeyframeViews:
    """What a camera has of the undeformed object beside the reference frame."""
    posed = [part.seen_image(image) for image in registered_images(own.registration, images)]
    first, *rest = [
        replace(image, seen=None if image.frame is None else seen_part(own, others, part, image.frame))
        for image in posed
    ]
    return choose_keyframe_views(Estimator(own.model, part.camera), first, rest, own.options)


def images_from(frames: Iterable[Frame], camera: Camera, numbers: Sequence[int]) -> dict[int, Image]:
    """Frames of a camera by number, made ready; those that are not there are left out."""
    maker, images = FrameImages(camera), {}
    for frame in frames:
        if frame.index in numbers:
            view = maker.prepare(frame.image, frame.index, frame.timestamp)
            images[frame.index] = Image(view.grey, view.normalized)
        if frame.index >= max(numbers):
            break
    return images


def seen_part(
    own: PlacedObject, others: Sequence[PlacedObject], part: RigCamera, frame: int
) -> NDArray[np.bool_] | None:
    """Where (h, w) a camera's image shows an object; None if no other one occludes any of it there."""
    state = own.state_in(frame, own.object)
    known = [(other, other.state_in(frame, own.object)) for other in others]
    before = [widened(_depth(other, part, there)) for other, there in known if there is not None]
    if state is None or not before:
        return None
    depth = _depth(own, part, state)
    covered = np.isfinite(depth)
    shown = covered & (depth <= np.minimum.reduce(before))
    return None if np.array_equal(shown, covered) else shown


def _depth(placed: PlacedObject, part: RigCamera, state: State) -> NDArray[np.float32]:
    return drawn_depth(placed.surface, part.camera, part.seen(state))
