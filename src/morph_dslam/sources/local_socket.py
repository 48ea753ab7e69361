"""Frames from another program on this computer, over a Unix socket: `morph studio` hands on those of a browser.

The other program listens; who tracks connects. Frames come as JPEG, and pictures of them may go back the same way.
Each message is a head, `<I` the frame's number and `<I` the number of bytes, and of a frame `<d` its time in seconds
between both; then the JPEG.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from morph_dslam.errors import SourceError
from morph_dslam.sources.frames import ASSUMED_FPS, Frame, decoded
from morph_dslam.sources.live import LiveStream, SteadyTimes

#: Of a frame: its number, its time in seconds, bytes of its JPEG.
FRAME_HEAD = struct.Struct("<IdI")
#: Of a picture that goes back: the number of its frame, bytes of its JPEG.
PICTURE_HEAD = struct.Struct("<II")
#: Bytes of a JPEG; more is no frame.
MOST_BYTES = 8_000_000
#: How it is decoded: as it is stored, whatever its head says of how the camera was held.
_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


class SocketCamera(LiveStream):
    """Frames that another program sends, which gets pictures of them in return.

    A frame that cannot be decoded is left out. The stream ends when the other program closes the connection. The times
    that it sends are those at which it got the frames: they are smoothed as those of a camera on this computer.

    Parameters
    ----------
    connection : to the other program.
    name : for messages.
    """

    def __init__(self, connection: socket.socket, name: str) -> None:
        super().__init__(name, ASSUMED_FPS)
        self._connection = connection
        self._file = connection.makefile("rb")
        self.start()

    def read(self) -> Iterator[Frame]:
        times = SteadyTimes()
        while head := self._exactly(FRAME_HEAD.size):
            index, seconds, size = FRAME_HEAD.unpack(head)
            if size > MOST_BYTES:
                raise SourceError(f"{self.name} sent {size} bytes as frame {index}: a frame has {MOST_BYTES} at most")
            data = self._exactly(size)
            captured, seconds = time.monotonic(), times.add(seconds)
            image = decoded(data, _FLAGS)
            if image is not None:
                yield Frame(index, seconds, image.astype(np.uint8, copy=False), captured=captured)

    def _exactly(self, count: int) -> bytes:
        """The next bytes; none where the connection ends."""
        try:
            data = self._file.read(count)
        except OSError:
            return b""
        return data if len(data) == count else b""

    def show(self, index: int, jpeg: bytes) -> None:
        """Send the picture of a frame back; nothing where the other program has gone."""
        with suppress(OSError):
            self._connection.sendall(PICTURE_HEAD.pack(index, len(jpeg)) + jpeg)

    def close(self) -> None:
        with suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)  # ends a read that waits
        super().close()

    def release(self) -> None:
        self._file.close()
        self._connection.close()


def open_socket(path: Path, first: int | None = None, last: int | None = None) -> SocketCamera:
    """Connect to the program that listens there; SourceError if none does, or a range is asked for."""
    if first is not None or last is not None:
        raise SourceError(f"{path} is live and has no range of frames to choose from")
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        connection.connect(str(path))
    except OSError as error:
        connection.close()
        raise SourceError(
            f"{path} does not answer ({error.strerror or error}): the studio that made it has ended"
        ) from error
    return SocketCamera(connection, str(path))
