"""`morph track --also`: several free objects in one recording, each with a run folder of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from morph_dslam.errors import TrackingError
from morph_dslam.online.aids.start import AidFiles
from morph_dslam.online.placement import Placement
from morph_dslam.online.results import RunResults
from morph_dslam.online.run_writing import check_run_folder
from morph_dslam.online.several_objects import ObjectTracker
from morph_dslam.online.track import Begin, TrackOptions, find_begin, open_frames, write_results
from morph_dslam.online.tracking_setup import Setup, load_setup


@dataclass(frozen=True)
class OtherObject:
    """One more object: the name of its folder in the run folder, its model and its landmarks."""

    name: str
    model: Path
    landmarks: Path


@dataclass(frozen=True)
class _Object:
    """What is needed of an object until its results are written."""

    options: TrackOptions
    setup: Setup
    placement: Placement
    run: RunResults


def track_objects(options: TrackOptions, others: Sequence[OtherObject]) -> dict[Path, dict[str, Any]]:
    """Track an object and others beside it; the summaries by run folder, that of the first one first.

    What is wished of parameters, inner structures and the outline holds for the first object only.

    Raises
    ------
    MorphError
        As `track` does; TrackingError if the objects are not free ones with different names.
    """
    _check(options, others)
    everything = [options, *(_for_other(options, other) for other in others)]
    for part in everything:
        check_run_folder(part.output, part.overwrite)
    setups = [load_setup(part) for part in everything]
    source, begin = open_frames(options), find_begin(setups[0], options)
    objects = [_prepare(part, setup, begin) for part, setup in zip(everything, setups, strict=True)]
    trackers = {
        str(part.options.output): part.setup.new_chain(
            part.placement, begin.picture, begin.in_sequence
        ).tracker
        for part in objects
    }
    tracker, summaries = ObjectTracker(trackers), {}
    try:
        for frame in tqdm(source, total=len(source), desc="tracking", unit="frame"):
            setups[0].camera.check_image(frame.image, f"frame {frame.index} of {options.frames}")
            depth = frame.depth if options.use_depth else None
            results = tracker.process_frame(frame.image, depth)
            for part in objects:
                part.run.add(frame.index, frame.timestamp, results[str(part.options.output)])
    finally:
        for part in objects:
            if len(part.run):
                folder = part.options.output
                summaries[folder] = write_results(part.setup, part.placement, source, part.options, part.run)
    return summaries


def _check(options: TrackOptions, others: Sequence[OtherObject]) -> None:
    if options.landmarks is None or options.refine_reference:
        raise TrackingError(
            "several objects are tracked as free ones, each from landmarks: leave out --place and --refine"
        )
    names = [other.name for other in others]
    for name in names:
        if names.count(name) > 1 or Path(name).name != name or name in ("", ".", "..", "plots"):
            raise TrackingError(
                f"'{name}' cannot be the name of another object's folder: give each a different, plain name"
            )


def _for_other(options: TrackOptions, other: OtherObject) -> TrackOptions:
    return replace(
        options,
        model=other.model,
        landmarks=other.landmarks,
        aids=AidFiles(),
        output=options.output / other.name,
        inner=(),
        per_sequence=(),
        random_walk=(),
        use_outline=False,
    )


def _prepare(options: TrackOptions, setup: Setup, begin: Begin) -> _Object:
    placement = setup.placed(begin.picture, begin.depth)
    setup.warm_up(placement, begin.picture)
    constant = setup.tracker_options(placement).per_sequence
    return _Object(options, setup, placement, RunResults(placement.model, begin.frame, per_sequence=constant))
