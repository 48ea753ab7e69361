"""Recordings in the layout of 7-Scenes (Shotton et al. 2013): `frame-000000.color.png`, `.depth.png`."""

from __future__ import annotations

import re
from pathlib import Path

from morph_dslam.sources.images import DepthScale
from morph_dslam.sources.recorded import ImageRecord, RecordedFrames

DEPTH = DepthScale(values_per_metre=1000.0, unknown=(0, 65535), registered=False)

#: The recordings carry no timestamps.
FPS = 30.0

_COLOUR = re.compile(r"frame-(\d+)\.color\.(png|jpg)")


def is_seven_scenes(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return any(_COLOUR.fullmatch(path.name) for path in folder.glob("frame-*.color.*"))


def seven_scenes_recording(folder: Path, first: int | None = None, last: int | None = None) -> RecordedFrames:
    """The colour images with their depth where it is there, by the numbers in their names.

    The depth camera is not registered to the colour camera in these recordings.
    """
    records = []
    for path in sorted(folder.glob("frame-*.color.*")):
        matched = _COLOUR.fullmatch(path.name)
        if matched:
            number, depth = int(matched[1]), folder / f"frame-{matched[1]}.depth.png"
            records.append(ImageRecord(number, number / FPS, path, depth=depth if depth.is_file() else None))
    return RecordedFrames(folder, records, first=first, last=last, depth_scale=DEPTH, fps=FPS)
