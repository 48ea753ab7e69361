"""Frames, what a source of frames offers, and reading image files."""

from __future__ import annotations

import operator
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SourceError
from morph_dslam.io.file_kinds import IMAGES, content_kind, file_kind, named_kind

#: Frames per second where a recording does not tell it.
ASSUMED_FPS = 30.0
#: No time in seconds is later, nor a negative one earlier: nanoseconds or milliseconds since 1970 are.
LATEST_S = 9e9
#: The bytes with which a complete picture of this kind ends; the decoder itself fills what is missing with grey.
_END_MARKERS = {".png": b"IEND", ".jpg": b"\xff\xd9"}


@dataclass(frozen=True)
class Frame:
    """One image of a sequence.

    Attributes
    ----------
    index : its number in the sequence
    timestamp : seconds, by the recording's clock where it has one, else since frame 0
    image : (h, w, 3) uint8, blue, green, red
    depth : (h, w) metres along the optical axis, NaN or 0 where not measured; None without a depth camera
    right : (h, w, 3) uint8, image of the right camera of a stereo pair; None without one
    captured : when a live frame came, seconds of `time.monotonic`; None in a recording

    Raises
    ------
    SourceError
        If the number is not whole.
    """

    index: int
    timestamp: float
    image: NDArray[np.uint8]
    depth: NDArray[np.float32] | None = None
    right: NDArray[np.uint8] | None = None
    captured: float | None = None

    def __post_init__(self) -> None:
        # Numbers of numpy become Python's own: JSON, of which streams and summaries are made, knows no others.
        try:
            object.__setattr__(self, "index", operator.index(self.index))
        except TypeError as error:
            raise SourceError(f"a frame has the number {self.index!r}: give a whole number") from error
        for name in ("timestamp", "captured"):
            if isinstance(seconds := getattr(self, name), Real):  # `check_time` refuses others
                object.__setattr__(self, name, float(seconds))


class MissingFrame(Frame):
    """Stands for the picture that a camera of a rig lacks of an instant, and others have; its image is black."""


class FrameStream(Protocol):
    """Frames one after the other, recorded or live.

    One whose frames have depth that belongs to their pixels says so by ``has_registered_depth = True``.
    """

    name: str
    fps: float

    def __iter__(self) -> Iterator[Frame]: ...


@runtime_checkable
class FrameSource(FrameStream, Protocol):
    """A recorded sequence of frames, which can be iterated more than once and drops none."""

    def __len__(self) -> int:
        """Number of frames expected; fewer may come when a video is cut short, and then SourceError."""
        ...


def usual_rate(timestamps: Sequence[float]) -> float:
    """Frames per second by the median time between two; 1 for a single frame."""
    gaps = np.diff(timestamps)
    return float(1.0 / np.median(gaps)) if len(gaps) and np.median(gaps) > 0.0 else 1.0


def check_frame(frame: object, before: Frame | None, source: str) -> None:
    """Raise SourceError unless a source gives a frame, with a larger number than the frame before it."""
    after = "at first" if before is None else f"after frame {before.index}"
    if not isinstance(frame, Frame):
        raise SourceError(f"{source} gives an object of type {type(frame).__name__} {after}: give md.Frame objects")
    if before is not None and not frame.index > before.index:
        raise SourceError(f"{source} gives frame {frame.index} {after}: number frames in the order in which they come")
    check_time(frame, f"{source}: frame {frame.index}")


def check_time(frame: Frame, what: str) -> None:
    """Raise SourceError unless a frame's time is a number of seconds; the message begins with ``what``."""
    time: object = frame.timestamp
    if time is None:
        raise SourceError(f"{what} has no timestamp: give its time in seconds")
    if not isinstance(time, Real) or not np.isfinite(float(time)):
        raise SourceError(f"{what} has the timestamp {time!r}: give its time in seconds, as a finite number")
    if abs(float(time)) > LATEST_S:
        raise SourceError(f"{what} has the timestamp {time!r}, which is no time in seconds: convert it to seconds")


class CheckedStream:
    """The frames of a source, each checked as it comes; all else is the source's own.

    Attributes
    ----------
    name : of the source.
    fps : frames per second.
    """

    def __init__(self, stream: FrameStream) -> None:
        self._stream, self.name, self.fps = stream, stream.name, stream.fps

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def __iter__(self) -> Iterator[Frame]:
        before = None
        for frame in self._stream:
            check_frame(frame, before, self.name)
            before = frame
            yield frame


class CheckedSource(CheckedStream):
    """That of a recording, which has a length."""

    _stream: FrameSource

    def __len__(self) -> int:
        return len(self._stream)


def has_depth(source: FrameStream) -> bool:
    """Whether frames come with depth, which belongs to their pixels or not."""
    return has_registered_depth(source) or bool(getattr(source, "has_depth", False))


def has_registered_depth(source: FrameStream) -> bool:
    """Whether frames come with depth that belongs to their pixels."""
    return bool(getattr(source, "has_registered_depth", False))


def notes_of_source(source: object, readout_s: float = 0.0) -> tuple[str, ...]:
    """What a reader of the results must know of the frames, in words; with the readout time of their camera."""
    notes, degrees = [], getattr(source, "turned_deg", 0)
    name = getattr(source, "name", "the recording")
    if degrees == 180:
        notes.append(
            f"{name} is marked as upside down and is read the right way up: the camera file has to be of pictures that "
            "are read so too, or its principal point is mirrored (docs/cameras.md)"
        )
    if degrees and readout_s:
        notes.append(
            f"{name} is marked to be shown turned, and is read so: its rows are not those of the camera, which "
            "readout_s counts; leave that out, or record without the mark (docs/cameras.md)"
        )
    if readout_s and getattr(source, "has_assumed_times", False):
        notes.append(
            f"nothing tells the times of the frames: {ASSUMED_FPS:g} a second are assumed, and readout_s of the camera "
            "file counts by them, as does what is said of the camera; give the right number with --fps"
        )
    return tuple(notes)


def check_range(where: Path, available: range, first: int | None, last: int | None) -> tuple[int, int]:
    """The wanted range with its open ends filled in.

    Raises SourceError if ``where``, whose frame numbers span ``available``, does not hold both ends.
    """
    low, high = available[0], available[-1]
    for wanted in (first, last):
        if wanted is not None and wanted not in available:
            raise SourceError(f"frame {wanted} is not in {where}, which has frames {low}-{high}")
    return (low if first is None else first), (high if last is None else last)


def check_size(image: NDArray, size: tuple[int, int] | None, what: str) -> tuple[int, int]:
    """The size (height, width) of an image; SourceError if it is not that of the frames before."""
    height, width = image.shape[:2]
    if size is not None and (height, width) != size:
        raise SourceError(f"{what} is {width}x{height} pixels, the frames before it are {size[1]}x{size[0]}")
    return height, width


#: Values of 16 bits with which cameras say that they measured nothing: 0, or the largest one, as Kinect drivers do.
NO_DEPTH = (0, 65535)


@dataclass(frozen=True)
class DepthScale:
    """How a recording stores depth.

    Attributes
    ----------
    values_per_metre : of the stored whole numbers
    registered : whether depth pixels belong to the colour pixels of the same row and column
    """

    values_per_metre: float
    registered: bool = True


def image_files(folder: Path) -> list[Path]:
    """The images in a folder, by name: those that are called so or, without any, those that are some; none hidden."""
    files = [path for path in sorted(folder.iterdir()) if path.is_file() and not path.name.startswith(".")]
    return [path for path in files if named_kind(path) in IMAGES] or [f for f in files if file_kind(f) in IMAGES]


def read_image(path: Path, what: str) -> NDArray[np.uint8]:
    """Read an image (h, w, 3) uint8 as blue, green, red, turned as its EXIF data say.

    Raises SourceError if the file is missing, cut short or not an image; the message begins with ``what``.
    """
    return np.asarray(_decode(path, what, cv2.IMREAD_COLOR), dtype=np.uint8)


def turned_deg(path: Path, what: str) -> int:
    """By how many degrees an image is turned to be shown: 0, 90 to either side, or 180."""
    # A JPEG at an eighth of its size, which takes a fraction of the time; others would be decoded whole for that, too.
    size = cv2.IMREAD_REDUCED_GRAYSCALE_8 if file_kind(path) == ".jpg" else cv2.IMREAD_GRAYSCALE
    stored, shown = (_decode(path, what, size | flag) for flag in (cv2.IMREAD_IGNORE_ORIENTATION, 0))
    if shown.shape != stored.shape or any(np.array_equal(shown, np.rot90(stored, k)) for k in (1, -1)):
        return 0 if np.array_equal(shown, stored) else 90
    return 0 if np.array_equal(shown, stored) else 180


def read_depth(path: Path, what: str, scale: DepthScale) -> NDArray[np.float32]:
    """Read a depth image (h, w) of one channel of 16 bits in metres, NaN where no depth was measured: `NO_DEPTH`."""
    stored = _decode(path, what, cv2.IMREAD_UNCHANGED)
    if stored.ndim != 2 or stored.dtype != np.uint16:
        raise SourceError(f"{what}: {path} is not a depth image, which has one channel of 16 bits")
    depth = stored.astype(np.float32) / np.float32(scale.values_per_metre)
    depth[(stored == NO_DEPTH[0]) | (stored == NO_DEPTH[1])] = np.nan
    return depth


def _decode(path: Path, what: str, flags: int) -> NDArray:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{what}: cannot read {path}: {error.strerror}") from error
    marker = _END_MARKERS.get(content_kind(data) or "")
    # Behind the picture more may follow: phones put a short video there.
    if marker and data.find(marker, _start_of_scan(data) if marker == _END_MARKERS[".jpg"] else 0) < 0:
        raise SourceError(f"{what}: {path} is cut short: copy it again")
    image = decoded(data, flags)
    if image is None:
        raise SourceError(f"{what}: {path} cannot be decoded as an image")
    return image


def decoded(data: bytes, flags: int = cv2.IMREAD_COLOR) -> NDArray | None:
    """An encoded image (h, w) or (h, w, channels), as ``flags`` of OpenCV ask for it; None where it is none."""
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if len(data) else None
    except cv2.error:  # a damaged head may state more pixels than OpenCV reads
        return None
    return None if image is None else np.asarray(image)


def _start_of_scan(data: bytes) -> int:
    """Where the first scan of a JPEG file begins (ITU T.81, B.1.1): segments before it may hold a preview."""
    place = 2
    while data[place : place + 1] == b"\xff" and data[place + 1 : place + 2] != b"\xda":
        is_fill = data[place + 1 : place + 2] == b"\xff"
        place += 1 if is_fill else 2 + max(int.from_bytes(data[place + 2 : place + 4], "big"), 2)
    return place


#: How long a camera on the network may take to answer, and then for a frame, milliseconds.
NETWORK_TIMEOUT_MS = 10_000


def open_capture(source: str | int, is_remote: bool = False) -> cv2.VideoCapture:
    """A video file, a webcam by its number, or what a URL leads to; see its ``isOpened()``.

    What OpenCV and FFmpeg print is kept away. What ``is_remote`` is given up if it is silent for `NETWORK_TIMEOUT_MS`.
    """
    # FFmpeg's log level AV_LOG_QUIET; it is read once, when the first video is opened.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    with quiet_opencv():
        if not is_remote:
            return cv2.VideoCapture(source)
        limits = (cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, cv2.CAP_PROP_READ_TIMEOUT_MSEC)
        parameters = [number for limit in limits for number in (limit, NETWORK_TIMEOUT_MS)]
        return cv2.VideoCapture(str(source), cv2.CAP_FFMPEG, parameters)


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Keep away what OpenCV prints: a message of the program's own follows."""
    # Until 4.12 these functions were OpenCV's own, since then they are in a module.
    log: Any = getattr(cv2.utils, "logging", cv2)
    before = log.getLogLevel()
    log.setLogLevel(0)
    try:
        yield
    finally:
        log.setLogLevel(before)


def frame_rate(capture: Any) -> float:
    """Frames per second of a video or a webcam."""
    fps = capture.get(cv2.CAP_PROP_FPS)
    return fps if np.isfinite(fps) and fps > 0 else ASSUMED_FPS
