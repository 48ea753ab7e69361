"""Reading image files, colour and depth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SourceError

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")

#: The bytes with which a complete file of this kind ends; the decoder itself fills what is missing with grey.
END_MARKERS = {".png": b"IEND", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}


@dataclass(frozen=True)
class DepthScale:
    """How a recording stores depth.

    Attributes
    ----------
    values_per_metre : of the stored whole numbers. unknown : values that mean it was not measured.
    registered : whether depth pixels belong to the colour pixels of the same row and column.
    """

    values_per_metre: float
    unknown: tuple[int, ...] = (0,)
    registered: bool = True


def read_image(path: Path, what: str) -> NDArray[np.uint8]:
    """Read an image (h, w, 3) uint8 as blue, green, red.

    Raises
    ------
    SourceError
        If the file is missing, cut short or not an image; the message begins with ``what``.
    """
    return np.asarray(_decode(path, what, cv2.IMREAD_COLOR), dtype=np.uint8)


def read_depth(path: Path, what: str, scale: DepthScale) -> NDArray[np.float32]:
    """Read a depth image (h, w) in metres, NaN where no depth was measured.

    Raises
    ------
    SourceError
        As `read_image` does, and if the image has not one channel of 16 bits.
    """
    stored = _decode(path, what, cv2.IMREAD_UNCHANGED)
    if stored.ndim != 2 or stored.dtype != np.uint16:
        raise SourceError(f"{what}: {path} is not a depth image, which has one channel of 16 bits")
    depth = stored.astype(np.float32) / np.float32(scale.values_per_metre)
    depth[np.isin(stored, scale.unknown)] = np.nan
    return depth


def _decode(path: Path, what: str, flags: int) -> NDArray:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{what}: cannot read {path}: {error.strerror}") from error
    marker = END_MARKERS.get(path.suffix.lower())
    if marker and marker not in data[-1024:]:
        raise SourceError(f"{what}: {path} is cut short or not a {path.suffix[1:]} image: copy it again")
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
    if image is None:
        raise SourceError(f"{what}: {path} cannot be decoded as an image")
    return np.asarray(image)
