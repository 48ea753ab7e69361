"""`morph live`: track objects in a live stream, show and record them, and write their run folders."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from morph_dslam.errors import SourceError, TrackingError
from morph_dslam.io.video import VideoWriter
from morph_dslam.notices import Remark
from morph_dslam.sources import open_live, open_stream
from morph_dslam.sources.live import LiveCamera, LiveStream
from morph_dslam.threads import one_thread_for_algebra
from morph_dslam.tracking.drawing import AugmentedView, DrawOptions
from morph_dslam.tracking.live import (
    BrowserSink,
    LiveChain,
    LivePicture,
    LiveSession,
    LiveTimes,
    OneObject,
    Sink,
    VideoSink,
)
from morph_dslam.tracking.multi_object import (
    ObjectStart,
    OtherObject,
    check_names,
    check_one_map,
    objects_chain,
    without_hidden,
)
from morph_dslam.tracking.run_folder import RunResults, check_run_folder
from morph_dslam.tracking.run_writing import RunInputs, write_run
from morph_dslam.tracking.setup import ObjectOptions, Reregistration, Setup, load_setup, warm_up


@dataclass(frozen=True)
class LiveOptions:
    """What to track live, and what becomes of it.

    Attributes
    ----------
    source : `webcam:0`, or a recording that plays at its own pace. output : the run folder.
    of_object : what is tracked and with what. drawing : what is drawn.
    others : more objects, registered in the same map, each with its run folder in ``output``.
    first, last : frame numbers of a recording to play, both included; all by default.
    reregister_at : see `TrackOptions`; by the initializer it may be a later frame, where that one was dropped.
    serve : port on this computer at which browsers see the pictures; None for none, 0 for any.
    record : write the pictures into a video. seconds : how long; until the stream ends by default.
    overwrite : replace a run that is there already.
    """

    source: str
    output: Path
    of_object: ObjectOptions
    drawing: DrawOptions = field(default_factory=DrawOptions)
    others: tuple[OtherObject, ...] = ()
    first: int | None = None
    last: int | None = None
    reregister_at: tuple[tuple[int, Path | None], ...] = ()
    serve: int | None = None
    record: bool = True
    seconds: float | None = None
    overwrite: bool = False


@dataclass(frozen=True)
class _Object:
    """An object at its beginning, its run folder, and what goes there."""

    folder: Path
    start: ObjectStart
    run: RunResults

    @property
    def name(self) -> str:
        """Its run folder, by which messages call it too."""
        return str(self.folder)


@one_thread_for_algebra
def run_live(
    options: LiveOptions, tell: Callable[[Path, dict[str, Any]], None] = lambda folder, summary: None
) -> dict[str, Any]:
    """Track a live stream; an interrupt ends it, keeps everything, and goes on.

    Parameters
    ----------
    tell : called with each run folder and the content of its ``summary.json`` when it is written, after an
        interrupt too; with nothing where no frame was tracked.

    Returns
    -------
    The content of the first object's ``summary.json``.

    Raises
    ------
    MorphError
        If an input cannot be used (ModelFileError, CameraError, SourceError, RegistrationError, MapError), or
        a run folder holds a run, depth images are to be used, the port is taken, or several objects are not
        all registered in one map (TrackingError).
    """
    _check(options)
    setups = [load_setup(part) for part in _parts(options)]
    views = [AugmentedView(setup.model, setup.camera, options.drawing) for setup in setups]
    if options.others:
        _check_several(setups, views)
    folders = [options.output, *(options.output / other.name for other in options.others)]
    for folder in folders:
        check_run_folder(folder, options.overwrite)
    with ExitStack() as stack:
        stream = stack.enter_context(open_live(options.source, options.first, options.last))
        starts = without_hidden([_start(setup, stream, options) for setup in setups])
        objects = [_Object(folder, start, start.new_run()) for folder, start in zip(folders, starts, strict=True)]
        first = starts[0]
        again = Reregistration(first.setup, first.registration, options.reregister_at, first.frame)
        _warm_up(objects)
        sinks = _sinks(stack, first.setup, stream, options)
        runs = {part.name: part.run for part in objects}
        picture = _picture(objects, options.drawing)
        session = LiveSession(stream, _new_chain(objects, again), picture, runs, sinks)
        print(f"tracking {stream.name} (Ctrl-C ends it)", file=sys.stderr)
        summaries = []
        try:
            session.run(options.seconds)
        finally:
            for part in objects:
                summaries.append(_write(part, again.notes, session.times, options) if len(part.run) else {})
                tell(part.folder, summaries[-1])
    return summaries[0]


def _parts(options: LiveOptions) -> list[ObjectOptions]:
    """What is tracked and with what, of each object."""
    return [options.of_object, *(other.options(options.of_object) for other in options.others)]


def _check(options: LiveOptions) -> None:
    if options.of_object.use_depth:
        raise TrackingError("live tracking takes no depth images: leave out --depth, or use `morph track`")
    if options.others and options.reregister_at:
        raise TrackingError("several objects are tracked from where they start: leave out --reregister-at")
    check_names(options.others)


def _check_several(setups: Sequence[Setup], views: Sequence[AugmentedView]) -> None:
    if any(setup.map_path is None or setup.reference is None for setup in setups):
        raise TrackingError(
            "several objects are tracked live in the map that they are all registered in: give each its "
            "registration.json, and leave out --outline and --pose free"
        )
    check_one_map(setups)
    if len({view.show for view in views}) > 1:
        raise TrackingError("the models hold different fields to colour the objects by: --show displacement")


def _new_chain(objects: Sequence[_Object], again: Reregistration | None = None) -> LiveChain:
    if len(objects) > 1:
        return objects_chain({part.name: part.start for part in objects})
    start = objects[0].start
    chain = start.setup.new_tracker(start.registration, start.picture, start.in_sequence)
    return OneObject(objects[0].name, chain, again)


def _warm_up(objects: Sequence[_Object]) -> None:
    chain = _new_chain(objects)
    warm_up(lambda frame: chain.track(frame, chain.locate(frame)), objects[0].start.picture)


def _picture(objects: Sequence[_Object], drawing: DrawOptions) -> LivePicture:
    views, camera = {}, objects[0].start.setup.camera
    for part in objects:
        model = part.run.model
        views[part.name] = AugmentedView(model, camera, drawing, part.start.setup.carried(model))
    return LivePicture(camera, views)


def _start(setup: Setup, stream: LiveStream, options: LiveOptions) -> ObjectStart:
    """The keyframe of the map, or the first frame that comes, with the landmarks in it."""
    registration = setup.registration
    if setup.reference is not None:
        assert registration is not None
        assert registration.frame is not None
        return ObjectStart(setup, registration, setup.reference, registration.frame, False)
    if registration is not None:
        raise TrackingError(
            "a registration needs the map that it was made in, to know what the object looks like: give "
            "--map, and leave out --outline"
        )
    # A recording is not begun by that: it would play while everything is made ready.
    is_camera = isinstance(stream, LiveCamera)
    for frame in stream if is_camera else open_stream(options.source, options.first, options.last):
        setup.camera.check_image(frame.image, f"frame {frame.index} of {options.source}")
        return ObjectStart(setup, setup.placed(frame.image), frame.image, frame.index, False)
    raise SourceError(f"{options.source} ended before the first frame")


def _sinks(stack: ExitStack, setup: Setup, stream: LiveStream, options: LiveOptions) -> list[Sink]:
    sinks: list[Sink] = []
    if options.serve is not None:
        browser = stack.enter_context(BrowserSink(options.serve))
        print(f"shown at {browser.address}", flush=True)
        sinks.append(browser)
    if options.record:
        size = (setup.camera.width, setup.camera.height)
        writer = stack.enter_context(VideoWriter(options.output / "augmented.mp4", stream.fps, size))
        sinks.append(VideoSink(writer, stream.fps))
    return sinks


def _write(part: _Object, notes: Sequence[str], times: LiveTimes, options: LiveOptions) -> dict[str, Any]:
    """Write all files of an object's run folder but the video, which was written on the way."""
    setup, run, of_object = part.start.setup, part.run, part.start.setup.options
    registration = part.start.registration
    registration = replace(registration, warnings=(*registration.warnings, *map(Remark, notes)))
    named = {"source": options.source}
    named |= {name: str(path) for name, path in vars(of_object.initializer).items() if path is not None}
    for name, path in (("landmarks", of_object.landmarks), ("registration", of_object.registration)):
        named |= {} if path is None else {name: str(path)}
    named |= {} if setup.map_path is None else {"map": str(setup.map_path)}
    tracker = setup.tracker_options(registration)
    extra = {
        "live": live_figures(times),
        "pose": of_object.pose if setup.map_path is not None else "free",
        "outline_used": of_object.use_outline,
        "reference_keyframes": setup.reference_keyframes,
        "settings": {"tracker": asdict(tracker)},
    }
    inputs = RunInputs(of_object.model, of_object.camera, named)
    summary = write_run(part.folder, run, inputs, registration, setup.carried(run.model), tracker, extra)
    write_latencies(part.folder / "latency.csv", times)
    return summary


def live_figures(times: LiveTimes) -> dict[str, float]:
    """How fast it was."""
    return {
        "fps": times.fps,
        "n_dropped": times.n_dropped,
        "latency_median_ms": times.latency_ms(50),
        "latency_p95_ms": times.latency_ms(95),
    }


def write_latencies(path: Path, times: LiveTimes) -> None:
    """Write when each frame was captured, and its latency until the picture was finished."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", "captured_s", "latency_ms"])
        for frame, captured, latency in zip(times.frames, times.captured, times.latency, strict=True):
            writer.writerow([frame, f"{captured - times.captured[0]:.6f}", f"{1e3 * latency:.3f}"])
