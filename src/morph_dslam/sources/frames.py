"""Frames, and what a source of frames offers."""

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
    timestamp : seconds, by the recording's clock where it has one, else since frame 0.
    image : (h, w, 3) uint8, blue, green, red.
    depth : (h, w) metres along the optical axis, NaN where not measured; None without a depth camera.
    right : (h, w, 3) uint8, what the right camera of a stereo pair saw; None without one.
    captured : when a live frame came, seconds of `time.monotonic`; None in a recording.
    """

    index: int
    timestamp: float
    image: NDArray[np.uint8]
    depth: NDArray[np.float32] | None = None
    right: NDArray[np.uint8] | None = None
    captured: float | None = None


class FrameStream(Protocol):
    """Frames one after the other, recorded or live."""

    name: str
    fps: float

    def __iter__(self) -> Iterator[Frame]: ...


class FrameSource(FrameStream, Protocol):
    """A recorded sequence of frames, which can be iterated more than once and drops none."""

    def __len__(self) -> int:
        """Number of frames expected; fewer may come when a video is cut short, and then SourceError."""
        ...


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
