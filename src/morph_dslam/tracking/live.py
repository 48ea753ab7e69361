"""A live session: each frame goes through three threads, and each of these always takes the newest.

One finds the camera in the map, one the objects, and one draws and records, so that while a frame is drawn
the next is tracked already. None waits for a later one; a frame that the next thread has no time for is
dropped. What is compiled, or OpenCV's, leaves the interpreter to the others.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol
from urllib.parse import urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import TrackingError
from morph_dslam.io.video import VideoWriter
from morph_dslam.sources import Frame
from morph_dslam.sources.live import LiveStream, Newest
from morph_dslam.threads import threads_side_by_side
from morph_dslam.tracking.drawing import AugmentedView, with_caption
from morph_dslam.tracking.result import FrameResult
from morph_dslam.tracking.run_folder import RunResults
from morph_dslam.tracking.setup import Reregistration
from morph_dslam.tracking.tracker import CameraLocalization, Tracker


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


class LiveChain(Protocol):
    """What finds objects in a frame, in two steps that take turns in two threads; see `Tracker`."""

    def locate(self, frame: Frame) -> Any: ...

    def track(self, frame: Frame, located: Any) -> Mapping[str, FrameResult]: ...


class OneObject:
    """The chain of one object by its name; ``again`` decides when it is placed anew, never by default."""

    def __init__(self, name: str, chain: Tracker, again: Reregistration | None = None) -> None:
        self._name, self._chain, self._again = name, chain, again

    def locate(self, frame: Frame) -> CameraLocalization:
        """See `Tracker.locate`."""
        return self._chain.locate(frame)

    def track(self, frame: Frame, located: CameraLocalization) -> dict[str, FrameResult]:
        """See `Tracker.track`."""
        if self._again is not None:
            self._chain = self._again.chain(frame, self._chain)
        result = self._chain.track(frame, located)
        if self._again is not None:
            self._again.take_in(result)
        return {self._name: result}


class LivePicture:
    """Draws a tracked frame: undistorted, with the objects over it, or the reason why one is not there.

    Parameters
    ----------
    views : by object, whose run folder it is called by; all of the same field, with one range of colours.
    """

    def __init__(self, camera: Camera, views: Mapping[str, AugmentedView]) -> None:
        ranges = np.array([view.range_of_box() for view in views.values()])
        self._views, self._limits = dict(views), (float(ranges[:, 0].min()), float(ranges[:, 1].max()))
        self._maps = camera.undistortion_maps()

    def draw(self, frame: Frame, results: Mapping[str, FrameResult]) -> NDArray[np.uint8]:
        """The picture, the nearest object over the others."""
        image, caption = frame.image, f"frame {frame.index}"
        if self._maps is not None:
            image = np.asarray(cv2.remap(image, *self._maps, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
        missing = {name: result.reason for name, result in results.items() if result.estimate is None}
        if missing and len(results) == 1:
            caption = f"{caption}: {next(iter(missing.values()))}"
        elif missing:
            caption = "; ".join([caption, *(f"{Path(name).name}: {why}" for name, why in missing.items())])
        if len(missing) == len(results):
            return with_caption(image, caption)
        found = [
            (self._views[name], result.estimate.state, result.discrepancy)
            for name, result in results.items()
            if result.estimate is not None
        ]
        for view, state, discrepancy in sorted(found, key=lambda one: -one[0].distance(one[1])):
            image = view.draw(image, state, self._limits, caption, discrepancy)
        return image


class LiveSession:
    """Tracks a live stream until it ends, or until `stop`.

    Parameters
    ----------
    runs : by object, get the results, without the residuals of single points: sessions are long.
    sinks : get the pictures, after the latency has been taken.
    """

    def __init__(
        self,
        stream: LiveStream,
        chain: LiveChain,
        picture: LivePicture,
        runs: Mapping[str, RunResults],
        sinks: Sequence[Sink] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._stream, self._chain, self._picture, self._clock = stream, chain, picture, clock
        self._sinks, self.runs, self.times = sinks, runs, LiveTimes()
        self._located: Newest[tuple[Frame, Any]] = Newest()
        self._tracked: Newest[tuple[Frame, Mapping[str, FrameResult]]] = Newest()
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

        An interrupt ends it too; what was found until then is in `runs` and `times`.
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
            self._tracked.put((frame, self._chain.track(frame, located)))

    def _draw(self) -> None:
        while (item := self._tracked.take()) is not None:
            frame, results = item
            picture = self._picture.draw(frame, results)
            captured = self._clock() if frame.captured is None else frame.captured
            self.times.frames.append(frame.index)
            self.times.captured.append(captured)
            self.times.latency.append(self._clock() - captured)
            for name, result in results.items():
                self.runs[name].add(frame.index, frame.timestamp, _without_points(result))
            for sink in self._sinks:
                sink.show(frame, picture)


def _without_points(result: FrameResult) -> FrameResult:
    if result.estimate is None:
        return result
    return replace(result, estimate=replace(result.estimate, residuals=np.empty((0, 2))))


# Where finished pictures go: into a video, and to browsers on this computer.


HOST = "127.0.0.1"

JPEG_QUALITY = 80

#: A gap in the frames longer than this, seconds, is not filled in the video.
LONGEST_GAP = 2.0

_PAGE = b"""<!doctype html><title>morph live</title>
<body style="margin:0;background:#222;text-align:center">
<img src="/stream.mjpg" style="max-width:100%">
"""


class VideoSink:
    """Records pictures at a fixed rate; where frames were dropped the last picture stays."""

    def __init__(self, writer: VideoWriter, fps: float) -> None:
        self._writer, self._fps = writer, fps
        self._start: float | None = None
        self._written = 0

    def show(self, frame: Frame, picture: NDArray[np.uint8]) -> None:
        """Write the picture (h, w, 3) as often as its time asks for."""
        self._start = frame.timestamp if self._start is None else self._start
        due = 1 + round((frame.timestamp - self._start) * self._fps)
        missing = due - self._written
        if not 0 < missing <= LONGEST_GAP * self._fps:
            # The clock stood still, or there was a long gap: go on from here.
            self._start, missing = frame.timestamp - self._written / self._fps, 1
        for _ in range(missing):
            self._writer.write(picture)
        self._written += missing


class BrowserSink:
    """Shows pictures to browsers on this computer, as motion JPEG; a context manager.

    Pictures are only encoded while somebody looks at them, and who is slow gets fewer.

    Raises
    ------
    TrackingError
        If the port cannot be taken; 0 takes any free one.
    """

    def __init__(self, port: int) -> None:
        self._changed = threading.Condition()
        self._jpeg, self._number, self._lookers, self._ended = b"", 0, 0, False
        try:
            self._server = _Server((HOST, port), partial(_Handler, self))
        except (OSError, OverflowError) as error:
            raise TrackingError(
                f"port {port} cannot be taken ({error}); choose another with --serve; 0 takes any free one"
            ) from error
        self.address = f"http://{HOST}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, name="browser", daemon=True)

    def __enter__(self) -> BrowserSink:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()

    def show(self, frame: Frame, picture: NDArray[np.uint8]) -> None:
        """Hand the picture (h, w, 3) to all who look."""
        if not self._lookers:
            return
        _, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        with self._changed:
            self._jpeg, self._number = jpeg.tobytes(), self._number + 1
            self._changed.notify_all()

    def look(self, delta: int) -> None:
        """Count who looks on."""
        with self._changed:
            self._lookers += delta
            self._changed.notify_all()

    def wait_for_looker(self, seconds: float) -> bool:
        """Wait until somebody looks on; whether anybody does."""
        with self._changed:
            return self._changed.wait_for(lambda: self._lookers > 0, timeout=seconds)

    def next_after(self, number: int) -> tuple[int, bytes]:
        """The number and JPEG of a picture newer than ``number``; waits for it. Empty at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > number or self._ended)
            return (number, b"") if self._ended else (self._number, self._jpeg)


class _Handler(BaseHTTPRequestHandler):
    def __init__(self, sink: BrowserSink, *arguments) -> None:
        self._sink = sink
        super().__init__(*arguments)

    def do_GET(self) -> None:
        # Else a page from elsewhere could look on under a name of its own for this address.
        if urlsplit(f"//{self.headers.get('Host', '')}").hostname not in (HOST, "localhost"):
            self.send_error(HTTPStatus.FORBIDDEN)
        elif self.path == "/":
            self._begin("text/html; charset=utf-8")
            self.wfile.write(_PAGE)
        elif self.path == "/stream.mjpg":
            self._stream()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _begin(self, content_type: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", content_type)
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()

    def _stream(self) -> None:
        self._begin("multipart/x-mixed-replace; boundary=frame")
        self._sink.look(1)
        try:
            number, jpeg = self._sink.next_after(0)
            while jpeg:
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                self.wfile.write(head.encode() + jpeg + b"\r\n")
                number, jpeg = self._sink.next_after(number)
        except ConnectionError:
            pass  # the page was closed
        finally:
            self._sink.look(-1)

    def log_message(self, format: str, *args) -> None:
        """Nothing: requests are no news."""


class _Server(ThreadingHTTPServer):
    daemon_threads = True
