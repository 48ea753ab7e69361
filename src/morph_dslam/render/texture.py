"""Texturing: the colour each rasterised pixel takes from a texture image, sampled bilinearly."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.render.rasteriser import Buffers

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
    """Image of a textured surface.

    Parameters
    ----------
    buffers : from `rasterise`, of the same triangles.
    triangles : (m, 3) node indices.
    texture_coordinates : (n, 2) column and row of each node in the texture, texture pixels; coordinates
        outside the texture take its border.
    texture : (H, W) or (H, W, channels) uint8.

    Returns
    -------
    (h, w) or (h, w, channels) uint8, 0 where there is no triangle.
    """
    height, width = buffers.triangle_ids.shape
    layered = texture if texture.ndim == 3 else texture[:, :, None]
    image = np.zeros((height, width, layered.shape[2]), dtype=np.uint8)
    _sample_texture(
        buffers.triangle_ids,
        buffers.weights,
        np.ascontiguousarray(triangles, dtype=np.int64),
        np.ascontiguousarray(texture_coordinates, dtype=np.float64),
        np.ascontiguousarray(layered),
        image,
    )
    return image if texture.ndim == 3 else image[:, :, 0]


def interpolate(buffers: Buffers, triangles: NDArray, node_values: NDArray) -> NDArray:
    """Node values (n, ...) at the covered pixels (k, ...), in the order of ``buffers.covered``."""
    covered = buffers.covered
    corners = triangles[buffers.triangle_ids[covered]]
    return np.einsum("kc,kc...->k...", buffers.weights[covered], node_values[corners])


def render_textured_numpy(
    buffers: Buffers, triangles: NDArray, texture_coordinates: Array, texture: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """The plain twin of `render_textured`."""
    last = np.array([texture.shape[1] - 1, texture.shape[0] - 1])
    place = np.clip(interpolate(buffers, triangles, texture_coordinates), 0, last)
    x0, y0 = place.astype(int).T
    x1, y1 = np.minimum(x0 + 1, last[0]), np.minimum(y0 + 1, last[1])
    shape = (-1,) + (1,) * (texture.ndim - 2)
    right, down = (place[:, 0] - x0).reshape(shape), (place[:, 1] - y0).reshape(shape)
    above = (1.0 - right) * texture[y0, x0] + right * texture[y0, x1]
    below = (1.0 - right) * texture[y1, x0] + right * texture[y1, x1]
    image = np.zeros(buffers.triangle_ids.shape + texture.shape[2:], dtype=np.uint8)
    image[buffers.covered] = ((1.0 - down) * above + down * below + 0.5).astype(np.uint8)
    return image
