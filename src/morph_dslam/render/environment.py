"""The static surroundings of an object: textured rectangles and boxes, fixed in the world."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.errors import SceneError
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.render.model_view import looking_at
from morph_dslam.render.rasteriser import Buffers, rasterise
from morph_dslam.render.scene_file import (
    CameraKeyFrame,
    DepthSensor,
    Environment,
    Occluder,
    ParameterKeyFrame,
    PoseKeyFrame,
    Scene,
    Vector,
    interpolate_key_frames,
)
from morph_dslam.render.shading import lambert
from morph_dslam.render.texture import load_photograph, paint_textured, resize_to_fill
from morph_dslam.units import to_si

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
#: Triangles that reach behind the camera are not drawn, so rectangles are cut into cells of at most this
#: side, metres.
CELL = 0.08
MOST_CELLS = 60
#: A texture has at most so many pixels along a side.
LARGEST_TEXTURE = 3000
#: A rectangle with a shorter edge is none, metres.
SHORTEST_EDGE = 1e-6
#: The faces of a box: a corner, then the directions along its rows and columns, in halves of the size.
_BOX_FACES = (
    ((-1, -1, 1), (2, 0, 0), (0, 0, -2)),
    ((1, -1, 1), (0, 2, 0), (0, 0, -2)),
    ((1, 1, 1), (-2, 0, 0), (0, 0, -2)),
    ((-1, 1, 1), (0, -2, 0), (0, 0, -2)),
    ((-1, 1, 1), (2, 0, 0), (0, -2, 0)),
    ((-1, -1, -1), (2, 0, 0), (0, 2, 0)),
)


@dataclass(frozen=True)
class _Face:
    """A textured rectangle: its top left corner and its edges (3,), perpendicular, world, metres."""

    texture: str
    corner: Array
    right: Array
    down: Array

    @property
    def size(self) -> Array:
        """Width and height, metres."""
        return np.linalg.norm([self.right, self.down], axis=1).astype(np.float64)

    def distance(self, point: Array) -> float:
        """From a point (3,) to the rectangle, metres."""
        nearest = self.corner
        for edge in (self.right, self.down):
            nearest = nearest + np.clip((point - self.corner) @ edge / (edge @ edge), 0.0, 1.0) * edge
        return float(np.linalg.norm(point - nearest))

    def grid(self) -> tuple[Array, NDArray[np.int64], Array]:
        """Nodes (n, 3), triangles (m, 3), and the place (n, 2) of each node in the rectangle, 0 to 1."""
        columns, rows = (int(np.clip(np.ceil(side / CELL), 1, MOST_CELLS)) for side in self.size)
        a, b = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1)))
        nodes = self.corner + a[:, None] * self.right + b[:, None] * self.down
        index = np.arange(len(nodes)).reshape(rows + 1, columns + 1)
        p, q, r, s = (x.ravel() for x in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
        triangles = np.concatenate([np.column_stack([p, q, r]), np.column_stack([p, r, s])])
        return nodes, triangles, np.column_stack([a, b])


def environment_faces(environment: Environment) -> list[_Face]:
    """All rectangles, those of the boxes among them."""
    faces = []
    for number, section in enumerate(environment.rectangles):
        centre, right, down = (
            1e-3 * np.array(vector) for vector in (section.centre_mm, section.right_mm, section.down_mm)
        )
        lengths = np.linalg.norm([right, down], axis=1)
        if lengths.min() < SHORTEST_EDGE or abs(right @ down) > 1e-6 * lengths.prod():
            raise SceneError(
                f"environment.rectangles.{number}: right_mm and down_mm must be its edges, perpendicular to each other"
            )
        faces.append(_Face(section.texture, centre - (right + down) / 2.0, right, down))
    for section in environment.boxes:
        turn = rotation_exp(np.radians([0.0, 0.0, section.turn_deg]))
        half, centre = 0.5e-3 * np.array(section.size_mm), 1e-3 * np.array(section.centre_mm)
        for corner, right, down in _BOX_FACES:
            edges = [turn @ (half * np.array(edge)) for edge in (right, down)]
            faces.append(_Face(section.texture, centre + turn @ (half * np.array(corner)), *edges))
    return faces


class StaticScene:
    """Draws the surroundings as a camera in the world sees them.

    Parameters
    ----------
    environment : its description.
    folder : what paths in it are relative to.
    camera : whose pictures are drawn.
    positions : (T, 3) where the camera is, world, metres; textures are made as fine as they can be seen from there.
    light : (3,) direction towards a distant light, world.
    ambient : its ambient part.
    """

    def __init__(
        self, environment: Environment, folder: Path, camera: Camera, positions: Array, light: Array, ambient: float
    ) -> None:
        self._camera = camera
        faces = environment_faces(environment)
        nodes, triangles, coordinates, owners, self._textures, offset = [], [], [], [], [], 0
        for number, face in enumerate(faces):
            nearest = max(min(face.distance(position) for position in positions), 1e-2)
            texture = _face_texture(face, folder, max(camera.fx, camera.fy) / nearest)
            normal = np.cross(face.right, face.down)
            brightness = lambert(normal[None] / np.linalg.norm(normal), light, ambient)[0]
            self._textures.append((texture.astype(np.float32) * brightness + 0.5).astype(np.uint8))
            grid_nodes, grid_triangles, places = face.grid()
            nodes.append(grid_nodes)
            triangles.append(grid_triangles + offset)
            coordinates.append(places * np.array([texture.shape[1], texture.shape[0]]) - 0.5)
            owners.append(np.full(len(grid_triangles), number))
            offset += len(grid_nodes)
        self._nodes, self._triangles = np.concatenate(nodes), np.concatenate(triangles)
        self._coordinates, self._owners = np.concatenate(coordinates), np.concatenate(owners)

    def buffers(self, camera_from_world: RigidTransform, camera: Camera | None = None) -> Buffers:
        """What every pixel of the surroundings sees, in this camera or in another one."""
        camera = camera or self._camera
        local = camera_from_world.apply(self._nodes)
        return rasterise(camera.project(local), local[:, 2], self._triangles, camera.height, camera.width)

    def paint(self, image: Image, buffers: Buffers) -> None:
        """Draw the surroundings into an image (h, w, 3) wherever ``buffers`` are covered."""
        owners = np.where(buffers.covered, self._owners[buffers.triangle_ids], -1)
        for number, texture in enumerate(self._textures):
            mine = owners == number
            if mine.any():
                part = replace(buffers, triangle_ids=np.where(mine, buffers.triangle_ids, np.int32(-1)))
                paint_textured(image, part, self._triangles, self._coordinates, texture)


def _face_texture(face: _Face, folder: Path, pixels_per_metre: float) -> Image:
    size = np.maximum(np.rint(face.size * pixels_per_metre), 2.0)
    size *= min(1.0, LARGEST_TEXTURE / size.max())
    width, height = np.maximum(size, 2.0).astype(int)
    return resize_to_fill(load_photograph(face.texture, folder), int(width), int(height))


#: 16-bit depth images hold this many values a metre, as those of the TUM RGB-D benchmark do.
VALUES_PER_METRE = 5000.0


def sensor_depth(depth: NDArray[np.float32], sensor: DepthSensor, seed: tuple[int, int]) -> NDArray[np.uint16]:
    """The 16-bit image (h, w) that the sensor gives of exact depth (h, w) in metres; 0 is unknown.

    The standard deviation grows with the square of the distance, as that of triangulation does (Khoshelham
    and Elberink, Sensors 2012). Pixels at the rim of a surface have no depth. The same ``seed`` (scene,
    frame) gives the same noise.
    """
    known = np.isfinite(depth) & (depth <= sensor.range_mm * 1e-3) & ~_rim(depth, sensor)
    exact = np.where(known, depth, 0.0).astype(np.float64)
    noise = np.random.default_rng((*seed, 1)).standard_normal(depth.shape)
    measured = exact + noise * sensor.noise_mm_at_1m * 1e-3 * exact**2
    stored = np.rint(measured * VALUES_PER_METRE)
    return np.where(known & (stored > 0) & (stored < 65535), stored, 0).astype(np.uint16)


def _rim(depth: NDArray[np.float32], sensor: DepthSensor) -> NDArray[np.bool_]:
    """Pixels within ``rim_px`` of a jump in depth."""
    if sensor.rim_px == 0:
        return np.zeros(depth.shape, dtype=bool)
    filled = np.where(np.isfinite(depth), depth, np.float32(1e3))
    square = np.ones((3, 3), np.uint8)
    jump = cv2.dilate(filled, square) - cv2.erode(filled, square) > 0.03 * filled
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * sensor.rim_px + 1,) * 2)
    return cv2.dilate(jump.astype(np.uint8), disc).astype(bool)


_AT_ORIGIN = PoseKeyFrame(frame=0, position_mm=(0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Motion:
    """What moves how.

    Attributes
    ----------
    parameters : (T, d) SI.
    camera_from_object : T poses of the object in the camera frame, metres.
    camera_from_world : T poses of the world, or None where only the object's pose is prescribed.
    occluder_centres : (T, 2) pixels, or None without an occluder.
    """

    parameters: Array
    camera_from_object: list[RigidTransform]
    camera_from_world: list[RigidTransform] | None
    occluder_centres: Array | None


def _check_parameter(parameter: Parameter, frames: NDArray, values: Array, remedy: str) -> None:
    slack = 1e-9 * (parameter.upper - parameter.lower)  # for the rounding of converted units
    wrong = np.flatnonzero((values < parameter.lower - slack) | (values > parameter.upper + slack))
    if wrong.size:
        first = wrong[0]
        value, low, high = (
            f"{parameter.display(float(x)):.6g}" for x in (values[first], parameter.lower, parameter.upper)
        )
        raise SceneError(
            f"parameter '{parameter.name}' is {value} {parameter.unit} in frame {frames[first]:g}, "
            f"outside the model's range {low} to {high}: {remedy}"
        )


def _parameter_track(parameter: Parameter, keys: list[ParameterKeyFrame], frames: NDArray) -> Array:
    """One parameter (T,) in SI; without key frames it keeps its default."""
    named = [
        (key.frame, key.__pydantic_extra__[parameter.name]) for key in keys if parameter.name in key.__pydantic_extra__
    ]
    if not named:
        return np.full(len(frames), parameter.default)
    key_frames = np.array([frame for frame, _ in named])
    key_values = np.array([to_si(value, parameter.unit, parameter.quantity) for _, value in named])
    _check_parameter(parameter, key_frames, key_values, "change this key frame")
    track = interpolate_key_frames(key_frames, key_values, frames)
    _check_parameter(parameter, frames, track, "the curve swings beyond its key frames here; add one or move them")
    return np.clip(track, parameter.lower, parameter.upper)


def _parameter_tracks(model: ReducedModel, keys: list[ParameterKeyFrame], frames: NDArray) -> Array:
    known = [parameter.name for parameter in model.parameters]
    for key in keys:
        for name in key.__pydantic_extra__:
            if name not in known:
                raise SceneError(
                    f"unknown parameter '{name}' in key frame {key.frame}; the model has {', '.join(known) or 'none'}"
                )
    tracks = [_parameter_track(parameter, keys, frames) for parameter in model.parameters]
    return np.array(tracks).reshape(len(tracks), len(frames)).T


def _pose_track(keys: list[PoseKeyFrame], frames: NDArray, upright: Vector) -> list[RigidTransform]:
    numbers = [key.frame for key in keys]
    position = interpolate_key_frames(numbers, np.array([key.position_mm for key in keys]) * 1e-3, frames)
    angles = interpolate_key_frames(numbers, np.array([key.rotation_deg or upright for key in keys]), frames)
    rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    return [RigidTransform(r, p) for r, p in zip(rotation, position, strict=True)]


def _camera_track(keys: list[CameraKeyFrame], frames: NDArray) -> list[RigidTransform]:
    """Poses camera_from_world of a camera that looks at its target with the world's z axis up."""
    numbers = [key.frame for key in keys]
    both = 1e-3 * np.array([(key.position_mm, key.target_mm) for key in keys])
    positions, targets = interpolate_key_frames(numbers, both, frames).transpose(1, 0, 2)
    poses = []
    for frame, position, target in zip(frames, positions, targets, strict=True):
        ahead = target - position
        distance = float(np.linalg.norm(ahead))
        if np.hypot(*ahead[:2]) <= 1e-3 * distance:
            raise SceneError(
                f"camera_path: in frame {frame:g} the camera looks straight up or down, or stands in its "
                "target, so that nothing is upright: move it aside"
            )
        poses.append(looking_at(target, ahead, distance))
    return poses


def _occluder_track(occluder: Occluder | None, frames: NDArray) -> Array | None:
    if occluder is None:
        return None
    numbers = [key.frame for key in occluder.path]
    return interpolate_key_frames(numbers, np.array([key.centre_px for key in occluder.path]), frames)


def plan_motion(scene: Scene, model: ReducedModel, frames: NDArray | None = None) -> Motion:
    """The motion at ``frames`` (T,), which may lie between two; at every frame if absent."""
    frames = np.arange(scene.frames) if frames is None else frames
    if scene.camera_path:
        in_world = _pose_track(scene.pose or [_AT_ORIGIN], frames, (0.0, 0.0, 0.0))
        camera_from_world = _camera_track(scene.camera_path, frames)
        poses = [camera @ placed for camera, placed in zip(camera_from_world, in_world, strict=True)]
    else:
        camera_from_world, poses = None, _pose_track(scene.pose, frames, (180.0, 0.0, 0.0))
    return Motion(
        parameters=_parameter_tracks(model, scene.parameters, frames),
        camera_from_object=poses,
        camera_from_world=camera_from_world,
        occluder_centres=_occluder_track(scene.occluder, frames),
    )
