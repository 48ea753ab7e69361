"""Frames recorded as image files, one by one, in whatever layout of folders."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SourceError
from morph_dslam.sources.frames import Frame, check_range
from morph_dslam.sources.images import DepthScale, read_depth, read_image


@dataclass(frozen=True)
class ImageRecord:
    """Where one frame is: its number, its time in seconds, and the files of its images."""

    index: int
    timestamp: float
    image: Path
    depth: Path | None = None
    right: Path | None = None


class RecordedFrames:
    """Image files as a `FrameSource`.

    Parameters
    ----------
    folder : the recording. records : its frames, by ascending number.
    first, last : the range of frame numbers wanted, both included; open ends by default.
    depth_scale : how depth is stored. fps : frames a second; from the timestamps where it is not given.

    Raises
    ------
    SourceError
        If there are no records, or ``first`` or ``last`` is not among them.
    """

    def __init__(
        self,
        folder: Path,
        records: Sequence[ImageRecord],
        *,
        first: int | None = None,
        last: int | None = None,
        depth_scale: DepthScale | None = None,
        fps: float | None = None,
    ) -> None:
        if not records:
            raise SourceError(f"{folder} holds no frames")
        numbers = [record.index for record in records]
        low, high = check_range(folder, range(numbers[0], numbers[-1] + 1), first, last)
        for wanted in (low, high):
            if wanted not in numbers:
                raise SourceError(f"frame {wanted} is missing from {folder}")
        self.name = str(folder)
        self.fps = fps or _frame_rate([record.timestamp for record in records])
        self._records = [record for record in records if low <= record.index <= high]
        self._depth_scale = depth_scale

    @property
    def has_registered_depth(self) -> bool:
        """Whether frames come with depth that belongs to their pixels."""
        scale = self._depth_scale
        return scale is not None and scale.registered and any(r.depth is not None for r in self._records)

    def __len__(self) -> int:
        return len(self._records)

    def __iter__(self) -> Iterator[Frame]:
        size = None
        for record in self._records:
            what = f"frame {record.index}"
            image = read_image(record.image, what)
            size = size or image.shape[:2]
            _check_size(image, size, record.image, what)
            depth, right = None, None
            if record.depth is not None and self._depth_scale is not None:
                depth = read_depth(record.depth, what, self._depth_scale)
                _check_size(depth, size, record.depth, what)
            if record.right is not None:
                right = read_image(record.right, what)
                _check_size(right, size, record.right, what)
            yield Frame(record.index, record.timestamp, image, depth, right)


def _frame_rate(timestamps: list[float]) -> float:
    """Frames a second, from the usual time between two; one where there is nothing to tell it."""
    gaps = np.diff(timestamps)
    return float(1.0 / np.median(gaps)) if len(gaps) and np.median(gaps) > 0.0 else 1.0


def _check_size(image: NDArray, size: tuple[int, int], path: Path, what: str) -> None:
    if image.shape[:2] != size:
        raise SourceError(
            f"{what}: {path} is {image.shape[1]}x{image.shape[0]} pixels, "
            f"the frames before it are {size[1]}x{size[0]}"
        )
