"""Rasterising meshes: which triangle each pixel shows, where on it, and at which depth, in compiled loops.

Edge functions decide coverage (Pineda 1988). They are linear in the image, so along a row each is the value
at the first pixel plus so many steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

#: Barycentric slack that keeps a pixel centre lying on a shared edge from falling between both triangles.
EDGE_TOLERANCE = 1e-9
#: A triangle of at most this area in the image, squared pixels, covers nothing.
LEAST_AREA = 1e-12


@njit(cache=True, nogil=True, error_model="numpy")
def load_triangle(pixels, depths, triangles, t, closed, u, v, inverse_depth):
    """Load the corners of triangle ``t`` into u, v and inverse_depth, all (3,).

    Parameters
    ----------
    pixels, depths, triangles, closed : see `rasteriser.rasterise`.

    Returns
    -------
    Twice its area in the image, squared pixels, negative where the corners run anticlockwise; 0 if it is not
    to be drawn: a corner is not in front of the camera, or it is turned away or degenerate.
    """
    ahead = True
    for corner in range(3):
        node = triangles[t, corner]
        ahead &= depths[node] > 0.0 and np.isfinite(pixels[node, 0] + pixels[node, 1])
        u[corner], v[corner] = pixels[node, 0], pixels[node, 1]
    area = (u[1] - u[0]) * (v[2] - v[0]) - (u[2] - u[0]) * (v[1] - v[0])
    is_drawn = ahead and abs(area) > LEAST_AREA and not (closed and area >= 0.0)
    if is_drawn:
        for corner in range(3):
            inverse_depth[corner] = 1.0 / depths[triangles[t, corner]]
    return area if is_drawn else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def pixel_window(u, v, height, width):
    """First and last column, first and last row, of the pixels that a triangle may cover; it may be none."""
    # Clamp before the conversion: a corner just in front of the camera lies far outside any integer.
    left = int(np.ceil(max(min(u[0], u[1], u[2]), 0.0)))
    right = int(np.floor(min(max(u[0], u[1], u[2]), width - 1.0)))
    top = int(np.ceil(max(min(v[0], v[1], v[2]), 0.0)))
    bottom = int(np.floor(min(max(v[0], v[1], v[2]), height - 1.0)))
    return left, right, top, bottom


@njit(cache=True, nogil=True, error_model="numpy")
def weights_at(u, v, area, column, row):
    """Weights of the first two corners at a pixel, in the image plane."""
    b0 = ((u[1] - column) * (v[2] - row) - (u[2] - column) * (v[1] - row)) / area
    b1 = ((u[2] - column) * (v[0] - row) - (u[0] - column) * (v[2] - row)) / area
    return b0, b1


@njit(cache=True, nogil=True, error_model="numpy")
def weight_steps(v, area):
    """By how much the weights of the first two corners grow from one pixel to the next in its row."""
    return (v[1] - v[2]) / area, (v[2] - v[0]) / area


@njit(cache=True, nogil=True, error_model="numpy")
def is_inside(b0, b1, b2):
    """Whether a pixel with these weights is covered."""
    return b0 >= -EDGE_TOLERANCE and b1 >= -EDGE_TOLERANCE and b2 >= -EDGE_TOLERANCE


Array = NDArray[np.float64]


@dataclass(frozen=True)
class Buffers:
    """What every pixel sees.

    Attributes
    ----------
    triangle_ids : (h, w) int32, the nearest triangle, -1 where there is none.
    weights : (h, w, 3) float32, perspective-correct barycentric weights of its corners, 0 where none.
    depth : (h, w) float32, depth along the optical axis in the unit given, infinity where none.
    """

    triangle_ids: NDArray[np.int32]
    weights: NDArray[np.float32]
    depth: NDArray[np.float32]

    @property
    def covered(self) -> NDArray[np.bool_]:
        """Pixels (h, w) that see a triangle."""
        return self.triangle_ids >= 0


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_triangle(triangle_id, area, u, v, q, triangle_ids, weights, depth):
    """Draw one triangle: twice its area, and its corners' pixels u, v and inverse depths q, all (3,)."""
    left, right, top, bottom = pixel_window(u, v, *depth.shape)
    if left > right or top > bottom:  # it lies between the centres of pixels
        return
    step0, step1 = weight_steps(v, area)
    for row in range(top, bottom + 1):
        first0, first1 = weights_at(u, v, area, left, row)
        for column in range(left, right + 1):
            b0, b1 = first0 + (column - left) * step0, first1 + (column - left) * step1
            b2 = 1.0 - b0 - b1
            if not is_inside(b0, b1, b2):
                continue
            z = 1.0 / (b0 * q[0] + b1 * q[1] + b2 * q[2])
            if z < depth[row, column]:
                depth[row, column] = z
                triangle_ids[row, column] = triangle_id
                weights[row, column, 0] = b0 * q[0] * z
                weights[row, column, 1] = b1 * q[1] * z
                weights[row, column, 2] = b2 * q[2] * z


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_triangles(pixels, depths, triangles, closed, triangle_ids, weights, depth):
    u, v, q = np.empty(3), np.empty(3), np.empty(3)
    for t in range(triangles.shape[0]):
        area = load_triangle(pixels, depths, triangles, t, closed, u, v, q)
        if area != 0.0:
            _fill_triangle(t, area, u, v, q, triangle_ids, weights, depth)


def rasterise(
    pixels: Array, depths: Array, triangles: NDArray, height: int, width: int, closed: bool = False
) -> Buffers:
    """Draw triangles into a z-buffer.

    Parameters
    ----------
    pixels : (n, 2) projected nodes, pixels; a node that is not in front of the camera is NaN.
    depths : (n,) depth of the nodes along the optical axis, any length unit.
    triangles : (m, 3) node indices. A triangle with a node not in front of the camera is left out.
    height, width : size of the image, pixels.
    closed : whether the triangles close a volume, run anticlockwise seen from outside it, and the camera is
        outside: then those turned away, which others hide, are left out.

    Returns
    -------
    Buffers, whose depth is in the unit of ``depths``.
    """
    buffers = Buffers(
        triangle_ids=np.full((height, width), -1, dtype=np.int32),
        weights=np.zeros((height, width, 3), dtype=np.float32),
        depth=np.full((height, width), np.inf, dtype=np.float32),
    )
    _fill_triangles(
        np.ascontiguousarray(pixels, dtype=np.float64),
        np.ascontiguousarray(depths, dtype=np.float64),
        np.ascontiguousarray(triangles, dtype=np.int64),
        closed,
        buffers.triangle_ids,
        buffers.weights,
        buffers.depth,
    )
    return buffers


@njit(cache=True, nogil=True, error_model="numpy")
def draw_depth(pixels, depths, triangles, closed, height, width):
    """The nearest triangle (h, w) int32 of each pixel, -1 for none, and its depth (h, w) float32.

    As `rasterise`, which says what the parameters are, without the weights: half of its time.
    """
    triangle_ids = np.full((height, width), -1, np.int32)
    depth = np.full((height, width), np.float32(np.inf), np.float32)
    u, v, q = np.empty(3), np.empty(3), np.empty(3)
    for t in range(triangles.shape[0]):
        area = load_triangle(pixels, depths, triangles, t, closed, u, v, q)
        if area == 0.0:
            continue
        left, right, top, bottom = pixel_window(u, v, height, width)
        if left > right or top > bottom:
            continue
        step0, step1 = weight_steps(v, area)
        for row in range(top, bottom + 1):
            first0, first1 = weights_at(u, v, area, left, row)
            for column in range(left, right + 1):
                b0, b1 = first0 + (column - left) * step0, first1 + (column - left) * step1
                b2 = 1.0 - b0 - b1
                if not is_inside(b0, b1, b2):
                    continue
                z = np.float32(1.0 / (b0 * q[0] + b1 * q[1] + b2 * q[2]))
                if z < depth[row, column]:
                    depth[row, column] = z
                    triangle_ids[row, column] = t
    return triangle_ids, depth


def image_region(pixels: Array, height: int, width: int, margin: int = 0) -> tuple[slice, slice] | None:
    """Rows and columns of an image that a projected mesh (n, 2) may cover; None if it is out of sight.

    Nodes that are not in front of the camera are NaN and do not count. ``margin`` pixels are added around.
    """
    # Column by column, and without a copy of what is finite: ten times faster than along rows.
    least, most = (np.array([op.reduce(column) for column in pixels.T]) for op in (np.fmin, np.fmax))
    if not np.isfinite(least).all():
        return None
    left, top = np.clip(np.floor(least) - margin, 0, [width, height]).astype(int)
    right, bottom = np.clip(np.ceil(most) + margin + 1, 0, [width, height]).astype(int)
    if left >= right or top >= bottom:
        return None
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def visible_points(
    pixels: Array, depths: Array, depth_buffer: NDArray[np.float32], tolerance: float
) -> NDArray[np.bool_]:
    """Which surface points no other part of the surface hides.

    Parameters
    ----------
    pixels : (p, 2) projected points, NaN where not in front of the camera.
    depths : (p,) their depths, in the unit of the buffer.
    depth_buffer : (h, w) from `rasterise`.
    tolerance : a point this much behind the buffer still counts as seen; it makes up for the surface's
        slope within a pixel. Same unit.

    Returns
    -------
    (p,) bool; points outside the image are not visible.
    """
    height, width = depth_buffer.shape
    inside = (
        (pixels[:, 0] > -0.5) & (pixels[:, 0] < width - 0.5) & (pixels[:, 1] > -0.5) & (pixels[:, 1] < height - 0.5)
    )
    visible = np.zeros(len(pixels), dtype=bool)
    columns, rows = np.rint(pixels[inside]).astype(int).T
    # A point on the outline may round to an empty pixel; its infinite depth then hides nothing.
    visible[inside] = depths[inside] <= depth_buffer[rows, columns] + tolerance
    return visible
