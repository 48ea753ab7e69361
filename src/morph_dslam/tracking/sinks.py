"""What a session hands to its sinks, and sinks that show pictures: a video, and browsers on this computer."""

from __future__ import annotations

import csv
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from http import HTTPStatus
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import TrackingError
from morph_dslam.io.access import split_target
from morph_dslam.io.local_server import LocalHandler, local_server
from morph_dslam.io.video import VideoWriter
from morph_dslam.sources import Frame
from morph_dslam.sources.local_socket import SocketCamera
from morph_dslam.tracking.repeated_pictures import RepeatedPictures
from morph_dslam.tracking.result import FrameResult


@dataclass(frozen=True)
class TrackedFrame:
    """What the sinks of a session get.

    Attributes
    ----------
    frames : by camera, of one instant.
    results : by object.
    picture : (h, w, 3), the first camera's frame with the objects drawn over it; None if nothing is drawn.
    latency_s : from the capture of a live frame until its picture was finished, seconds; 0 in a recording.
    """

    frames: tuple[Frame, ...]
    results: dict[str, FrameResult]
    picture: NDArray[np.uint8] | None = None
    latency_s: float = 0.0

    @property
    def frame(self) -> Frame:
        """Of the first camera."""
        return self.frames[0]


#: Takes each tracked frame: a function, a run folder, a video, a browser.
Sink = Callable[[TrackedFrame], object]


@dataclass
class LiveTimes:
    """A sink: when frames were captured and how long it took until they were drawn; tells of a frozen camera.

    Attributes
    ----------
    frames : (f,) numbers.
    captured : (f,) seconds of `time.monotonic`.
    latency : (f,) seconds until the picture was finished.
    """

    frames: list[int] = field(default_factory=list)
    captured: list[float] = field(default_factory=list)
    latency: list[float] = field(default_factory=list)
    _repeated: RepeatedPictures = field(default_factory=partial(RepeatedPictures, tells=True), repr=False)

    def __call__(self, tracked: TrackedFrame) -> None:
        self._repeated.add(tracked.frame)
        self.frames.append(tracked.frame.index)
        self.captured.append(tracked.frame.captured or 0.0)
        self.latency.append(tracked.latency_s)

    @property
    def fps(self) -> float:
        """Pictures a second."""
        if len(self.captured) < 2:
            return 0.0
        return (len(self.captured) - 1) / max(self.captured[-1] - self.captured[0], 1e-9)

    def latency_ms(self, percentile: float) -> float:
        """A percentile of the latency, milliseconds; NaN where nothing was drawn."""
        return 1e3 * float(np.percentile(self.latency, percentile)) if self.latency else float("nan")

    def figures(self) -> dict[str, float]:
        """For the summary of a run."""
        return {"fps": self.fps, "latency_median_ms": self.latency_ms(50), "latency_p95_ms": self.latency_ms(95)}

    def write(self, path: Path) -> None:
        """Write when each frame was captured, and its latency, as a table."""
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["frame", "captured_s", "latency_ms"])
            for frame, captured, latency in zip(self.frames, self.captured, self.latency, strict=True):
                writer.writerow([frame, f"{captured - self.captured[0]:.6f}", f"{1e3 * latency:.3f}"])


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

    def __call__(self, tracked: TrackedFrame) -> None:
        """Write the picture as often as its time asks for."""
        assert tracked.picture is not None
        seconds = tracked.frame.timestamp
        self._start = seconds if self._start is None else self._start
        due = 1 + round((seconds - self._start) * self._fps)
        missing = due - self._written
        if not 0 < missing <= LONGEST_GAP * self._fps:
            # The clock stood still, or there was a long gap: go on from here.
            self._start, missing = seconds - self._written / self._fps, 1
        for _ in range(missing):
            self._writer.write(tracked.picture)
        self._written += missing


class SourceSink:
    """Sends pictures back to where their frames come from."""

    def __init__(self, source: SocketCamera) -> None:
        self._source = source

    def __call__(self, tracked: TrackedFrame) -> None:
        """Send the picture of a frame."""
        assert tracked.picture is not None
        self._source.show(tracked.frame.index, _jpeg(tracked.picture))


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
        self._jpeg, self._number, self._viewers, self._ended = b"", 0, 0, False
        self._server = local_server(port, partial(_Handler, self), TrackingError, "--serve")
        self.address = self._server.address
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

    def __call__(self, tracked: TrackedFrame) -> None:
        """Hand the picture to all who look."""
        if not self.is_watched or tracked.picture is None:
            return
        jpeg = _jpeg(tracked.picture)
        with self._changed:
            self._jpeg, self._number = jpeg, self._number + 1
            self._changed.notify_all()

    @property
    def is_watched(self) -> bool:
        """Whether a browser shows the pictures."""
        return self._viewers > 0

    def watch(self, delta: int) -> None:
        """Count who looks on."""
        with self._changed:
            self._viewers += delta
            self._changed.notify_all()

    def next_after(self, number: int) -> tuple[int, bytes]:
        """The number and JPEG of a picture newer than ``number``; waits for it. Empty at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > number or self._ended)
            return (number, b"") if self._ended else (self._number, self._jpeg)


def _jpeg(picture: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


class _Handler(LocalHandler):
    def __init__(self, sink: BrowserSink, *arguments) -> None:
        self._sink = sink
        super().__init__(*arguments)

    def answer(self) -> None:
        path, _ = split_target(self.path)
        if path == "/":
            self.begin("text/html; charset=utf-8")
            self.wfile.write(_PAGE)
        elif path == "/stream.mjpg":
            self._stream()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _stream(self) -> None:
        self.begin("multipart/x-mixed-replace; boundary=frame")
        self._sink.watch(1)
        try:
            number, jpeg = self._sink.next_after(0)
            while jpeg:
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                self.wfile.write(head.encode() + jpeg + b"\r\n")
                number, jpeg = self._sink.next_after(number)
        except ConnectionError:
            pass  # the page was closed
        finally:
            self._sink.watch(-1)
