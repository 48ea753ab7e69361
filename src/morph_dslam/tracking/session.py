"""A session: one or several objects in the frames of one or several cameras, recorded or live."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import replace

from tqdm import tqdm

from morph_dslam.errors import ArgumentError, check_kind
from morph_dslam.sources import Frame
from morph_dslam.sources.frames import check_frame
from morph_dslam.sources.live import LiveStream
from morph_dslam.threads import ahead, one_thread_for_algebra, threads_side_by_side
from morph_dslam.tracking.anchoring import Anchor, CameraLocalization
from morph_dslam.tracking.drawing import AugmentedPicture
from morph_dslam.tracking.live import LivePipeline
from morph_dslam.tracking.multi_camera import RigTracker
from morph_dslam.tracking.occlusion import MultiObjectTracker
from morph_dslam.tracking.reregistration import Reregistration
from morph_dslam.tracking.sinks import Sink, TrackedFrame
from morph_dslam.tracking.tracker import Tracker

Localizations = dict[str, CameraLocalization]


class Session:
    """Finds the camera in the map once a frame, and each object in it, and hands the results to sinks.

    Of a recording one thread reads the next frames and finds the camera in them while another tracks the objects in
    this one; the results are those of one thread. In a live stream one thread finds the camera, one tracks the
    objects and one draws and hands out; each takes the newest frame, so that some are dropped but none is late.

    Parameters
    ----------
    trackers : by name, one of each object; `RigTracker` where several cameras see them.
    source : of frames, recorded or live; of several cameras a `SynchronizedFrames`.
    sinks : called with each `TrackedFrame`.
    anchor : the map that several objects are anchored in, by the same names; None if each tracker has its own
        or the objects are free.
    picture : draws each frame; None to draw nothing.
    reregistration : by object, decides when it is registered anew.

    Attributes
    ----------
    n_dropped : number of live frames that came but were not handed out.

    Raises
    ------
    ArgumentError
        If trackers, source or sinks are of another kind.
    """

    def __init__(
        self,
        trackers: Mapping[str, Tracker | RigTracker],
        source: Iterable[Frame | tuple[Frame, ...]],
        sinks: Sequence[Sink] = (),
        *,
        anchor: Anchor | None = None,
        picture: AugmentedPicture | None = None,
        reregistration: Mapping[str, Reregistration] | None = None,
    ) -> None:
        check_kind(trackers, Mapping, "trackers", "a tracker of each object by its name, {'object': tracker}")
        for name, tracker in trackers.items():
            check_kind(tracker, (Tracker, RigTracker), f"trackers[{name!r}]", "a Tracker or a RigTracker")
        check_kind(source, Iterable, "source", "frames: a list of md.Frame, or what open_source returns")
        if not isinstance(sinks, Sequence) or not all(map(callable, sinks)):
            raise ArgumentError("sinks are a list of functions of a TrackedFrame, of one too: [results.append]")
        self._objects, self._source, self._sinks = MultiObjectTracker(trackers), source, tuple(sinks)
        self._anchor, self._picture, self._reregistration = anchor, picture, reregistration or {}
        self._pipeline: LivePipeline | None = None

    @property
    def trackers(self) -> dict[str, Tracker | RigTracker]:
        """By name; another one after an object was registered anew."""
        return self._objects.trackers

    @property
    def n_dropped(self) -> int:
        return 0 if self._pipeline is None else self._pipeline.n_dropped

    def locate(self, frames: Sequence[Frame]) -> Localizations:
        """Find the first camera of the next frames in the map, and with it each anchored object."""
        if self._anchor is None:
            return {name: tracker.locate(frames[0]) for name, tracker in self.trackers.items()}
        return self._anchor.localized(frames[0], next(iter(self.trackers.values())).camera)

    def track(self, frames: tuple[Frame, ...], localizations: Localizations) -> TrackedFrame:
        """Find the objects in frames that `locate` has seen."""
        for name, again in self._reregistration.items():
            self.trackers[name] = again.tracker(frames, self.trackers[name])
        results = self._objects.track(frames, localizations)
        for name, again in self._reregistration.items():
            again.learn(results[name])
        return TrackedFrame(frames, results)

    def __iter__(self) -> Iterator[TrackedFrame]:
        """Track a recording frame by frame, without the sinks."""
        for frames, localizations in ahead(self._located()):
            yield self._drawn(self.track(frames, localizations))

    def _located(self) -> Iterator[tuple[tuple[Frame, ...], Localizations]]:
        """The frames of a recording with what `locate` found in them."""
        before = None
        for item in self._source:
            frames = item if isinstance(item, tuple) else (item,)
            for frame in frames:
                check_frame(frame, before, getattr(self._source, "name", "the session's source"))
            before = frames[0]
            yield frames, self.locate(frames)

    @one_thread_for_algebra
    def run(self, seconds: float | None = None, progress: bool = False) -> None:
        """Track until the source ends, and hand each frame to the sinks.

        Parameters
        ----------
        seconds : after which a live session ends; None to go on until the stream ends.
        progress : whether to show a progress bar, of a recording.

        Raises
        ------
        MorphError
            If a frame cannot be read, has not the camera's size, or its number is not above that of the frame before.
            The sinks have all frames before it.
        """
        if isinstance(self._source, LiveStream):
            self._pipeline = LivePipeline(self._source, (self._locate_live, self._track_live, self._finish_live))
            self._pipeline.run(seconds)
            return
        total = len(self._source) if isinstance(self._source, Sized) else None
        with threads_side_by_side():
            for tracked in tqdm(self, total=total, desc="tracking", unit="frame", disable=not progress):
                self._hand_out(tracked)

    def _locate_live(self, frame: Frame) -> tuple[tuple[Frame, ...], Localizations]:
        return (frame,), self.locate((frame,))

    def _track_live(self, located: tuple[tuple[Frame, ...], Localizations]) -> TrackedFrame:
        return self.track(*located)

    def _finish_live(self, tracked: TrackedFrame) -> None:
        tracked = self._drawn(tracked)
        captured = tracked.frame.captured
        latency = 0.0 if captured is None else time.monotonic() - captured
        self._hand_out(replace(tracked, latency_s=latency))

    def _drawn(self, tracked: TrackedFrame) -> TrackedFrame:
        if self._picture is None:
            return tracked
        return replace(tracked, picture=self._picture.draw(tracked.frame, tracked.results))

    def _hand_out(self, tracked: TrackedFrame) -> None:
        for sink in self._sinks:
            sink(tracked)
