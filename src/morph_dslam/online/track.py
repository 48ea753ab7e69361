"""`morph track`: register once, follow through all frames, write the run folder."""

from __future__ import annotations

import platform
import shutil
import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
from tqdm import tqdm

from morph_dslam import __version__
from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import SourceError, TrackingError
from morph_dslam.io.calibration import load_camera
from morph_dslam.io.landmarks import Landmarks, load_landmarks
from morph_dslam.model import load_model, save_model
from morph_dslam.model.inner_structure import InnerStructure, load_inner_structure
from morph_dslam.online.augmentation import write_video
from morph_dslam.online.inner_positions import write_inner_positions
from morph_dslam.online.outline import rim
from morph_dslam.online.pipeline import Tracker, TrackerOptions
from morph_dslam.online.placement import Placement, load_placement, place_by_landmarks
from morph_dslam.online.plots import write_plots
from morph_dslam.online.reference_refinement import (
    Keyframe,
    RefinementOptions,
    choose_keyframes,
    refine_reference,
)
from morph_dslam.online.registration import RegistrationOptions, bind_landmarks
from morph_dslam.online.results import RunResults, write_csv, write_hdf5, write_summary
from morph_dslam.sources import Frame, FrameSource, open_source

#: Options that name input files.
_INPUTS = ("frames", "model", "camera", "landmarks", "placement")


@dataclass(frozen=True)
class TrackOptions:
    """What to track, with what, and where the results go.

    Attributes
    ----------
    frames : video file or folder of images. model, camera : files.
    landmarks : file of landmarks in the reference frame; or placement : registration.json of
        `morph register`, whose last keyframe is the reference frame.
    output : the run folder. first, last : frame numbers to track, both included; all by default.
    reference_frame : the frame that the landmarks belong to; the first one tracked by default.
    refine_reference : after tracking, refine the reference state over the whole sequence and track once more.
    use_outline : let the object's outline count beside its texture.
    inner : files of inner structures (`morph inner`), whose positions are written and drawn.
    per_sequence : names of the parameters that are one over the whole sequence, beside those that the
        placement leaves open.
    overlay : draw the augmented video. overwrite : replace a run that is there already.
    """

    frames: Path
    model: Path
    camera: Path
    output: Path
    landmarks: Path | None = None
    placement: Path | None = None
    first: int | None = None
    last: int | None = None
    reference_frame: int | None = None
    refine_reference: bool = False
    use_outline: bool = False
    inner: tuple[Path, ...] = ()
    per_sequence: tuple[str, ...] = ()
    overlay: bool = True
    overwrite: bool = False
    registration: RegistrationOptions = field(default_factory=RegistrationOptions)
    refinement: RefinementOptions = field(default_factory=RefinementOptions)
    tracker: TrackerOptions = field(default_factory=TrackerOptions)


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
        If an input cannot be used (ModelFileError, CameraError, SourceError, RegistrationError) or the run
        folder holds a run already (TrackingError).
    """
    _check_output(options)
    model, camera = load_model(options.model), load_camera(options.camera)
    landmarks = None if options.landmarks is None else load_landmarks(options.landmarks)
    if options.use_outline and not len(rim(model.triangles)):
        raise TrackingError(
            f"the surface of '{model.name}' is closed and has no rim: track it without the outline"
        )
    if options.placement is not None:
        placement = load_placement(options.placement, model)
        first = placement.frame if options.first is None else options.first
        options = replace(options, reference_frame=placement.frame, first=first)
    inner = [load_inner_structure(path) for path in options.inner]
    for structure in inner:
        structure.carried_by(model)  # says so before the tracking if it is not for this model
    source = open_source(options.frames, options.first, options.last)
    reference = _reference_frame(options)
    camera.check_image(reference.image, f"frame {reference.index} of {options.frames}")
    if landmarks is not None:
        placement = place_by_landmarks(model, camera, landmarks, options.registration)
    constant = tuple(dict.fromkeys((*placement.per_sequence, *options.per_sequence)))
    options = replace(options, tracker=replace(options.tracker, per_sequence=constant))
    _warm_up(camera, reference, placement, options)
    run = RunResults(placement.model, reference.index, per_sequence=constant)
    try:
        keyframes = _follow(source, camera, reference, placement, options, run)
        if options.refine_reference and landmarks is not None:
            refined = _refined(camera, landmarks, placement, keyframes, reference, options)
            again = RunResults(placement.model, reference.index, True, constant)
            _follow(source, camera, reference, refined, options, again)
            run = again
    finally:
        summary = _write_run(options, source, camera, run, placement, inner) if len(run) else {}
    return summary


def _follow(
    source: FrameSource,
    camera: PinholeCamera,
    reference: Frame,
    placement: Placement,
    options: TrackOptions,
    run: RunResults,
) -> list[Keyframe]:
    """Track all frames into ``run``; returns where the points were seen if the reference is to be refined."""
    tracker = _new_tracker(camera, reference, placement, options)
    keyframes = []
    for frame in tqdm(source, total=len(source), desc="tracking", unit="frame"):
        camera.check_image(frame.image, f"frame {frame.index} of {options.frames}")
        result = tracker.process_frame(frame.image)
        run.add(frame.index, frame.timestamp, result)
        if options.refine_reference and result.estimate is not None and tracker.last_seen is not None:
            keyframes.append(tracker.last_seen)
    return keyframes


def _refined(
    camera: PinholeCamera,
    landmarks: Landmarks,
    placement: Placement,
    keyframes: list[Keyframe],
    reference: Frame,
    options: TrackOptions,
) -> Placement:
    """The placement refined over the sequence; how sure it is then is not known."""
    print("refining the reference state over the sequence ...", file=sys.stderr)
    tracker = _new_tracker(camera, reference, placement, options)
    # How well the landmarks fit tells how carefully they were set, where they are enough to tell.
    sigma = placement.facts["sigma_px"]
    stated = options.refinement.landmark_px
    trust = replace(options.refinement, landmark_px=max(sigma, 0.1) if np.isfinite(sigma) else stated)
    state = refine_reference(
        tracker.estimator,
        bind_landmarks(placement.model, landmarks.points, options.registration),
        camera.undistort_pixels(landmarks.pixels),
        tracker.reference.pixels,
        placement.state,
        choose_keyframes(keyframes, options.refinement.n_keyframes),
        trust,
        tracker.reference.outline,
    )
    return replace(placement, state=state, covariance=None)


def _check_output(options: TrackOptions) -> None:
    if (options.landmarks is None) == (options.placement is None):
        raise TrackingError("say where the object is: either landmarks, or a registration in a map")
    if options.placement is not None and (options.refine_reference or options.reference_frame is not None):
        raise TrackingError(
            "a registration in a map brings its own reference frame, refined already: leave out --refine and "
            "--reference-frame"
        )
    if (options.output / "result.h5").exists() and not options.overwrite:
        raise TrackingError(
            f"{options.output} holds a run already: choose another folder, or allow it to be overwritten"
        )
    try:
        options.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrackingError(f"cannot make the run folder {options.output}: {error.strerror}") from error


def _reference_frame(options: TrackOptions) -> Frame:
    number = options.reference_frame if options.reference_frame is not None else options.first
    for frame in open_source(options.frames, number, number):
        return frame
    raise SourceError(f"{options.frames} holds no frame {number} to take as the reference")


def _new_tracker(
    camera: PinholeCamera, reference: Frame, placement: Placement, options: TrackOptions
) -> Tracker:
    # A sequence that does not begin with the reference frame is entered as if the object had been lost.
    begins = options.reference_frame in (None, options.first)
    settings = replace(options.tracker, use_outline=options.use_outline)
    return Tracker(
        placement.model,
        camera,
        reference.image,
        placement.state,
        settings,
        in_sequence=begins,
        reference_covariance=placement.covariance,
    )


def _warm_up(camera: PinholeCamera, reference: Frame, placement: Placement, options: TrackOptions) -> None:
    """Compile the inner loops, so that the first frame takes no longer than the others."""
    print("preparing: compiling the inner loops (half a minute the first time) ...", file=sys.stderr)
    tracker = _new_tracker(camera, reference, placement, options)
    tracker.process_frame(reference.image)


def _write_run(
    options: TrackOptions,
    source: FrameSource,
    camera: PinholeCamera,
    run: RunResults,
    placement: Placement,
    inner: list[InnerStructure],
) -> dict[str, Any]:
    """Write all files of the run folder; the video last, because it takes longest."""
    folder, carried = options.output, [structure.carried_by(run.model) for structure in inner]
    write_hdf5(folder / "result.h5", run)
    write_inner_positions(folder / "result.h5", run, carried)
    write_csv(folder / "frames.csv", run)
    if placement.per_sequence:  # the model has the angle that the placement leaves open
        save_model(folder / "model.morph", placement.model)
    else:
        _copy(options.model, folder / "model.morph")
    _copy(options.camera, folder / "camera.yaml")
    extra = {
        "registration": placement.facts,
        "reference_refined_over_the_sequence": run.refined,
        "outline_used": options.use_outline,
        "flags": list(placement.flags),
        "start_of_each_frame": "previous state; the first guess of image motion assumes constant velocity",
        "temporal_prior": _temporal_prior(options.tracker.per_sequence),
        "inputs": {name: str(getattr(options, name)) for name in _INPUTS if getattr(options, name)},
        "settings": {
            "registration": asdict(options.registration),
            "refinement": asdict(options.refinement),
            "tracker": asdict(options.tracker),
        },
        "versions": _versions(),
    }
    summary = write_summary(folder / "summary.json", run, extra)
    write_plots(folder / "plots", run)
    if options.overlay:
        write_video(folder / "augmented.mp4", source, camera, run, carried)
    return summary


def _temporal_prior(per_sequence: tuple[str, ...]) -> str:
    if not per_sequence:
        return "none"
    return f"one over the sequence, from all frames so far: {', '.join(per_sequence)}; none on the others"


def _copy(source: Path, target: Path) -> None:
    if source.resolve() != target.resolve():
        shutil.copyfile(source, target)


def _versions() -> dict[str, Any]:
    return {
        "morph-dslam": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "numba": numba.__version__,
        "opencv_threads": cv2.getNumThreads(),
    }
