"""A video file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from morph_dslam.errors import SourceError
from morph_dslam.io.file_kinds import file_kind
from morph_dslam.sources.frames import Frame, check_range, frame_rate, open_capture

#: Containers that only estimate their length from its duration are off by so many frames without damage.
LENGTH_TOLERANCE = 1
#: Containers that declare the number of frames; an edit list of an mp4 file may leave some of them out.
_COUNTED = (".mp4", ".mov", ".avi")
#: What FFmpeg calls the codecs by which it draws text as pictures: it takes any text for these if its name ends so.
_DRAWN_TEXT = tuple(cv2.VideoWriter.fourcc(*name) for name in ("ansi", "bint", "xbin"))


def _open(path: Path) -> cv2.VideoCapture:
    capture = open_capture(str(path))
    if not capture.isOpened():
        raise SourceError(
            f"{path} cannot be opened as a video: it is damaged, cut short before its index, or of a kind "
            "that OpenCV does not read; copy it again or convert it to mp4"
        )
    if int(capture.get(cv2.CAP_PROP_FOURCC)) in _DRAWN_TEXT:
        capture.release()
        raise SourceError(f"{path} holds text and no video: name a video file, or a folder of images")
    return capture


def _count_and_rate(path: Path, capture: cv2.VideoCapture) -> tuple[int, float]:
    """The declared number of frames and their rate; counted, and taken from the times, where they are not declared.

    Matroska and WebM, which browsers record, and MPEG streams have a duration alone: where frames were dropped,
    OpenCV's count is wrong.
    """
    count, fps = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0), frame_rate(capture)
    has_count = file_kind(path) in _COUNTED
    if count and has_count:
        return count, fps
    count, last = 0, 0.0
    while capture.grab():
        count, last = count + 1, 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC)
    if count == 0:
        raise SourceError(f"{path} holds no frames")
    return count, (count - 1) / last if not has_count and count > 1 and last > 0.0 else fps


def _is_cut_short(path: Path) -> bool:
    """Whether the boxes of an mp4 file (ISO 14496-12), or the chunks of an AVI file, reach beyond its end."""
    is_avi, size, start = file_kind(path) == ".avi", path.stat().st_size, 0
    with path.open("rb") as file:
        while start + 8 <= size:
            file.seek(start)
            head = file.read(16)
            length = 8 + int.from_bytes(head[4:8], "little") if is_avi else int.from_bytes(head[:4], "big")
            if not is_avi and length == 0:
                return False  # it reaches to the end of the file
            if not is_avi and length == 1:
                length = int.from_bytes(head[8:16], "big")
            if length < 8 or start + length > size:
                return True
            start += length + (length % 2 if is_avi else 0)
    return False


class VideoFile:
    """A video file as a `FrameSource`; frames are numbered by their position from 0."""

    def __init__(self, path: Path, first: int | None = None, last: int | None = None) -> None:
        capture = _open(path)
        try:
            self._declared, self.fps = _count_and_rate(path, capture)
            #: By how many degrees frames are turned to be shown: 0, 90 to either side, or 180.
            self.turned_deg = {180: 180, 90: 90, 270: 90}.get(
                round(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360, 0
            )
        finally:
            capture.release()
        self._path, self._open_ended, self.name = path, last is None, str(path)
        self._first, self._last = check_range(path, range(self._declared), first, last)

    def __len__(self) -> int:
        return self._last - self._first + 1

    def __iter__(self) -> Iterator[Frame]:
        capture = _open(self._path)
        try:
            # Decoding from the start is exact; seeking lands on the nearest key frame in some containers.
            for index in range(self._last + 1):
                decoded, image = capture.read() if index >= self._first else (capture.grab(), None)
                if not decoded:
                    self._check_end(index)
                    return
                if image is not None:
                    yield Frame(index, self._timestamp(capture, index), np.asarray(image, dtype=np.uint8))
        finally:
            capture.release()

    def _timestamp(self, capture: cv2.VideoCapture, index: int) -> float:
        """Seconds since frame 0, by the container if it has times: telephones film at a varying rate."""
        milliseconds = capture.get(cv2.CAP_PROP_POS_MSEC)
        return 1e-3 * milliseconds if milliseconds > 0.0 else index / self.fps

    def _check_end(self, index: int) -> None:
        """Raise SourceError unless the stream may well end before frame ``index``."""
        near = self._declared - index <= LENGTH_TOLERANCE
        is_whole = file_kind(self._path) in _COUNTED and not _is_cut_short(self._path)
        if self._open_ended and index > 0 and (near or is_whole):
            return
        if index > 0 and is_whole:
            raise SourceError(f"{self._path} ends with frame {index - 1}: choose a range of frames up to that")
        raise SourceError(
            f"{self._path} breaks off at frame {index}, though it declares {self._declared} frames: "
            "it is cut short or damaged; copy it again, or choose a range of frames before the break"
        )
