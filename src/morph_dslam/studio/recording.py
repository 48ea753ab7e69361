"""Pictures that users bring: frames of the recording one by one, and a camera guessed from a photograph.

These functions run in the worker process.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import ExifTags, Image

from morph_dslam import Frame, open_source
from morph_dslam.errors import StudioError
from morph_dslam.sources.frames import decoded
from morph_dslam.sources.recorded import RecordedFrames
from morph_dslam.studio.project import read_once

_JPEG_QUALITY = 88
#: JPEGs that are kept for a page that goes back and forth.
_KEPT = 48
#: Diagonal of the 24 x 36 mm film that EXIF's equivalent focal length refers to, millimetres.
_FILM_DIAGONAL = 43.2666
_EQUIVALENT = ExifTags.Base.FocalLengthIn35mmFilm


class _Recording:
    """Frames in any order; going forward costs nothing, going back reads from the beginning."""

    def __init__(self, path: Path) -> None:
        self.path, source = path, open_source(path)
        self.count, self.fps = len(source), source.fps
        self._frames: Iterator[Frame] = iter(())
        self._last: int | None = None
        self._kept: dict[int, bytes] = {}
        first = next(iter(source))
        self.first, (self.height, self.width) = first.index, first.image.shape[:2]
        self.numbers = (
            source.numbers if isinstance(source, RecordedFrames) else range(self.first, self.first + self.count)
        )

    def jpeg(self, number: int) -> bytes:
        """A frame as JPEG."""
        if number not in self._kept:
            if len(self._kept) >= _KEPT:
                self._kept.pop(next(iter(self._kept)))
            _, data = cv2.imencode(".jpg", self.image(number), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
            self._kept[number] = data.tobytes()
        return self._kept[number]

    def image(self, number: int) -> np.ndarray:
        """A frame (h, w, 3)."""
        if self._last is None or number <= self._last:
            self._frames = iter(open_source(self.path, number))
        for frame in self._frames:
            self._last = frame.index
            if frame.index >= number:
                break
        if self._last != number:
            self._last = None
            raise StudioError(f"the recording has no frame {number}; its first is {self.first}, of {self.count}")
        return frame.image


@read_once(2)
def _opened(path: Path) -> _Recording:
    return _Recording(path)


def recording_facts(path: Path) -> dict[str, Any]:
    """Size, number of frames, numbers of the first and the last one, and rate of a recording."""
    found = _opened(path)
    return {
        "width": found.width,
        "height": found.height,
        "frames": found.count,
        "first": found.first,
        "last": found.numbers[-1],
        "fps": found.fps,
    }


def frame_numbers(path: Path) -> list[int] | None:
    """Numbers of the frames of a recording, ascending; None where each number from the first to the last is there."""
    numbers = _opened(path).numbers
    return None if numbers[-1] - numbers[0] + 1 == len(numbers) else list(numbers)


def frame_jpeg(path: Path, number: int) -> bytes:
    """A frame of a recording as JPEG."""
    return _opened(path).jpeg(number)


def check_jpeg(jpeg: bytes) -> None:
    """Raise StudioError if this cannot be decoded."""
    if decoded(jpeg) is None:
        raise StudioError("the frame cannot be decoded: take another one")


def save_frame(path: Path, number: int | None, target: Path) -> None:
    """Write a frame of a recording, the first one by default, as an image file without loss."""
    found = _opened(path)
    if not cv2.imwrite(str(target), found.image(found.first if number is None else number)):
        raise StudioError(f"{target.name} cannot be written")


def camera_from_photo(photo: Path, width: int, height: int) -> tuple[str, str]:
    """A camera file for images of a size, guessed from what a photograph of the same lens says of itself.

    EXIF's focal length is that of 35 mm film with the same diagonal of view. The film of most telephones is cut off at
    the sides, and its picture may be steadied, so the guess may be off by a third.

    Parameters
    ----------
    photo : JPEG straight from the camera.
    width, height : of the images to track, pixels.

    Returns
    -------
    The text of a camera file, and a sentence that says what was guessed.

    Raises
    ------
    StudioError
        If the photograph does not say its focal length.
    """
    with Image.open(photo) as image:
        exif = image.getexif()
        found = exif.get_ifd(ExifTags.IFD.Exif).get(_EQUIVALENT) or exif.get(_EQUIVALENT)
    if not found or not 5 <= float(found) <= 2000:
        raise StudioError(
            f"{photo.name} does not say its focal length (EXIF FocalLengthIn35mmFilm): take a picture straight from "
            "the phone, not one that was edited or sent through a messenger, or calibrate"
        )
    focal = float(found) / _FILM_DIAGONAL * float(np.hypot(width, height))
    words = (
        f"Guess: focal length {focal:.0f} px from EXIF ({float(found):g} mm on 35 mm film), centre in the middle, no "
        "distortion. Video is often cut or steadied: the focal length may be off by a third. Calibrate to measure."
    )
    lines = [
        f"# {words}",
        f"width: {width}",
        f"height: {height}",
        f"fx: {focal:.2f}",
        f"fy: {focal:.2f}",
        f"cx: {(width - 1) / 2}",
        f"cy: {(height - 1) / 2}",
    ]
    return "\n".join(lines) + "\n", words
