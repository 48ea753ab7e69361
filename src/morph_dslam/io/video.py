"""Writing video files."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SourceError
from morph_dslam.interrupts import WaitingInterrupts
from morph_dslam.sources.frames import open_capture

_LOG = logging.getLogger("morph_dslam")
#: MPEG-4 part 2: the wheels of OpenCV carry no H.264 encoder, and their VP9 takes 120 ms a frame.
CODEC = "mp4v"


class VideoWriter:
    """An mp4 file written frame by frame, as a context manager.

    Frames go to a file beside ``path``; leaving the context, by an exception or an interrupt as well,
    completes it and gives it its name, so that what was written until then plays. Without a single frame an older
    file stays; where none can be read back no file is left.

    Parameters
    ----------
    path : where the video goes; a file of that name is replaced.
    fps : frames per second.
    size : (width, height) in pixels.

    Raises
    ------
    SourceError
        On entering the context, if no video can be written there; on leaving it, if frames are missing in the file, as
        on a full disk. Where another exception leaves the context, that goes on and this is logged.
    """

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        self._path = Path(path)
        self._partial = self._path.with_name(f"{self._path.stem}.partial.mp4")
        self._fps = fps
        self._size = size
        self._writer: cv2.VideoWriter | None = None
        self.n_frames = 0

    def __enter__(self) -> VideoWriter:
        if not self._path.parent.is_dir():
            raise SourceError(f"cannot write the video {self._path}: there is no folder {self._path.parent}")
        codec = cv2.VideoWriter.fourcc(*CODEC)
        writer = cv2.VideoWriter(str(self._partial), codec, float(self._fps), self._size)
        if not writer.isOpened():
            raise SourceError(
                f"cannot write the video {self._path} ({self._size[0]}x{self._size[1]}, {self._fps} frames a "
                "second): check that the folder can be written to and that the disk is not full"
            )
        self._writer = writer
        return self

    def write(self, image: NDArray[np.uint8]) -> None:
        """Append a frame (h, w, 3) uint8, blue, green, red, of the size given at the start.

        OpenCV drops frames of another size without a word, so the size is checked here.

        Raises
        ------
        RuntimeError, ValueError
            If the video is not open, or the frame's size is another.
        """
        if self._writer is None:
            raise RuntimeError("the video is not open: write inside its with block")
        if image.shape != (self._size[1], self._size[0], 3):
            raise ValueError(f"the frame has shape {image.shape}, the video is {self._size[0]}x{self._size[1]}")
        self._writer.write(np.ascontiguousarray(image))
        self.n_frames += 1

    def discard(self) -> None:
        """Forget what was written so far: leaving the context then, an older file stays."""
        self.n_frames = 0

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is None:
            return
        with WaitingInterrupts():
            self._writer.release()
            self._writer = None
            n_readable = _n_readable(self._partial) if self.n_frames else 0
            if n_readable:
                os.replace(self._partial, self._path)
            else:
                self._partial.unlink(missing_ok=True)
            if self.n_frames and not n_readable:
                self._path.unlink(missing_ok=True)  # an older one does not show what was written now
        if n_readable >= self.n_frames:
            return
        kept = f"only {n_readable} of its {self.n_frames} frames are there" if n_readable else "it is left out"
        message = f"the video {self._path} was not written whole, {kept}: check whether the disk is full"
        if kind is None:
            raise SourceError(message)
        _LOG.warning(message)


def _n_readable(path: Path) -> int:
    """Number of frames that a video holds; 0 if it cannot be opened. OpenCV does not tell of what it did not write."""
    capture = open_capture(str(path))
    n_frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
    capture.release()
    return n_frames
