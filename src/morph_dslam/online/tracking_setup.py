"""What tracking starts from, recorded or live: model, camera, the object's place, the map of the scene."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import TrackingError
from morph_dslam.io.calibration import load_camera
from morph_dslam.io.landmarks import Landmarks, load_landmarks
from morph_dslam.model import ReducedModel, load_model
from morph_dslam.model.inner_structure import CarriedStructure, InnerStructure, load_inner_structure
from morph_dslam.online.aids.start import Aid, AidFiles, place_by_aid
from morph_dslam.online.anchored.anchor import Anchor
from morph_dslam.online.attempt import Picture
from morph_dslam.online.chain import Chain
from morph_dslam.online.estimation.discrepancy import DiscrepancyOptions
from morph_dslam.online.estimation.estimator import Estimator
from morph_dslam.online.measuring.outline import rim
from morph_dslam.online.pipeline import Tracker
from morph_dslam.online.reference.further_views import FurtherViews, choose_further
from morph_dslam.online.slam.map_file import load_map
from morph_dslam.online.start.placement import Placement, load_placement, place_by_landmarks
from morph_dslam.online.start.registration import RegistrationOptions
from morph_dslam.online.start.scan_pictures import ScanPicture, map_of, pictures_of, views_of
from morph_dslam.online.tracker_options import StartFrom, TrackerOptions
from morph_dslam.sources import Frame
from morph_dslam.units import to_si

#: How an object's pose is found: by the map and its points, by the map alone, by its points alone.
PoseFrom = Literal["map", "fixed", "free"]


@dataclass(frozen=True)
class ObjectOptions:
    """The object, its place and the camera.

    Attributes
    ----------
    model, camera : files.
    landmarks : file of landmarks in the reference frame; or placement : registration.json of
        `morph register`; or aids : another thing to place the object by there.
    map_path : map.h5 that the object was registered in; by default the one that the registration names, or
        the one beside it, if there is one.
    pose : "map": the object is anchored and the camera is found in the map, "fixed": and the map's pose is
        taken as exact, "free": it may be anywhere.
    use_outline, use_depth : let the object's outline, and the frames' depth images, count beside its texture.
    use_discrepancy : look in every frame for what the object's shape has beyond the model's.
    inner : files of inner structures (`morph inner`), whose positions are written and drawn.
    per_sequence : names of the parameters that are one over the whole sequence, beside those that the
        placement leaves open.
    random_walk : names of parameters and the standard deviation of their change from frame to frame, in the
        parameter's own unit. start : see `TrackerOptions`.
    """

    model: Path
    camera: Path
    landmarks: Path | None = None
    placement: Path | None = None
    aids: AidFiles = field(default_factory=AidFiles)
    map_path: Path | None = None
    pose: PoseFrom = "map"
    use_outline: bool = False
    use_depth: bool = False
    use_discrepancy: bool = False
    inner: tuple[Path, ...] = ()
    per_sequence: tuple[str, ...] = ()
    random_walk: tuple[tuple[str, float], ...] = ()
    start: StartFrom = "previous"
    registration: RegistrationOptions = field(default_factory=RegistrationOptions)
    tracker: TrackerOptions = field(default_factory=TrackerOptions)


@dataclass(frozen=True)
class Setup:
    """The inputs, read and checked.

    Attributes
    ----------
    model : as it is in its file. placement : None as long as the frame that landmarks belong to is not there.
    map_path : of the map that the object is anchored in; None if it is free.
    keyframes : of that map, by frame, in which the object is; none where a frame has to be the reference.
    aid : that places the object in the reference frame; None if something else does.
    seen : (h, w) by frame, where it shows the object, if other objects hide some of it there.
    """

    options: ObjectOptions
    model: ReducedModel
    camera: PinholeCamera
    landmarks: Landmarks | None
    inner: tuple[InnerStructure, ...]
    placement: Placement | None
    map_path: Path | None
    keyframes: Mapping[int, ScanPicture]
    aid: Aid | None = None
    seen: Mapping[int, NDArray[np.bool_]] = field(default_factory=dict)

    @property
    def reference(self) -> Picture | None:
        """The keyframe that the object is placed in; None where a frame has to be it."""
        if self.placement is None or self.placement.frame is None:
            return None
        keyframe = self.keyframes.get(self.placement.frame)
        return None if keyframe is None else keyframe.picture

    @cached_property
    def further(self) -> FurtherViews | None:
        """Other keyframes that show more of the object, where it is known how they are off with the first."""
        placement = self.placement
        if placement is None or not placement.views or not self.options.tracker.further_views:
            return None
        views = views_of(placement, self.keyframes, self.seen)
        if len(views) < 2:
            return None
        estimator = Estimator(placement.model, self.camera)
        return choose_further(estimator, views[0], views[1:], self.tracker_options(placement))

    @property
    def reference_keyframes(self) -> list[int]:
        """Numbers of the map's keyframes that the object is compared with, the one it is placed in first."""
        if self.placement is None or self.placement.frame is None or self.reference is None:
            return []
        others = [] if self.further is None else [view.frame for view in self.further.views]
        return [self.placement.frame, *(frame for frame in others if frame is not None)]

    def placed(
        self, image: NDArray[np.uint8] | Picture, depth: NDArray[np.float32] | None = None
    ) -> Placement:
        """The placement; raises RegistrationError as `place_by_landmarks` and `Aid.place` do.

        Parameters
        ----------
        image : (h, w, 3) the reference frame. depth : (h, w) there, metres, where there is any.
        """
        if self.placement is not None:
            return self.placement
        if self.aid is not None:
            assert not isinstance(image, Picture)
            return place_by_aid(self.aid, self.model, self.camera, image)
        assert self.landmarks is not None
        registration, sensor = self.options.registration, self.options.tracker.depth
        return place_by_landmarks(self.model, self.camera, self.landmarks, registration, depth, sensor)

    def carried(self, model: ReducedModel) -> list[CarriedStructure]:
        """The inner structures in the model that is tracked with."""
        return [structure.carried_by(model) for structure in self.inner]

    def tracker_options(self, placement: Placement) -> TrackerOptions:
        """The options with what the placement leaves open."""
        options = self.options
        return replace(
            options.tracker,
            per_sequence=tuple(dict.fromkeys((*placement.per_sequence, *options.per_sequence))),
            use_outline=options.use_outline,
            use_depth=options.use_depth,
            discrepancy=(options.tracker.discrepancy or DiscrepancyOptions())
            if options.use_discrepancy
            else None,
            random_walk=tuple((name, _in_si(placement, name, step)) for name, step in options.random_walk),
            start=options.start,
            hold_pose=options.pose == "fixed",
        )

    def new_tracker(
        self,
        placement: Placement,
        reference: NDArray[np.uint8] | Picture,
        in_sequence: bool,
        seen: NDArray[np.bool_] | None = None,
    ) -> Tracker:
        """A tracker at its beginning; see `Tracker` for the arguments.

        An object in a map is known by further keyframes too.
        """
        by_map = self.reference is not None and reference is self.reference
        return Tracker(
            placement.model,
            self.camera,
            reference,
            placement.state,
            self.tracker_options(placement),
            in_sequence,
            placement.covariance,
            seen,
            placement.discrepancy,
            self.further if by_map else None,
        )

    def new_chain(
        self, placement: Placement, reference: NDArray[np.uint8] | Picture, in_sequence: bool
    ) -> Chain:
        """As `new_tracker`, with the camera in the map before it where the object is anchored."""
        tracker = self.new_tracker(placement, reference, in_sequence)
        return Chain(self.camera, tracker, self.new_anchor({self.model.name: placement}))

    def new_anchor(self, placements: Mapping[str, Placement]) -> Anchor | None:
        """The map with this object, and others by name, in it; None for a free object."""
        if self.map_path is None:
            return None
        objects = {name: (p.place, p.model) for name, p in placements.items() if p.place is not None}
        return Anchor(load_map(self.map_path, self.camera), self.camera, objects)

    def warm_up(self, placement: Placement, reference: NDArray[np.uint8] | Picture) -> None:
        """Compile the inner loops, so that the first frame takes no longer than the others."""
        warm_up(self.new_chain(placement, reference, True).process, reference)


def warm_up(process: Callable[[Frame], object], reference: NDArray[np.uint8] | Picture) -> None:
    """Compile the inner loops of what processes frames, by the reference view."""
    print("preparing: compiling the inner loops (half a minute the first time) ...", file=sys.stderr)
    image = reference
    if isinstance(image, Picture):
        image = np.asarray(cv2.cvtColor(image.grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    for number in range(2):
        process(Frame(number, float(number), image))


def _in_si(placement: Placement, name: str, value: float) -> float:
    """A value in a parameter's own unit; of a name that is none it stays as it is, to be refused later."""
    known = {parameter.name: parameter for parameter in placement.model.parameters}
    return to_si(value, known[name].unit, known[name].quantity) if name in known else value


def load_setup(options: ObjectOptions) -> Setup:
    """Read and check the inputs.

    Raises
    ------
    MorphError
        If one cannot be used (ModelFileError, CameraError, MapError, RegistrationError), or they do not fit
        together (TrackingError).
    """
    aid = options.aids.load()
    if sum(start is not None for start in (options.landmarks, options.placement, aid)) != 1:
        raise TrackingError(
            "say where the object is, in one way: by landmarks, a registration in a map, a board, a picture "
            "or a guess"
        )
    if options.placement is None and options.map_path is not None:
        raise TrackingError("a map needs the object's place in it: --place registration.json")
    if options.placement is None and options.pose == "fixed":
        raise TrackingError("a pose is held fixed by a map: give the object's place in it, --place")
    model, camera = load_model(options.model), load_camera(options.camera)
    if options.use_outline and not len(rim(model.triangles)):
        raise TrackingError(
            f"the surface of '{model.name}' is closed and has no rim: track it without the outline"
        )
    inner = tuple(load_inner_structure(path) for path in options.inner)
    for structure in inner:
        structure.carried_by(model)  # says so before the tracking if it is not for this model
    if options.placement is None:
        landmarks = None if options.landmarks is None else load_landmarks(options.landmarks)
        return Setup(options, model, camera, landmarks, inner, None, None, {}, aid)
    placement, path = load_placement(options.placement, model), map_of(options.placement, options.map_path)
    free = options.pose == "free"
    if path is None and not free:
        note = "no map was given or found beside the registration: the object is tracked as a free one"
        placement = replace(placement, flags=(*placement.flags, note))
    keyframes: dict[int, ScanPicture] = {}
    if path is not None and not options.use_outline:
        keyframes = pictures_of(path, camera, placement)
    # A free object is not where the map has it, but looks as in the map's pictures.
    return Setup(options, model, camera, None, inner, placement, None if free else path, keyframes)
