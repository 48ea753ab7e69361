"""`morph studio`: the server, and what it prints when it begins."""

from __future__ import annotations

import asyncio
import re
import shutil
import signal
import socket
import webbrowser
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path
from types import FrameType

import uvicorn

from morph_dslam.errors import StudioError, TrackingError
from morph_dslam.io.access import HOST, ServerNames, new_token
from morph_dslam.io.folders import only_writer
from morph_dslam.studio.app import make_app, phone_app
from morph_dslam.studio.gate import Access
from morph_dslam.studio.live import WEBSOCKETS
from morph_dslam.studio.phone import PhoneServer, own_address
from morph_dslam.studio.project import UPLOADING, Project
from morph_dslam.studio.steps import Steps

#: Hidden file that says where the studio of a project answers, without its token.
_OPEN_AT = ".studio-address"


class StudioServer:
    """The studio of one project, not yet running.

    Parameters
    ----------
    folder : of the project; it is made, the one around it is not.
    port : 0 takes any free one.
    host : address to listen at; that of this computer alone by default.
    phone : whether phones in the network may bring recordings, at the next port.

    Attributes
    ----------
    project : that is served.
    address : with the token, to be opened in a browser.
    phone_access : of phones, None if none is let in.
    phone_port : that a phone opens, 0 if none is let in.

    Raises
    ------
    StudioError
        If the folder cannot be made or written to, another studio serves it, or the address cannot be taken.
    """

    def __init__(self, folder: str | Path, port: int = 8766, host: str = HOST, phone: bool = False) -> None:
        project, self.token = Project(folder), new_token()
        self.project = project
        with ExitStack() as opened:
            _keep_others_out(opened, project)
            self._socket = opened.enter_context(_listening(host, port))
            self._phone_socket = None
            if phone:
                own_port = int(self._socket.getsockname()[1])
                self._phone_socket = opened.enter_context(_listening("0.0.0.0", own_port + 1 if port else 0))
            self._opened = opened.pop_all()
        self.port = int(self._socket.getsockname()[1])
        names = ServerNames() if host == HOST else ServerNames((host, socket.gethostname()), any_address=True)
        self.phone_access = Access.single() if phone else None
        self.phone_port = int(self._phone_socket.getsockname()[1]) if self._phone_socket else 0
        self._phone_host = own_address()
        steps = Steps(project, lambda: self.phone_address)
        self._phone_app = phone_app(steps, self.phone_access) if self.phone_access else None
        application = make_app(steps, Access(self.token, self.token), names, self._phones)
        config = uvicorn.Config(
            application, log_level="error", access_log=False, server_header=False, lifespan="on", **WEBSOCKETS,
            timeout_graceful_shutdown=2,
        )  # fmt: skip
        self._server = _Server(config, steps)
        shown = socket.gethostname() if host in ("0.0.0.0", "::") else _in_address(host)
        self.address = f"http://{shown}:{self.port}/?token={self.token}"
        (project.folder / _OPEN_AT).write_text(self.address.partition("?")[0] + "\n", encoding="utf-8")

    @property
    def phone_address(self) -> str | None:
        """What a phone opens, once; None if none is let in."""
        if self.phone_access is None:
            return None
        return f"https://{self._phone_host}:{self.phone_port}/?token={self.phone_access.invitation}"

    @asynccontextmanager
    async def _phones(self) -> AsyncIterator[None]:
        """Let phones in as long as the context lasts."""
        if self._phone_app is None or self._phone_socket is None:
            yield
            return
        server = PhoneServer(self._phone_app, self._phone_host)
        task = asyncio.create_task(server.serve([self._phone_socket]))
        try:
            yield
        finally:
            server.should_exit = True
            await task

    def run(self) -> None:
        """Answer until the process is interrupted, or `stop`; then other studios may serve the project."""
        with self._opened:
            self._server.run(sockets=[self._socket])

    @property
    def started(self) -> bool:
        """Whether it answers."""
        return self._server.started

    def stop(self) -> None:
        """End `run`, from another thread."""
        self._server.end()


class _Server(uvicorn.Server):
    """A server whose pages are let go when it ends; it would wait for them."""

    def __init__(self, config: uvicorn.Config, steps: Steps) -> None:
        super().__init__(config)
        self._steps = steps

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """End, as a signal asks."""
        self._steps.end_news()
        super().handle_exit(sig, frame)

    def end(self) -> None:
        """End without a signal."""
        self._steps.end_news()
        self.should_exit = True


def _keep_others_out(opened: ExitStack, project: Project) -> None:
    """Lock the project, and take away what uploads of a studio that was killed have left; raises StudioError."""
    try:
        opened.enter_context(only_writer(project.folder))
    except TrackingError as error:
        try:
            found = re.fullmatch(
                r"http://[\w.:\[\]-]+/", (project.folder / _OPEN_AT).read_text(encoding="utf-8").strip()
            )
        except (OSError, ValueError):
            found = None
        where = f" at {found[0]}" if found else ""
        raise StudioError(
            f"another studio{where} serves {project.folder} already: use that one, or end it first (Ctrl-C in its "
            "terminal)"
        ) from error
    opened.callback((project.folder / _OPEN_AT).unlink, missing_ok=True)
    for left in project.folder.glob(f"{UPLOADING}*"):
        shutil.rmtree(left, ignore_errors=True)


def _in_address(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _listening(host: str, port: int) -> socket.socket:
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listening = socket.create_server((host, port), family=family, backlog=64)
    except (OSError, OverflowError) as error:
        raise StudioError(
            f"{_in_address(host)}:{port} cannot be taken ({error}); choose another with --port; --port 0 takes any "
            "free one"
        ) from error
    return listening


def open_studio(
    folder: str | Path = ".", port: int = 8766, host: str = HOST, open_browser: bool = False, phone: bool = False
) -> None:
    """Serve the studio of a project until it is interrupted.

    Parameters
    ----------
    folder : of the project; it is made, the one around it is not.
    port : 0 takes any free one.
    host : address to listen at; that of this computer alone by default.
    open_browser : whether to open the page at once.
    phone : whether phones in the network may bring recordings, over HTTPS at the next port.

    Raises
    ------
    StudioError
        If the folder cannot be made or written to, another studio serves it, or the address cannot be taken.
    """
    server = StudioServer(folder, port, host, phone)
    print(f"the studio of {Path(folder).resolve()} is at {server.address} (Ctrl-C ends it)", flush=True)
    if server.project.damage is not None:
        print(f"note: {server.project.damage}", flush=True)
    if phone:
        print(f"a phone records at {server.phone_address}, once; its browser warns of the certificate", flush=True)
    if open_browser:
        webbrowser.open(server.address)
    # uvicorn ends on Ctrl-C and raises it again; the studio's own answer to it is to end quietly.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        server.run()
    except KeyboardInterrupt:
        print()
    finally:
        signal.signal(signal.SIGINT, before)
