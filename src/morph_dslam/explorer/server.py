"""`morph explore`: a web server on this computer only, which answers with a model's surface, moved and coloured."""

from __future__ import annotations

import json
import webbrowser
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import matplotlib
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import ExploreError
from morph_dslam.io.access import split_target
from morph_dslam.io.local_server import LocalHandler, LocalServer, local_server
from morph_dslam.model import ReducedModel, load_model
from morph_dslam.model.reduced_model import von_mises
from morph_dslam.model.shown_field import shown_kind
from morph_dslam.units import to_si

Array = NDArray[np.float64]
#: Colours end at this percentile of the field over the surface and the box: stress has narrow peaks.
_PERCENTILE = 99.5
#: States of the box, besides its middle, that the range of colours is taken from (a power of two).
_SAMPLES = 64
#: Labels of the stresses, in the order in which they are offered.
_PLACES = {"solid": "von Mises stress", "top": "von Mises stress, top", "bottom": "von Mises stress, bottom"}


def _round_up(top: float) -> float:
    """The next number whose fifths are short."""
    power = 10.0 ** np.floor(np.log10(max(top, 1e-9)))
    return float(next(step * power for step in (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.5, 10.0) if step * power >= top))


@dataclass(frozen=True)
class _ColourField:
    """A scalar that the surface can be coloured by; ``top`` is the end of its colours, in ``unit``."""

    key: str
    label: str
    unit: str
    top: float


class ModelSurface:
    """The visible surface of a reduced model, evaluated for one state after the other.

    Attributes
    ----------
    nodes : (n, 3) surface nodes at rest, metres.
    triangles : (m, 3) in these nodes.
    """

    def __init__(self, model: ReducedModel) -> None:
        self._model, self._stress = model, shown_kind(model, "stress")
        used, corners = np.unique(model.triangles, return_inverse=True)
        self.nodes, self.triangles = model.nodes[used], corners.reshape(-1, 3)
        one = np.ones((len(used), 1))
        self._displacement = model.displacement.restrict(used[:, None], one)
        self._stresses = {place: field.restrict(used[:, None], one) for place, field in model.stresses.items()}

    def values(self, mu: Array, key: str) -> Array:
        """The field ``key`` (n,) for parameters ``mu`` (d,) in the unit of its colours."""
        if key == "displacement":
            return 1e3 * np.linalg.norm(self._displacement.value(mu), axis=1)
        return von_mises(self._stresses[key].value(mu)) / self._stress.si_factor

    def state(self, mu: Array, key: str) -> bytes:
        """Little-endian floats: displacements (n, 3) in metres, then the values (n,) of field ``key``."""
        parts = (self._displacement.value(mu), self.values(mu, key))
        return b"".join(np.ascontiguousarray(part, dtype="<f4").tobytes() for part in parts)

    def shape(self) -> bytes:
        """Little endian: nodes (n, 3) in single precision, then triangles (m, 3) as 32-bit integers."""
        return self.nodes.astype("<f4").tobytes() + self.triangles.astype("<u4").tobytes()

    @cached_property
    def fields(self) -> tuple[_ColourField, ...]:
        """The fields to choose from, with one range of colours for the whole box."""
        model = self._model
        samples = model.spread_parameters(_SAMPLES)
        names = {"displacement": "displacement"}
        names |= {place: label for place, label in _PLACES.items() if place in self._stresses}
        result = []
        for key, label in names.items():
            top = float(np.percentile([self.values(mu, key) for mu in samples], _PERCENTILE))
            unit = "mm" if key == "displacement" else self._stress.unit
            result.append(_ColourField(key, label, unit, _round_up(top or 1.0)))
        return tuple(result)

    def description(self) -> dict[str, Any]:
        """Everything else that the page needs, as plain JSON; parameters in their own units."""
        parameters = [
            {
                "name": p.name,
                "description": p.description,
                "unit": "" if p.unit == "1" else p.unit,
                "lower": p.display(p.lower),
                "upper": p.display(p.upper),
                "default": p.display(p.default),
            }
            for p in self._model.parameters
        ]
        colours = matplotlib.colormaps["turbo"](np.arange(256), bytes=True)
        return {
            "name": self._model.name,
            "nodes": len(self.nodes),
            "triangles": len(self.triangles),
            "parameters": parameters,
            "fields": [asdict(field) for field in self.fields],
            "colours": np.asarray(colours).tolist(),
        }


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


class BadRequest(Exception):
    """What the page asked for cannot be answered."""


class ModelPages:
    """Answers to the page's requests, without the network: (content type, content) for a path.

    Attributes
    ----------
    surface : of the model.
    """

    def __init__(self, model: ReducedModel) -> None:
        self._model, self.surface = model, ModelSurface(model)
        self._model_json = json.dumps(self.surface.description()).encode()
        self._shape = self.surface.shape()

    def answer(self, target: str) -> tuple[str, bytes] | None:
        """The answer to a request's path and query, None where there is nothing.

        Raises
        ------
        BadRequest
            If the query describes no state of the model.
        """
        path, asked = split_target(target)
        if path in _FILES:
            name = _FILES[path]
            content = files("morph_dslam.explorer").joinpath("static", *name.split("/")).read_bytes()
            return _TYPES[Path(name).suffix], content
        if path == "/model.json":
            return "application/json", self._model_json
        if path == "/shape.bin":
            return "application/octet-stream", self._shape
        if path == "/state.bin":
            query = {name: values[-1] for name, values in parse_qs(asked, keep_blank_values=True).items()}
            return "application/octet-stream", self._state(query)
        return None

    def _state(self, query: dict[str, str]) -> bytes:
        try:
            return self.surface.state(self._parameters(query["mu"]), query["field"])
        except KeyError as error:
            raise BadRequest(f"{error} is missing, or no field of this model") from error

    def _parameters(self, text: str) -> NDArray[np.float64]:
        """The values (d,) of "1.5,20" in the parameters' units as SI, within their ranges."""
        model = self._model
        try:
            given = zip(model.parameters, text.split(",") if text else [], strict=True)
            mu = np.array([to_si(float(value), p.unit, p.quantity) for p, value in given])
        except ValueError as error:
            raise BadRequest(f"'{text}' is not {len(model.parameters)} numbers") from error
        if not np.isfinite(mu).all():
            raise BadRequest(f"'{text}' holds values that are not finite")
        return np.clip(mu, model.lower, model.upper)


class _Handler(LocalHandler):
    protocol_version = "HTTP/1.1"

    def __init__(self, answers: ModelPages, *arguments) -> None:
        self._answers = answers
        super().__init__(*arguments)

    def answer(self) -> None:
        status = HTTPStatus.OK
        try:
            answer = self._answers.answer(self.path)
        except BadRequest as error:
            status, answer = HTTPStatus.BAD_REQUEST, ("text/plain; charset=utf-8", str(error).encode())
        if answer is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        content_type, content = answer
        self.begin(content_type, len(content), status)
        self.wfile.write(content)


def make_server(model: ReducedModel, port: int) -> LocalServer:
    """A server for one model; ``port`` 0 takes any free one."""
    return local_server(port, partial(_Handler, ModelPages(model)), ExploreError, "--port")


def explore(model: str | Path | ReducedModel, port: int = 8765, open_browser: bool = False) -> None:
    """Serve a model's page to browsers on this computer until interrupted.

    Parameters
    ----------
    model : a model or its file.
    port : 0 takes any free one.
    open_browser : whether to open the page at once.

    Raises
    ------
    ModelFileError
        If the model cannot be read.
    ExploreError
        If the port cannot be taken.
    """
    shown = model if isinstance(model, ReducedModel) else load_model(model)
    with make_server(shown, port) as server:
        name = shown.name if shown is model else model
        print(f"{name} is shown at {server.address} (Ctrl-C ends it)", flush=True)
        if open_browser:
            webbrowser.open(server.address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()
