"""`morph explore`: a small web server on this computer only, which answers with shapes and states."""

from __future__ import annotations

import json
import sys
import webbrowser
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import ExploreError
from morph_dslam.explore.surface import ModelSurface
from morph_dslam.model import ReducedModel, load_model
from morph_dslam.units import to_si

HOST = "127.0.0.1"

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
}
#: The only files that are served, by the path they are asked for.
_FILES = {
    "/": "index.html",
    **{
        f"/{name}": name
        for name in (
            "explore.css", "explore.js", "solid_view.js", "colour_bar.js",
            "three/three.module.min.js", "three/three.core.min.js", "three/OrbitControls.js",
        )
    },
}  # fmt: skip


class _BadRequest(Exception):
    """What the page asked for cannot be answered."""


class Answers:
    """Answers to the page's requests, without the network: (content type, content) for a path."""

    def __init__(self, model: ReducedModel) -> None:
        self._model, self._surface = model, ModelSurface(model)
        self._model_json = json.dumps(self._surface.description()).encode()
        self._shape = self._surface.shape()

    def answer(self, target: str) -> tuple[str, bytes] | None:
        """The answer to a request's path and query, None where there is nothing.

        Raises
        ------
        _BadRequest
            If the query of a state does not name a field and the value of every parameter.
        """
        url = urlsplit(target)
        if url.path in _FILES:
            name = _FILES[url.path]
            content = files("morph_dslam.explore").joinpath("static", *name.split("/")).read_bytes()
            return _TYPES[Path(name).suffix], content
        if url.path == "/model.json":
            return "application/json", self._model_json
        if url.path == "/shape.bin":
            return "application/octet-stream", self._shape
        if url.path == "/state.bin":
            query = {name: values[-1] for name, values in parse_qs(url.query).items()}
            return "application/octet-stream", self._state(query)
        return None

    def _state(self, query: dict[str, str]) -> bytes:
        try:
            return self._surface.state(self._parameters(query["mu"]), query["field"])
        except KeyError as error:
            raise _BadRequest(f"{error} is missing, or no field of this model") from error

    def _parameters(self, text: str) -> NDArray[np.float64]:
        """The values (d,) of "1.5,20" in the parameters' units as SI, within their ranges."""
        model = self._model
        try:
            given = zip(model.parameters, text.split(","), strict=True)
            mu = np.array([to_si(float(value), p.unit, p.quantity) for p, value in given])
        except ValueError as error:
            raise _BadRequest(f"'{text}' is not {len(model.parameters)} numbers") from error
        if not np.isfinite(mu).all():
            raise _BadRequest(f"'{text}' holds values that are not finite")
        return np.clip(mu, model.lower, model.upper)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def __init__(self, answers: Answers, *arguments) -> None:
        self._answers = answers
        super().__init__(*arguments)

    def do_GET(self) -> None:
        # Else a page from elsewhere could read the model under a name of its own for this address.
        if urlsplit(f"//{self.headers.get('Host', '')}").hostname not in (HOST, "localhost"):
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        try:
            answer = self._answers.answer(self.path)
        except _BadRequest as error:
            self._send(HTTPStatus.BAD_REQUEST, "text/plain; charset=utf-8", str(error).encode())
            return
        if answer is None:
            self.send_error(HTTPStatus.NOT_FOUND)
        else:
            self._send(HTTPStatus.OK, *answer)

    def _send(self, status: HTTPStatus, content_type: str, content: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args) -> None:
        """Nothing: a slider asks many times a second."""


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request, client_address) -> None:
        """Say nothing of a page that was closed before its answer came."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


def make_server(model: ReducedModel, port: int) -> ThreadingHTTPServer:
    """A server for one model on this computer's own address; ``port`` 0 takes any free one.

    Raises
    ------
    ExploreError
        If the port cannot be taken.
    """
    try:
        return _Server((HOST, port), partial(_Handler, Answers(model)))
    except (OSError, OverflowError) as error:
        raise ExploreError(
            f"port {port} cannot be taken ({error}); choose another with --port; --port 0 takes any free one"
        ) from error


def explore(model_path: Path, port: int, open_browser: bool) -> None:
    """Serve a model's page until interrupted.

    Raises
    ------
    ModelFileError
        If the model cannot be read.
    ExploreError
        If the port cannot be taken.
    """
    with make_server(load_model(model_path), port) as server:
        address = f"http://{HOST}:{server.server_address[1]}/"
        print(f"{model_path} is shown at {address} (Ctrl-C ends it)", flush=True)
        if open_browser:
            webbrowser.open(address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()
