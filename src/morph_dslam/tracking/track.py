"""`morph track` and `morph live`: from files to run folders, by a session."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from morph_dslam.errors import SourceError, TrackingError
from morph_dslam.interrupts import WaitingInterrupts
from morph_dslam.io.camera_doubts import camera_doubts
from morph_dslam.io.folders import only_writer, replaced_files
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.io.video import VideoWriter
from morph_dslam.io.writing import check_no_input
from morph_dslam.model.shown_field import Shown
from morph_dslam.notices import Remark
from morph_dslam.registration.landmark_binding import bind_landmarks
from morph_dslam.registration.registration import Registration
from morph_dslam.slam.camera_notes import camera_notes
from morph_dslam.sources import Frame, open_live, open_source, open_stream
from morph_dslam.sources.frames import FrameSource, notes_of_source, read_image
from morph_dslam.sources.live import LiveStream, PacedRecording
from morph_dslam.sources.local_socket import SocketCamera
from morph_dslam.threads import one_thread_for_algebra
from morph_dslam.tracking.camera_check import CameraCheck
from morph_dslam.tracking.combinations import check_depth, check_inputs, check_options, check_times
from morph_dslam.tracking.discrepancy import DiscrepancyFit, Reference, refine_discrepancy
from morph_dslam.tracking.drawing import AugmentedPicture, AugmentedView, DrawOptions, write_video
from morph_dslam.tracking.frame_log import FrameLog, check_frame_log
from morph_dslam.tracking.hypothesis import Image
from morph_dslam.tracking.options import NOT_IN_EQUILIBRIUM
from morph_dslam.tracking.outcomes import ModelDoesNotExplain
from morph_dslam.tracking.placement import (
    FramesAt,
    PlacedObject,
    frame_at,
    new_anchor,
    place,
    place_by_map,
    with_other_images,
)
from morph_dslam.tracking.refinement import Keyframe, choose_keyframes, landmark_deviation, refine_reference, relied_on
from morph_dslam.tracking.reregistration import Reregistration
from morph_dslam.tracking.run_facts import run_facts
from morph_dslam.tracking.run_folder import RunFolder
from morph_dslam.tracking.run_options import TrackOptions
from morph_dslam.tracking.run_results import RunResults
from morph_dslam.tracking.session import Session
from morph_dslam.tracking.setup import TrackedObject, load_cameras, load_objects
from morph_dslam.tracking.sinks import BrowserSink, LiveTimes, Sink, SourceSink, TrackedFrame, VideoSink
from morph_dslam.tracking.still_run import OpenedSurface, Sharpening, known_state, with_pose, with_still_pose
from morph_dslam.tracking.stream_sink import StreamedObject, StreamSink
from morph_dslam.tracking.synchronized import SynchronizedFrames
from morph_dslam.tracking.tracker import Tracker

Tell = Callable[[Path, dict[str, Any]], object]
Source = FrameSource | SynchronizedFrames | LiveStream
#: Number of a reference image that is no frame of the stream.
BEFORE_ALL = -1


@one_thread_for_algebra
def track(run: TrackOptions, tell: Tell = lambda folder, summary: None) -> dict[str, Any]:
    """Track objects through a recording or a live stream, and write a run folder of each.

    An interrupt, or a recording that breaks off, keeps what was done: the run folders are completed with the
    frames so far, and the exception goes on. An interrupt ends a recording between two frames; a further one, while no
    frame comes, does so at once. While the folders are written interrupts wait, and one while the videos are drawn cuts
    these short.

    Parameters
    ----------
    run : what to track, in which frames, and what becomes of the results.
    tell : called with each run folder and the content of its ``summary.json`` when it is written; with nothing
        where no frame was tracked.

    Returns
    -------
    The content of the first object's ``summary.json``.

    Raises
    ------
    MorphError
        If an input cannot be used (ModelFileError, CameraError, SourceError, RegistrationError, MapError), or
        options make no sense together or with the inputs, or a run folder holds a run already, or another run is
        writing to it (TrackingError).
    StreamError
        If a stream cannot be opened; or did not get all frames, after the run folders were written.
    SourceError
        If the video could not be written whole, after the run folders were written.
    """
    with ExitStack() as stack:
        run, source, placed = prepare(run, stack)
        job = _Job(stack, run, source, placed)
        warm_up(placed)
        try:
            job.run()
        finally:
            try:
                job.end_streams()
            finally:
                summaries = job.finish(tell)
    return summaries[0]


def prepare(run: TrackOptions, stack: ExitStack) -> tuple[TrackOptions, Source, list[PlacedObject]]:
    """Read and check all inputs, open the frames, and place the objects in their reference frames.

    Parameters
    ----------
    run : the options.
    stack : closes what is opened.

    Returns
    -------
    run : the options, with the first frame to track.
    source : of the frames.
    placed : the objects.

    Raises
    ------
    MorphError
        As `track` does.
    """
    check_options(run)
    outputs = [path for folder in run.folders for path in replaced_files(folder)]
    check_no_input(outputs, run.input_files, TrackingError, folders_are_emptied=True)
    if run.frame_log is not None:
        check_frame_log(run.frame_log, run.input_files)
    cameras = load_cameras(run)
    objects = load_objects(run, cameras[0].camera)
    check_inputs(run, objects)
    if run.reference_frame is not None and run.other_cameras:
        frame = frame_at(run.frames, run.reference_frame)
        objects = [place_by_map(part, cameras[0].camera, frame) for part in objects]
    run = _with_first_frame(run, objects)
    source, frames_at = _open_live(run, stack) if run.live else _open_recordings(run)
    check_depth(run, objects, source)
    check_times(run, source)
    placed = [place(part, cameras, frames_at, run) for part in objects]
    return run, source, with_other_images(placed, _whole_recordings(run) if run.other_cameras else None)


def _with_first_frame(run: TrackOptions, objects: Sequence[TrackedObject]) -> TrackOptions:
    """Without a map, a recording is tracked from the frame that an object is registered in, if nothing else is asked.

    A map's keyframe is a frame of the scan, which may be another recording, and it shows the object to whatever pose is
    tracked by. So all frames are tracked, and the object is searched for in the first one.
    """
    starts = [part.start for part in objects if isinstance(part.start, Registration)]
    frames = [start.frame for start in starts if start.scene is None]
    return run if run.live or run.first is not None or not frames else replace(run, first=frames[0])


def _open_recordings(run: TrackOptions) -> tuple[Source, FramesAt]:
    """The frames to track, and what gives reference frames."""
    whole = _whole_recordings(run) if run.other_cameras else None

    @cache
    def frames_at(number: int | None) -> tuple[Frame, ...]:
        wanted = run.first if number is None else number
        if whole is not None and whole.goes_by_time:
            return whole.at(wanted)
        return tuple(frame_at(path, wanted, scale, run.fps) for path, scale in _recordings(run))

    if whole is None or not whole.goes_by_time:
        sources = [open_source(path, run.first, run.last, run.fps, scale) for path, scale in _recordings(run)]
        return (SynchronizedFrames(sources) if run.other_cameras else sources[0]), frames_at
    open_source(run.frames, run.first, run.last, run.fps, run.depth_per_metre)  # refused where the range is not in it
    return SynchronizedFrames(whole.sources, run.first, run.last), frames_at


def _recordings(run: TrackOptions) -> list[tuple[Path | str, float | None]]:
    """By camera, the recording, and how many values a metre its depth images have."""
    return [(run.frames, run.depth_per_metre), *((path, None) for path in run.other_cameras)]


def _whole_recordings(run: TrackOptions) -> SynchronizedFrames:
    """What all cameras recorded, from the beginnings: where frames go by times, these tell whose clocks are one."""
    return SynchronizedFrames([open_source(path, None, None, run.fps, scale) for path, scale in _recordings(run)])


def _open_live(run: TrackOptions, stack: ExitStack) -> tuple[Source, FramesAt]:
    """The stream to track, and what gives its reference: an image, or its first frame."""
    scale = run.depth_per_metre
    stream = stack.enter_context(open_live(run.frames, run.first, run.last, run.fps, scale))

    @cache
    def frames_at(number: int | None) -> tuple[Frame, ...]:
        if run.reference_image is not None:
            return (Frame(BEFORE_ALL, 0.0, read_image(run.reference_image, "the reference image")),)
        # A recording is not begun by that: it would play while everything is made ready.
        is_recorded = isinstance(stream, PacedRecording)
        for frame in open_stream(run.frames, run.first, run.last, run.fps, scale) if is_recorded else stream:
            return (frame,)
        raise SourceError(f"{run.frames} ended before the first frame")

    return stream, frames_at


def new_session(placed: Sequence[PlacedObject], source: Iterable, *arguments: Any, **options: Any) -> Session:
    """A session of new trackers."""
    anchor = new_anchor(placed)  # first, because it raises where two objects are in the same place
    trackers = {part.name: part.new_tracker() for part in placed}
    return Session(trackers, source, *arguments, anchor=anchor, **options)


def warm_up(placed: Sequence[PlacedObject]) -> None:
    """Compile the inner loops by the reference frame, so that the first frame takes no longer than the others."""
    print("preparing (half a minute the first time, when the inner loops are compiled) ...", file=sys.stderr)
    images = [cv2.cvtColor(i.grey, cv2.COLOR_GRAY2BGR) if isinstance(i, Image) else i for i in placed[0].images]
    instants = [tuple(Frame(n, float(n), np.asarray(i, dtype=np.uint8)) for i in images) for n in range(2)]
    for _ in new_session(placed, instants):
        pass


class _Job:
    """A run: its session, and what becomes of the results.

    Parameters
    ----------
    stack : closes what is opened.
    run : the options.
    source : of the frames.
    placed : the objects.
    """

    def __init__(self, stack: ExitStack, run: TrackOptions, source: Any, placed: list[PlacedObject]) -> None:
        self._run, self._source, self._placed = run, source, placed
        self._notes = notes_of_source(source, placed[0].camera.readout_s)
        self._views = _views_of(placed, run)
        for folder in run.folders:
            stack.enter_context(only_writer(folder))
        self._folders = [
            RunFolder(folder, part.name, part.new_results(), part.camera, part.inner, run.overwrite, more)
            for folder, part, more in zip(run.folders, placed, run.shown_in_folders, strict=True)
        ]
        sharpens = {part.name: run.live and part.options.pose == "still" for part in placed}
        self._again = {p.name: Sharpening(p) if sharpens[p.name] else Reregistration(p) for p in placed}
        self._times = LiveTimes()
        self._interrupts = WaitingInterrupts(only_first=True)
        self._seen: dict[str, list[tuple[int, Keyframe]]] = {part.name: [] for part in placed}
        self._checks = {
            part.name: CameraCheck(part.camera, deforms=bool(part.model.parameters))
            for part in placed
            if _checks_camera(part, run)
        }
        named = dict(zip(run.stream_names, self._folders, strict=True))
        self._streams = self._opened_streams(stack)  # before the log of an earlier run is emptied: it may be refused
        self._log = None if run.frame_log is None else FrameLog(run.frame_log, named)
        sinks: list[Sink] = [*self._folders, *([] if self._log is None else [self._log])]
        self._video = stack.enter_context(ExitStack())
        screens = self._screens(stack) if run.live else []
        if run.live:
            sinks += [self._times, *screens]
        if self._checks:
            sinks.append(self._keep_for_camera)
        streams: list[Sink] = []
        if run.in_two_passes:
            # What is sent is final: the second pass.
            sinks.append(self._keep_seen)
            # By its own points in each frame, which shows more of them as long as the one pose is not known well.
            placed = [with_pose(part, "free") if part.options.pose == "still" else part for part in placed]
        else:
            streams = self._begun_streams(placed)
        views = {part.name: view for part, view in zip(placed, self._views, strict=True)}
        picture = AugmentedPicture(placed[0].camera, views) if screens else None
        self._session = new_session(
            placed, source, self._between_interrupts(sinks, streams), picture=picture, reregistration=self._again
        )

    def run(self) -> None:
        """Track, and once more from a refined reference if that is asked for."""
        run = self._run
        if run.live:
            print(f"tracking {self._source.name} (Ctrl-C ends it)", file=sys.stderr)
            with self._video:  # ended before the results are written: on a full disk it makes room for them
                self._session.run(run.seconds)
        else:
            with self._interrupts:
                self._session.run(progress=True)
        if run.in_two_passes:
            begun = self._placed
            self._track_refined(begun, {})
            opened = self._opened(begun)
            if opened and not run.streams:  # what is sent is final
                self._track_refined(begun, opened)

    def _opened(self, placed: Sequence[PlacedObject]) -> dict[str, OpenedSurface]:
        """The objects, by name, whose surface was found to open, and in which frames."""
        opened = {}
        for part, folder in zip(placed, self._folders, strict=True):
            run = folder.results
            found = {number: one.jumps for number, one in zip(run.frames, run.results, strict=True) if one.jumps}
            if found:
                opened[part.name] = OpenedSurface(part, found)
        return opened

    def _track_refined(self, begun: Sequence[PlacedObject], opened: Mapping[str, OpenedSurface]) -> None:
        """Refine what is the same in the whole sequence, and track once more.

        Parameters
        ----------
        begun : the objects as the first pass had them.
        opened : by name, what a pass before found of surfaces that open: no pose explains these frames.
        """
        run = self._run
        print("refining what is the same in the whole sequence ...", file=sys.stderr)
        placed = []
        for part, folder in zip(begun, self._folders, strict=True):
            end = opened[part.name].first if part.name in opened else np.inf
            seen = relied_on(self._seen[part.name], folder.results.mistaken_frames, end)
            placed.append(_refined(part, seen, run))
        with self._interrupts:  # until then the frames of the pass before are the results
            self._placed, self._views = placed, _views_of(placed, run)
            for folder, part in zip(self._folders, placed, strict=True):
                folder.start_again(part.new_results(refined=isinstance(part.object.start, Landmarks)), part.camera)
            sinks: list[Sink] = [*self._folders]
            if self._log is not None:
                self._log.start_again()
                sinks.append(self._log)
            whole = self._between_interrupts(sinks, self._begun_streams(placed))
            new_session(placed, self._source, whole, reregistration=opened).run(progress=True)

    def _between_interrupts(self, sinks: Sequence[Sink], streams: Sequence[Sink]) -> list[Sink]:
        """Sinks that all get a frame or none, then streams, which may wait for others; then interrupts are raised."""

        def hand_out(tracked: TrackedFrame) -> None:
            with WaitingInterrupts():
                for sink in sinks:
                    sink(tracked)

        return [hand_out, *streams, lambda tracked: self._interrupts.raise_waiting()]

    def finish(self, tell: Tell) -> list[dict[str, Any]]:
        """Write the run folder of each object, then the videos, because they take longest; returns the summaries."""
        summaries: list[dict[str, Any]] = []
        try:
            with WaitingInterrupts("writing what was tracked ..."):
                for number in range(len(self._placed)):
                    summaries.append(self._write(number))
            if self._run.video and not self._run.live:
                for number, summary in enumerate(summaries):
                    if summary:
                        self._draw(number)
        finally:
            with WaitingInterrupts():
                for folder, summary in zip(self._folders, summaries, strict=False):  # an error may have ended it
                    tell(folder.path, summary)
        return summaries

    def _write(self, number: int) -> dict[str, Any]:
        """Write the run folder of one object but for its video; returns the summary, empty without a frame."""
        run, folder, again = self._run, self._folders[number], self._again[self._placed[number].name]
        # What the results rest on: live, the one pose is estimated anew while frames come.
        part = again.part if isinstance(again, Sharpening) else self._placed[number]
        if not len(folder.results):
            return {}
        facts = run_facts(run, number, part, folder.results)
        notices = [*part.registration.warnings, *again.notices, *map(Remark, self._notes)]
        of_camera = camera_doubts(part.camera) if part.object.scene is None else part.object.scene.camera_notes
        notices += [Remark(note) for note in of_camera]
        deforms, checked = bool(part.model.parameters), None
        if part.name in self._checks:
            checked = self._checks[part.name].estimate(deforms and _leaves_residuals(folder.results))
        if checked is not None:
            facts["camera"] = {term: found.facts() for term, found in checked.terms.items()}
            notices += [Remark(note) for note in camera_notes(checked, deforms)]
        known = part.object.known
        notices += [] if known is None else map(Remark, known.remarks(folder.results.frames))
        if part.options.use_discrepancy and part.model.stresses:
            notices.append(Remark(f"{NOT_IN_EQUILIBRIUM}; those in plots and tables are the model's without it"))
        if isinstance(self._source, SynchronizedFrames):
            notices += self._source.notices()
        if run.live:
            facts["live"] = self._times.figures() | {"n_dropped": self._session.n_dropped}
            self._times.write(folder.path / "latency.csv")
        return folder.write(facts, notices)

    def _draw(self, number: int) -> None:
        """Draw the video of one object."""
        run, folder, camera = self._run, self._folders[number], self._placed[number].camera
        first = self._source
        if isinstance(first, SynchronizedFrames):  # which may read from the beginning, where a range is asked for
            first = open_source(run.frames, run.first, run.last, run.fps)
        write_video(folder.path / "augmented.mp4", first, camera, folder.results, self._views[number])

    def _screens(self, stack: ExitStack) -> list[Sink]:
        """Where the pictures of a live run go."""
        screens: list[Sink] = [SourceSink(self._source)] if isinstance(self._source, SocketCamera) else []
        if self._run.serve is not None:
            browser = stack.enter_context(BrowserSink(self._run.serve))
            print(f"shown at {browser.address}", flush=True)
            screens.append(browser)
        if self._run.video:
            camera, fps = self._placed[0].camera, self._source.fps
            path = self._run.output / "augmented.mp4"
            writer = self._video.enter_context(VideoWriter(path, fps, (camera.width, camera.height)))
            screens.append(VideoSink(writer, fps))
        return screens

    def _opened_streams(self, stack: ExitStack) -> StreamSink | None:
        """What sends results to other programs; None if nobody asked for it."""
        if not self._run.streams:
            return None
        streams = stack.enter_context(StreamSink(self._run.streams, self._run.overwrite))
        for publisher in streams.publishers:
            print(f"streamed to {publisher.place}", flush=True)
        return streams

    def _begun_streams(self, placed: Sequence[PlacedObject]) -> list[Sink]:
        """The sink of the streams, told what will be tracked; none if nobody asked for it."""
        if self._streams is None:
            return []
        objects = {
            part.name: StreamedObject(part.model, name, _shown_of(part, self._run), view.surface_field, part.inner)
            for part, name, view in zip(placed, self._run.stream_names, self._views, strict=True)
        }
        return [self._streams.begin(objects, placed[0].camera)]

    def end_streams(self) -> None:
        """End the streams as soon as the last frame is tracked: a video may take minutes to draw."""
        if self._streams is not None:
            self._streams.close()

    def _keep_for_camera(self, tracked: TrackedFrame) -> None:
        """Keep where the points of each object were seen, to check the camera."""
        for name, check in self._checks.items():
            tracker = self._session.trackers[name]
            if tracked.results[name].tracked and isinstance(tracker, Tracker) and tracker.last_seen is not None:
                errors = tracker.deformation_errors()
                check.add(tracked.frame.timestamp, tracker.reference.points, tracker.last_seen, errors)

    def _keep_seen(self, tracked: TrackedFrame) -> None:
        """Keep where the points of each object were seen, to refine its reference."""
        for name, tracker in self._session.trackers.items():
            if tracked.results[name].tracked and isinstance(tracker, Tracker) and tracker.last_seen is not None:
                self._seen[name].append((tracked.frame.index, tracker.last_seen))


def _checks_camera(part: PlacedObject, run: TrackOptions) -> bool:
    """Whether the object's points check the camera: one camera and a recording, which no map has been made of."""
    return not run.live and not run.other_cameras and part.object.scene is None and part.options.pose != "still"


def _leaves_residuals(results: RunResults) -> bool:
    """Whether the model does not explain some of the frames."""
    return any(result.warning(ModelDoesNotExplain) is not None for result in results.results)


def _shown_of(part: PlacedObject, run: TrackOptions) -> Shown | None:
    """What colours an object: its displacement where stress would be drawn on a shape that is not in equilibrium."""
    return "displacement" if part.options.use_discrepancy and run.drawing.show is None else run.drawing.show


def _views_of(placed: Sequence[PlacedObject], run: TrackOptions) -> list[AugmentedView]:
    """What draws each object; of a rigid one beside others there is nothing to choose."""
    some_deform = any(part.model.parameters for part in placed)
    views = []
    for part in placed:
        drawing = replace(run.drawing, show=_shown_of(part, run))
        if some_deform and not part.model.parameters:
            drawing = DrawOptions()
        views.append(AugmentedView(part.model, part.camera, drawing, part.inner))
    return views


def _refined(part: PlacedObject, keyframes: list[Keyframe], run: TrackOptions) -> PlacedObject:
    """An object with its reference state refined over the sequence."""
    if part.options.pose == "still":
        return with_still_pose(part, keyframes, run.refine_camera)
    landmarks, registration = part.object.start, part.registration
    if not isinstance(landmarks, Landmarks):
        return part
    tracker = part.new_tracker()
    assert isinstance(tracker, Tracker)
    pixels, chosen = tracker.reference.pixels, choose_keyframes(keyframes)
    if not part.options.use_discrepancy:
        asked = tracker.estimator, known_state(part), pixels, registration.state, chosen
        state, covariance = refine_reference(*asked, part.depth_scale_std)
        refined = replace(registration, state=state, covariance=covariance)
    else:
        # What the state is wrong by counts with the discrepancy: to refine both would be the same twice.
        bound, seen = bind_landmarks(part.model, landmarks.points), part.camera.undistort_pixels(landmarks.pixels)
        known = Reference(registration.state, pixels, bound, seen, landmark_deviation(registration.facts["sigma_px"]))
        fit = DiscrepancyFit(part.model, part.camera, part.options.discrepancy)
        found = refine_discrepancy(fit, tracker.estimator, known, chosen)
        refined = replace(registration, discrepancy=found)
    return replace(part, registration=refined)
