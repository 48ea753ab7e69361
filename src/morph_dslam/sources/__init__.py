"""Where frames come from: videos, images, benchmark recordings, ROS bags, webcams, sockets, and registered kinds."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from pathlib import Path

from morph_dslam.errors import SourceError, check_kind
from morph_dslam.sources.frames import CheckedSource, CheckedStream, Frame, FrameSource, FrameStream
from morph_dslam.sources.live import LiveStream, PacedRecording, is_camera, open_camera
from morph_dslam.sources.local_socket import open_socket
from morph_dslam.sources.recorded import (
    RecordedFrames,
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

__all__ = ["Frame", "FrameSource", "FrameStream", "open_live", "open_source", "open_stream", "register_source"]
Matches = Callable[[Path], bool]
Open = Callable[[Path, int | None, int | None], FrameStream]
_KINDS: list[tuple[Matches, Open]] = []


def register_source(matches: Matches, open: Open) -> None:
    """Add a kind of source, which `open_source`, and all else in the program that calls this, then accept.

    Parameters
    ----------
    matches : function of a path that tells whether it is of this kind; the newest kind is asked first
    open : function of the path and of the first and last frame number wanted (None: open end) that returns the
        frames: an object with ``name``, ``fps`` and ``__iter__``, and, if it is a recording, ``__len__``
    """
    _KINDS.insert(0, (matches, open))


def open_stream(
    source: str | Path,
    first: int | None = None,
    last: int | None = None,
    fps: float | None = None,
    depth_per_metre: float | None = None,
) -> FrameStream:
    """Open a recording as `open_source` does, or a camera: `webcam:0`, `/dev/video0`, or a URL such as `rtsp://address`.

    A recording gives every frame, however long each takes; a camera gives the newest and drops the others.

    Raises SourceError if the source is missing or cannot be opened, or the range is not in it, and ArgumentError if it
    is no path: a number of a webcam for example.
    """
    check_kind(source, (str, PathLike), "the source of frames", "a path, or 'webcam:0' for the first webcam")
    path = Path(source)
    if first is not None and last is not None and last < first:
        raise SourceError(f"frames {first}-{last} of {path}: the last frame is before the first")
    for matches, open_kind in _KINDS:
        if matches(path):
            stream = open_kind(path, first, last)
            if fps is not None:
                stream = _recorded(stream, "says the times of its frames itself: leave --fps out").with_rate(fps)
            if depth_per_metre is not None:
                recorded = _recorded(stream, "has no depth images: leave --depth-per-metre out")
                stream = recorded.with_depth_per_metre(depth_per_metre)
            return stream if open_kind in _BUILT_IN else _checked(stream, path)
    raise SourceError(
        f"there is no folder of images and no video at {path} (cameras are webcam:0, /dev/video0 or a URL)"
    )


def _recorded(stream: FrameStream, refusal: str) -> RecordedFrames:
    """A recording by this program's own readers; SourceError with the refusal if it is anything else."""
    if isinstance(stream, RecordedFrames):
        return stream
    if isinstance(stream, LiveStream):
        stream.close()
    raise SourceError(f"{stream.name} {refusal}")


def _checked(stream: FrameStream, path: Path) -> FrameStream:
    """What a kind of source has opened; SourceError unless it is a source, also of its frames as they come."""
    if isinstance(stream, LiveStream):
        return stream
    missing = [name for name in ("name", "fps", "__iter__") if getattr(stream, name, None) is None]
    if missing:
        raise SourceError(
            f"what was registered for {path} opens it as an object of type {type(stream).__name__}, without "
            f"{missing[0]}: return one with name, fps and __iter__"
        )
    return CheckedSource(stream) if isinstance(stream, FrameSource) else CheckedStream(stream)


def open_source(
    path: str | Path,
    first: int | None = None,
    last: int | None = None,
    fps: float | None = None,
    depth_per_metre: float | None = None,
) -> FrameSource:
    """Open a recording.

    Parameters
    ----------
    path : a folder of images, whose frames are numbered by the last number in each file name (`001.jpg` is
        frame 1), or from 0 if all names are times (`1305031100.5.png`, in seconds, a date as
        `20240131123059800.png`, or 13 digits or more, in milli-, micro- or nanoseconds); a folder in the layout of TUM
        RGB-D, EuRoC or 7-Scenes; a video file, or a ROS 1 or ROS 2 bag, with `#topic` after its name where it holds
        several, whose frames are numbered from 0
    first, last : range of frame numbers, both included; open ends by default
    fps : frames a second of numbered images, which nothing else tells; 30 by default
    depth_per_metre : values a metre of the depth images, 1000 for millimetres; as the layout has them by default

    Raises SourceError if the path is missing, holds no frames, or does not reach ``first`` or ``last``. While
    iterating: if a frame cannot be decoded, changes size, or the video ends early; all frames before it come first.
    """
    stream = open_stream(path, first, last, fps, depth_per_metre)
    if isinstance(stream, LiveStream):
        stream.close()
        raise SourceError(f"{path} is live; a recording is needed here")
    if not isinstance(stream, FrameSource):
        raise SourceError(f"{path} has no length, and a recording is needed here: give what opens it a method __len__")
    return stream


def open_live(
    source: str | Path,
    first: int | None = None,
    last: int | None = None,
    fps: float | None = None,
    depth_per_metre: float | None = None,
) -> LiveStream:
    """Open a camera, or a recording that plays as if it were live: frames that come too fast are dropped.

    Parameters
    ----------
    source : `webcam:0` for the first webcam, `/dev/video0`, the URL of a camera on the network, or a recording
    first, last : range of frame numbers of a recording, both included
    fps : frames a second of numbered images, which nothing else tells; 30 by default
    depth_per_metre : values a metre of a recording's depth images, 1000 for millimetres; as its layout has them by
        default

    Raises
    ------
    SourceError
        If there is no such source, or it cannot be opened.
    """
    stream = open_stream(source, first, last, fps, depth_per_metre)
    return stream if isinstance(stream, LiveStream) else PacedRecording(stream)


# From the general to the special: the last one is asked first.
register_source(Path.is_file, VideoFile)
register_source(Path.is_dir, image_folder)
register_source(is_seven_scenes, seven_scenes_recording)
register_source(is_euroc, euroc_recording)
register_source(is_tum, tum_recording)
register_source(is_bag, RosBag)
register_source(is_camera, open_camera)
register_source(Path.is_socket, open_socket)
#: What these open is what it should be, with more than all sources have.
_BUILT_IN = frozenset(open_kind for _, open_kind in _KINDS)
