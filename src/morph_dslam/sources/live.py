"""A live camera, which waits for nobody: of the frames that come during work on one the newest is kept."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SourceError
from morph_dslam.sources.frames import Frame


class Capture(Protocol):
    """What is needed of `cv2.VideoCapture`."""

    def read(self) -> tuple[bool, NDArray | None]: ...

    def get(self, propId: int) -> float: ...

    def release(self) -> None: ...


def open_webcam(device: int) -> LiveCamera:
    """Open webcam number ``device``.

    Raises
    ------
    SourceError
        If there is none, or another program holds it.
    """
    capture = cv2.VideoCapture(device)
    if not capture.isOpened():
        raise SourceError(
            f"webcam {device} cannot be opened: check that it is plugged in, that no other program uses it, "
            "and that you may read /dev/video*"
        )
    return LiveCamera(capture, f"webcam {device}")


class LiveCamera:
    """A `FrameStream` that a thread reads without pause, so that each frame handed out is the newest.

    A context manager: leaving it stops the thread and frees the device. Frames are numbered as they come, so
    a dropped frame leaves a gap; timestamps are seconds since the first.

    Attributes
    ----------
    dropped : number of frames so far that came while another was worked on.
    """

    def __init__(
        self, capture: Capture, name: str = "camera", clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.name = name
        fps = capture.get(cv2.CAP_PROP_FPS)
        self.fps = fps if np.isfinite(fps) and fps > 0 else 30.0
        self.dropped = 0
        self._capture = capture
        self._clock = clock
        self._changed = threading.Condition()
        self._newest: Frame | None = None
        self._ended = False
        self._closing = False
        self._thread = threading.Thread(target=self._read, name=f"{name} reader", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        index, start = 0, 0.0
        while not self._closing:
            delivered, image = self._capture.read()
            now = self._clock()
            if not delivered or image is None:
                break
            start = now if index == 0 else start
            # Captures may hand out the same memory again.
            frame = Frame(index, now - start, np.array(image, dtype=np.uint8))
            with self._changed:
                self.dropped += self._newest is not None
                self._newest = frame
                self._changed.notify()
            index += 1
        with self._changed:
            self._ended = True
            self._changed.notify()

    def __iter__(self) -> Iterator[Frame]:
        last = None
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None or self._ended)
                frame, self._newest = self._newest, None
            if frame is None:
                if self._closing:
                    return
                after = "before the first frame" if last is None else f"after frame {last}"
                raise SourceError(f"{self.name} stopped delivering {after}: check its cable")
            last = frame.index
            yield frame

    def close(self) -> None:
        """Stop reading and free the device; iterating ends."""
        self._closing = True
        # A read that hangs in a broken driver must not hang the program; its thread is a daemon.
        self._thread.join(timeout=2.0)
        if not self._thread.is_alive():
            self._capture.release()

    def __enter__(self) -> LiveCamera:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
