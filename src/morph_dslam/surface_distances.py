"""Distances of points from a surface of triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Array = NDArray[np.float64]


def _distances_to_triangles(points: Array, corners: Array) -> Array:
    """Distance (k,) of each point (k, 3) to its own triangle (k, 3, 3): to its edges, or its plane if above it."""
    edges = np.roll(corners, -1, axis=1) - corners
    offsets = points[:, None] - corners
    squares = np.maximum(np.einsum("kex,kex->ke", edges, edges), 1e-300)
    shares = np.clip(np.einsum("kex,kex->ke", edges, offsets) / squares, 0.0, 1.0)
    to_edges = np.linalg.norm(offsets - shares[..., None] * edges, axis=2).min(axis=1)
    normals = np.cross(edges[:, 0], edges[:, 1])
    sides = np.einsum("kex,kex->ke", np.cross(normals[:, None], edges), offsets)
    heights = np.abs(np.einsum("kx,kx->k", normals, offsets[:, 0]))
    lengths = np.maximum(np.linalg.norm(normals, axis=1), 1e-300)
    # The sides of a triangle without area are all zero.
    return np.where((sides > 0.0).all(axis=1), heights / lengths, to_edges)


#: Points that are looked for together, lest their candidates fill the memory.
_AT_ONCE = 1000


def nearest_triangles(points: Array, nodes: Array, triangles: NDArray[np.integer]) -> tuple[NDArray[np.int64], Array]:
    """The triangle (p,) of a surface that is nearest to each point (p, 3), and the distance (p,) from it.

    The nearest triangle is no farther than the one whose centre is nearest, so its own centre is within that distance
    and the largest radius of a triangle.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    corners = np.asarray(nodes, dtype=np.float64)[triangles]
    centres = corners.mean(axis=1)
    tree = KDTree(centres)
    reach = _distances_to_triangles(points, corners[tree.query(points)[1]])
    reach += np.linalg.norm(corners - centres[:, None], axis=2).max()
    rows, found = np.zeros(len(points), dtype=np.int64), np.zeros(len(points))
    for first in range(0, len(points), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        near = tree.query_ball_point(points[part], reach[part] * (1.0 + 1e-9))
        counts = np.array([len(each) for each in near])
        candidates = np.concatenate(near).astype(np.int64)
        distances = _distances_to_triangles(np.repeat(points[part], counts, axis=0), corners[candidates])
        order = np.lexsort((distances, np.repeat(np.arange(len(counts)), counts)))
        best = order[np.cumsum(counts) - counts]
        rows[part], found[part] = candidates[best], distances[best]
    return rows, found


def distances_to_surface(points: Array, nodes: Array, triangles: NDArray[np.integer]) -> Array:
    """Distance (p,) of each point (p, 3) to the nearest point of a surface, in the unit of the input."""
    return nearest_triangles(points, nodes, triangles)[1] if len(points) else np.zeros(0)
