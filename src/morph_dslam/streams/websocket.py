"""A stream by WebSocket, and a page that shows it, served at one port by a thread of its own.

Each client is sent the scene, then always the newest frame: who is slow gets fewer, and nobody waits for anybody.
A message is followed by a ping, whose answer says that the client's side has read so far: only then comes the next.
Otherwise messages would get old in the buffers of both systems.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import logging
import re
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from http import HTTPStatus
from importlib.resources import files

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from morph_dslam.errors import StreamError
from morph_dslam.io.access import HOST, split_target
from morph_dslam.streams.colours import colour_map
from morph_dslam.streams.gate import StreamGate, stream_token
from morph_dslam.streams.messages import FrameMessage, SceneMessage
from morph_dslam.streams.packets import end_packet, frame_packet, scene_packet

#: Takes what the server would say of connections that are none, instead of the terminal.
_LOG = logging.getLogger("morph_dslam.streams")
_LOG.addHandler(logging.NullHandler())
#: Where programs connect.
PATH = "/stream"
#: Bytes that may wait for a client, in the process and in the system: frames that wait there get old.
WAITING = 1 << 17
#: Bytes of a message from a client; none is expected.
MOST_RECEIVED = 1024
#: Seconds that a client has at the end to take what is left.
LAST_SECONDS = 2.0
_TYPES = {"html": "text/html; charset=utf-8", "css": "text/css; charset=utf-8", "js": "text/javascript; charset=utf-8"}
#: The files of the page, and those of the explorer that it shares.
_OWN = ("index.html", "stream.js", "stream.css")
_SHARED = (
    "explore.css", "solid_view.js", "colour_bar.js", "three/three.module.min.js", "three/three.core.min.js",
    "three/OrbitControls.js",
)  # fmt: skip


def _page(name: str) -> bytes:
    package = "morph_dslam.streams" if name in _OWN else "morph_dslam.explorer"
    return files(package).joinpath("static", *name.split("/")).read_bytes()


@dataclass
class _Newest:
    """What clients are sent; used in the server's thread alone.

    Attributes
    ----------
    scene : as bytes; None before it is known.
    n_scenes : number of scenes so far.
    frame : the newest.
    n_frames : number of frames so far.
    ended : whether no more will come.
    changed : set at the next change, when another takes its place.
    no_more : set once it has ended.
    """

    scene: bytes | None = None
    n_scenes: int = 0
    frame: FrameMessage | None = None
    n_frames: int = 0
    ended: bool = False
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    no_more: asyncio.Event = field(default_factory=asyncio.Event)
    _packet: tuple[int, bytes] = (0, b"")

    def packet(self) -> bytes:
        """The newest frame as bytes, made once for all clients, and only if one has time for it."""
        if self._packet[0] != self.n_frames and self.frame is not None:
            self._packet = self.n_frames, frame_packet(self.frame)
        return self._packet[1]


class WebSocketPublisher:
    """Serves a stream to browsers and programs.

    Parameters
    ----------
    host : address to listen at.
    port : 0 takes any free one.

    Attributes
    ----------
    port : that it listens at.
    token : that clients must bring.

    Raises
    ------
    StreamError
        If the address cannot be taken, or the system lets nobody listen at it.
    """

    def __init__(self, host: str = HOST, port: int = 0) -> None:
        self.token = stream_token()
        self._socket = _listening(host, port)
        self.port = int(self._socket.getsockname()[1])
        is_own = host in (HOST, "localhost")
        self._name = HOST if is_own else _name_for_others(host)
        names = () if is_own else (host, socket.gethostname())
        self._gate = StreamGate(self.token, HOST if is_own else host, self.port, names)
        self._clients: set[ServerConnection] = set()
        self._ready = threading.Event()
        self._failure: OSError | None = None
        self._thread = threading.Thread(target=self._run, name="stream", daemon=True)
        self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            raise StreamError(f"--stream ws cannot be served: {self._failure}") from self._failure

    @property
    def place(self) -> str:
        """The address of the page, with the token."""
        return f"http://{self._name}:{self.port}/?token={self.token}"

    @property
    def is_watched(self) -> bool:
        """Whether a client is connected."""
        return bool(self._clients)

    def begin(self, scene: SceneMessage) -> None:
        """Tell the scene to all clients, and to those that come later."""
        packet = scene_packet(scene, colour_map().tolist())

        def change(newest: _Newest) -> None:
            newest.scene, newest.n_scenes, newest.frame = packet, newest.n_scenes + 1, None

        self._change(change)

    def publish(self, message: FrameMessage) -> None:
        """Tell a frame to all clients that have time for it; it is not kept for those that come later."""

        def change(newest: _Newest) -> None:
            if self._clients:
                newest.frame, newest.n_frames = message, newest.n_frames + 1

        self._change(change)

    def close(self) -> None:
        """Tell clients that it ends, and stop."""

        def change(newest: _Newest) -> None:
            newest.ended = True
            newest.no_more.set()

        self._change(change)
        self._thread.join(3.0 * LAST_SECONDS)

    def _change(self, change: Callable[[_Newest], None]) -> None:
        """Change what clients are sent, in the server's thread, without waiting for it."""

        def changed() -> None:
            change(self._newest)
            self._newest.changed.set()
            self._newest.changed = asyncio.Event()

        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(changed)

    def _run(self) -> None:
        """Serve until it ends; keep the error that did not let it begin, for the thread that waits."""
        try:
            asyncio.run(self._serve())
        except OSError as error:
            if self._ready.is_set():
                raise
            self._socket.close()
            self._failure = error
        finally:
            self._ready.set()

    async def _serve(self) -> None:
        self._loop, self._newest = asyncio.get_running_loop(), _Newest()
        async with serve(
            self._send_all, sock=self._socket, process_request=self._answer, compression=None, max_size=MOST_RECEIVED,
            write_limit=WAITING, close_timeout=LAST_SECONDS, server_header=None, logger=_LOG,
        ):  # fmt: skip
            self._ready.set()
            while not self._newest.ended:
                await self._newest.changed.wait()
            # Leaving the server closes what is still open, so clients get a moment for the last frame.
            last = self._loop.time() + LAST_SECONDS
            while self._clients and self._loop.time() < last:
                await asyncio.sleep(0.02)
            for client in tuple(self._clients):
                client.transport.abort()

    async def _send_all(self, client: ServerConnection) -> None:
        """Send a client scene and frames until there are no more, or it goes."""
        self._clients.add(client)
        newest, n_scenes, n_frames = self._newest, 0, 0
        ended = asyncio.ensure_future(newest.no_more.wait())
        try:
            while True:
                if newest.n_scenes > n_scenes and newest.scene is not None:
                    n_scenes = newest.n_scenes
                    await _send_and_wait(client, newest.scene, ended)
                elif newest.n_frames > n_frames and newest.frame is not None:
                    n_frames = newest.n_frames
                    await _send_and_wait(client, newest.packet(), ended)
                elif newest.ended:
                    await client.send(end_packet())
                    return
                else:
                    await newest.changed.wait()
        except ConnectionClosed:
            pass  # it has gone
        finally:
            ended.cancel()
            self._clients.discard(client)
            if not self._clients:
                newest.frame = None  # it would be old when one comes

    def _answer(self, client: ServerConnection, request: Request) -> Response | None:
        """Refuse a request, or answer it with a file of the page; None to go on with a WebSocket."""
        path, _ = split_target(request.path)
        try:
            refusal = self._gate.refusal(request.path, request.headers)
        except LookupError:  # a header that may stand once stands twice
            return _response(HTTPStatus.BAD_REQUEST, b"a header stands twice", "text/plain")
        if refusal is not None:
            return _response(refusal.status, refusal.text.encode(), "text/plain")
        if path == PATH:
            return None
        if path == "/" and self._gate.has_token(request.path):
            answer = _response(HTTPStatus.SEE_OTHER, b"", "text/plain")
            answer.headers["Location"] = "/"
            answer.headers["Set-Cookie"] = f"{self._gate.cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
            return answer
        name = "index.html" if path == "/" else path.removeprefix("/")
        if name not in (*_OWN, *_SHARED):
            return _response(HTTPStatus.NOT_FOUND, b"there is no such page", "text/plain")
        answer = _response(HTTPStatus.OK, _page(name), _TYPES[name.rpartition(".")[2]])
        answer.headers["Content-Security-Policy"] = _policy(request.headers["Host"])
        return answer


async def _send_and_wait(client: ServerConnection, packet: bytes, ended: asyncio.Future) -> None:
    """Send a message, and wait until the client has read it, or the stream has ended."""
    await client.send(packet)
    read = await client.ping()
    await asyncio.wait({asyncio.ensure_future(read), ended}, return_when=asyncio.FIRST_COMPLETED)


def _response(status: HTTPStatus, body: bytes, content_type: str) -> Response:
    headers = Headers(
        {
            "Content-Type": content_type,
            "Content-Length": str(len(body)),
            "Connection": "close",
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
        }
    )
    return Response(status.value, status.phrase, headers, body)


def _policy(host: str) -> str:
    """Nothing from elsewhere; the one script within the page is the map of module names, known by its hash."""
    (script,) = re.findall(rb'<script type="importmap">(.*?)</script>', _page("index.html"), re.DOTALL)
    known = base64.b64encode(hashlib.sha256(script).digest()).decode()
    return (
        f"default-src 'self'; script-src 'self' 'sha256-{known}'; connect-src 'self' ws://{host}; "
        "img-src 'self' data:; style-src 'self' 'unsafe-inline'; frame-ancestors 'none'; base-uri 'none'; "
        "form-action 'none'"
    )


def _name_for_others(host: str) -> str:
    """How an address names a host that listens: one that stands for all of its addresses says nothing to others."""
    if host in ("0.0.0.0", "::"):
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host


def _listening(host: str, port: int) -> socket.socket:
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listening = socket.create_server((host, port), family=family)
    except OSError as error:
        raise StreamError(
            f"{host}:{port} cannot be taken for --stream ws ({error}); choose another port, --stream ws:PORT; "
            "ws:0 takes any free one"
        ) from error
    # Connections inherit both; without the second a ping would wait until the message before is acknowledged.
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, WAITING)
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listening
