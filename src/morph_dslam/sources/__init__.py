"""Where frames come from: folders of images and video files."""

from __future__ import annotations

from pathlib import Path

from morph_dslam.errors import SourceError
from morph_dslam.sources.folder import ImageFolder
from morph_dslam.sources.frames import Frame, FrameSource
from morph_dslam.sources.video import VideoFile

__all__ = ["Frame", "FrameSource", "open_source"]


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
    path = Path(path)
    if not path.exists():
        raise SourceError(f"there is no folder of images and no video at {path}")
    if first is not None and last is not None and last < first:
        raise SourceError(f"frames {first}-{last} of {path}: the last frame is before the first")
    return ImageFolder(path, first, last) if path.is_dir() else VideoFile(path, first, last)
