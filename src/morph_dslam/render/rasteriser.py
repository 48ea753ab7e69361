"""Rasterising meshes: which triangle each pixel shows, where on it, and at which depth, in compiled loops.

Edge functions decide coverage (Pineda 1988). They are linear in the image, so each is the value at a triangle's first
pixel plus so many steps along its rows and columns.
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
def pack_nodes(pixels, depths):
    """Column, row and inverse depth of nodes (n, 3), side by side in memory; NaN where not in front of the camera.

    Parameters
    ----------
    pixels, depths : see `rasterise`.
    """
    nodes = np.full((len(depths), 3), np.nan)
    for k in range(len(depths)):
        if depths[k] > 0.0 and np.isfinite(pixels[k, 0] + pixels[k, 1]):
            nodes[k, 0], nodes[k, 1], nodes[k, 2] = pixels[k, 0], pixels[k, 1], 1.0 / depths[k]
    return nodes


@njit(cache=True, nogil=True, error_model="numpy")
def pixel_window(nodes, triangle, closed, height, width):
    """First and last column, first and last row, of the pixels that a triangle may cover.

    There are none, that is a last one before the first, if it is not to be drawn: a corner is not in front of the
    camera, or it is turned away or degenerate.

    Parameters
    ----------
    nodes : (n, 3), see `pack_nodes`.
    triangle : (3,) its corners.
    closed, height, width : see `rasterise`.
    """
    i, j, k = triangle[0], triangle[1], triangle[2]
    u0, u1, u2, v0, v1, v2 = nodes[i, 0], nodes[j, 0], nodes[k, 0], nodes[i, 1], nodes[j, 1], nodes[k, 1]
    area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
    if (closed and area >= 0.0) or not abs(area) > LEAST_AREA:
        return 0, -1, 0, -1
    # Clamp before the conversion: a corner just in front of the camera lies far outside any integer.
    left, right = int(np.ceil(max(min(u0, u1, u2), 0.0))), int(np.floor(min(max(u0, u1, u2), width - 1.0)))
    top, bottom = int(np.ceil(max(min(v0, v1, v2), 0.0))), int(np.floor(min(max(v0, v1, v2), height - 1.0)))
    return left, right, top, bottom if left <= right else top - 1


@njit(cache=True, nogil=True, error_model="numpy")
def corner_weights(nodes, triangle, column, row):
    """Weights of a triangle's first two corners at a pixel, and by how much they grow to the next column and row.

    Parameters
    ----------
    nodes, triangle : see `pixel_window`.
    """
    i, j, k = triangle[0], triangle[1], triangle[2]
    u0, u1, u2, v0, v1, v2 = nodes[i, 0], nodes[j, 0], nodes[k, 0], nodes[i, 1], nodes[j, 1], nodes[k, 1]
    share = 1.0 / ((u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0))
    b0 = ((u1 - column) * (v2 - row) - (u2 - column) * (v1 - row)) * share
    b1 = ((u2 - column) * (v0 - row) - (u0 - column) * (v2 - row)) * share
    return b0, b1, (v1 - v2) * share, (v2 - v0) * share, (u2 - u1) * share, (u0 - u2) * share


@njit(cache=True, nogil=True, error_model="numpy")
def is_inside(b0, b1, b2):
    """Whether a pixel with these weights is covered."""
    return min(b0, b1, b2) >= -EDGE_TOLERANCE


@njit(cache=True, nogil=True, error_model="numpy")
def covered_steps(weight, slope, inverse, first, last):
    """Where steps along a row, no less than ``first`` and no more than ``last``, begin and end to be covered.

    Parameters
    ----------
    weight, slope : a corner's weight at step 0, and by how much it grows at each.
    inverse : one over ``slope``.
    first, last : not whole numbers; there is no step where the last is less than the first.
    """
    if slope > 0.0:
        return max(first, (-EDGE_TOLERANCE - weight) * inverse), last
    if slope < 0.0:
        return first, min(last, (-EDGE_TOLERANCE - weight) * inverse)
    return first, last if weight >= -EDGE_TOLERANCE else -1.0


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
def _fill_triangles(pixels, depths, triangles, closed, triangle_ids, weights, depth):
    nodes = pack_nodes(pixels, depths)
    for t in range(triangles.shape[0]):
        triangle = triangles[t]
        left, right, top, bottom = pixel_window(nodes, triangle, closed, *depth.shape)
        if bottom < top:
            continue
        b0_first, b1_first, b0_right, b1_right, b0_down, b1_down = corner_weights(nodes, triangle, left, top)
        q0, q1, q2 = nodes[triangle[0], 2], nodes[triangle[1], 2], nodes[triangle[2], 2]
        for row in range(top, bottom + 1):
            b0_left, b1_left = b0_first + (row - top) * b0_down, b1_first + (row - top) * b1_down
            for column in range(left, right + 1):
                b0, b1 = b0_left + (column - left) * b0_right, b1_left + (column - left) * b1_right
                b2 = 1.0 - b0 - b1
                if not is_inside(b0, b1, b2):
                    continue
                z = 1.0 / (b0 * q0 + b1 * q1 + b2 * q2)
                if z < depth[row, column]:
                    depth[row, column] = z
                    triangle_ids[row, column] = t
                    weights[row, column, 0] = b0 * q0 * z
                    weights[row, column, 1] = b1 * q1 * z
                    weights[row, column, 2] = b2 * q2 * z


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
    nodes = pack_nodes(pixels, depths)
    for t in range(triangles.shape[0]):
        triangle = triangles[t]
        left, right, top, bottom = pixel_window(nodes, triangle, closed, height, width)
        if bottom < top:
            continue
        b0_first, b1_first, b0_right, b1_right, b0_down, b1_down = corner_weights(nodes, triangle, left, top)
        q0, q1, q2 = nodes[triangle[0], 2], nodes[triangle[1], 2], nodes[triangle[2], 2]
        for row in range(top, bottom + 1):
            b0_left, b1_left = b0_first + (row - top) * b0_down, b1_first + (row - top) * b1_down
            for column in range(left, right + 1):
                b0, b1 = b0_left + (column - left) * b0_right, b1_left + (column - left) * b1_right
                b2 = 1.0 - b0 - b1
                if not is_inside(b0, b1, b2):
                    continue
                z = np.float32(1.0 / (b0 * q0 + b1 * q1 + b2 * q2))
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
