"""A folder of numbered images."""

from __future__ import annotations

import re
from pathlib import Path

from morph_dslam.errors import SourceError
from morph_dslam.sources.images import SUFFIXES
from morph_dslam.sources.recorded import ImageRecord, RecordedFrames

#: A folder says nothing of its frame rate; timestamps assume the usual one.
ASSUMED_FPS = 30.0


def numbered_images(folder: Path) -> dict[int, Path]:
    """The images of a folder by the last number in their names, in its order.

    Raises
    ------
    SourceError
        If a name has no number, two have the same, or there is no image.
    """
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


def image_folder(folder: Path, first: int | None = None, last: int | None = None) -> RecordedFrames:
    """A folder of images as a source; gaps in the numbering are kept as they are."""
    records = [
        ImageRecord(number, number / ASSUMED_FPS, path) for number, path in numbered_images(folder).items()
    ]
    return RecordedFrames(folder, records, first=first, last=last, fps=ASSUMED_FPS)
