"""Frames and the choice of a source by its path."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SourceError


@dataclass(frozen=True)
class Frame:
    """One image of a sequence.

    Attributes
    ----------
    index : its number in the sequence.
    timestamp : seconds since frame 0.
    image : (h, w, 3) uint8, blue, green, red.
    """

    index: int
    timestamp: float
    image: NDArray[np.uint8]


class FrameSource(Protocol):
    """A sequence of frames that can be iterated more than once."""

    name: str
    fps: float

    def __len__(self) -> int:
        """Number of frames expected; fewer may come when a video is cut short, and then SourceError."""
        ...

    def __iter__(self) -> Iterator[Frame]: ...


def open_source(path: Path, first: int | None = None, last: int | None = None) -> FrameSource:
    """Open a folder of numbered images or a video file.

    Parameters
    ----------
    path : a folder, whose frames are numbered by the last number in each file name (`001.jpg` is frame 1),
        or a video file, whose frames are numbered from 0.
    first, last : the range of frame numbers wanted, both included; open ends by default.

    Raises
    ------
    SourceError
        If the path is missing, holds no frames, or does not reach ``first`` or ``last``. While iterating:
        if a frame cannot be decoded, changes size, or the video ends early; all frames before it come first.
    """
    from morph_dslam.sources.folder import ImageFolder
    from morph_dslam.sources.video import VideoFile

    path = Path(path)
    if not path.exists():
        raise SourceError(f"there is no folder of images and no video at {path}")
    if first is not None and last is not None and last < first:
        raise SourceError(f"frames {first}-{last} of {path}: the last frame is before the first")
    return ImageFolder(path, first, last) if path.is_dir() else VideoFile(path, first, last)


def check_range(where: Path, available: range, first: int | None, last: int | None) -> tuple[int, int]:
    """The wanted range with its open ends filled in.

    Raises
    ------
    SourceError
        If ``where``, whose frame numbers span ``available``, does not hold both ends.
    """
    low, high = available[0], available[-1]
    for wanted in (first, last):
        if wanted is not None and wanted not in available:
            raise SourceError(f"frame {wanted} is not in {where}, which has frames {low}-{high}")
    return (low if first is None else first), (high if last is None else last)
