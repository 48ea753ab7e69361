"""Where finished pictures go: into a video, and to browsers on this computer."""

from __future__ import annotations

import threading
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from urllib.parse import urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import TrackingError
from morph_dslam.io.video import VideoWriter
from morph_dslam.sources import Frame

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
