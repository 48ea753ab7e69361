"""A stream to the viewer rerun, or to a recording of it: every frame, with its image."""

from __future__ import annotations

import socket
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from morph_dslam.camera import Maps
from morph_dslam.errors import StreamError
from morph_dslam.model.inner_structure import colour_of
from morph_dslam.streams.colours import colours_of
from morph_dslam.streams.messages import FrameMessage, ObjectInfo, ObjectMessage, SceneMessage

JPEG_QUALITY = 80
#: Frames that may wait to be written.
MOST_WAITING = 8
#: Addresses of a viewer that runs elsewhere.
VIEWER = "rerun+http"
#: Seconds that a viewer has to answer, and at the end to take what is left.
LONGEST_ANSWER, LAST_SECONDS = 5.0, 10.0
_LEVELS = {"tracked": "INFO", "hidden": "WARN", "lost": "ERROR"}


class RerunPublisher:
    """Logs frames in a thread of its own, each of them.

    Parameters
    ----------
    where : file to write, what it held is gone with the first frame; or address of a viewer, "rerun+http://..."; empty
        to start one.

    Raises
    ------
    StreamError
        If the file cannot be written, no viewer can be started, or none answers.
    """

    def __init__(self, where: str) -> None:
        self._where, self._recording = where, rr.RecordingStream("morph-dslam")
        self._file = Path(where) if where and not where.startswith(VIEWER) else None  # until it is begun
        try:
            if self._file is not None:
                _check_file(self._file)
            elif where:
                _check_viewer(where)
                self._recording.connect_grpc(where, default_blueprint=_layout())
            else:
                self._recording.spawn(default_blueprint=_layout())
        except (OSError, RuntimeError, ValueError) as error:
            raise self._not_opened(error) from error
        self._scene: SceneMessage | None = None
        self._maps: Maps | None = None
        self._texts: dict[str, str] = {}
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="rerun")
        self._waiting: deque[Future[None]] = deque()

    def _not_opened(self, error: Exception) -> StreamError:
        where = self._where
        return StreamError(f"--stream rerun{where and ':'}{where} cannot be opened: {error}")

    @property
    def place(self) -> str:
        """The file or the viewer."""
        return self._where or "the viewer of rerun"

    @property
    def is_watched(self) -> bool:
        """Always: what is recorded is looked at later."""
        return True

    def begin(self, scene: SceneMessage) -> None:
        """Log what does not change."""
        self._scene, self._maps = scene, scene.camera.undistortion_maps()
        camera = scene.camera
        self._log_static("world", rr.ViewCoordinates.RDF)
        pinhole = rr.Pinhole(
            width=camera.width, height=camera.height, focal_length=[camera.fx, camera.fy],
            principal_point=[camera.cx + 0.5, camera.cy + 0.5],  # rerun counts from the pixel's corner
        )  # fmt: skip
        self._log_static("world/camera", pinhole)
        for part in scene.objects:
            self._log_static(f"world/objects/{_entity(part.name)}", _mesh_of(part.triangles))
            for number, one in enumerate(part.inner):
                self._log_static(_inner_entity(part, one.name), _mesh_of(one.triangles, colour_of(number)))

    def _log_static(self, entity: str, archetype: Any) -> None:
        self._recording.log(entity, archetype, static=True)

    def publish(self, message: FrameMessage) -> None:
        """Hand a frame to the thread; waits only while it is far behind.

        The first one begins the file, also with what was logged before: a run that has none leaves an earlier one.
        """
        if self._file is not None:
            try:
                self._recording.save(self._file, default_blueprint=_layout())
            except (OSError, RuntimeError, ValueError) as error:
                raise self._not_opened(error) from error
            self._file = None
        if len(self._waiting) >= MOST_WAITING:
            self._waiting.popleft().result()
        self._waiting.append(self._pool.submit(self._log_frame, message))

    def close(self) -> None:
        """Log what is left, and end the recording; StreamError if not all of it arrived."""
        try:
            while self._waiting:
                self._waiting.popleft().result()
        finally:
            self._pool.shutdown()
            try:
                self._recording.flush(timeout_sec=LAST_SECONDS)
            except RuntimeError as error:
                raise StreamError(f"{self.place} did not get all frames: {error}") from error
            finally:
                self._recording.disconnect()

    def _log_frame(self, message: FrameMessage) -> None:
        assert self._scene is not None
        recording = self._recording
        recording.set_time("frame", sequence=message.frame)
        recording.set_time("time", duration=message.timestamp)
        if message.captured is not None:
            recording.set_time("captured", timestamp=message.captured)
        recording.log("world/camera/image", self._image(message.image))
        for info, now in zip(self._scene.objects, message.objects, strict=True):
            self._log_object(info, now)

    def _image(self, image: NDArray[np.uint8]) -> rr.EncodedImage:
        """The frame without its lens' distortion, as the pinhole has it."""
        if self._maps is not None:
            image = np.asarray(cv2.remap(image, *self._maps, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
        _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg")

    def _log_object(self, info: ObjectInfo, now: ObjectMessage) -> None:
        recording, name = self._recording, _entity(info.name)
        entity, pose = f"world/objects/{name}", now.camera_from_object
        if now.vertices is None or pose is None:
            for gone in (entity, *(_inner_entity(info, one.name) for one in info.inner)):
                recording.log(gone, rr.Clear(recursive=False))
        else:
            colours = colours_of(now.scalar, info, len(now.vertices))
            recording.log(entity, rr.Transform3D(translation=pose.translation, mat3x3=pose.rotation))
            recording.log(entity, rr.Mesh3D.from_fields(vertex_positions=now.vertices, vertex_colors=colours))
            for structure, vertices in now.inner.items():
                inside = rr.Mesh3D.from_fields(vertex_positions=vertices)
                recording.log(_inner_entity(info, structure), inside)
            if now.scalar is not None and info.scalar is not None:
                values = {f"{info.scalar.name} [{info.scalar.unit}]": now.scalar}
                recording.log(f"values/{name}", rr.AnyValues(drop_untyped_nones=True, **values))
        for parameter, value, deviation in zip(info.parameters, now.parameters, now.parameter_std, strict=True):
            shown = np.array([value, deviation]) / parameter.shown_factor
            recording.log(f"parameters/{name}/{_entity(parameter.name)}", rr.Scalars(shown[:1]))
            recording.log(f"deviations/{name}/{_entity(parameter.name)}", rr.Scalars(shown[1:]))
        for support, reaction in now.reactions.items():
            recording.log(f"forces/{name}/{_entity(support)}", rr.Scalars(reaction.force))
        if self._texts.get(name) != now.text:
            self._texts[name] = now.text
            recording.log(f"status/{name}", rr.TextLog(now.text, level=_LEVELS[now.status]))


def _check_file(path: Path) -> None:
    """OSError unless a file can be written, in Python's words; what it holds stays."""
    is_there = path.exists()
    path.open("ab").close()
    if not is_there:
        path.unlink()


def _check_viewer(address: str) -> None:
    """StreamError if nobody listens there: rerun would find out at the end only."""
    parts = urlsplit(address)
    if not (parts.hostname and parts.port):
        return
    try:
        socket.create_connection((parts.hostname, parts.port), timeout=LONGEST_ANSWER).close()
    except OSError as error:
        raise StreamError(
            f"no viewer answers at {address} ({error.strerror or error}): start `rerun` there first"
        ) from error


def _mesh_of(triangles: NDArray[np.int64], colour: tuple[int, int, int] | None = None) -> rr.Mesh3D:
    """What does not change of a surface: its triangles, and the colour of a structure inside."""
    return rr.Mesh3D.from_fields(triangle_indices=triangles.astype(np.uint32), albedo_factor=colour)


def _inner_entity(part: ObjectInfo, structure: str) -> str:
    """Where a structure inside an object is logged: below the object, with whose pose it moves."""
    return f"world/objects/{_entity(part.name)}/inner/{_entity(structure)}"


def _entity(name: str) -> str:
    """A name as one part of a path."""
    return rr.escape_entity_path_part(name)


def _layout() -> rrb.Blueprint:
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial3DView(origin="world", name="object"),
                rrb.Spatial2DView(origin="world/camera", contents="world/**", name="camera"),
            ),
            rrb.Vertical(
                rrb.TimeSeriesView(origin="parameters", name="parameters"),
                rrb.TimeSeriesView(origin="forces", name="forces"),
                rrb.TextLogView(origin="status", name="status"),
            ),
        )
    )
