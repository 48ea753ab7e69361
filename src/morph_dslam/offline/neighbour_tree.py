"""The tree along which a sweep goes from sample to sample, outwards from the root in short steps."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Steps and paths that differ by less, relatively, are equally long: rounding decides nothing.
TIE = 1e-9


def neighbour_tree(
    samples: Array, scale: Array, root: Array, solved: Collection[int] = (), failed: Collection[int] = ()
) -> tuple[list[int], list[int]]:
    """Prim's order of the samples that are not solved yet, and the neighbour that each starts from.

    The tree is as short as can be. Among equally short steps, as a grid has, the one is taken whose path from
    the root is shortest: every path of a grid then leads outwards from the defaults and never back, so that
    loads only grow along it and branches can be walked in parallel.

    Parameters
    ----------
    samples : (n, d). scale : (d,) lengths in which steps are measured. root : (d,).
    solved, failed : samples that may be started from already, and samples that nothing is to start from.

    Returns
    -------
    order : the unsolved samples. parent : for every sample, another one or -1 for the root state.
    """
    points = samples / scale
    distance = np.linalg.norm(points - root / scale, axis=1)
    path = distance.copy()
    parent = np.full(len(points), -1)
    waiting = np.ones(len(points), dtype=bool)
    known = sorted(solved)
    order: list[int] = []
    for step in range(len(points)):
        nearest = known[step] if step < len(known) else _next(waiting, distance, path)
        if step >= len(known):
            order.append(nearest)
        waiting[nearest] = False
        if nearest in failed:
            continue
        to_new = np.linalg.norm(points - points[nearest], axis=1)
        through_new = path[nearest] + to_new
        as_close = (to_new <= distance * (1.0 + TIE)) & (through_new < path * (1.0 - TIE))
        closer = waiting & ((to_new < distance * (1.0 - TIE)) | as_close)
        distance[closer], path[closer], parent[closer] = to_new[closer], through_new[closer], nearest
    return order, parent.tolist()


def _next(waiting: NDArray[np.bool_], distance: Array, path: Array) -> int:
    """The waiting sample of the shortest step and, among equals, of the shortest path."""
    left = np.flatnonzero(waiting)
    equals = left[distance[left] <= distance[left].min() * (1.0 + TIE)]
    shortest = path[equals].min()
    return int(equals[np.argmax(path[equals] <= shortest * (1.0 + TIE))])
