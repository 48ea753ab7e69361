"""A surface with fewer triangles, to be drawn thousands of times while an object is looked for."""

from __future__ import annotations

import fast_simplification
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Surfaces of more triangles than this get so many. A scan of 56 000 and a seal of 29 000 triangles then differ by
#: 0.0003 of their size in the mean: a tenth of a pixel where they fill an image.
MOST_TRIANGLES = 8000


def simplified(nodes: Array, triangles: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """The surface with at most `MOST_TRIANGLES` triangles and the nodes of these, by collapsing edges.

    Those go first that change the surface least (Garland and Heckbert, Surface simplification using quadric error
    metrics, 1997). A surface with so few triangles is returned as it is.

    Parameters
    ----------
    nodes : (n, 3) metres.
    triangles : (m, 3) node indices.
    """
    if len(triangles) <= MOST_TRIANGLES:
        return nodes, triangles
    used, renumbered = np.unique(triangles, return_inverse=True)
    size = float(np.ptp(nodes[used], axis=0).max())  # the library's tolerances are for coordinates of about one
    coarse = fast_simplification.simplify(
        nodes[used] / size, renumbered.reshape(-1, 3).astype(np.int32), target_count=MOST_TRIANGLES
    )
    points, faces = coarse[0], coarse[1]
    return np.asarray(size * points, dtype=np.float64), np.asarray(faces, dtype=np.int64)
