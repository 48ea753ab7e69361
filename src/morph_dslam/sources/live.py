"""Live sources, which wait for nobody: of the frames that come during work on one the newest is kept."""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SourceError
from morph_dslam.sources import frames as limits
from morph_dslam.sources.frames import Frame, FrameStream, frame_rate, has_registered_depth, open_capture, quiet_opencv

_LOG = logging.getLogger("morph_dslam")
Item = TypeVar("Item")
#: Frames that tell the times of the newest one.
REMEMBERED = 30
#: A frame farther from where the others have it, in seconds or as a share of the interval, does not tell times with
#: them: it is late, or the rate has changed.
MOST_OFF_S, MOST_OFF = 6e-3, 0.4
#: So many of these in a row begin anew.
BEGIN_ANEW = 2
#: Times are apart by this share of the interval at least; by so many seconds where that is not known.
LEAST_STEP, LEAST_SECONDS = 0.1, 1e-6
#: Seconds between two attempts to connect again.
AGAIN_S = 0.5
_WEBCAM = re.compile(r"(?:webcam:|/dev/video)(\d+)")
#: As a path, which has lost one of two slashes.
_URL = re.compile(r"(rtsps?|https?|rtmp|udp|tcp):/+(\S+)")


class Newest(Generic[Item]):
    """A place for one item: who takes always gets the newest, and what nobody took in time is dropped.

    Attributes
    ----------
    dropped : number of items so far that were replaced before anybody took them
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._changed = threading.Condition()
        self._item: Item | None = None
        self._ended = False
        self._error: BaseException | None = None

    def put(self, item: Item) -> None:
        """Leave an item, in place of one that is there still; never waits for a taker."""
        with self._changed:
            self.dropped += self._item is not None
            self._item = item
            self._changed.notify_all()

    def end(self, error: BaseException | None = None) -> None:
        """No more will come; takers get ``error``, if any, when nothing is left."""
        with self._changed:
            self._ended, self._error = True, error
            self._changed.notify_all()

    def take(self) -> Item | None:
        """Wait for an item and take it; None when no more will come, or the error with which they ended."""
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self._ended)
            item, self._item = self._item, None
            if item is None and self._error is not None:
                raise self._error
            return item


class Capture(Protocol):
    """What is needed of `cv2.VideoCapture`."""

    def isOpened(self) -> bool: ...

    def read(self) -> tuple[bool, NDArray | None]: ...

    def get(self, propId: int) -> float: ...

    def release(self) -> None: ...


class LiveStream:
    """A `FrameStream` that a thread reads without pause, so that each frame handed out is the newest.

    A context manager: leaving it stops the thread. Frames have the time at which they were captured.
    """

    def __init__(self, name: str, fps: float) -> None:
        self.name, self.fps = name, fps
        self.closing = False
        self._newest: Newest[Frame] = Newest()
        self._thread = threading.Thread(target=self._read_all, name=f"{name} reader", daemon=True)

    @property
    def dropped(self) -> int:
        """Number of frames so far that came while another was worked on."""
        return self._newest.dropped

    def read(self) -> Iterator[Frame]:
        """The frames as they come; runs in the thread."""
        raise NotImplementedError

    def release(self) -> None:
        """Free what was read from."""

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def _read_all(self) -> None:
        try:
            for frame in self.read():
                self._newest.put(frame)
                if self.closing:
                    break
        except Exception as error:  # told in the thread that takes the frames
            self._newest.end(error)
        else:
            self._newest.end()

    def __iter__(self) -> Iterator[Frame]:
        while (frame := self._newest.take()) is not None:
            yield frame

    def close(self) -> None:
        """Stop reading and free what was read from; iterating ends."""
        self.closing = True
        # A read that hangs in a broken driver must not hang the program; its thread is a daemon.
        self._thread.join(timeout=2.0)
        if not self._thread.is_alive():
            self.release()
        self._newest.end()

    def __enter__(self) -> LiveStream:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class SteadyTimes:
    """Smooths the times at which frames come.

    A camera records in even intervals, but a frame is received some milliseconds late, now more and now less, and a
    velocity from two frames would have that as an error. The time of a frame is that of the line that fits the last
    `REMEMBERED` ones best, which counts on where frames are dropped. A frame that is not near the line has the time at
    which it was received, and so have those after it until a line holds again: no time is moved by more than
    `MOST_OFF_S`, but for what lets times increase where several frames come at once.
    """

    def __init__(self) -> None:
        # Pairs of a frame's number and when it was received: those of the line, and those in a row that are off it.
        self._on_line: deque[tuple[int, float]] = deque(maxlen=REMEMBERED)
        self._off_line: list[float] = []
        self._last = -np.inf

    def add(self, received: float) -> float:
        """The time of the next frame, by when it was received, seconds."""
        time, interval = self._smoothed(received)
        self._last = max(time, self._last + (LEAST_STEP * interval or LEAST_SECONDS))
        return self._last

    def _smoothed(self, received: float) -> tuple[float, float]:
        """The time of the next frame, and the interval; that is 0 where it is not known yet."""
        offset, interval = self._line()
        number = self._on_line[-1][0] if self._on_line else 0
        if interval <= 0.0:
            self._on_line.append((number + 1, received))
            return received, 0.0
        number += max(round((received - offset) / interval - number), 1)
        near = min(MOST_OFF_S, MOST_OFF * interval)
        if abs(received - offset - interval * number) > near:
            self._off_line.append(received)
            if len(self._off_line) >= BEGIN_ANEW:
                self._on_line, self._off_line = deque(enumerate(self._off_line), REMEMBERED), []
            return received, interval
        self._off_line.clear()
        self._on_line.append((number, received))
        offset, interval = self._line()
        return offset + interval * number, interval

    def _line(self) -> tuple[float, float]:
        """The time of number 0 on the line, and the interval; 0 where that is not known."""
        if len(self._on_line) < 2:
            return 0.0, 0.0
        numbers, received = np.array(self._on_line).T
        away = numbers - numbers.mean()
        interval = float(away @ (received - received.mean()) / (away @ away))
        return float(received.mean() - interval * numbers.mean()), interval


class LiveCamera(LiveStream):
    """A camera. Frames are numbered as they come, so a dropped frame leaves a gap.

    Timestamps are seconds since the first frame, without the jitter of when frames come.

    Parameters
    ----------
    capture : that delivers the frames.
    name : for messages.
    clock : gives the time, seconds.
    advice : what to do where it stops delivering.
    reopen : connects again where it stops delivering, until the last frame is `NETWORK_TIMEOUT_MS` old; None for a
        camera that has no connection.
    """

    def __init__(
        self,
        capture: Capture,
        name: str = "camera",
        clock: Callable[[], float] = time.monotonic,
        advice: str = "check its cable",
        reopen: Callable[[], Capture] | None = None,
    ) -> None:
        super().__init__(name, frame_rate(capture))
        self._capture, self._clock, self._advice, self._reopen = capture, clock, advice, reopen
        self.start()

    def read(self) -> Iterator[Frame]:
        index, start, now, times = 0, 0.0, 0.0, SteadyTimes()
        while not self.closing:
            with quiet_opencv():  # it says when a camera on the network has been silent for too long
                delivered, image = self._capture.read()
            if not delivered or image is None:
                after = f"after frame {index - 1}" if index else "before the first frame"
                what = f"{self.name} stopped delivering {after}"
                image = self._image_after_reconnection(now, what) if index else None
                if self.closing:
                    return
                if image is None:
                    raise SourceError(f"{what}: {self._advice}")
            now = self._clock()
            start = now if index == 0 else start
            # Captures may hand out the same memory again.
            yield Frame(index, times.add(now - start), np.array(image, dtype=np.uint8), captured=now)
            index += 1

    def _image_after_reconnection(self, last: float, what: str) -> NDArray | None:
        """The first image of another connection; None where there is none in time.

        Parameters
        ----------
        last : when the last frame came, seconds.
        what : has happened, for the log.
        """
        patience = 1e-3 * limits.NETWORK_TIMEOUT_MS
        is_told = False
        while self._reopen is not None and not self.closing and self._clock() - last < patience:
            if not is_told:
                _LOG.warning("%s: connecting again, for %g seconds at most ...", what, patience)
                is_told = True
            self._capture.release()
            self._capture = self._reopen()
            if self._capture.isOpened():
                with quiet_opencv():
                    delivered, image = self._capture.read()
                if delivered and image is not None:
                    return image
            time.sleep(AGAIN_S)
        return None

    def release(self) -> None:
        self._capture.release()


def is_camera(path: Path) -> bool:
    """Whether it is written like `webcam:0`, `/dev/video0` or `rtsp://address`."""
    return _WEBCAM.fullmatch(str(path)) is not None or _URL.fullmatch(str(path)) is not None


def open_camera(path: Path, first: int | None = None, last: int | None = None) -> LiveCamera:
    """Open a webcam by its number, or a camera on the network.

    Raises
    ------
    SourceError
        If it is not there, is in use, does not answer, or a range is asked for.
    """
    if first is not None or last is not None:
        raise SourceError(f"{_without_password(str(path))} is live and has no range of frames to choose from")
    if url := _URL.fullmatch(str(path)):
        return _open_address(f"{url[1]}://{url[2]}")
    webcam = _WEBCAM.fullmatch(str(path))
    assert webcam is not None
    device = int(webcam[1])
    capture = open_capture(device)
    if not capture.isOpened():
        raise SourceError(
            f"webcam {device} cannot be opened: check that it is plugged in, that no other program uses it, "
            "and that you may read /dev/video*"
        )
    return LiveCamera(capture, f"webcam {device}")


def _open_address(url: str) -> LiveCamera:
    capture = open_capture(url, is_remote=True)
    name = _without_password(url)
    if not capture.isOpened():
        raise SourceError(
            f"no video comes from {name}: check the address, its user and password, and that the camera is on and in "
            "this network"
        )
    # A film on a server has a length, and would begin again.
    ends = capture.get(cv2.CAP_PROP_FRAME_COUNT) > 0
    reopen = None if ends else partial(open_capture, url, is_remote=True)
    return LiveCamera(capture, name, advice="check the network, and that the camera is on", reopen=reopen)


def _without_password(url: str) -> str:
    """A URL, or one as a path, for messages."""
    return re.sub(r"(:/+)[^/@]*@", r"\1", url)


class PacedRecording(LiveStream):
    """A recording that plays as if it were live: each frame comes when its time has come.

    It begins with the first frame taken, and ends with the last one.
    """

    def __init__(
        self,
        source: FrameStream,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(source.name, source.fps)
        self._source, self._clock, self._sleep = source, clock, sleep
        self.has_registered_depth = has_registered_depth(source)
        self.depth_off_s = getattr(source, "depth_off_s", None)
        self.has_assumed_times = getattr(source, "has_assumed_times", False)
        self.turned_deg = getattr(source, "turned_deg", 0)

    def read(self) -> Iterator[Frame]:
        first: tuple[float, float] | None = None
        for frame in self._source:
            if self.closing:
                return
            first = first or (self._clock(), frame.timestamp)
            wait = first[0] + frame.timestamp - first[1] - self._clock()
            if wait > 0.0:
                self._sleep(wait)
            yield replace(frame, captured=self._clock())

    def __iter__(self) -> Iterator[Frame]:
        if self._thread.ident is None:
            self.start()
        return super().__iter__()

    def close(self) -> None:
        if self._thread.ident is not None:
            super().close()
