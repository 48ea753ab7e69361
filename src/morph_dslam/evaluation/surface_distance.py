"""Distance from measured points to a triangulated surface: the paper's error against a depth sensor."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def _square_distance_to_triangle(p, a, b, c):
    """Squared distance of a point to a triangle (Ericson, Real-Time Collision Detection, 2005, 5.1.5)."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = np.dot(ab, ap), np.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return np.dot(ap, ap)
    bp = p - b
    d3, d4 = np.dot(ab, bp), np.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return np.dot(bp, bp)
    cp = p - c
    d5, d6 = np.dot(ab, cp), np.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return np.dot(cp, cp)
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        off = ap - ab * (d1 / (d1 - d3))
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        off = ap - ac * (d2 / (d2 - d6))
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        off = bp - (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)))
    else:
        scale = 1.0 / (va + vb + vc)
        off = ap - ab * (vb * scale) - ac * (vc * scale)
    return np.dot(off, off)


@njit(cache=True, nogil=True)
def _distances(points, corners, centres, radii):
    result = np.empty(len(points))
    for i in range(len(points)):
        best = np.inf
        # In single numbers: most triangles are left out here, and small arrays would cost more than that.
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for t in range(len(corners)):
            square = (x - centres[t, 0]) ** 2 + (y - centres[t, 1]) ** 2 + (z - centres[t, 2]) ** 2
            if square >= (radii[t] + best) ** 2:
                continue
            off = _square_distance_to_triangle(points[i], corners[t, 0], corners[t, 1], corners[t, 2])
            best = min(best, np.sqrt(off))
        result[i] = best
    return result


def distances_to_surface(points: Array, nodes: Array, triangles: NDArray[np.integer]) -> Array:
    """Distance (p,) of each point (p, 3) to the nearest point of a surface, in the unit of the input.

    Every triangle is looked at unless a sphere around it is farther than what was found already.

    Parameters
    ----------
    nodes : (n, 3). triangles : (t, 3) node indices.
    """
    corners = np.ascontiguousarray(nodes[triangles], dtype=np.float64)
    centres = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    return _distances(np.ascontiguousarray(points, dtype=np.float64), corners, centres, radii)


def distances_to_surface_numpy(points: Array, nodes: Array, triangles: NDArray[np.integer]) -> Array:
    """The plain twin of `distances_to_surface`: the plane where its foot is inside, else the nearest edge."""
    corners = nodes[triangles]
    edges = [(corners[:, i], corners[:, (i + 1) % 3] - corners[:, i]) for i in range(3)]
    normal = np.cross(edges[0][1], -edges[2][1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    result = np.empty(len(points))
    for i, point in enumerate(points):
        height = np.abs(np.einsum("tx,tx->t", point - corners[:, 0], normal))
        inside = np.ones(len(corners), dtype=bool)
        nearest = np.full(len(corners), np.inf)
        for start, edge in edges:
            inside &= np.einsum("tx,tx->t", np.cross(edge, point - start), normal) >= 0.0
            along = np.einsum("tx,tx->t", point - start, edge) / np.einsum("tx,tx->t", edge, edge)
            foot = start + np.clip(along, 0.0, 1.0)[:, None] * edge
            nearest = np.minimum(nearest, np.linalg.norm(point - foot, axis=1))
        result[i] = np.where(inside, height, nearest).min()
    return result
