"""Live frames: from a browser's camera to the command that tracks them, and pictures of them back to all who look.

A browser, of a phone or of this computer, sends JPEGs over a WebSocket; `morph live` takes them from a Unix socket.
Nothing waits for anybody: who is slow misses frames, and always gets the newest one next. Frames are decoded by the
command alone; here only their heads are read.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import struct
import tempfile
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from morph_dslam.sources.local_socket import FRAME_HEAD, PICTURE_HEAD

#: Bytes of a message of a browser: its frame's number, and a JPEG.
_MOST_MESSAGE = 2_000_000
#: What a server of WebSockets is given; JPEGs are compressed already.
WEBSOCKETS: dict[str, Any] = {
    "ws": "websockets-sansio", "ws_max_size": _MOST_MESSAGE, "ws_per_message_deflate": False,
}  # fmt: skip
_NUMBER = struct.Struct("<I")
#: Seconds from one frame to the next at least; who sends faster is read more slowly.
_LEAST_INTERVAL = 1 / 60
#: Bytes that wait for the command; more frames are left out meanwhile.
_MOST_WAITING = 4_000_000
#: Frames that the command has and has not answered, of which the numbers are kept.
_MOST_OPEN = 100
#: Pixels along an edge of a frame.
_LONGEST_EDGE = 4096
#: How a connection is closed when another camera takes its place.
_REPLACED = 4000
#: Markers of a JPEG that begin a frame, with its size, and those without a length.
_FRAME_MARKERS = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
_BARE_MARKERS = frozenset({0x01, *range(0xD0, 0xD8)})

Size = tuple[int, int]


def jpeg_size(data: bytes) -> Size | None:
    """Width and height by the head of a JPEG, which is not decoded; None where it is none."""
    if data[:2] != b"\xff\xd8":
        return None
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in _FRAME_MARKERS:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return (width, height) if width and height else None
        if marker == 0xFF:
            at += 1
        elif marker in _BARE_MARKERS:
            at += 2
        else:
            at += 2 + max(2, struct.unpack_from(">H", data, at + 2)[0])
    return None


def size_refusal(found: Size, wanted: Size | None) -> str | None:
    """Why frames of a size are not taken; None if they are."""
    width, height = found
    if max(found) > _LONGEST_EDGE:
        return f"the camera gives {width} × {height} pixels: a frame has at most {_LONGEST_EDGE} along an edge"
    if wanted is None or found == wanted:
        return None
    given = f"the camera gives {width} × {height} pixels, the camera file is for {wanted[0]} × {wanted[1]}"
    if (height, width) == wanted:
        return f"{given}: turn the phone by a quarter"
    return f"{given}: calibrate this camera at its size, or take the camera that the file is of"


class _Outbox:
    """What one browser is to be sent: the newest picture, and the newest of each fact."""

    def __init__(self, browser: WebSocket) -> None:
        self._browser, self._changed = browser, asyncio.Event()
        self._facts: dict[str, Any] = {}
        self._picture: bytes | None = None

    def tell(self, **facts: Any) -> None:
        self._facts |= facts
        self._changed.set()

    def show(self, number: int, jpeg: bytes) -> None:
        self._picture = _NUMBER.pack(number) + jpeg
        self._changed.set()

    async def send(self) -> None:
        """Send what there is, until the browser goes."""
        while True:
            await self._changed.wait()
            self._changed.clear()
            facts, self._facts = self._facts, {}
            picture, self._picture = self._picture, None
            if facts:
                await self._browser.send_text(json.dumps(facts))
            if picture is not None:
                await self._browser.send_bytes(picture)


class LiveRelay:
    """Takes frames from one camera, and hands them to one command and to all pages that look on.

    Parameters
    ----------
    wanted : gives the size of frames by the camera file, None where there is none.
    keep : takes the number and the JPEG of each frame that the command gets.
    begin : called when the command has tracked its first frame.

    Attributes
    ----------
    newest : JPEG of the last frame that came from the camera that sends; None without one.
    """

    def __init__(
        self,
        wanted: Callable[[], Awaitable[Size | None]],
        keep: Callable[[int, bytes], None],
        begin: Callable[[], None],
    ) -> None:
        self._wanted, self._keep, self._begin = wanted, keep, begin
        self._watching: set[_Outbox] = set()
        self._camera: _Outbox | None = None
        self._sending: WebSocket | None = None
        self._folder: Path | None = None
        self._server: asyncio.Server | None = None
        self._tracker: asyncio.StreamWriter | None = None
        self._is_tracking = False
        self._count, self._start = 0, 0.0
        self._open: dict[int, tuple[_Outbox, int]] = {}
        self._what = self._refusal = ""
        self._size: Size | None = None
        self.newest: bytes | None = None

    # -- the command --------------------------------------------------------------------------------

    async def listen(self) -> Path:
        """The socket that a command connects to; a folder that nobody else may enter holds it."""
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="morph-"))
            self._server = await asyncio.start_unix_server(self._answer_tracker, self._folder / "camera.sock")
        return self._folder / "camera.sock"

    async def close(self) -> None:
        """End the connections of the command and of the camera."""
        if self._server is not None:
            self._server.close()
        if self._tracker is not None:
            self._tracker.close()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    async def _answer_tracker(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One command that tracks, as long as it is connected; a second one is let go at once."""
        if self._tracker is not None:
            writer.close()
            return
        self._tracker, self._count, self._start = writer, 0, time.monotonic()
        try:
            while True:
                number, size = PICTURE_HEAD.unpack(await reader.readexactly(PICTURE_HEAD.size))
                self._picture_came(number, await reader.readexactly(size))
        except (asyncio.IncompleteReadError, OSError):
            pass  # it has ended
        finally:
            self._tracker, self._is_tracking = None, False
            self._open.clear()
            self._tell_all()
            writer.close()

    def _picture_came(self, number: int, jpeg: bytes) -> None:
        if not self._is_tracking:
            self._is_tracking = True
            self._begin()
            self._tell_all()
        camera, own = self._open.get(number, (None, 0))
        self._open = {one: frame for one, frame in self._open.items() if one > number}
        if camera is not None:
            camera.show(own, jpeg)
        for page in self._watching:
            page.show(number, jpeg)

    def _hand_on(self, camera: _Outbox, own: int, jpeg: bytes) -> bool:
        """Give a frame to the command; whether its picture will tell the camera that it is done."""
        if self._tracker is None or self._tracker.transport.get_write_buffer_size() > _MOST_WAITING:
            return False
        self._count += 1
        self._tracker.write(FRAME_HEAD.pack(self._count, time.monotonic() - self._start, len(jpeg)) + jpeg)
        self._open[self._count] = camera, own
        self._open.pop(self._count - _MOST_OPEN, None)
        self._keep(self._count, jpeg)
        return self._is_tracking

    # -- browsers -----------------------------------------------------------------------------------

    def facts(self) -> dict[str, Any]:
        """What pages show: the camera that sends, why its frames are not taken, and whether they are tracked."""
        return {"camera": self._what, "refused": self._refusal, "tracking": self._is_tracking}

    def _tell_all(self) -> None:
        for page in (*self._watching, *([] if self._camera is None else [self._camera])):
            page.tell(**self.facts())

    async def watch(self, browser: WebSocket) -> None:
        """Show a page what comes, until it goes."""
        await browser.accept()
        page = _Outbox(browser)
        page.tell(**self.facts())
        self._watching.add(page)
        try:
            await _until_either(page.send(), _drain(browser))
        finally:
            self._watching.discard(page)

    async def camera(self, browser: WebSocket, what: str) -> None:
        """Take the frames of a browser's camera, until it goes; the newest camera takes the place of another.

        Parameters
        ----------
        browser : not yet accepted.
        what : the camera is, for pages.
        """
        await browser.accept()
        camera = _Outbox(browser)
        before, self._sending, self._camera, self._what = self._sending, browser, camera, what
        if before is not None:
            with suppress(RuntimeError, WebSocketDisconnect):
                await before.close(_REPLACED, "another camera has taken the place of this one")
        self._size = await self._wanted()
        camera.tell(size=self._size)
        self._tell_all()
        try:
            await _until_either(camera.send(), self._take_frames(browser, camera))
        finally:
            if self._camera is camera:
                self._camera = self._sending = self.newest = None
                self._what = self._refusal = ""
                self._tell_all()

    async def _take_frames(self, browser: WebSocket, camera: _Outbox) -> None:
        while True:
            began = time.monotonic()
            message = await browser.receive()
            if message["type"] != "websocket.receive":
                return
            data = message.get("bytes") or b""
            if len(data) > _NUMBER.size and self._camera is camera:
                (own,), jpeg = _NUMBER.unpack_from(data), data[_NUMBER.size :]
                if not await self._take_frame(camera, own, jpeg):
                    camera.tell(seen=own)
            await asyncio.sleep(max(0.0, began + _LEAST_INTERVAL - time.monotonic()))

    async def _take_frame(self, camera: _Outbox, own: int, jpeg: bytes) -> bool:
        """Look at a frame and hand it on; whether its picture will be the answer."""
        found, wanted = jpeg_size(jpeg), await self._wanted()
        if wanted != self._size:  # there is another camera file
            self._size = wanted
            camera.tell(size=wanted)
        refusal = "the camera's frames are no JPEGs" if found is None else size_refusal(found, wanted)
        if (refusal or "") != self._refusal:
            self._refusal = refusal or ""
            self._tell_all()
        if refusal is not None:
            return False
        self.newest = jpeg
        if not self._is_tracking:
            for page in self._watching:
                page.show(own, jpeg)
        return self._hand_on(camera, own, jpeg)


async def _drain(browser: WebSocket) -> None:
    """Wait until a browser goes; what it says is for nobody."""
    while (await browser.receive())["type"] == "websocket.receive":
        pass


async def _until_either(*works: Awaitable[None]) -> None:
    """Work side by side until one ends; a browser that has gone is no error."""
    tasks = [asyncio.ensure_future(work) for work in works]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            with suppress(WebSocketDisconnect, RuntimeError, OSError):
                task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
