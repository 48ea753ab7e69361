"""A live session: each frame goes through three threads, and each of these always takes the newest.

One finds the camera in the map, one the object, and one draws and records, so that while a frame is drawn the
next is tracked already. None waits for a later one; a frame that the next thread has no time for is dropped.
What is compiled, or OpenCV's, leaves the interpreter to the others.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.online.chain import Chain, Located
from morph_dslam.online.drawing.augmented_view import AugmentedView, with_caption
from morph_dslam.online.frame_result import FrameResult
from morph_dslam.online.runs.results import RunResults
from morph_dslam.online.side_by_side import threads_side_by_side
from morph_dslam.online.start.reregistration import Reregistration
from morph_dslam.sources import Frame
from morph_dslam.sources.live import LiveStream
from morph_dslam.sources.newest import Newest


class Sink(Protocol):
    """Takes the finished pictures (h, w, 3), for a video say."""

    def show(self, frame: Frame, picture: NDArray[np.uint8]) -> None: ...


@dataclass
class LiveTimes:
    """When frames were captured and how long it took until they were drawn, seconds.

    Attributes
    ----------
    frames : (f,) numbers. captured : (f,) `time.monotonic`. latency : (f,) until the picture was finished.
    n_dropped : frames that came but were not drawn, because newer ones were there.
    """

    frames: list[int] = field(default_factory=list)
    captured: list[float] = field(default_factory=list)
    latency: list[float] = field(default_factory=list)
    n_dropped: int = 0

    @property
    def fps(self) -> float:
        """Pictures a second."""
        if len(self.captured) < 2:
            return 0.0
        return (len(self.captured) - 1) / max(self.captured[-1] - self.captured[0], 1e-9)

    def latency_ms(self, percentile: float) -> float:
        """A percentile of the latency, milliseconds; NaN where nothing was drawn."""
        return 1e3 * float(np.percentile(self.latency, percentile)) if self.latency else float("nan")


class LivePicture:
    """Draws a tracked frame: undistorted, with the object over it, or with the reason why it is not there."""

    def __init__(self, camera: PinholeCamera, view: AugmentedView) -> None:
        self._view, self._limits = view, view.range_of_box()
        self._maps = camera.undistortion_maps()

    def draw(self, frame: Frame, result: FrameResult) -> NDArray[np.uint8]:
        image = frame.image
        if self._maps is not None:
            image = np.asarray(cv2.remap(image, *self._maps, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
        if result.estimate is None:
            return with_caption(image, f"frame {frame.index}: {result.reason}")
        return self._view.draw(
            image, result.estimate.state, self._limits, f"frame {frame.index}", result.discrepancy
        )


class LiveSession:
    """Tracks a live stream until it ends, or until `stop`.

    Parameters
    ----------
    run : gets the results, without the residuals of single points: sessions are long.
    again : decides when the object is placed anew; it never is by default.
    sinks : get the pictures, after the latency has been taken.
    """

    def __init__(
        self,
        stream: LiveStream,
        chain: Chain,
        picture: LivePicture,
        run: RunResults,
        sinks: Sequence[Sink] = (),
        again: Reregistration | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._again = again
        self._stream, self._chain, self._picture, self._clock = stream, chain, picture, clock
        self._sinks, self.results, self.times = sinks, run, LiveTimes()
        self._located: Newest[tuple[Frame, Located]] = Newest()
        self._tracked: Newest[tuple[Frame, FrameResult]] = Newest()
        self._errors: list[BaseException] = []
        self._done = threading.Event()
        self._threads = [
            threading.Thread(target=self._guarded, args=(work, following), name=name, daemon=True)
            for name, work, following in (
                ("locate", self._locate, self._located),
                ("track", self._track, self._tracked),
                ("draw", self._draw, None),
            )
        ]

    def run(self, seconds: float | None = None) -> None:
        """Work until the stream ends, or for some seconds; raises what went wrong in a thread.

        An interrupt ends it too; what was found until then is in `results` and `times`.
        """
        with threads_side_by_side():
            for thread in self._threads:
                thread.start()
            try:
                end = None if seconds is None else self._clock() + seconds
                # Not by joining: a thread whose join is interrupted counts as ended in Python 3.11.
                while not self._done.wait(0.1) and (end is None or self._clock() < end):
                    pass
            finally:
                self.stop()
                places = (self._stream, self._located, self._tracked)
                self.times.n_dropped = sum(place.dropped for place in places)
        if self._errors:
            raise self._errors[0]

    def stop(self) -> None:
        """End the stream, and wait until what is under way is done."""
        self._stream.close()
        for thread in self._threads:
            thread.join(timeout=10.0)

    def _guarded(self, work: Callable[[], None], following: Newest | None) -> None:
        """One thread; when it ends, for whatever reason, so do the others."""
        try:
            work()
        except BaseException as error:
            self._errors.append(error)
            self._stream.closing = True
        finally:
            if following is None:
                self._done.set()
            else:
                following.end()

    def _locate(self) -> None:
        for frame in self._stream:
            self._located.put((frame, self._chain.locate(frame)))

    def _track(self) -> None:
        while (item := self._located.take()) is not None:
            frame, located = item
            if self._again is not None:
                self._chain = self._again.chain(frame, self._chain)
            result = self._chain.track(frame, located)
            if self._again is not None:
                self._again.take_in(result)
            self._tracked.put((frame, result))

    def _draw(self) -> None:
        while (item := self._tracked.take()) is not None:
            frame, result = item
            picture = self._picture.draw(frame, result)
            captured = self._clock() if frame.captured is None else frame.captured
            self.times.frames.append(frame.index)
            self.times.captured.append(captured)
            self.times.latency.append(self._clock() - captured)
            self.results.add(frame.index, frame.timestamp, _without_points(result))
            for sink in self._sinks:
                sink.show(frame, picture)


def _without_points(result: FrameResult) -> FrameResult:
    if result.estimate is None:
        return result
    return replace(result, estimate=replace(result.estimate, residuals=np.empty((0, 2))))
