"""Shading: vertex normals of a mesh and Lambert's law."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def vertex_normals(points: Array, triangles: NDArray) -> Array:
    """Unit normals (n, 3) of a surface at its nodes, the mean of the triangles around them by area.

    Parameters
    ----------
    points : (n, 3) node positions. triangles : (m, 3), whose order of nodes gives the normal its side.
    """
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
