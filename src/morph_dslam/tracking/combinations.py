"""Which options of a run make no sense together: all refusals are here."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from morph_dslam.errors import TrackingError
from morph_dslam.model.shown_field import shown_field
from morph_dslam.registration.registration import Registration
from morph_dslam.sources.recorded import depth_on_another_clock
from morph_dslam.streams.destinations import check_destination
from morph_dslam.tracking.options import NO_DISCREPANCY, NO_LOADS, NO_MAP, NOT_IN_EQUILIBRIUM
from morph_dslam.tracking.run_options import ObjectOptions, TrackOptions
from morph_dslam.tracking.setup import TrackedObject
from morph_dslam.tracking.still import TERM_STD


def _n_starts(part: ObjectOptions) -> int:
    files = (part.landmarks, part.registration, *vars(part.initializer).values())
    return sum(path is not None for path in files)


def _has_initializer(part: ObjectOptions) -> bool:
    return any(path is not None for path in vars(part.initializer).values())


def _is_no_folder(run: TrackOptions) -> bool:
    names = [name for name, _ in run.others]
    return any(names.count(name) > 1 or Path(name).name != name or name in ("", ".", "..", "plots") for name in names)


#: Of each object: when to refuse, and what to tell.
OF_OBJECT: tuple[tuple[Callable[[ObjectOptions], bool], str], ...] = (
    (
        lambda part: _n_starts(part) != 1,
        "say where the object is, in one way: by landmarks, a registration in a map, a board, a picture or a guess",
    ),
    (lambda part: part.tracker.pose == "fixed" and part.registration is None, f"{NO_MAP}, --registration"),
    (
        lambda part: part.at_rest and part.landmarks is None,
        "the frame of the landmarks shows the object at rest: start from landmarks, or leave out --at-rest",
    ),
    (
        lambda part: part.snap and part.landmarks is None,
        "the outline corrects landmarks: start from landmarks, or leave out --snap",
    ),
    (
        lambda part: part.snap and part.tracker.use_depth,
        "depth says where the object is in the frame of the landmarks: leave out --snap or --depth",
    ),
    (
        lambda part: len(dict(part.tracker.random_walk)) < len(part.tracker.random_walk),
        "a parameter walks by one step from frame to frame: give --random-walk once for each",
    ),
    (
        lambda part: part.tracker.pose == "still" and part.registration is not None,
        "an object that is registered in a map stands still in it already: leave out --still",
    ),
    (
        lambda part: part.tracker.pose == "still" and bool(part.reregister_at),
        "what stands still is not registered anew: leave out --still or --reregister-at",
    ),
    (
        lambda part: not _has_initializer(part) and any(path is None for _, path in part.reregister_at),
        "to register the object anew give landmarks of that frame (--reregister-at N=FILE), or start from a board, "
        "a picture or a guess, which are looked for there again",
    ),
)
#: Of the whole run.
OF_RUN: tuple[tuple[Callable[[TrackOptions], bool], str], ...] = (
    (
        lambda run: run.map_path is not None and all(part.registration is None for part in run.objects),
        "a map needs the object's registration in it: --registration registration.json",
    ),
    (_is_no_folder, "the name of another object cannot be that of a folder: give each a different, plain name"),
    (
        lambda run: run.live and bool(run.other_cameras),
        "several cameras are tracked from recordings: leave out --with, or use `morph track`",
    ),
    (
        lambda run: len(run.other_landmarks) > len(run.other_cameras),
        "landmarks of more cameras than there are: name the recording of each further camera, --with",
    ),
    (
        lambda run: bool(run.other_landmarks) and run.landmarks is None,
        "landmarks of further cameras count beside those of the first one: give --landmarks, or leave out "
        "--with-landmarks",
    ),
    (
        lambda run: bool(run.other_landmarks) and run.snap,
        "the outline corrects the landmarks of one camera: leave out --snap or --with-landmarks",
    ),
    (
        lambda run: run.live and run.refine_reference,
        "a reference is refined over a whole recording: leave out --refine, or use `morph track`",
    ),
    (
        lambda run: run.live and run.reference_frame is not None,
        "the first frame that comes is the reference frame of a live run: leave out --reference-frame, or give an "
        "image, --reference-image",
    ),
    (
        lambda run: run.reference_image is not None and not run.live,
        "the reference frame of a recording is one of its own: give its number, --reference-frame",
    ),
    (
        lambda run: run.reference_image is not None and all(part.registration is not None for part in run.objects),
        "a registration in a map brings its own reference frame: leave out --reference-image",
    ),
    (
        lambda run: not run.live and (run.serve, run.seconds) != (None, None),
        "--serve and --seconds are for live runs: leave them out, or use `morph live`",
    ),
    (
        lambda run: run.refine_reference and any(p.at_rest and p.tracker.pose != "still" for p in run.objects),
        "the reference state is not refined where it is known: leave out --refine or --at-rest, or add --still",
    ),
    (
        lambda run: run.refine_reference and all(part.landmarks is None for part in run.objects),
        "the reference is refined with the landmarks in it: start from landmarks, or leave out --refine",
    ),
    (
        lambda run: run.refine_reference and any(part.reregister_at for part in run.objects),
        "a reference refined over the whole sequence cannot be changed in mid-sequence: leave out --refine or "
        "--reregister-at",
    ),
    (
        lambda run: bool(run.other_cameras) and any(part.tracker.pose == "still" for part in run.objects),
        "one pose for the whole sequence is estimated from one camera: leave out --still or --with",
    ),
    (
        lambda run: bool(run.refine_camera) and (run.live or run.tracker.pose != "still" or bool(run.others)),
        "the camera is estimated with the one pose of one object over a recording: give --still, or leave out "
        "--refine-camera",
    ),
    (
        lambda run: not set(run.refine_camera) <= set(TERM_STD),
        f"--refine-camera (refine_camera) estimates {' and '.join(TERM_STD)} here: leave out the other terms",
    ),
    (
        lambda run: any(part.known is not None for part in run.objects) and run.live,
        "a table of known parameters belongs to a recording: leave out --known; live, your own program tells the "
        "tracker (Tracker.know)",
    ),
    (
        lambda run: run.refine_reference and bool(run.other_cameras),
        "the reference is refined for one camera: leave out --refine or --with",
    ),
    (lambda run: bool(run.other_cameras) and any(part.tracker.use_discrepancy for part in run.objects), NO_DISCREPANCY),
    (
        lambda run: run.drawing.show in ("stress", "strain") and any(p.tracker.use_discrepancy for p in run.objects),
        f"{NOT_IN_EQUILIBRIUM}: leave out --show, or --discrepancy",
    ),
    (
        lambda run: run.depth_per_metre is not None and not any(part.tracker.use_depth for part in run.objects),
        "--depth-per-metre says how depth images are to be read, which do not count here: add --depth, or leave it out",
    ),
    (lambda run: bool(run.other_cameras) and any(part.tracker.use_unknown_loads for part in run.objects), NO_LOADS),
    (
        lambda run: (
            run.reference_frame is not None
            and not run.other_cameras
            and all(part.registration is not None for part in run.objects)
        ),
        "a registration in a map brings its own reference frame: leave out --reference-frame",
    ),
    (
        lambda run: not run.video and run.serve is None and run.drawing.section is not None,
        "--section says what the video shows: leave it or --no-video out",
    ),
    (
        lambda run: not run.video and run.serve is None and run.drawing.forces,
        "--forces says what the video shows: leave it or --no-video out",
    ),
    (
        lambda run: not run.video and run.serve is None and not run.streams and run.drawing.show is not None,
        "--show says what the video and streams show: leave it or --no-video out",
    ),
)


def check_options(run: TrackOptions) -> None:
    """Raise TrackingError if options make no sense together, StreamError for a stream that cannot be."""
    for part in run.objects:
        _refuse((message for refuses, message in OF_OBJECT if refuses(part)))
    _refuse((message for refuses, message in OF_RUN if refuses(run)))
    for destination in run.streams:
        check_destination(destination, run.overwrite)


def check_inputs(run: TrackOptions, objects: Sequence[TrackedObject]) -> None:
    """Raise TrackingError if options do not suit the objects."""
    for part in objects:
        _refuse(_unsuited(run, part))
    maps = dict.fromkeys(
        str(p.scene.path.resolve()) for p in objects if p.scene is not None and p.scene.path is not None
    )
    if len(maps) > 1:
        raise TrackingError(
            f"the objects are anchored in different maps, {' and '.join(maps)}: register them all in one"
        )
    # A rigid object is drawn grey.
    shown = {shown_field(part.model, None) for part in objects if part.model.parameters}
    if run.live and run.drawing.show is None and len(shown) > 1:
        raise TrackingError("the models hold different fields to colour the objects by: --show displacement")


def check_depth(run: TrackOptions, objects: Sequence[TrackedObject], source: object) -> None:
    """Raise TrackingError if depth images are to be used that the source of frames has not."""
    if not any(part.options.use_depth for part in objects):
        return
    if doubt := depth_on_another_clock(source, run.frames):
        raise TrackingError(f"{doubt}, or track it without --depth")
    if not getattr(source, "has_registered_depth", False):
        raise TrackingError(
            f"{run.frames} has no depth images that belong to its pixels, as TUM RGB-D recordings have: "
            "track it without --depth"
        )


def check_times(run: TrackOptions, source: object) -> None:
    """Raise TrackingError if the model's time is to be known by frames that have no times."""
    is_asked = any(part.time_zero is not None for part in run.objects)
    if is_asked and run.fps is None and getattr(source, "has_assumed_times", False):
        raise TrackingError(
            f"--time-zero: nothing tells the times of the frames of {run.frames}: name the images by their times, or "
            "give --fps"
        )


def _unsuited(run: TrackOptions, part: TrackedObject) -> Iterable[str]:
    """What of the options does not suit an object."""
    if not isinstance(part.start, Registration):
        return
    if run.live and not part.keyframes:
        yield "a registration needs the map that it was made in, to know what the object looks like: give --map"
    if run.reference_frame is not None and run.other_cameras and not (part.keyframes and part.scene):
        yield "without its map a registration brings its own reference frame: leave out --reference-frame"


def _refuse(messages: Iterable[str]) -> None:
    for message in messages:
        raise TrackingError(message)
