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
from morph_dslam.online.aids.start import AidFiles
from morph_dslam.online.runs.output_folders import check_run_folder
from morph_dslam.online.runs.results import RunResults
from morph_dslam.online.several.hiding import Known, seen_parts
from morph_dslam.online.several.several_objects import ObjectsChain
from morph_dslam.online.start.placement import Placement
from morph_dslam.online.track import (
    Begin,
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


@dataclass(frozen=True)
class _Object:
    """What is needed of an object until its results are written."""

    options: TrackOptions
    setup: Setup
    begin: Begin
    placement: Placement
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
    warm_up(chain.process, objects[0].begin.picture)
    chain, summaries = _new_chain(objects), {}
    try:
        _follow(chain, objects, source)
    finally:
        for part in objects:
            if len(part.run):
                folder = part.options.output
                summaries[folder] = write_results(part.setup, part.placement, source, part.options, part.run)
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
    names = [other.name for other in others]
    for name in names:
        if names.count(name) > 1 or Path(name).name != name or name in ("", ".", "..", "plots"):
            raise TrackingError(
                f"'{name}' cannot be the name of another object's folder: give each a different, plain name"
            )


def _all_registered(options: TrackOptions, others: Sequence[OtherObject]) -> bool:
    return options.placement is not None and all(other.is_registered for other in others)


def _for_first(options: TrackOptions, others: Sequence[OtherObject]) -> TrackOptions:
    """The first object's options: a map may have been given for the others only."""
    needs_map = options.placement is not None or not any(other.is_registered for other in others)
    return options if needs_map else replace(options, map_path=None)


def _for_other(options: TrackOptions, other: OtherObject) -> TrackOptions:
    registered = other.is_registered
    return replace(
        options,
        model=other.model,
        landmarks=None if registered else other.start,
        placement=other.start if registered else None,
        map_path=options.map_path if registered else None,
        aids=AidFiles(),
        output=options.output / other.name,
        inner=(),
        per_sequence=(),
        random_walk=(),
        use_outline=False,
    )


def _prepare(everything: Sequence[TrackOptions], setups: Sequence[Setup]) -> list[_Object]:
    """The objects in their reference frames; the sequence begins with that of the map, if there is one."""
    maps = {str(setup.map_path.resolve()): None for setup in setups if setup.map_path is not None}
    if len(maps) > 1:
        raise TrackingError(
            f"the objects are anchored in different maps, {' and '.join(maps)}: register them all in one"
        )
    own = [with_reference(part, setup) for part, setup in zip(everything, setups, strict=True)]
    first = next((part.first for part in own if part.placement is not None), own[0].first)
    objects = []
    for part, setup in zip(own, setups, strict=True):
        part = replace(part, first=first)
        begin = find_begin(setup, part)
        placement = setup.placed(begin.picture, begin.depth)
        constant = setup.tracker_options(placement).per_sequence
        run = RunResults(placement.model, begin.frame, per_sequence=constant)
        objects.append(_Object(part, setup, begin, placement, run))
    return _without_hidden(objects)


def _without_hidden(objects: Sequence[_Object]) -> list[_Object]:
    """The objects, bound only where none is before another in the pictures that they are known by."""
    known = [Known(part.setup, part.placement, part.begin.frame) for part in objects]
    seen = seen_parts(known)
    return [
        replace(part, setup=replace(part.setup, seen=own)) for part, own in zip(objects, seen, strict=True)
    ]


def _new_chain(objects: Sequence[_Object]) -> ObjectsChain:
    """All objects at their beginning."""
    anchored = [part for part in objects if part.setup.map_path is not None]
    placements = {part.name: part.placement for part in anchored}
    anchor = anchored[0].setup.new_anchor(placements) if anchored else None
    trackers = {}
    for part in objects:
        seen = part.setup.seen.get(part.begin.frame)
        trackers[part.name] = part.setup.new_tracker(
            part.placement, part.begin.picture, part.begin.in_sequence, seen
        )
    return ObjectsChain(objects[0].setup.camera, trackers, anchor)
