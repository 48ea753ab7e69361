"""What the studio answers: its pages, and for each step what it reads and writes."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
import re
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager, nullcontext
from functools import partial
from importlib.resources import files
from typing import Any

from pydantic import ValidationError, validate_call
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route, WebSocketRoute

from morph_dslam.errors import StudioError
from morph_dslam.io.access import ServerNames
from morph_dslam.studio import project as names
from morph_dslam.studio.gate import MOST_BODY, Access, Gate
from morph_dslam.studio.phone import qr_code
from morph_dslam.studio.steps import Steps

_TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
#: The pages' own files, and those of the explorer that they share.
_PAGES = (
    "studio.css", "studio.js", "server.js", "parts.js", "mesh_view.js", "overlay.js", "plot.js", "recorder.js",
    "object_step.js", "study_step.js", "build_step.js", "camera_step.js", "start_step.js", "scan_start.js",
    "track_step.js", "results_step.js", "phone.js", "live_camera.js", "live_view.js",
)  # fmt: skip
_PHONE = ("studio.css", "server.js", "parts.js", "recorder.js", "live_camera.js", "phone.js")
_SHARED = (
    "solid_view.js", "colour_bar.js", "three/three.module.min.js", "three/three.core.min.js", "three/OrbitControls.js",
)  # fmt: skip
_REPORT_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; frame-ancestors 'self'"


def _page(name: str) -> bytes:
    package = "morph_dslam.explorer" if name in _SHARED else "morph_dslam.studio"
    return files(package).joinpath("static", *name.split("/")).read_bytes()


def _policy() -> str:
    """Nothing from elsewhere; the one script within a page is the map of module names, known by its hash."""
    hashes = []
    for page in (_page("index.html"), files("morph_dslam.explorer").joinpath("static", "index.html").read_bytes()):
        for script in re.findall(rb'<script type="importmap">(.*?)</script>', page, re.DOTALL):
            hashes.append(f"'sha256-{base64.b64encode(hashlib.sha256(script).digest()).decode()}'")
    return (
        f"default-src 'self'; script-src 'self' {' '.join(hashes)}; img-src 'self' blob: data:; "
        "style-src 'self' 'unsafe-inline'; frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
    )


class _Answers:
    """Answers to requests, by the steps of a project."""

    def __init__(self, steps: Steps) -> None:
        self._steps = steps

    async def index(self, request: Request) -> Response:
        """The page."""
        return Response(_page("index.html"), media_type="text/html")

    async def page(self, request: Request) -> Response:
        """A file of the page."""
        name = request.path_params["name"]
        if name not in (*_PAGES, *_SHARED):
            raise HTTPException(404, "there is no such page")
        return Response(_page(name), media_type=_TYPES[name.rpartition(".")[2]])

    async def state(self, request: Request) -> Response:
        """What the project has, and the job."""
        return JSONResponse(await self._steps.state())

    async def events(self, request: Request) -> Response:
        """The job whenever it has news, and new lines of the frame log, as server-sent events."""

        async def stream() -> AsyncIterator[str]:
            async for name, content in self._steps.news():
                yield f"event: {name}\ndata: {json.dumps(content)}\n\n"

        return StreamingResponse(stream(), media_type="text/event-stream")

    async def upload(self, request: Request) -> Response:
        """Take in a file; the body is its content."""
        kind, name = request.path_params["kind"], request.path_params["name"]
        _, allowed = self._steps.project.upload_path(kind, name)
        declared = request.headers.get("content-length", "")
        if declared.isdecimal() and int(declared) > allowed.largest:
            raise HTTPException(413, f"{name} is larger than {allowed.largest} bytes, the most that is taken")
        with self._steps.project.uploading(name) as part:
            size = 0
            with part.open("wb") as file:
                async for chunk in request.stream():
                    size += len(chunk)
                    if size > allowed.largest:
                        raise HTTPException(
                            413, f"{name} is larger than {allowed.largest} bytes, the most that is taken"
                        )
                    await asyncio.to_thread(file.write, chunk)
            return JSONResponse(await self._steps.uploaded(kind, name, part))

    async def phone_code(self, request: Request) -> Response:
        """The address that a phone opens, as a QR code."""
        address = self._steps.phone_address()
        if address is None:
            raise HTTPException(404, "no phone is let in: start with --phone")
        return Response(qr_code(address), media_type="image/png")

    async def phone(self, request: Request) -> Response:
        """The page of a phone."""
        return Response(_page("phone.html"), media_type="text/html")

    async def phone_page(self, request: Request) -> Response:
        """A file of the phone's page."""
        if request.path_params["name"] not in _PHONE:
            raise HTTPException(404, "there is no such page")
        return await self.page(request)

    async def phone_upload(self, request: Request) -> Response:
        """Take in a recording, and nothing else."""
        if request.path_params["kind"] != "recording":
            raise HTTPException(404, "a phone brings recordings")
        return await self.upload(request)

    async def file(self, request: Request) -> Response:
        """A file of the project, to keep."""
        path = self._steps.project.path(request.path_params["name"])
        if not path.is_file():
            raise HTTPException(404, "there is no such file in the project")
        return FileResponse(path, filename=path.name, media_type="application/octet-stream")

    async def report(self, request: Request) -> Response:
        """The report of the build."""
        path = self._steps.project.path(names.REPORT)
        if not path.is_file():
            raise HTTPException(404, "there is no report: build the model")
        return FileResponse(path, media_type="text/html", headers={"Content-Security-Policy": _REPORT_POLICY})

    async def explore(self, request: Request) -> Response:
        """The page of `morph explore` for the model of the project."""
        target = "/" + request.path_params["name"] + (f"?{request.url.query}" if request.url.query else "")
        found = await self._steps.explore(target)
        if found is None:
            raise HTTPException(404, "the explorer has no such page")
        return Response(found[1], media_type=found[0])

    async def frame(self, request: Request) -> Response:
        """A frame of the recording."""
        return Response(await self._steps.frame(request.path_params["number"]), media_type="image/jpeg")

    async def scan_frame(self, request: Request) -> Response:
        """A frame of the scan."""
        return Response(await self._steps.scan.frame(request.path_params["number"]), media_type="image/jpeg")

    async def call(self, request: Request) -> Response:
        """Call a step's action with the body's JSON object as its arguments."""
        action = self._steps.actions.get(request.path_params["action"])
        if action is None:
            raise HTTPException(404, "there is no such action")
        content = await _json(request)
        try:
            found = await validate_call(action)(**content)
        except ValidationError as error:
            what = "; ".join(f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()[:3])
            raise HTTPException(400, f"{request.path_params['action']} was asked for wrongly: {what[:300]}") from error
        return (
            Response(found, media_type="application/octet-stream") if isinstance(found, bytes) else JSONResponse(found)
        )


async def _json(request: Request) -> dict[str, Any]:
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > MOST_BODY:
            raise HTTPException(413, f"a request has at most {MOST_BODY} bytes")
    try:
        content = json.loads(body or b"{}", parse_constant=_no_number)
    except (ValueError, RecursionError):
        raise HTTPException(400, "the request is not JSON") from None
    if not isinstance(content, dict):
        raise HTTPException(400, "the request is not a JSON object")
    return content


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number")


async def _told(request: Request, error: Exception) -> Response:
    """One message for what the user can mend."""
    return PlainTextResponse(str(error), 400)


async def _told_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return PlainTextResponse(error.detail, error.status_code)


async def _told_nothing(request: Request, error: Exception) -> Response:
    return PlainTextResponse("the studio could not do this; its terminal may say more", 500)


async def _left(request: Request, error: Exception) -> Response:
    return PlainTextResponse("the upload broke off", 400)


_HANDLERS = {StudioError: _told, HTTPException: _told_http, ClientDisconnect: _left, Exception: _told_nothing}


def phone_app(steps: Steps, access: Access) -> Callable:
    """What a phone may do, behind a gate: record, bring the recording, and be the camera of live tracking.

    Parameters
    ----------
    steps : of the project.
    access : of phones.
    """
    answers = _Answers(steps)
    routes = [
        Route("/", answers.phone),
        Route("/api/upload/{kind:str}/{name:path}", answers.phone_upload, methods=["PUT"]),
        WebSocketRoute("/api/camera", partial(steps.live.relay.camera, what="of the phone")),
        Route("/{name:path}", answers.phone_page),
    ]
    application = Starlette(routes=routes, exception_handlers=_HANDLERS)  # type: ignore[arg-type]
    return Gate(application, access, ServerNames(any_address=True), _policy())


def make_app(
    steps: Steps,
    access: Access,
    server_names: ServerNames,
    beside: Callable[[], AbstractAsyncContextManager] = nullcontext,
) -> Callable:
    """The studio of a project as an ASGI application, behind its gate.

    Parameters
    ----------
    steps : of the project.
    access : of browsers.
    server_names : that the server may be asked by.
    beside : what runs as long as the application does.
    """
    answers = _Answers(steps)

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        async with beside():
            yield
        await steps.close()

    routes = [
        Route("/", answers.index),
        Route("/api/state", answers.state),
        Route("/api/events", answers.events),
        Route("/api/upload/{kind}/{name:path}", answers.upload, methods=["PUT"]),
        Route("/api/phone.png", answers.phone_code),
        Route("/api/frame/{number:int}", answers.frame),
        WebSocketRoute("/api/camera", partial(steps.live.relay.camera, what="of this computer")),
        WebSocketRoute("/api/watch", steps.live.relay.watch),
        Route("/api/scan/{number:int}", answers.scan_frame),
        Route("/api/{action}", answers.call, methods=["POST"]),
        Route("/files/{name:path}", answers.file),
        Route("/report", answers.report),
        Route("/explore/{name:path}", answers.explore),
        Route("/{name:path}", answers.page),
    ]
    application = Starlette(routes=routes, lifespan=lifespan, exception_handlers=_HANDLERS)  # type: ignore[arg-type]
    return Gate(application, access, server_names, _policy())
