"""`morph track --with`: one object, free or anchored, seen by several synchronised cameras.

An anchored object's map is the first camera's: it is found there in every frame, and the others by the rig.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from morph_dslam.camera import Camera
from morph_dslam.errors import CameraError, RegistrationError, SourceError, TrackingError
from morph_dslam.io.camera_files import load_rig
from morph_dslam.notices import Remark
from morph_dslam.slam.frame_images import FrameImages
from morph_dslam.sources import Frame, FrameSource, open_source
from morph_dslam.threads import one_thread_for_algebra
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.hypothesis import Image
from morph_dslam.tracking.multi_camera import RigCamera, RigTracker, keyframe_views_of_rig
from morph_dslam.tracking.run_folder import RunResults, check_run_folder
from morph_dslam.tracking.setup import Setup, load_setup
from morph_dslam.tracking.track import TrackOptions, find_begin, open_frames, with_reference, write_results
from morph_dslam.tracking.tracker import Tracker

#: Correlation of two contrast-normalized images that are the same but for the compression.
SAME_IMAGE = 0.8


@one_thread_for_algebra
def track_rig(options: TrackOptions, others: Sequence[Path]) -> dict[str, Any]:
    """Track an object through the recordings of several cameras and write one run folder.

    Parameters
    ----------
    options : ``frames``, ``landmarks``, the map and the run folder are of the first camera; ``camera`` is a
        camchain. ``reference_frame`` is one in which an anchored object is undeformed, if the scan is not in
        these recordings.
    others : recordings of the other cameras, in the order of the camchain, with the same frame numbers.

    Returns
    -------
    The content of ``summary.json``.

    Raises
    ------
    MorphError
        As `track` does; CameraError if the camchain has not one camera for each recording; TrackingError if
        depth is to be used, or the map is not of this recording, so that the other cameras' reference
        frames are not known.
    """
    _check(options)
    # No camera makes a reference view; see `RigTracker`.
    options = replace(options, tracker=replace(options.tracker, new_views=False))
    cameras = _cameras(options.camera, 1 + len(others))
    check_run_folder(options.output, options.overwrite)
    setup, options = _with_reference(load_setup(options), options)
    sources = [open_frames(options), *(open_source(path, options.first, options.last) for path in others)]
    begin = find_begin(setup, options)
    further = None
    if setup.reference is not None:
        _check_scan(setup.camera, setup.reference, options.frames, begin.frame)
        further = keyframe_views_of_rig(setup, cameras, others)
    references = [begin.picture, *(_frame(path, begin.frame).image for path in others)]
    registration = setup.placed(begin.picture)
    setup.warm_up(registration, begin.picture)
    tracked_with = setup.tracker_options(registration)
    tracker = RigTracker(
        registration.model,
        cameras,
        references,
        registration.state,
        tracked_with,
        begin.in_sequence,
        registration.covariance,
        further,
    )
    first = setup.new_tracker(registration, begin.picture, begin.in_sequence)
    run = RunResults(registration.model, begin.frame, per_sequence=tracked_with.per_sequence)
    try:
        _follow(sources, first, tracker, run)
    finally:
        registration = replace(
            registration, warnings=(*registration.warnings, *map(Remark, _unequal(sources, len(run))))
        )
        summary = write_results(setup, registration, sources[0], options, run) if len(run) else {}
    return summary


def _follow(sources: Sequence[FrameSource], first: Tracker, tracker: RigTracker, run: RunResults) -> None:
    """Track all frames into ``run``; ``first`` finds the first camera in the map, where there is one."""
    for frames in tqdm(_together(sources), total=len(sources[0]), desc="tracking", unit="frame"):
        for number, (frame, part) in enumerate(zip(frames, tracker.cameras, strict=True)):
            part.camera.check_image(frame.image, f"frame {frame.index} of camera {number}")
        located = first.locate(frames[0])
        result = tracker.track([frame.image for frame in frames], located)
        run.add(frames[0].index, frames[0].timestamp, result)


def _check(options: TrackOptions) -> None:
    if options.refine_reference or options.reregister_at or options.use_depth or options.use_discrepancy:
        raise TrackingError(
            "several cameras track an object from where it starts, by its model, without depth: leave out "
            "--refine, --reregister-at, --depth and --discrepancy"
        )


def _with_reference(setup: Setup, options: TrackOptions) -> tuple[Setup, TrackOptions]:
    """As `with_reference`; a frame that is wished instead of the map's keyframe is where the map has it."""
    number, registration = options.reference_frame, setup.registration
    if number is None or registration is None:
        return setup, with_reference(options, setup)
    if setup.map_path is None or setup.reference is None or registration.map_registration is None:
        raise TrackingError(
            "without its map a registration brings its own reference frame: leave out --reference-frame"
        )
    frame = _frame(options.frames, number)
    located = setup.new_tracker(registration, setup.reference, False).locate(frame)
    if located.pose_prior is None:
        raise RegistrationError(
            f"the camera is not found in the map in frame {number} of {options.frames} ({located.why_lost}): "
            "take another --reference-frame"
        )
    d = len(registration.model.parameters)
    covariance = np.zeros((d + 6, d + 6))
    covariance[d:, d:] = located.pose_prior.covariance
    state = State(registration.model.default, located.pose_prior.pose)
    placed = replace(registration, frame=number, state=state, covariance=covariance)
    setup = replace(setup, registration=placed, keyframes={})
    return setup, with_reference(options, setup)


def _check_scan(camera: Camera, keyframe: Image, frames: Path, number: int) -> None:
    """Raise TrackingError unless a frame is the map's keyframe of the same number.

    The other cameras' reference frames are those of that number, in which the object is undeformed.
    """
    try:
        view = FrameImages(camera).prepare(_frame(frames, number).image, number, 0.0)
        is_keyframe = np.corrcoef(view.normalized.ravel(), keyframe.normalized.ravel())[0, 1] > SAME_IMAGE
    except SourceError:
        is_keyframe = False
    if not is_keyframe:
        raise TrackingError(
            f"{frames} does not show the map's keyframe {number}, so it is not known when the other cameras "
            "saw the undeformed object: name a frame of these recordings in which it is undeformed, "
            "--reference-frame"
        )


def _cameras(path: Path, count: int) -> list[RigCamera]:
    """The cameras of the camchain that one of its cameras was named of, ``camchain.yaml#cam0``."""
    name, _, chosen = str(path).partition("#")
    if chosen != "cam0":
        raise CameraError(
            f"{path} does not say where several cameras are: give the first camera of a Kalibr camchain, "
            "camchain.yaml#cam0"
        )
    cameras = [RigCamera(camera, pose) for camera, pose in load_rig(Path(name))]
    if len(cameras) != count:
        raise CameraError(f"{name} has {len(cameras)} cameras, but there are {count} recordings")
    return cameras


def _frame(path: Path, number: int) -> Frame:
    for frame in open_source(path, number, number):
        return frame
    raise SourceError(f"{path} holds no frame {number} to take as the reference")


def _unequal(sources: Sequence[FrameSource], tracked: int) -> list[str]:
    """What a reader must know if not all recordings are as long."""
    counts = [len(source) for source in sources]
    if len(set(counts)) == 1:
        return []
    return [
        f"the cameras recorded {', '.join(map(str, counts))} frames: {tracked} were tracked, to the end of "
        "the shortest recording"
    ]


def _together(sources: Sequence[FrameSource]) -> Iterator[tuple[Frame, ...]]:
    """The frames of one instant after the other; ends with the shortest recording."""
    for frames in zip(*sources, strict=False):
        if len({frame.index for frame in frames}) > 1:
            numbers = ", ".join(str(frame.index) for frame in frames)
            raise SourceError(
                f"the cameras' recordings do not go together: frames {numbers} come at the same time; number "
                "what was taken at one instant alike"
            )
        yield frames
