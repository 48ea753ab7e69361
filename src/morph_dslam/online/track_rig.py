"""`morph track --with`: one free object seen by several synchronised cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from morph_dslam.errors import CameraError, SourceError, TrackingError
from morph_dslam.io.stereo_calibration import load_rig
from morph_dslam.online.results import RunResults
from morph_dslam.online.rig import RigCamera
from morph_dslam.online.rig_tracking import RigTracker
from morph_dslam.online.run_writing import check_run_folder
from morph_dslam.online.track import TrackOptions, find_begin, open_frames, write_results
from morph_dslam.online.tracking_setup import load_setup
from morph_dslam.sources import Frame, FrameSource, open_source


def track_rig(options: TrackOptions, others: Sequence[Path]) -> dict[str, Any]:
    """Track an object through the recordings of several cameras and write one run folder.

    Parameters
    ----------
    options : ``frames``, ``landmarks`` and the run folder are of the first camera; ``camera`` is a camchain.
    others : recordings of the other cameras, in the order of the camchain, with the same frame numbers.

    Returns
    -------
    The content of ``summary.json``.

    Raises
    ------
    MorphError
        As `track` does; CameraError if the camchain has not one camera for each recording; TrackingError if
        the object is not a free one, or depth is to be used.
    """
    if options.placement is not None or options.refine_reference or options.use_depth:
        raise TrackingError("several cameras track a free object: leave out --place, --refine and --depth")
    # Each camera keeps its one reference view; see `RigTracker`.
    options = replace(options, tracker=replace(options.tracker, new_views=False))
    cameras = _cameras(options.camera, 1 + len(others))
    check_run_folder(options.output, options.overwrite)
    setup = load_setup(options)
    sources = [open_frames(options), *(open_source(path, options.first, options.last) for path in others)]
    begin = find_begin(setup, options)
    references = [begin.picture, *(_frame(path, begin.frame) for path in others)]
    placement = setup.placed(begin.picture)
    setup.warm_up(placement, begin.picture)
    tracked_with = setup.tracker_options(placement)
    tracker = RigTracker(
        placement.model, cameras, references, placement.state, tracked_with, begin.in_sequence
    )
    run = RunResults(placement.model, begin.frame, per_sequence=tracked_with.per_sequence)
    try:
        for frames in tqdm(_together(sources), total=len(sources[0]), desc="tracking", unit="frame"):
            for number, (frame, part) in enumerate(zip(frames, cameras, strict=True)):
                part.camera.check_image(frame.image, f"frame {frame.index} of camera {number}")
            result = tracker.process_frame([frame.image for frame in frames])
            run.add(frames[0].index, frames[0].timestamp, result)
    finally:
        summary = write_results(setup, placement, sources[0], options, run) if len(run) else {}
    return summary


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


def _frame(path: Path, number: int):
    for frame in open_source(path, number, number):
        return frame.image
    raise SourceError(f"{path} holds no frame {number} to take as the reference")


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
