"""Picking: which material point of a mesh a pixel sees, exactly.

A ray d meets the plane of the triangle A, B, C where w_A A + w_B B + w_C C is parallel to d. Cramer's rule
gives w_A : w_B : w_C = d·(B×C) : d·(C×A) : d·(A×B), and these, scaled to sum to one, are the barycentric
weights on the triangle in space: no image-plane weights and no pixel grid are involved.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.model import SurfacePoints
from morph_dslam.small_arrays import cross, dot

Array = NDArray[np.float64]
#: Barycentric slack, so that a ray through a shared edge meets at least one of its triangles.
EDGE_TOLERANCE = 1e-9
#: Cells along each side of the grid in which rays are looked up.
GRID = 64


def pick_surface(camera_points: Array, triangles: NDArray[np.int64], rays: Array) -> SurfacePoints:
    """The nearest surface point on each ray from the camera centre.

    Rays are looked up by where they meet the plane one unit before the camera, so each triangle is tried with
    those about it only.

    Parameters
    ----------
    camera_points : (n, 3) mesh nodes in the camera frame, metres.
    triangles : (m, 3) node indices; both faces count, triangles that reach behind the camera do not.
    rays : (p, 3) directions in the camera frame.

    Returns
    -------
    SurfacePoints of length p; where a ray meets nothing, ``triangles`` is -1 and ``weights`` NaN.
    """
    found, weights = np.full(len(rays), -1, dtype=np.int64), np.full((len(rays), 3), np.nan)
    # Triangles in front of the camera are met by no others.
    ahead = np.flatnonzero(np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.0))
    if not ahead.size:
        return SurfacePoints(found, weights)
    rays = np.ascontiguousarray(rays[ahead], dtype=np.float64)
    nodes = np.ascontiguousarray(camera_points, dtype=np.float64)
    triangles = np.ascontiguousarray(triangles, dtype=np.int64)
    found[ahead], weights[ahead] = _nearest(nodes, triangles, rays, *_in_cells(rays))
    return SurfacePoints(found, weights)


def _in_cells(rays: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]:
    """Rays (p, 3) by cells of a grid on the plane z = 1.

    Returns
    -------
    order : (p,) rays, cell by cell.
    starts : (cells + 1,) where in it each cell begins.
    corner : (2,) of the grid.
    size : (2,) of a cell.
    """
    places = rays[:, :2] / rays[:, 2:]
    corner = places.min(axis=0)
    size = np.maximum(np.ptp(places, axis=0), 1e-12) / GRID * (1.0 + 1e-9)
    column, row = ((places - corner) / size).astype(np.int64).T
    cell = row * GRID + column
    starts = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=GRID * GRID))])
    return np.argsort(cell, kind="stable"), starts, corner, size


@njit(cache=True, nogil=True)
def _cells_between(a, b, c, corner, size):
    """First and last cell along one axis that a triangle meets, widened by what rounding may hide."""
    low, high = min(a, b, c), max(a, b, c)
    slack = 1e-6 * (high - low) + 1e-9 * size
    first = max(np.floor((low - slack - corner) / size), 0.0)
    last = min(np.floor((high + slack - corner) / size), GRID - 1.0)
    return int(min(first, float(GRID))), int(max(last, -1.0))


@njit(cache=True, nogil=True)
def _nearest(nodes, triangles, rays, order, starts, corner, size):
    found, nearest = np.full(len(rays), -1, dtype=np.int64), np.zeros(len(rays))
    weights = np.full((len(rays), 3), np.nan)
    for t in range(len(triangles)):
        i, j, k = triangles[t]
        a = (nodes[i, 0], nodes[i, 1], nodes[i, 2])
        b = (nodes[j, 0], nodes[j, 1], nodes[j, 2])
        c = (nodes[k, 0], nodes[k, 1], nodes[k, 2])
        volume = dot(a, cross(b, c))
        if not (a[2] > 0.0 and b[2] > 0.0 and c[2] > 0.0) or volume == 0.0:  # behind, or seen edge-on
            continue
        left, right = _cells_between(a[0] / a[2], b[0] / b[2], c[0] / c[2], corner[0], size[0])
        top, bottom = _cells_between(a[1] / a[2], b[1] / b[2], c[1] / c[2], corner[1], size[1])
        for row in range(top, bottom + 1):
            for place in range(starts[row * GRID + left], starts[row * GRID + right + 1]):
                ray = order[place]
                d = (rays[ray, 0], rays[ray, 1], rays[ray, 2])
                of_a = dot(d, cross(b, c)) / volume
                of_b = dot(d, cross(c, a)) / volume
                of_c = dot(d, cross(a, b)) / volume
                # 1 / (the multiple of the ray at which it meets the plane)
                inverse_range = of_a + of_b + of_c
                if inverse_range <= nearest[ray]:
                    continue
                if min(of_a, of_b, of_c) < -EDGE_TOLERANCE * inverse_range:
                    continue
                found[ray], nearest[ray] = t, inverse_range
                of_a, of_b, of_c = max(of_a, 0.0), max(of_b, 0.0), max(of_c, 0.0)
                total = of_a + of_b + of_c
                weights[ray, 0], weights[ray, 1], weights[ray, 2] = of_a / total, of_b / total, of_c / total
    return found, weights


def nearest_on_outline(
    camera_points: Array, node_pixels: Array, triangles: NDArray[np.int64], pixels: Array
) -> tuple[SurfacePoints, Array]:
    """The surface points whose image is nearest to pixels that the surface does not cover.

    The nearest point of the covered region lies on the image of an edge, so only edges are searched.

    Parameters
    ----------
    camera_points : (n, 3) mesh nodes in the camera frame.
    node_pixels : (n, 2) their pixels.
    triangles : (m, 3) node indices.
    pixels : (p, 2).

    Returns
    -------
    (points, distance): SurfacePoints of length p, and how far (p,) their images lie from ``pixels``, px.
    """
    starts = triangles.ravel()  # edge k of triangle t runs from corner k to corner k + 1
    ends = np.roll(triangles, -1, axis=1).ravel()
    along = node_pixels[ends] - node_pixels[starts]
    squared = np.maximum(np.einsum("ex,ex->e", along, along), 1e-300)
    edge, fraction, distance = (np.zeros(len(pixels), dtype=t) for t in (np.int64, float, float))
    for row, pixel in enumerate(pixels):
        offset = pixel - node_pixels[starts]
        t = np.clip(np.einsum("ex,ex->e", offset, along) / squared, 0.0, 1.0)
        gap = np.linalg.norm(offset - t[:, None] * along, axis=1)
        best = int(np.nanargmin(gap))
        edge[row], fraction[row], distance[row] = best, t[best], gap[best]
    near, far = camera_points[starts[edge], 2], camera_points[ends[edge], 2]
    # Inverse depth is linear in the image, so a fraction of the edge's image is another of the edge itself.
    fraction = fraction * near / ((1.0 - fraction) * far + fraction * near)
    weights = np.zeros((len(pixels), 3))
    rows, corner = np.arange(len(pixels)), edge % 3
    weights[rows, corner] = 1.0 - fraction
    weights[rows, (corner + 1) % 3] += fraction
    return SurfacePoints(edge // 3, weights), distance
