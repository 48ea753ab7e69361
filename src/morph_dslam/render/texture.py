"""Photographs that texture a scene: the user's own files, or those that scikit-image packages."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.errors import SceneError, SourceError, how_to_install
from morph_dslam.model import ReducedModel, SurfacePoints
from morph_dslam.model.discrepancy import farthest_points
from morph_dslam.model.reduced_model import triangle_normals
from morph_dslam.render.picking import pick_surface
from morph_dslam.render.rasteriser import Buffers
from morph_dslam.sources.frames import read_image


def _packaged_folder() -> Path | None:
    """The folder of scikit-image's photographs, or None where it is not installed."""
    spec = find_spec("skimage")
    return None if spec is None or spec.origin is None else Path(spec.origin).parent / "data"


def find_photograph(name: str, folder: Path) -> Path:
    """The file of a photograph.

    Parameters
    ----------
    name : a path relative to ``folder``, or the bare name of a photograph packaged with scikit-image, such
        as "coffee". A name with a suffix or a folder is always a path.
    """
    path = folder / name
    if path.is_file():
        return path
    if Path(name).suffix or Path(name).name != name:
        raise SceneError(f"there is no image {path}")
    packaged = _packaged_folder()
    if packaged is None:
        raise SceneError(
            f"'{name}' is a photograph packaged with scikit-image, which is not installed: {how_to_install('demo')}, "
            "or name an image file"
        )
    files = {file.stem: file for file in sorted(packaged.glob("*.png")) + sorted(packaged.glob("*.jpg"))}
    if name not in files:
        raise SceneError(
            f"scikit-image packages no photograph '{name}': use one of {', '.join(sorted(files))}, or an image file"
        )
    return files[name]


def resize_to_fill(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """The largest centred part of an image (h, w, ...) with these proportions, resized, (height, width, ...).

    A finer image would alias, so it is averaged down; a coarser one is smoothed up.
    """
    cropped = crop_to_aspect(image, width / height)
    shrinks = cropped.shape[1] > width
    resized = cv2.resize(cropped, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    return np.asarray(resized, dtype=np.uint8)


def crop_to_aspect(image: NDArray[np.uint8], aspect: float) -> NDArray[np.uint8]:
    """The largest centred part (k, l, ...) of an image (h, w, ...) with this width-to-height ratio."""
    height, width = image.shape[:2]
    kept_width = min(width, max(1, round(height * aspect)))
    kept_height = min(height, max(1, round(width / aspect)))
    left, top = (width - kept_width) // 2, (height - kept_height) // 2
    return image[top : top + kept_height, left : left + kept_width]


def load_photograph(name: str, folder: Path) -> NDArray[np.uint8]:
    """A photograph (H, W, 3) uint8, blue, green, red; raises SceneError as `find_photograph` does."""
    path = find_photograph(name, folder)
    try:
        return read_image(path, f"photograph '{name}'")
    except SourceError as error:
        raise SceneError(str(error)) from error


Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def _sample_texture(triangle_ids, weights, triangles, coordinates, texture, image):
    """Fill ``image`` (h, w, channels) from ``texture`` (H, W, channels)."""
    height, width = triangle_ids.shape
    last_row, last_column = texture.shape[0] - 1, texture.shape[1] - 1
    for row in range(height):
        for column in range(width):
            t = triangle_ids[row, column]
            if t < 0:
                continue
            x, y = 0.0, 0.0
            for corner in range(3):
                node = triangles[t, corner]
                x += weights[row, column, corner] * coordinates[node, 0]
                y += weights[row, column, corner] * coordinates[node, 1]
            x = min(max(x, 0.0), last_column)
            y = min(max(y, 0.0), last_row)
            x0, y0 = int(x), int(y)
            x1, y1 = min(x0 + 1, last_column), min(y0 + 1, last_row)
            right, down = x - x0, y - y0
            for channel in range(texture.shape[2]):
                above = (1.0 - right) * texture[y0, x0, channel] + right * texture[y0, x1, channel]
                below = (1.0 - right) * texture[y1, x0, channel] + right * texture[y1, x1, channel]
                image[row, column, channel] = np.uint8((1.0 - down) * above + down * below + 0.5)


def render_textured(
    buffers: Buffers, triangles: NDArray, texture_coordinates: Array, texture: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Image (h, w) or (h, w, channels) uint8 of a textured surface, 0 where there is no triangle.

    Parameters
    ----------
    buffers, triangles, texture_coordinates, texture : as of `paint_textured`.
    """
    image = np.zeros((*buffers.triangle_ids.shape, *texture.shape[2:]), dtype=np.uint8)
    paint_textured(image, buffers, triangles, texture_coordinates, texture)
    return image


def paint_textured(
    image: NDArray[np.uint8],
    buffers: Buffers,
    triangles: NDArray,
    texture_coordinates: Array,
    texture: NDArray[np.uint8],
) -> None:
    """Draw a textured surface into an image, wherever there is a triangle.

    Parameters
    ----------
    image : (h, w) or (h, w, channels) uint8.
    buffers : from `rasterise`, of the same triangles.
    triangles : (m, 3) node indices.
    texture_coordinates : (n, 2) column and row of each node in the texture, texture pixels; coordinates
        outside the texture take its border.
    texture : (H, W) or (H, W, channels) uint8.
    """
    layered, drawn = (layers if layers.ndim == 3 else layers[:, :, None] for layers in (texture, image))
    _sample_texture(
        buffers.triangle_ids,
        buffers.weights,
        np.ascontiguousarray(triangles, dtype=np.int64),
        np.ascontiguousarray(texture_coordinates, dtype=np.float64),
        np.ascontiguousarray(layered),
        drawn,
    )


def interpolate(buffers: Buffers, triangles: NDArray, node_values: NDArray) -> NDArray:
    """Node values (n, ...) at the covered pixels (k, ...), in the order of ``buffers.covered``."""
    covered = buffers.covered
    corners = triangles[buffers.triangle_ids[covered]]
    return np.einsum("kc,kc...->k...", buffers.weights[covered], node_values[corners])


#: A model whose rest shape is deeper than this fraction of its smaller side is no sheet.
FLATNESS = 0.02


def is_sheet(model: ReducedModel) -> bool:
    """Whether the model at rest is a sheet in the plane z = constant."""
    extent = np.ptp(model.nodes[np.unique(model.triangles)], axis=0)
    return not model.cells and bool(extent[2] <= FLATNESS * extent[:2].min())


def sheet_bounds(model: ReducedModel) -> tuple[Array, Array]:
    """Lower and upper corner (2,) of the sheet's rest plane, metres."""
    plane = model.nodes[np.unique(model.triangles), :2]
    return plane.min(axis=0), plane.max(axis=0)


def texture_coordinates(model: ReducedModel, printed_face: str, width: int, height: int) -> Array:
    """Texture pixel (n, 2) of each node when the texture, edge to edge, fills the sheet's rectangle.

    Seen on the printed face x runs to the right; y runs up on the top face (z towards the viewer) and down
    on the bottom face.
    """
    low, high = sheet_bounds(model)
    fraction = (model.nodes[:, :2] - low) / (high - low)
    if printed_face == "top":
        fraction[:, 1] = 1.0 - fraction[:, 1]
    # Texture pixel 0 covers -0.5 to 0.5.
    return fraction * [width, height] - 0.5


def regular_points(model: ReducedModel, count: int) -> SurfacePoints:
    """About ``count`` surface points on a regular grid over the sheet, half a spacing off its edges."""
    low, high = sheet_bounds(model)
    size = high - low
    spacing = np.sqrt(size.prod() / count)
    columns, rows = np.maximum(np.rint(size / spacing).astype(int), 1)
    x = low[0] + (np.arange(columns) + 0.5) / columns * size[0]
    y = low[1] + (np.arange(rows) + 0.5) / rows * size[1]
    # In the plane z = 1 a ray's first two components are where it meets the sheet.
    flat, places = np.ones((len(model.nodes), 3)), np.ones((columns * rows, 3))
    flat[:, :2], places[:, :2] = model.nodes[:, :2], np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    points = pick_surface(flat, model.triangles, places)
    return points.take(points.triangles >= 0)


def landmark_nodes(model: ReducedModel) -> NDArray[np.int64]:
    """Mesh nodes (k,) nearest to the sheet's four corners, edge points and inner points, corners first."""
    low, high = sheet_bounds(model)
    edge = [(0, 0), (1, 0), (1, 1), (0, 1), (0.5, 0), (1, 0.5), (0.5, 1), (0, 0.5)]
    inner = [(0.5, 0.5), (0.25, 0.25), (0.75, 0.25), (0.75, 0.75), (0.25, 0.75)]
    candidates = np.unique(model.triangles)
    nodes = []
    for fraction in edge + inner:
        place = low + np.array(fraction) * (high - low)
        distance = np.linalg.norm(model.nodes[candidates, :2] - place, axis=1)
        nodes.append(candidates[distance.argmin()])
    return np.array(list(dict.fromkeys(nodes)), dtype=np.int64)


#: Landmarks of a solid, spread over all of its surface: about half of them face the camera.
N_LANDMARKS = 40


@dataclass(frozen=True)
class TexturedSurface:
    """A surface with one texture coordinate for each of its vertices.

    Attributes
    ----------
    nodes : (k,) mesh node of each vertex.
    triangles : (m, 3) vertices, in the mesh's order of triangles.
    coordinates : (k, 2) column and row in the texture, texture pixels.
    """

    nodes: NDArray[np.int64]
    triangles: NDArray[np.int64]
    coordinates: Array


def surface_size(model: ReducedModel) -> float:
    """The largest extent of the surface at rest, metres: the side of the square print."""
    return float(np.ptp(model.nodes[np.unique(model.triangles)], axis=0).max())


def box_projection(model: ReducedModel, pixels: int) -> TexturedSurface:
    """Lay a square texture of ``pixels`` a side over the surface at rest, x or y to the right and z up."""
    axis = np.abs(triangle_normals(model.nodes, model.triangles)).argmax(axis=1)
    keys = 3 * model.triangles + axis[:, None]
    vertices, inverse = np.unique(keys.ravel(), return_inverse=True)
    nodes, axes = vertices // 3, vertices % 3
    low = model.nodes[np.unique(model.triangles)].min(axis=0)
    fraction = (model.nodes[nodes] - low) / surface_size(model)
    right = np.where(axes == 0, fraction[:, 1], fraction[:, 0])
    up = np.where(axes == 2, fraction[:, 1], fraction[:, 2])
    coordinates = np.column_stack([right, 1.0 - up]) * pixels - 0.5
    return TexturedSurface(nodes, inverse.reshape(-1, 3), coordinates)


def spread_nodes(model: ReducedModel) -> NDArray[np.int64]:
    """Surface nodes (k,), each as far as possible from those before it, from the lowest corner on."""
    candidates = np.unique(model.triangles)
    places = model.nodes[candidates]
    return candidates[farthest_points(places, N_LANDMARKS, first=int(places.sum(axis=1).argmin()))]
