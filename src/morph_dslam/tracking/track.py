"""`morph track`: register once, follow through all frames, write the run folder."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from morph_dslam.errors import SourceError, TrackingError
from morph_dslam.notices import Remark
from morph_dslam.registration.landmarks import bind_landmarks
from morph_dslam.registration.registration import Registration
from morph_dslam.sources import Frame, FrameSource, open_source
from morph_dslam.sources.frames import has_registered_depth
from morph_dslam.threads import one_thread_for_algebra
from morph_dslam.tracking.discrepancy import DiscrepancyFit, Reference, refine_discrepancy
from morph_dslam.tracking.drawing import AugmentedView, DrawOptions, write_video
from morph_dslam.tracking.hypothesis import Image
from morph_dslam.tracking.refinement import LANDMARK_PX, Keyframe, choose_keyframes, refine_reference
from morph_dslam.tracking.run_folder import RunResults, check_run_folder
from morph_dslam.tracking.run_writing import RunInputs, write_run
from morph_dslam.tracking.setup import ObjectOptions, Reregistration, Setup, load_setup

#: Options that name input files.
_INPUTS = ("frames", "landmarks", "registration")


@dataclass(frozen=True, kw_only=True)
class TrackOptions(ObjectOptions):
    """What to track, with what (see `ObjectOptions`), and where the results go.

    Attributes
    ----------
    frames : video file or folder of images. output : the run folder.
    reregister_at : frames in which to place the object anew, with landmarks there, or None for the initializer.
    first, last : frame numbers to track, both included; all by default.
    reference_frame : the frame that the landmarks belong to; the first one tracked by default. With
        ``registration`` it is the map's last keyframe.
    refine_reference : after tracking, refine the reference state over the whole sequence and track once more.
    overlay : draw the augmented video, drawing : with what. overwrite : replace a run that is there already.
    """

    frames: Path
    output: Path
    reregister_at: tuple[tuple[int, Path | None], ...] = ()
    first: int | None = None
    last: int | None = None
    reference_frame: int | None = None
    refine_reference: bool = False
    overlay: bool = True
    drawing: DrawOptions = field(default_factory=DrawOptions)
    overwrite: bool = False


@one_thread_for_algebra
def track(options: TrackOptions) -> dict[str, Any]:
    """Track an object through a sequence and write the run folder.

    An interrupt, or a video that ends early, keeps what was done: the run folder is completed with the frames
    so far and the exception goes on.

    Returns
    -------
    The content of ``summary.json``.

    Raises
    ------
    MorphError
        If an input cannot be used (ModelFileError, CameraError, SourceError, RegistrationError, MapError) or
        the run folder holds a run already (TrackingError).
    """
    _check(options)
    setup = load_setup(options)
    options = with_reference(options, setup)
    if options.overlay:
        AugmentedView(setup.model, setup.camera, options.drawing)  # says so now if it cannot be drawn
    source = open_frames(options)
    begin = find_begin(setup, options)
    registration = setup.placed(begin.picture, begin.depth)
    again = Reregistration(setup, registration, options.reregister_at, begin.frame)
    setup.warm_up(registration, begin.picture)
    run = RunResults(registration.model, begin.frame, per_sequence=setup.tracker_options(registration).per_sequence)
    try:
        keyframes = _follow(source, setup, registration, begin, options.refine_reference, run, again)
        if options.refine_reference and setup.landmarks is not None:
            registration = _refined(setup, registration, begin, keyframes, options)
            run = replace(run, refined=True, frames=[], timestamps=[], results=[])
            _follow(source, setup, registration, begin, False, run)
    finally:
        registration = replace(registration, warnings=(*registration.warnings, *map(Remark, again.notes)))
        summary = write_results(setup, registration, source, options, run) if len(run) else {}
    return summary


def with_reference(options: TrackOptions, setup: Setup) -> TrackOptions:
    """The options with the reference frame that a registration brings; tracking begins there by default."""
    if setup.registration is None:
        return options
    frame = setup.registration.frame
    return replace(options, reference_frame=frame, first=frame if options.first is None else options.first)


def open_frames(options: TrackOptions) -> FrameSource:
    """The frames to track; raises SourceError, or TrackingError if there is no depth that is to be used."""
    source = open_source(options.frames, options.first, options.last)
    if options.use_depth and not has_registered_depth(source):
        raise TrackingError(
            f"{options.frames} has no depth images that belong to its pixels, as TUM RGB-D recordings have: "
            "track it without --depth"
        )
    return source


@dataclass(frozen=True)
class Begin:
    """The reference view: its image, frame, whether the sequence begins with it, and its depth, if used."""

    picture: np.ndarray | Image
    frame: int
    in_sequence: bool
    depth: np.ndarray | None = None


def find_begin(setup: Setup, options: TrackOptions) -> Begin:
    """The reference view; raises SourceError or CameraError if it is not there, or of another size."""
    if setup.reference is not None:
        assert setup.registration is not None
        assert setup.registration.frame is not None
        # The frames may be those of another recording: the object is looked for as after a loss.
        return Begin(setup.reference, setup.registration.frame, False)
    reference = _reference_frame(options)
    setup.camera.check_image(reference.image, f"frame {reference.index} of {options.frames}")
    # A sequence that does not begin with the reference frame is entered as if the object had been lost.
    depth = reference.depth if options.use_depth else None
    return Begin(reference.image, reference.index, options.reference_frame in (None, options.first), depth)


def _reference_frame(options: TrackOptions) -> Frame:
    number = options.reference_frame if options.reference_frame is not None else options.first
    for frame in open_source(options.frames, number, number):
        return frame
    raise SourceError(f"{options.frames} holds no frame {number} to take as the reference")


def _follow(
    source: FrameSource,
    setup: Setup,
    registration: Registration,
    begin: Begin,
    refines: bool,
    run: RunResults,
    again: Reregistration | None = None,
) -> list[Keyframe]:
    """Track all frames into ``run``; returns where the points were seen if the reference is to be refined."""
    chain = setup.new_tracker(registration, begin.picture, begin.in_sequence)
    keyframes = []
    for frame in tqdm(source, total=len(source), desc="tracking", unit="frame"):
        chain = chain if again is None else again.chain(frame, chain)
        result = chain.track(frame)
        if again is not None:
            again.take_in(result)
        run.add(frame.index, frame.timestamp, result)
        if refines and result.estimate is not None and chain.last_seen is not None:
            keyframes.append(chain.last_seen)
    return keyframes


def _refined(
    setup: Setup, registration: Registration, begin: Begin, keyframes: list[Keyframe], options: TrackOptions
) -> Registration:
    """The registration refined over the sequence; how sure it is then is not known."""
    print("refining the reference state over the sequence ...", file=sys.stderr)
    tracker, landmarks = setup.new_tracker(registration, begin.picture, True), setup.landmarks
    assert landmarks is not None
    # How well the landmarks fit tells how carefully they were set, where they are enough to tell.
    sigma = registration.facts["sigma_px"]
    landmark_px = max(sigma, 0.1) if np.isfinite(sigma) else LANDMARK_PX
    bound = bind_landmarks(registration.model, landmarks.points)
    seen = setup.camera.undistort_pixels(landmarks.pixels)
    chosen = choose_keyframes(keyframes)
    pixels, outline, sought = tracker.reference.pixels, tracker.reference.outline, tracker.options.discrepancy
    if sought is None:
        start = registration.state
        state = refine_reference(tracker.estimator, bound, seen, pixels, start, chosen, outline, landmark_px)
        return replace(registration, state=state, covariance=None)
    # What the state is wrong by counts with the discrepancy: both at once would be the same twice.
    known = Reference(registration.state, pixels, bound, seen, landmark_px)
    fit = DiscrepancyFit(registration.model, setup.camera, sought)
    found = refine_discrepancy(fit, tracker.estimator, known, chosen, outline)
    return replace(registration, discrepancy=found, covariance=None)


def _check(options: TrackOptions) -> None:
    if options.reregister_at and options.refine_reference:
        raise TrackingError(
            "a reference refined over the whole sequence cannot be changed in mid-sequence: leave out "
            "--refine or --reregister-at"
        )
    if options.registration is not None and (options.refine_reference or options.reference_frame is not None):
        raise TrackingError(
            "a registration in a map brings its own reference frame, refined already: leave out --refine and "
            "--reference-frame"
        )
    if options.refine_reference and any(path is not None for path in vars(options.initializer).values()):
        raise TrackingError(
            "the reference is refined with the landmarks in it: start from landmarks, or leave out --refine"
        )
    check_run_folder(options.output, options.overwrite)


def write_results(
    setup: Setup, registration: Registration, source: FrameSource, options: TrackOptions, run: RunResults
) -> dict[str, Any]:
    """Write all files of the run folder; the video last, because it takes longest."""
    carried = setup.carried(run.model)
    named = {name: str(getattr(options, name)) for name in _INPUTS if getattr(options, name)}
    given = {name: str(path) for name, path in vars(options.initializer).items() if path is not None}
    named |= given | ({} if setup.map_path is None else {"map": str(setup.map_path)})
    tracker = setup.tracker_options(registration)
    extra = {
        "reference_keyframes": setup.reference_keyframes,
        "reference_refined_over_the_sequence": run.refined,
        "outline_used": options.use_outline,
        "depth_used": options.use_depth,
        "discrepancy_used": options.use_discrepancy,
        "pose": options.pose if setup.map_path is not None else "free",
        "settings": {"click_px": options.click_px, "tracker": asdict(tracker)},
    }
    inputs = RunInputs(options.model, options.camera, named)
    summary = write_run(options.output, run, inputs, registration, carried, tracker, extra)
    if options.overlay:
        view = AugmentedView(run.model, setup.camera, options.drawing, carried)
        write_video(options.output / "augmented.mp4", source, setup.camera, run, view)
    return summary
