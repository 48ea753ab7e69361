"""The static surroundings of an object: textured rectangles and boxes, fixed in the world."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import SceneError
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.render.photographs import load_photograph, resize_to_fill
from morph_dslam.render.rasteriser import Buffers, rasterise
from morph_dslam.render.scene_file import Environment
from morph_dslam.render.shading import lambert
from morph_dslam.render.texture import render_textured

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
class Face:
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
        a, b = (
            axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
        )
        nodes = self.corner + a[:, None] * self.right + b[:, None] * self.down
        index = np.arange(len(nodes)).reshape(rows + 1, columns + 1)
        p, q, r, s = (x.ravel() for x in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
        triangles = np.concatenate([np.column_stack([p, q, r]), np.column_stack([p, r, s])])
        return nodes, triangles, np.column_stack([a, b])


def environment_faces(environment: Environment) -> list[Face]:
    """All rectangles, those of the boxes among them.

    Raises
    ------
    SceneError
        If the edges of a rectangle are not perpendicular.
    """
    faces = []
    for number, section in enumerate(environment.rectangles):
        centre, right, down = (
            1e-3 * np.array(vector) for vector in (section.centre_mm, section.right_mm, section.down_mm)
        )
        lengths = np.linalg.norm([right, down], axis=1)
        if lengths.min() < SHORTEST_EDGE or abs(right @ down) > 1e-6 * lengths.prod():
            raise SceneError(
                f"environment.rectangles.{number}: right_mm and down_mm must be its edges, perpendicular to "
                "each other"
            )
        faces.append(Face(section.texture, centre - (right + down) / 2.0, right, down))
    for section in environment.boxes:
        turn = rotation_exp(np.radians([0.0, 0.0, section.turn_deg]))
        half, centre = 0.5e-3 * np.array(section.size_mm), 1e-3 * np.array(section.centre_mm)
        for corner, right, down in _BOX_FACES:
            edges = [turn @ (half * np.array(edge)) for edge in (right, down)]
            faces.append(Face(section.texture, centre + turn @ (half * np.array(corner)), *edges))
    return faces


class StaticScene:
    """Draws the surroundings as a camera in the world sees them.

    Parameters
    ----------
    environment : its description. folder : what paths in it are relative to.
    camera : whose pictures are drawn. positions : (T, 3) where the camera is, world, metres; textures are
        made as fine as they can be seen from there.
    light : (3,) direction towards a distant light, world. ambient : its ambient part.

    Raises
    ------
    SceneError
        If a photograph is missing or a rectangle is none.
    """

    def __init__(
        self,
        environment: Environment,
        folder: Path,
        camera: PinholeCamera,
        positions: Array,
        light: Array,
        ambient: float,
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

    def buffers(self, camera_from_world: RigidTransform, camera: PinholeCamera | None = None) -> Buffers:
        """What every pixel of the surroundings sees, in this camera or in another one."""
        camera = camera or self._camera
        local = camera_from_world.apply(self._nodes)
        return rasterise(camera.project(local), local[:, 2], self._triangles, camera.height, camera.width)

    def paint(self, image: Image, buffers: Buffers) -> None:
        """Draw the surroundings into an image (h, w, 3) wherever ``buffers`` are covered."""
        owners = np.where(buffers.covered, self._owners[buffers.triangle_ids], -1)
        for number in np.unique(owners[owners >= 0]):
            mine = owners == number
            ids = np.where(mine, buffers.triangle_ids, np.int32(-1))
            part = Buffers(ids, buffers.weights, buffers.depth)
            drawn = render_textured(part, self._triangles, self._coordinates, self._textures[number])
            image[mine] = drawn[mine]


def _face_texture(face: Face, folder: Path, pixels_per_metre: float) -> Image:
    size = np.maximum(np.rint(face.size * pixels_per_metre), 2.0)
    size *= min(1.0, LARGEST_TEXTURE / size.max())
    width, height = np.maximum(size, 2.0).astype(int)
    return resize_to_fill(load_photograph(face.texture, folder), int(width), int(height))
