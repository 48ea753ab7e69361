"""Recordings in the layout of the TUM RGB-D benchmark (Sturm et al. 2012).

`rgb.txt` and `depth.txt` list "timestamp file" of the colour and the depth images.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from morph_dslam.errors import SourceError
from morph_dslam.sources.images import DepthScale
from morph_dslam.sources.recorded import ImageRecord, RecordedFrames

DEPTH = DepthScale(values_per_metre=5000.0)

#: Colour and depth are not taken at the same instant; these belong together, seconds.
MOST_TIME_DIFFERENCE = 0.02


def is_tum(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return (folder / "rgb.txt").is_file()


def tum_recording(folder: Path, first: int | None = None, last: int | None = None) -> RecordedFrames:
    """The colour images with the depth taken closest to them; numbered from 0.

    Raises
    ------
    SourceError
        If a list is malformed, or the range is not in it.
    """
    colour = _read_list(folder / "rgb.txt")
    depths = _read_list(folder / "depth.txt") if (folder / "depth.txt").is_file() else []
    depth_times = np.array([timestamp for timestamp, _ in depths])
    records = []
    for index, (timestamp, path) in enumerate(colour):
        depth = None
        if depths:
            nearest = int(np.abs(depth_times - timestamp).argmin())
            if abs(depth_times[nearest] - timestamp) <= MOST_TIME_DIFFERENCE:
                depth = depths[nearest][1]
        records.append(ImageRecord(index, timestamp, path, depth=depth))
    return RecordedFrames(folder, records, first=first, last=last, depth_scale=DEPTH)


def _read_list(path: Path) -> list[tuple[float, Path]]:
    """Timestamps and files of a list, in the order of time."""
    entries = []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            timestamp = float(words[0])
        except ValueError:
            timestamp = np.nan
        if len(words) != 2 or not np.isfinite(timestamp):
            raise SourceError(f"{path}, line {number}: '{line}' is not a timestamp and a file")
        entries.append((timestamp, path.parent / words[1]))
    return sorted(entries)
