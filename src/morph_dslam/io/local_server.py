"""Web servers for browsers on this computer only: the pages of `morph explore`, the pictures of `morph live`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from morph_dslam.errors import MorphError
from morph_dslam.io.access import HOST, ServerNames

_NAMES = ServerNames()


class LocalHandler(BaseHTTPRequestHandler):
    """Answers requests of this computer's own browsers by `answer`."""

    def answer(self) -> None:
        """Answer the request for ``path``."""
        raise NotImplementedError

    def do_GET(self) -> None:
        if _NAMES.refusal(self.headers.get("Host", ""), None) is None:
            self.answer()
        else:
            self.send_error(HTTPStatus.FORBIDDEN)

    def begin(self, content_type: str, length: int | None = None, status: HTTPStatus = HTTPStatus.OK) -> None:
        """Send what comes before the content; ``length`` in bytes where it is known."""
        self.send_response(status)
        self.send_header("Content-Type", content_type)
        if length is not None:
            self.send_header("Content-Length", str(length))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()

    def log_message(self, format: str, *args) -> None:
        """Nothing: requests are no news, and a slider makes many a second."""


class LocalServer(ThreadingHTTPServer):
    """A server on this computer's own address."""

    daemon_threads = True

    @property
    def address(self) -> str:
        return f"http://{HOST}:{self.server_address[1]}/"

    def handle_error(self, request, client_address) -> None:
        """Say nothing of a page that was closed before its answer came."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


def local_server(port: int, handler: Callable[..., LocalHandler], error: type[MorphError], option: str) -> LocalServer:
    """A server whose requests are handled on this computer.

    Parameters
    ----------
    port : 0 takes any free one.
    handler : makes the handler of a request.
    error : is raised where the port cannot be taken.
    option : of the command line that sets the port.
    """
    try:
        return LocalServer((HOST, port), handler)
    except (OSError, OverflowError) as cause:
        raise error(
            f"port {port} cannot be taken ({cause}); choose another with {option}; {option} 0 takes any free one"
        ) from cause
