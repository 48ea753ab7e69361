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


def distances_to_surface(points: Array, nodes: Array, triangles: NDArray[np.integer]) -> Array:
    """Distance (p,) of each point (p, 3) to the nearest point of a surface, in the unit of the input.

    The nearest triangle is no farther than the nearest centre of one, so its own centre is within that and the
    largest radius of a triangle.
    """
    if not len(points):
        return np.zeros(0)
    points = np.ascontiguousarray(points, dtype=np.float64)
    corners = np.asarray(nodes, dtype=np.float64)[triangles]
    centres = corners.mean(axis=1)
    tree = KDTree(centres)
    reach = tree.query(points)[0] + np.linalg.norm(corners - centres[:, None], axis=2).max()
    near = tree.query_ball_point(points, reach * (1.0 + 1e-9))
    counts = np.array([len(found) for found in near])
    candidates = np.concatenate(near).astype(np.int64)
    distances = _distances_to_triangles(np.repeat(points, counts, axis=0), corners[candidates])
    return np.minimum.reduceat(distances, np.cumsum(counts) - counts)
