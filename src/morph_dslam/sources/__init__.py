"""Where frames come from: videos, folders of images, recordings of benchmarks, ROS bags, and webcams."""

from __future__ import annotations

import re
from pathlib import Path

from morph_dslam.errors import SourceError
from morph_dslam.sources.frames import Frame, FrameSource, FrameStream
from morph_dslam.sources.live import LiveStream, PacedRecording, open_webcam
from morph_dslam.sources.recorded import (
    euroc_recording,
    image_folder,
    is_euroc,
    is_seven_scenes,
    is_tum,
    seven_scenes_recording,
    tum_recording,
)
from morph_dslam.sources.ros_bag import RosBag, is_bag
from morph_dslam.sources.video import VideoFile

__all__ = ["Frame", "FrameSource", "FrameStream", "open_live", "open_source", "open_stream"]

_WEBCAM = re.compile(r"webcam:(\d+)")

#: Layouts of folders, each with the test for it and what opens it.
_LAYOUTS = ((is_tum, tum_recording), (is_euroc, euroc_recording), (is_seven_scenes, seven_scenes_recording))


def open_source(path: Path, first: int | None = None, last: int | None = None) -> FrameSource:
    """Open a recording.

    Parameters
    ----------
    path : a folder of images, whose frames are numbered by the last number in each file name (`001.jpg` is
        frame 1); a folder in the layout of TUM RGB-D, EuRoC or 7-Scenes; a video file, or a ROS 1 or ROS 2
        bag, with `#topic` after its name where it holds several, whose frames are numbered from 0.
    first, last : the range of frame numbers wanted, both included; open ends by default.

    Raises
    ------
    SourceError
        If the path is missing, holds no frames, or does not reach ``first`` or ``last``. While iterating:
        if a frame cannot be decoded, changes size, or the video ends early; all frames before it come first.
    """
    path, topic = _split_topic(Path(path))
    if not path.exists():
        raise SourceError(f"there is no folder of images and no video at {path}")
    if first is not None and last is not None and last < first:
        raise SourceError(f"frames {first}-{last} of {path}: the last frame is before the first")
    if is_bag(path):
        return RosBag(path, topic, first, last)
    if not path.is_dir():
        return VideoFile(path, first, last)
    for has_layout, open_layout in _LAYOUTS:
        if has_layout(path):
            return open_layout(path, first, last)
    return image_folder(path, first, last)


def open_stream(source: str | Path, first: int | None = None, last: int | None = None) -> FrameStream:
    """Open a webcam, `webcam:0` for the first one, or a recording as `open_source` does.

    A recording gives every frame, however long each takes; a webcam gives the newest and drops the others.

    Raises
    ------
    SourceError
        As `open_source` does; if the webcam cannot be opened, or a range of its frames is asked for.
    """
    webcam = _WEBCAM.fullmatch(str(source))
    if webcam is None:
        if str(source).startswith("webcam") and not Path(source).exists():
            raise SourceError(f"'{source}' is no webcam: write webcam:0 for the first one, webcam:1 for the next")
        return open_source(Path(source), first, last)
    if first is not None or last is not None:
        raise SourceError(f"{source} is live and has no range of frames to choose from")
    return open_webcam(int(webcam[1]))


def open_live(source: str | Path, first: int | None = None, last: int | None = None) -> LiveStream:
    """Open a webcam, or a recording that plays as if it were live: frames that come too fast are dropped.

    Raises
    ------
    SourceError
        As `open_stream` does.
    """
    stream = open_stream(source, first, last)
    return stream if isinstance(stream, LiveStream) else PacedRecording(stream)


def _split_topic(path: Path) -> tuple[Path, str | None]:
    """The bag and the topic after its name, None where none is given."""
    if path.exists() or "#" not in str(path):
        return path, None
    bag, _, topic = str(path).partition("#")
    return (Path(bag), topic) if is_bag(Path(bag)) else (path, None)
