"""`morph live`: track an object in a live stream, show and record it, and write the run folder at the end."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SourceError, TrackingError
from morph_dslam.io.video import VideoWriter
from morph_dslam.online.attempt import Picture
from morph_dslam.online.drawing.augmented_view import AugmentedView, DrawOptions
from morph_dslam.online.live.session import LivePicture, LiveSession, LiveTimes, Sink
from morph_dslam.online.live.sinks import BrowserSink, VideoSink
from morph_dslam.online.runs.output_folders import check_run_folder
from morph_dslam.online.runs.results import RunResults
from morph_dslam.online.runs.run_writing import RunInputs, write_run
from morph_dslam.online.start.placement import Placement
from morph_dslam.online.start.reregistration import Reregistration
from morph_dslam.online.tracking_setup import ObjectOptions, Setup, load_setup
from morph_dslam.sources import open_live, open_stream
from morph_dslam.sources.live import LiveCamera, LiveStream
from morph_dslam.threads import one_thread_for_algebra


@dataclass(frozen=True)
class LiveOptions:
    """What to track live, and what becomes of it.

    Attributes
    ----------
    source : `webcam:0`, or a recording that plays at its own pace. output : the run folder.
    of_object : what is tracked and with what. drawing : what is drawn.
    first, last : frame numbers of a recording to play, both included; all by default.
    reregister_at : see `TrackOptions`; by the aid it may be a later frame, where that one was dropped.
    serve : port on this computer at which browsers see the pictures; None for none, 0 for any.
    record : write the pictures into a video. seconds : how long; until the stream ends by default.
    overwrite : replace a run that is there already.
    """

    source: str
    output: Path
    of_object: ObjectOptions
    drawing: DrawOptions = field(default_factory=DrawOptions)
    first: int | None = None
    last: int | None = None
    reregister_at: tuple[tuple[int, Path | None], ...] = ()
    serve: int | None = None
    record: bool = True
    seconds: float | None = None
    overwrite: bool = False


@dataclass(frozen=True)
class _Begin:
    """The reference view, the object in it, and its frame."""

    picture: NDArray[np.uint8] | Picture
    placement: Placement
    frame: int


@one_thread_for_algebra
def run_live(
    options: LiveOptions, tell: Callable[[dict[str, Any]], None] = lambda summary: None
) -> dict[str, Any]:
    """Track a live stream; an interrupt ends it, keeps everything, and goes on.

    Parameters
    ----------
    tell : called with the content of ``summary.json`` when it is written, after an interrupt too.

    Returns
    -------
    The content of ``summary.json``.

    Raises
    ------
    MorphError
        If an input cannot be used (ModelFileError, CameraError, SourceError, RegistrationError, MapError), or
        the run folder holds a run, depth images are to be used, or the port is taken (TrackingError).
    """
    if options.of_object.use_depth:
        raise TrackingError("live tracking takes no depth images: leave out --depth, or use `morph track`")
    setup = load_setup(options.of_object)
    AugmentedView(setup.model, setup.camera, options.drawing)  # says so now if it cannot be drawn
    check_run_folder(options.output, options.overwrite)
    with ExitStack() as stack:
        stream = stack.enter_context(open_live(options.source, options.first, options.last))
        begin = _begin(setup, stream, options)
        again = Reregistration(setup, begin.placement, options.reregister_at, begin.frame)
        setup.warm_up(begin.placement, begin.picture)
        model = begin.placement.model
        view = AugmentedView(model, setup.camera, options.drawing, setup.carried(model))
        sinks = _sinks(stack, setup, stream, options)
        chain = setup.new_chain(begin.placement, begin.picture, in_sequence=False)
        kept = setup.tracker_options(begin.placement).per_sequence
        run = RunResults(model, begin.frame, per_sequence=kept)
        session = LiveSession(stream, chain, LivePicture(setup.camera, view), run, sinks, again)
        print(f"tracking {stream.name} (Ctrl-C ends it)", file=sys.stderr)
        try:
            session.run(options.seconds)
        finally:
            flags = (*begin.placement.flags, *again.notes)
            begin = replace(begin, placement=replace(begin.placement, flags=flags))
            summary = _write(setup, begin, session, options) if len(run) else {}
            tell(summary)
    return summary


def _begin(setup: Setup, stream: LiveStream, options: LiveOptions) -> _Begin:
    """The keyframe of the map, or the first frame that comes, with the landmarks in it."""
    placement = setup.placement
    if setup.reference is not None:
        assert placement is not None
        assert placement.frame is not None
        return _Begin(setup.reference, placement, placement.frame)
    if placement is not None:
        raise TrackingError(
            "a registration needs the map that it was made in, to know what the object looks like: give "
            "--map, and leave out --outline"
        )
    # A recording is not begun by that: it would play while everything is made ready.
    is_camera = isinstance(stream, LiveCamera)
    for frame in stream if is_camera else open_stream(options.source, options.first, options.last):
        setup.camera.check_image(frame.image, f"frame {frame.index} of {options.source}")
        return _Begin(frame.image, setup.placed(frame.image), frame.index)
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


def _write(setup: Setup, begin: _Begin, session: LiveSession, options: LiveOptions) -> dict[str, Any]:
    """Write all files of the run folder but the video, which was written on the way."""
    of_object = options.of_object
    named = {"source": options.source}
    named |= {name: str(path) for name, path in vars(of_object.aids).items() if path is not None}
    for name, path in (("landmarks", of_object.landmarks), ("placement", of_object.placement)):
        named |= {} if path is None else {name: str(path)}
    named |= {} if setup.map_path is None else {"map": str(setup.map_path)}
    tracker = setup.tracker_options(begin.placement)
    extra = {
        "live": live_figures(session.times),
        "pose": of_object.pose if setup.map_path is not None else "free",
        "outline_used": of_object.use_outline,
        "reference_keyframes": setup.reference_keyframes,
        "settings": {"tracker": asdict(tracker)},
    }
    inputs = RunInputs(of_object.model, of_object.camera, named)
    carried = setup.carried(session.results.model)
    summary = write_run(options.output, session.results, inputs, begin.placement, carried, tracker, extra)
    write_latencies(options.output / "latency.csv", session.times)
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
