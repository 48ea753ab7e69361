"""`morph track --also`: several objects in one recording, each with a run folder of its own.

Each is free, or anchored in the one map of the scene, in which the camera is found once a frame for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from morph_dslam.errors import TrackingError
from morph_dslam.online.runs.output_folders import check_run_folder
from morph_dslam.online.runs.results import RunResults
from morph_dslam.online.several.several_objects import ObjectsChain
from morph_dslam.online.several.starting_objects import (
    OtherObject,
    StartingObject,
    check_names,
    check_one_map,
    objects_chain,
    without_hidden,
)
from morph_dslam.online.track import (
    TrackOptions,
    find_begin,
    open_frames,
    with_reference,
    write_results,
)
from morph_dslam.online.tracking_setup import Setup, load_setup, warm_up
from morph_dslam.sources import FrameSource
from morph_dslam.threads import one_thread_for_algebra


@dataclass(frozen=True)
class _Object:
    """What is needed of an object until its results are written."""

    options: TrackOptions
    start: StartingObject
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
                summaries[folder] = write_results(
                    start.setup, start.placement, source, part.options, part.run
                )
    return summaries


def _follow(chain: ObjectsChain, objects: Sequence[_Object], source: FrameSource) -> None:
    for frame in tqdm(source, total=len(source), desc="tracking", unit="frame"):
        results = chain.process(frame)
        for part in objects:
            part.run.add(frame.index, frame.timestamp, results[part.name])


def _check(options: TrackOptions, others: Sequence[OtherObject]) -> None:
    if options.landmarks is None and options.placement is None:
        raise TrackingError(
            "several objects start from landmarks or from registrations in a map: give the first one "
            "--landmarks or --place"
        )
    if options.refine_reference or options.reregister_at:
        raise TrackingError(
            "several objects are tracked from where they start: leave out --refine and --reregister-at"
        )
    if options.reference_frame is not None and _all_registered(options, others):
        raise TrackingError(
            "a registration in a map brings its own reference frame: leave out --reference-frame"
        )
    check_names(others)


def _all_registered(options: TrackOptions, others: Sequence[OtherObject]) -> bool:
    return options.placement is not None and all(other.is_registered for other in others)


def _for_first(options: TrackOptions, others: Sequence[OtherObject]) -> TrackOptions:
    """The first object's options: a map may have been given for the others only."""
    needs_map = options.placement is not None or not any(other.is_registered for other in others)
    return options if needs_map else replace(options, map_path=None)


def _for_other(options: TrackOptions, other: OtherObject) -> TrackOptions:
    return replace(other.options(options), output=options.output / other.name)


def _prepare(everything: Sequence[TrackOptions], setups: Sequence[Setup]) -> list[_Object]:
    """The objects in their reference frames; the sequence begins with that of the map, if there is one."""
    check_one_map(setups)
    own = [with_reference(part, setup) for part, setup in zip(everything, setups, strict=True)]
    first = next((part.first for part in own if part.placement is not None), own[0].first)
    starts, options = [], [replace(part, first=first) for part in own]
    for part, setup in zip(options, setups, strict=True):
        begin = find_begin(setup, part)
        placement = setup.placed(begin.picture, begin.depth)
        starts.append(StartingObject(setup, placement, begin.picture, begin.frame, begin.in_sequence))
    return [
        _Object(part, start, start.new_run())
        for part, start in zip(options, without_hidden(starts), strict=True)
    ]


def _new_chain(objects: Sequence[_Object]) -> ObjectsChain:
    return objects_chain({part.name: part.start for part in objects})
