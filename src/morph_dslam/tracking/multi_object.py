"""Several objects in view of one camera: each is tracked by itself, and hides what is behind it.

A point that another object's surface hides does not count: the objects are drawn, each in the state of this
frame where it is known already, the nearest one first, and otherwise in that of the frame before, moved to
where the map has it in this frame if it is anchored.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.camera import Camera
from morph_dslam.errors import TrackingError
from morph_dslam.registration.initialization import InitializerFiles
from morph_dslam.registration.registration import PosePrior, Registration
from morph_dslam.sources import Frame, FrameSource
from morph_dslam.threads import one_thread_for_algebra
from morph_dslam.tracking.anchoring import Anchor
from morph_dslam.tracking.binding import DrawnSurface, draw_view, view_of
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.hypothesis import Image
from morph_dslam.tracking.outcomes import PoseSource
from morph_dslam.tracking.result import FrameResult
from morph_dslam.tracking.run_folder import RunResults, check_run_folder
from morph_dslam.tracking.setup import KeyframeImage, ObjectOptions, Setup, load_setup, warm_up
from morph_dslam.tracking.track import TrackOptions, find_begin, open_frames, with_reference, write_results
from morph_dslam.tracking.tracker import CameraLocalization, Tracker

#: How much wider than drawn an object hides, pixels: what is compared of a point reaches as far.
MARGIN_PX = 5


def widened(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """What an object hides: its depth (h, w), infinite where it is not, and that of a margin around it."""
    square = np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)
    return np.asarray(cv2.erode(depth, square), dtype=np.float32)


class ObjectTracker:
    """Follows several objects at once.

    Parameters
    ----------
    trackers : by name, each of one object, all of the same camera.
    """

    def __init__(self, trackers: Mapping[str, Tracker]) -> None:
        self.trackers = dict(trackers)
        self._last: dict[str, FrameResult] = {}

    def track(
        self, frame: Frame | NDArray[np.uint8], located: Mapping[str, CameraLocalization] | None = None
    ) -> dict[str, FrameResult]:
        """Find the objects in the next frame; see `Tracker.track`. By name.

        Parameters
        ----------
        located : of the anchored objects, what the map says of this frame.
        """
        located = {name: CameraLocalization() for name in self.trackers} | dict(located or {})
        expected = {name: self._expected(name, located[name].pose_prior) for name in self.trackers}
        nearest_first = sorted(expected, key=lambda name: self._distance(name, expected[name]))
        drawn = {name: self._drawn(name, expected[name]) for name in nearest_first}
        for name in nearest_first:
            others = [depths for other, depths in drawn.items() if other != name and depths is not None]
            occluder_depth = np.minimum.reduce(others) if others else None
            self._last[name] = self.trackers[name].track(frame, located[name], occluder_depth)
            drawn[name] = self._drawn(name, self.trackers[name].state)
        return {name: self._last[name] for name in self.trackers}

    def _expected(self, name: str, known: PosePrior | None) -> State:
        """Where an object may be in the next frame: where it was last, or where the map has it."""
        state, last = self.trackers[name].state, self._last.get(name)
        if known is None or (last is not None and last.pose_from is PoseSource.POINTS):
            return state
        return replace(state, camera_from_object=known.pose)

    def _distance(self, name: str, state: State) -> float:
        """Mean depth of an object's points."""
        return float(self.trackers[name].reference.points.in_camera(state)[:, 2].mean())

    def _drawn(self, name: str, state: State) -> NDArray[np.float32] | None:
        """Depth (h, w) of an object and its margin; None if nobody knows whether it is there."""
        if name in self._last and self._last[name].estimate is None:
            return None
        return widened(self.trackers[name].reference.depth(state))


class MultiObjectTracker:
    """From a frame to the objects in it, as `Tracker` for one: the camera in the map once, then each
    object.

    Parameters
    ----------
    anchor : of the objects that are anchored, by name; None if all are free.
    """

    def __init__(self, camera: Camera, trackers: Mapping[str, Tracker], anchor: Anchor | None = None) -> None:
        self._camera, self._objects, self._anchor = camera, ObjectTracker(trackers), anchor

    def process(self, frame: Frame) -> dict[str, FrameResult]:
        """Find the objects, by name; raises CameraError if the frame has not the camera's size."""
        return self.track(frame, self.locate(frame))

    def locate(self, frame: Frame) -> dict[str, CameraLocalization]:
        """Find the camera of the next frame in the map: what that tells of each anchored object, by name."""
        self._camera.check_image(frame.image, f"frame {frame.index}")
        if self._anchor is None:
            return {}
        known, camera = self._anchor.locate(frame.image, frame.index, frame.timestamp)
        reason = str(camera.reason or "")
        return {name: CameraLocalization(known.get(name), reason, camera.total_ms) for name in self._anchor.names}

    def track(self, frame: Frame, located: Mapping[str, CameraLocalization]) -> dict[str, FrameResult]:
        """Find the objects in a frame that `locate` has seen."""
        return self._objects.track(frame, located)


# Where several objects hide each other in the pictures that they are known by.
# An object's texture must not be taken where another one is before it: not in the frame that it starts from,
# and not in any keyframe of the scan. All are drawn where they are there, and the nearest is what is seen.


@dataclass(frozen=True)
class Known:
    """An object, where it is, and the ``frame`` that it starts from."""

    setup: Setup
    registration: Registration
    frame: int

    @cached_property
    def _surface(self) -> DrawnSurface:
        return DrawnSurface.of(self.registration.model)

    def state_in(self, frame: int, keyframe: KeyframeImage | None) -> State | None:
        """The object in a frame, a keyframe of the map or not; None where nobody knows where it is."""
        registration = self.registration
        if frame == self.frame:
            return registration.state
        pose = next((view.pose for view in registration.views if view.frame == frame), None)
        is_in_map = self.setup.map_path is not None and registration.map_registration is not None
        if pose is None and is_in_map and keyframe is not None:
            assert registration.map_registration is not None
            pose = registration.map_registration.pose_in(keyframe.camera_from_world)
        return None if pose is None else State(registration.model.default, pose)

    def depth(self, state: State) -> NDArray[np.float32]:
        """Depth (h, w) of the object in a state, metres, infinite where it is not."""
        camera, drawn = self.setup.camera, self._surface.model
        return draw_view(view_of(drawn, camera, state), drawn.triangles, camera).depth


def seen_parts(objects: Sequence[Known]) -> list[dict[int, NDArray[np.bool_]]]:
    """By object and frame where (h, w) a picture shows the object, if another one hides some of it there."""
    return [_seen_part(known, [other for other in objects if other is not known]) for known in objects]


def _seen_part(known: Known, others: Sequence[Known]) -> dict[int, NDArray[np.bool_]]:
    keyframes, seen = known.setup.keyframes, {}
    for frame in {known.frame, *keyframes}:
        keyframe = keyframes.get(frame)
        state = known.state_in(frame, keyframe)
        there = [(other, other.state_in(frame, keyframe)) for other in others]
        before = [widened(other.depth(placed)) for other, placed in there if placed is not None]
        if state is None or not before:
            continue
        own = known.depth(state)
        covered = np.isfinite(own)
        shown = covered & (own <= np.minimum.reduce(before))
        if not np.array_equal(shown, covered):
            seen[frame] = shown
    return seen


# Several objects at their beginning, each with its model, its place, and the picture that it starts from.
# Those that are anchored are so in one map of the scene.


_Options = TypeVar("_Options", bound=ObjectOptions)


@dataclass(frozen=True)
class OtherObject:
    """One more object.

    Attributes
    ----------
    name : of its folder in the run folder. model : file.
    start : file of landmarks in the reference frame, or the registration.json of `morph register`.
    """

    name: str
    model: Path
    start: Path

    @property
    def is_registered(self) -> bool:
        """Whether it starts from a registration in a map."""
        return self.start.suffix == ".json"

    def options(self, options: _Options) -> _Options:
        """The first object's options made its own; what they wish of parameters is for the first only."""
        return replace(
            options,
            model=self.model,
            landmarks=None if self.is_registered else self.start,
            registration=self.start if self.is_registered else None,
            map_path=options.map_path if self.is_registered else None,
            initializer=InitializerFiles(),
            inner=(),
            per_sequence=(),
            random_walk=(),
            use_outline=False,
        )


def check_names(others: Sequence[OtherObject]) -> None:
    """Raise TrackingError unless the objects have different names that folders can have."""
    names = [other.name for other in others]
    for name in names:
        if names.count(name) > 1 or Path(name).name != name or name in ("", ".", "..", "plots"):
            raise TrackingError(
                f"'{name}' cannot be the name of another object's folder: give each a different, plain name"
            )


def check_one_map(setups: Sequence[Setup]) -> None:
    """Raise TrackingError if objects are anchored in different maps."""
    maps = {str(setup.map_path.resolve()): None for setup in setups if setup.map_path is not None}
    if len(maps) > 1:
        raise TrackingError(
            f"the objects are anchored in different maps, {' and '.join(maps)}: register them all in one"
        )


@dataclass(frozen=True)
class ObjectStart:
    """An object and the ``picture`` that it starts from, a frame of this number or a keyframe of the map.

    ``in_sequence`` : whether the frames to track begin with it.
    """

    setup: Setup
    registration: Registration
    picture: NDArray[np.uint8] | Image
    frame: int
    in_sequence: bool

    def new_run(self) -> RunResults:
        """Results of no frame so far."""
        constant = self.setup.tracker_options(self.registration).per_sequence
        return RunResults(self.registration.model, self.frame, per_sequence=constant)


def without_hidden(objects: Sequence[ObjectStart]) -> list[ObjectStart]:
    """The objects, known by nothing that another one hides in the pictures that they are known by."""
    seen = seen_parts([Known(part.setup, part.registration, part.frame) for part in objects])
    return [replace(part, setup=replace(part.setup, seen=own)) for part, own in zip(objects, seen, strict=True)]


def objects_chain(objects: Mapping[str, ObjectStart]) -> MultiObjectTracker:
    """All objects at their beginning, by name.

    Raises
    ------
    RegistrationError
        If two are registered in the same place, or one shows too few corners.
    """
    anchored = {name: part for name, part in objects.items() if part.setup.map_path is not None}
    registrations = {name: part.registration for name, part in anchored.items()}
    first = next(iter(anchored.values()), None)
    anchor = None if first is None else first.setup.new_anchor(registrations)
    trackers = {
        name: part.setup.new_tracker(
            part.registration, part.picture, part.in_sequence, part.setup.seen.get(part.frame), anchored=False
        )
        for name, part in objects.items()
    }
    return MultiObjectTracker(next(iter(objects.values())).setup.camera, trackers, anchor)


# `morph track --also`: several objects in one recording, each with a run folder of its own.
# Each is free, or anchored in the one map of the scene, in which the camera is found once a frame for all.


@dataclass(frozen=True)
class _Object:
    """What is needed of an object until its results are written."""

    options: TrackOptions
    start: ObjectStart
    run: RunResults

    @property
    def name(self) -> str:
        """Its run folder, by which messages call it too."""
        return str(self.options.output)


@one_thread_for_algebra
def track_objects(options: TrackOptions, others: Sequence[OtherObject]) -> dict[Path, dict[str, Any]]:
    """Track an object and others beside it; the summaries by run folder, that of the first one first.

    What is wished of parameters, inner structures and the outline holds for the first object only.

    Raises
    ------
    MorphError
        As `track` does; TrackingError if the objects have not different names, or are anchored in different
        maps; RegistrationError if two are registered in the same place.
    """
    _check(options, others)
    everything = [_for_first(options, others), *(_for_other(options, other) for other in others)]
    for part in everything:
        check_run_folder(part.output, part.overwrite)
    objects = _prepare(everything, [load_setup(part) for part in everything])
    source = open_frames(objects[0].options)
    chain = _new_chain(objects)
    warm_up(chain.process, objects[0].start.picture)
    chain, summaries = _new_chain(objects), {}
    try:
        _follow(chain, objects, source)
    finally:
        for part in objects:
            if len(part.run):
                folder, start = part.options.output, part.start
                summaries[folder] = write_results(start.setup, start.registration, source, part.options, part.run)
    return summaries


def _follow(chain: MultiObjectTracker, objects: Sequence[_Object], source: FrameSource) -> None:
    for frame in tqdm(source, total=len(source), desc="tracking", unit="frame"):
        results = chain.process(frame)
        for part in objects:
            part.run.add(frame.index, frame.timestamp, results[part.name])


def _check(options: TrackOptions, others: Sequence[OtherObject]) -> None:
    if options.landmarks is None and options.registration is None:
        raise TrackingError(
            "several objects start from landmarks or from registrations in a map: give the first one "
            "--landmarks or --registration"
        )
    if options.refine_reference or options.reregister_at:
        raise TrackingError("several objects are tracked from where they start: leave out --refine and --reregister-at")
    if options.reference_frame is not None and _all_registered(options, others):
        raise TrackingError("a registration in a map brings its own reference frame: leave out --reference-frame")
    check_names(others)


def _all_registered(options: TrackOptions, others: Sequence[OtherObject]) -> bool:
    return options.registration is not None and all(other.is_registered for other in others)


def _for_first(options: TrackOptions, others: Sequence[OtherObject]) -> TrackOptions:
    """The first object's options: a map may have been given for the others only."""
    needs_map = options.registration is not None or not any(other.is_registered for other in others)
    return options if needs_map else replace(options, map_path=None)


def _for_other(options: TrackOptions, other: OtherObject) -> TrackOptions:
    return replace(other.options(options), output=options.output / other.name)


def _prepare(everything: Sequence[TrackOptions], setups: Sequence[Setup]) -> list[_Object]:
    """The objects in their reference frames; the sequence begins with that of the map, if there is one."""
    check_one_map(setups)
    own = [with_reference(part, setup) for part, setup in zip(everything, setups, strict=True)]
    first = next((part.first for part in own if part.registration is not None), own[0].first)
    starts, options = [], [replace(part, first=first) for part in own]
    for part, setup in zip(options, setups, strict=True):
        begin = find_begin(setup, part)
        registration = setup.placed(begin.picture, begin.depth)
        starts.append(ObjectStart(setup, registration, begin.picture, begin.frame, begin.in_sequence))
    return [_Object(part, start, start.new_run()) for part, start in zip(options, without_hidden(starts), strict=True)]


def _new_chain(objects: Sequence[_Object]) -> MultiObjectTracker:
    return objects_chain({part.name: part.start for part in objects})
