"""Recordings in the layout of the EuRoC benchmark (Burri et al. 2016).

`mav0/cam0/data.csv` lists "timestamp [ns],file" of the images in `mav0/cam0/data`, `mav0/cam1` those of
the right camera.
"""

from __future__ import annotations

from pathlib import Path

from morph_dslam.errors import SourceError
from morph_dslam.sources.recorded import ImageRecord, RecordedFrames


def _base(folder: Path) -> Path | None:
    """The folder that holds cam0, None if this is another layout."""
    candidates = (folder / "mav0", folder)
    return next((base for base in candidates if (base / "cam0" / "data.csv").is_file()), None)


def is_euroc(folder: Path) -> bool:
    """Whether a folder, or `mav0` in it, has this layout."""
    return _base(folder) is not None


def euroc_recording(folder: Path, first: int | None = None, last: int | None = None) -> RecordedFrames:
    """The images of cam0, with those of cam1 that have the same timestamp as right images; from 0.

    Raises
    ------
    SourceError
        If a list is malformed, or the range is not in it.
    """
    base = _base(folder)
    assert base is not None
    left = _read_list(base / "cam0")
    right = _read_list(base / "cam1") if (base / "cam1" / "data.csv").is_file() else {}
    records = [
        ImageRecord(index, nanoseconds / 1e9, path, right=right.get(nanoseconds))
        for index, (nanoseconds, path) in enumerate(sorted(left.items()))
    ]
    return RecordedFrames(folder, records, first=first, last=last)


def _read_list(camera: Path) -> dict[int, Path]:
    """The images of a camera by their timestamps in nanoseconds, which float64 seconds would round."""
    entries = {}
    path = camera / "data.csv"
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        words = [word.strip() for word in line.split(",")]
        if len(words) != 2 or not words[0].isdecimal():
            raise SourceError(f"{path}, line {number}: '{line}' is not a timestamp in nanoseconds and a file")
        entries[int(words[0])] = camera / "data" / words[1]
    return entries
