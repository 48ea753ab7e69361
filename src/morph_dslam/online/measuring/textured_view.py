"""Drawing a textured surface in one pass over its triangles: image and depth only, for every frame.

The same picture as `rasterise` followed by `render_textured`, at half the time: which triangle a pixel sees
and where on it need not be kept.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.texture import render_textured
from morph_dslam.render.triangle_pixels import (
    is_inside,
    load_triangle,
    pixel_window,
    weight_steps,
    weights_at,
)


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_triangle(area, u, v, q, x, y, texture, image, depth):
    """Draw one triangle: twice its area, and its corners' pixels u, v, inverse depths q and texture
    coordinates x, y, all (3,)."""
    last_row, last_column = texture.shape[0] - 1, texture.shape[1] - 1
    left, right, top, bottom = pixel_window(u, v, *depth.shape)
    step0, step1 = weight_steps(v, area)
    for row in range(top, bottom + 1):
        first0, first1 = weights_at(u, v, area, left, row)
        for column in range(left, right + 1):
            b0, b1 = first0 + (column - left) * step0, first1 + (column - left) * step1
            b2 = 1.0 - b0 - b1
            if not is_inside(b0, b1, b2):
                continue
            w0, w1, w2 = b0 * q[0], b1 * q[1], b2 * q[2]
            z = 1.0 / (w0 + w1 + w2)
            if not z < depth[row, column]:
                continue
            depth[row, column] = z
            s = min(max((w0 * x[0] + w1 * x[1] + w2 * x[2]) * z, 0.0), last_column)
            t = min(max((w0 * y[0] + w1 * y[1] + w2 * y[2]) * z, 0.0), last_row)
            s0, t0 = int(s), int(t)
            s1, t1 = min(s0 + 1, last_column), min(t0 + 1, last_row)
            a, b = s - s0, t - t0
            above = (1.0 - a) * texture[t0, s0] + a * texture[t0, s1]
            below = (1.0 - a) * texture[t1, s0] + a * texture[t1, s1]
            image[row, column] = np.uint8((1.0 - b) * above + b * below + 0.5)


@njit(cache=True, nogil=True, error_model="numpy")
def draw_textured(pixels, depths, triangles, coordinates, texture, closed, image, depth):
    """Draw a textured surface over what is in ``image`` and ``depth`` already.

    Parameters
    ----------
    pixels, depths, triangles, closed : see `rasterise`. coordinates : (m, 3, 2) column and row of each
        triangle's corners in the texture, texture pixels; outside it is its border. texture : (H, W) uint8.
    image, depth : (h, w) uint8 and float32, the unit of ``depths``; changed where the surface is nearest.
    """
    u, v, q, x, y = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for t in range(triangles.shape[0]):
        area = load_triangle(pixels, depths, triangles, t, closed, u, v, q)
        if area == 0.0:
            continue
        for corner in range(3):
            x[corner], y[corner] = coordinates[t, corner, 0], coordinates[t, corner, 1]
        _draw_triangle(area, u, v, q, x, y, texture, image, depth)


def draw_textured_numpy(pixels, depths, triangles, coordinates, texture, closed, image, depth):
    """The plain twin of `draw_textured`, in two passes."""
    buffers = rasterise(pixels, depths, triangles, *depth.shape, closed=closed)
    nearest = buffers.depth < depth
    corners = np.arange(3 * len(triangles)).reshape(-1, 3)
    image[nearest] = render_textured(buffers, corners, coordinates.reshape(-1, 2), texture)[nearest]
    depth[nearest] = buffers.depth[nearest]
