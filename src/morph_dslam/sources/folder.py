"""A folder of numbered images."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SourceError
from morph_dslam.sources.frames import Frame, check_range

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")

#: A folder says nothing of its frame rate; timestamps assume the usual one.
ASSUMED_FPS = 30.0

#: The bytes with which a complete file of this kind ends; the decoder itself fills what is missing with grey.
END_MARKERS = {".png": b"IEND", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}


def read_image(path: Path, what: str) -> NDArray[np.uint8]:
    """Read an image (h, w, 3) uint8 as blue, green, red.

    Raises
    ------
    SourceError
        If the file is missing, cut short or not an image; the message begins with ``what``.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{what}: cannot read {path}: {error.strerror}") from error
    marker = END_MARKERS.get(path.suffix.lower())
    if marker and marker not in data[-1024:]:
        raise SourceError(f"{what}: {path} is cut short or not a {path.suffix[1:]} image: copy it again")
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        raise SourceError(f"{what}: {path} cannot be decoded as an image")
    return np.asarray(image, dtype=np.uint8)


def _numbered_images(folder: Path) -> dict[int, Path]:
    """The images of a folder by the last number in their names, in its order."""
    images: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in SUFFIXES:
            continue
        numbers = re.findall(r"\d+", path.stem)
        if not numbers:
            raise SourceError(
                f"{path} has no number in its name, which gives the frames their order: rename it"
            )
        number = int(numbers[-1])
        if number in images:
            raise SourceError(
                f"{folder} has two images for frame {number}, {images[number].name} and {path.name}: "
                "keep one sequence in a folder"
            )
        images[number] = path
    if not images:
        raise SourceError(f"{folder} holds no images ({', '.join(SUFFIXES)})")
    return dict(sorted(images.items()))


class ImageFolder:
    """A folder of images as a `FrameSource`; gaps in the numbering are kept as they are."""

    def __init__(self, folder: Path, first: int | None = None, last: int | None = None) -> None:
        images = _numbered_images(folder)
        numbers = list(images)
        low, high = check_range(folder, range(numbers[0], numbers[-1] + 1), first, last)
        self.name = str(folder)
        self.fps = ASSUMED_FPS
        self._images = {number: path for number, path in images.items() if low <= number <= high}
        for wanted in (low, high):
            if wanted not in images:
                raise SourceError(f"frame {wanted} is missing from {folder}")

    def __len__(self) -> int:
        return len(self._images)

    def __iter__(self) -> Iterator[Frame]:
        shape = None
        for number, path in self._images.items():
            image = read_image(path, f"frame {number}")
            shape = shape or image.shape
            if image.shape != shape:
                raise SourceError(
                    f"frame {number}: {path} is {image.shape[1]}x{image.shape[0]} pixels, "
                    f"the frames before it are {shape[1]}x{shape[0]}"
                )
            yield Frame(number, number / self.fps, image)
