"""Shading: vertex normals of a mesh and Lambert's law."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def _sum_face_normals(points, triangles, normals):
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        x1, y1, z1 = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        x2, y2, z2 = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
        x, y, z = y1 * z2 - z1 * y2, z1 * x2 - x1 * z2, x1 * y2 - y1 * x2
        for node in (a, b, c):
            normals[node, 0] += x
            normals[node, 1] += y
            normals[node, 2] += z


def vertex_normals(points: Array, triangles: NDArray) -> Array:
    """Unit normals (n, 3) of a surface at its nodes, the mean of the triangles around them by area.

    Parameters
    ----------
    points : (n, 3) node positions. triangles : (m, 3), whose order of nodes gives the normal its side.
    """
    normals = np.zeros((len(points), 3))
    _sum_face_normals(
        np.ascontiguousarray(points, dtype=np.float64),
        np.ascontiguousarray(triangles, dtype=np.int64),
        normals,
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
