"""Points that stand for a surface: spread over a triangle mesh as its area asks for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.reduced_model import SurfacePoints

Array = NDArray[np.float64]


def triangle_normals(nodes: Array, triangles: NDArray[np.int64]) -> Array:
    """Normals (m, 3) of triangles (m, 3) of nodes (n, 3), as long as twice their areas."""
    a, b, c = (nodes[triangles[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def spread_over(nodes: Array, triangles: NDArray[np.int64], count: int) -> SurfacePoints:
    """``count`` points spread evenly over the triangles (m, 3) of nodes (n, 3), the same every time.

    Each stands for the same area: along the triangles, one after the other, they are equally far apart, and
    within its triangle each lies anywhere.
    """
    areas = np.linalg.norm(triangle_normals(nodes, triangles), axis=1)
    places = (np.arange(count) + 0.5) / count * areas.sum()
    # The sum may be larger than the last of the running sums by a rounding error.
    chosen = np.minimum(np.searchsorted(np.cumsum(areas), places), len(areas) - 1)
    return SurfacePoints(chosen, np.random.default_rng(0).dirichlet(np.ones(3), count))
