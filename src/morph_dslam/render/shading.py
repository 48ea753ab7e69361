"""Shading: vertex normals of a mesh and Lambert's law."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def _sum_normals(points, triangles, normals):
    """Add to ``normals`` (n, 3) the normals of all triangles, as long as these are large, and normalise."""
    for t in range(len(triangles)):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ux, uy, uz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
        vx, vy, vz = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for node in (i, j, k):
            normals[node, 0] += x
            normals[node, 1] += y
            normals[node, 2] += z
    for n in range(len(normals)):
        length = np.sqrt(normals[n, 0] ** 2 + normals[n, 1] ** 2 + normals[n, 2] ** 2)
        if length > 0.0:
            for c in range(3):
                normals[n, c] /= length


def vertex_normals(points: Array, triangles: NDArray) -> Array:
    """Unit normals (n, 3) of a surface at its nodes, the mean of the triangles around them by area.

    Parameters
    ----------
    points : (n, 3) node positions. triangles : (m, 3), whose order of nodes gives the normal its side.
    """
    normals = np.zeros((len(points), 3))
    _sum_normals(np.asarray(points, dtype=np.float64), np.asarray(triangles, dtype=np.int64), normals)
    return normals


def vertex_normals_numpy(points: Array, triangles: NDArray) -> Array:
    """The plain twin of `vertex_normals`."""
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    face_normals = np.cross(b - a, c - a)
    nodes = triangles.T.ravel()
    normals = np.column_stack(
        [np.bincount(nodes, np.tile(component, 3), len(points)) for component in face_normals.T]
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0.0, length, 1.0)


def lambert(normals: Array, to_light: Array, ambient: float) -> Array:
    """Brightness (n,) from ``ambient`` to 1 of a matt surface that looks alike from both sides.

    Parameters
    ----------
    normals : (n, 3) unit normals turned towards the viewer or away, which makes no difference.
    to_light : (3,) direction from the surface to a distant light, of any length.
    ambient : brightness of a part that the light only grazes, 0 to 1.
    """
    cosine = np.abs(normals @ (to_light / np.linalg.norm(to_light)))
    return ambient + (1.0 - ambient) * cosine
