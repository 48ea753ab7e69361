"""Images in ROS 1 and ROS 2 bags, read by `rosbags` without ROS itself."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SourceError, how_to_install
from morph_dslam.io.file_kinds import file_kind
from morph_dslam.sources.frames import Frame, check_range, check_size, decoded, usual_rate

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

#: So many of the first messages tell the rate.
N_TIMED = 100
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
#: Channels of 8 bits of each encoding, and OpenCV's conversion to blue, green, red. ROS names a Bayer pattern
#: by its first two pixels, OpenCV by those of the second row from the second column.
ENCODINGS: dict[str, tuple[int, int | None]] = {
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "mono8": (1, cv2.COLOR_GRAY2BGR),
    "mono16": (2, cv2.COLOR_GRAY2BGR),
    "8UC1": (1, cv2.COLOR_GRAY2BGR),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2BGR),
}


def is_bag(path: Path) -> bool:
    """Whether a path, `#topic` after it or not, is a ROS 1 bag, or a file or folder of a ROS 2 bag."""
    bag, _ = _split_topic(path)
    return file_kind(bag) in (".bag", ".db3", ".mcap") or (bag / "metadata.yaml").is_file()


def _split_topic(path: Path) -> tuple[Path, str | None]:
    """The bag and the topic after its name, None where none is given."""
    if path.exists() or "#" not in str(path):
        return path, None
    bag, _, topic = str(path).partition("#")
    return Path(bag), topic


@contextmanager
def _reader(path: Path) -> Iterator[AnyReader]:
    """The open bag."""
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise SourceError(f"{path} is a ROS bag, which needs rosbags: {how_to_install('ros')}") from error
    # ROS 2 bags are folders; older ones do not carry the definitions of their messages.
    folder = path.parent if file_kind(path) in (".db3", ".mcap") and (path.parent / "metadata.yaml").is_file() else path
    try:
        with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except AnyReaderError as error:
        raise SourceError(f"{path} cannot be read as a ROS bag: {error}") from error


def _choose_topic(path: Path, reader: AnyReader, topic: str | None) -> list[Connection]:
    """The connections of the wanted images: one for each node that sent them, and each time it was started."""
    images: dict[str, list[Connection]] = {}
    for connection in reader.connections:
        if connection.msgtype in IMAGE_TYPES and connection.msgcount:
            images.setdefault(connection.topic, []).append(connection)
    if not images:
        raise SourceError(f"{path} holds no images, but the topics {', '.join(sorted(reader.topics)) or 'none'}")
    if topic is None and len(images) == 1:
        return next(iter(images.values()))
    if topic not in images:
        raise SourceError(
            f"{path} holds images of the topics {', '.join(sorted(images))}: choose one, {path}#{min(images)} say"
        )
    return images[topic]


class RosBag:
    """The images of one topic of a bag as a `FrameSource`, numbered from 0 in the order of the bag.

    Timestamps are those of the message headers, or of the recorder where headers have none.

    Parameters
    ----------
    path : a `.bag` file, or a folder or file of a ROS 2 bag; `#topic` after it where there are several
    first, last : range of frame numbers, both included; open ends by default
    """

    has_assumed_times = False

    def __init__(self, path: Path, first: int | None = None, last: int | None = None) -> None:
        path, topic = _split_topic(path)
        self._path = path
        with _reader(path) as reader:
            connections = _choose_topic(path, reader, topic)
            begun = islice(reader.messages(connections=connections), N_TIMED)
            self.fps = usual_rate([1e-9 * received for _, received, _ in begun])
        self._topic = connections[0].topic
        self._first, self._last = check_range(path, range(sum(c.msgcount for c in connections)), first, last)
        self.name = f"{path}#{self._topic}"

    def __len__(self) -> int:
        return self._last - self._first + 1

    def __iter__(self) -> Iterator[Frame]:
        size = None
        with _reader(self._path) as reader:
            connections = _choose_topic(self._path, reader, self._topic)
            for index, (connection, received, data) in enumerate(reader.messages(connections=connections)):
                if index < self._first:
                    continue
                if index > self._last:
                    return
                message: Any = reader.deserialize(data, connection.msgtype)
                image = _decode(message, f"frame {index} of {self.name}")
                size = check_size(image, size, f"frame {index} of {self.name}")
                yield Frame(index, _timestamp(message, received), image)


def _timestamp(message: Any, received: int) -> float:
    """Seconds by the message's header, or by the recorder's clock, nanoseconds, where it has no time."""
    stamp = message.header.stamp
    nanoseconds = stamp.sec * 1_000_000_000 + stamp.nanosec
    return (nanoseconds or received) / 1e9


def _decode(message: Any, what: str) -> NDArray[np.uint8]:
    """The image (h, w, 3) uint8, blue, green, red, of a message."""
    if hasattr(message, "format"):
        image = decoded(message.data)
        if image is None:
            raise SourceError(f"{what} cannot be decoded ({message.format})")
        return np.asarray(image, dtype=np.uint8)
    if message.encoding not in ENCODINGS:
        raise SourceError(
            f"{what} has the encoding {message.encoding}; known are compressed images and {', '.join(ENCODINGS)}"
        )
    channels, conversion = ENCODINGS[message.encoding]
    # Rows may be padded.
    rows = np.frombuffer(message.data, dtype=np.uint8).reshape(message.height, message.step)
    pixels = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    if message.encoding == "mono16":  # the upper byte, as of images of 16 bits in files
        pixels = pixels[:, :, :1] if message.is_bigendian else pixels[:, :, 1:]
    if conversion is None:
        return np.array(pixels)
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), conversion), dtype=np.uint8)
