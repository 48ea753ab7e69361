"""Distance from measured points to a triangulated surface: the paper's error against a depth sensor.

The triangles are put into a tree of boxes, neighbours in space beside each other (Lauterbach et al., Fast BVH
construction on GPUs, 2009): sorted along a space-filling curve, a few to a leaf, each box around its two
children's. A point looks only into boxes that are nearer than what it has found already.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Triangles in a leaf of the tree.
LEAF = 4
#: Steps of the space-filling curve along each axis: 2 to the power of this.
CURVE_BITS = 10


@njit(cache=True, nogil=True)
def _minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True, nogil=True)
def _along(a, b, share):
    return a[0] - share * b[0], a[1] - share * b[1], a[2] - share * b[2]


@njit(cache=True, nogil=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)
def _square_distance_to_triangle(p, a, b, c):
    """Squared distance of a point to a triangle (Ericson, Real-Time Collision Detection, 2005, 5.1.5).

    Points are tuples of three numbers: arrays as small would cost more than what is computed with them.
    """
    ab, ac, ap = _minus(b, a), _minus(c, a), _minus(p, a)
    d1, d2 = _dot(ab, ap), _dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return _dot(ap, ap)
    bp = _minus(p, b)
    d3, d4 = _dot(ab, bp), _dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return _dot(bp, bp)
    cp = _minus(p, c)
    d5, d6 = _dot(ab, cp), _dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return _dot(cp, cp)
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        off = _along(ap, ab, d1 / (d1 - d3))
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        off = _along(ap, ac, d2 / (d2 - d6))
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        off = _along(bp, _minus(c, b), (d4 - d3) / ((d4 - d3) + (d5 - d6)))
    else:
        scale = 1.0 / (va + vb + vc)
        off = _along(_along(ap, ab, vb * scale), ac, vc * scale)
    return _dot(off, off)


def _along_curve(centres: Array) -> NDArray[np.intp]:
    """Order of points (t, 3) along a Z-order curve: neighbours in it are neighbours in space."""
    low, size = centres.min(axis=0), max(float(np.ptp(centres, axis=0).max()), 1e-300)
    cells = np.minimum((centres - low) / size * 2**CURVE_BITS, 2**CURVE_BITS - 1).astype(np.int64)
    codes = np.zeros(len(centres), dtype=np.int64)
    for bit in range(CURVE_BITS):
        for axis in range(3):
            codes |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(codes, kind="stable")


@njit(cache=True, nogil=True)
def _tree_of_boxes(corners, leaf):
    """Lowest and highest coordinates (2 l, 3) of boxes: the children of box i are 2 i and 2 i + 1.

    The last l boxes are leaves. Leaf k holds the triangles from k * leaf on; one that has none is infinitely
    far.
    """
    n_leaves = 1
    while n_leaves * leaf < len(corners):
        n_leaves *= 2
    low, high = np.full((2 * n_leaves, 3), np.inf), np.full((2 * n_leaves, 3), -np.inf)
    for t in range(len(corners)):
        box = n_leaves + t // leaf
        for corner in range(3):
            for axis in range(3):
                low[box, axis] = min(low[box, axis], corners[t, corner, axis])
                high[box, axis] = max(high[box, axis], corners[t, corner, axis])
    for box in range(n_leaves - 1, 0, -1):
        for axis in range(3):
            low[box, axis] = min(low[2 * box, axis], low[2 * box + 1, axis])
            high[box, axis] = max(high[2 * box, axis], high[2 * box + 1, axis])
    return low, high


@njit(cache=True, nogil=True)
def _square_distance_to_box(p, low, high):
    square = 0.0
    for axis in range(3):
        off = max(low[axis] - p[axis], p[axis] - high[axis], 0.0)
        square += off * off
    return square


@njit(cache=True, nogil=True)
def _distances(points, corners, low, high, leaf):
    n_leaves = len(low) // 2
    boxes, squares = np.empty(64, dtype=np.int64), np.empty(64)
    result = np.empty(len(points))
    for i in range(len(points)):
        p = (points[i, 0], points[i, 1], points[i, 2])
        best, depth = np.inf, 1
        boxes[0], squares[0] = 1, 0.0
        while depth:
            depth -= 1
            box = boxes[depth]
            if squares[depth] >= best:
                continue
            if box >= n_leaves:
                first = (box - n_leaves) * leaf
                for t in range(first, min(first + leaf, len(corners))):
                    a = (corners[t, 0, 0], corners[t, 0, 1], corners[t, 0, 2])
                    b = (corners[t, 1, 0], corners[t, 1, 1], corners[t, 1, 2])
                    c = (corners[t, 2, 0], corners[t, 2, 1], corners[t, 2, 2])
                    best = min(best, _square_distance_to_triangle(p, a, b, c))
                continue
            near, far = 2 * box, 2 * box + 1
            to_near = _square_distance_to_box(p, low[near], high[near])
            to_far = _square_distance_to_box(p, low[far], high[far])
            if to_far < to_near:
                near, far, to_near, to_far = far, near, to_far, to_near
            # The nearer one is taken from the stack first.
            boxes[depth], squares[depth] = far, to_far
            boxes[depth + 1], squares[depth + 1] = near, to_near
            depth += 2
        result[i] = np.sqrt(best)
    return result


def distances_to_surface(points: Array, nodes: Array, triangles: NDArray[np.integer]) -> Array:
    """Distance (p,) of each point (p, 3) to the nearest point of a surface, in the unit of the input.

    Parameters
    ----------
    nodes : (n, 3). triangles : (t, 3) node indices.
    """
    corners = np.asarray(nodes, dtype=np.float64)[triangles]
    corners = corners[_along_curve(corners.mean(axis=1))]
    low, high = _tree_of_boxes(corners, LEAF)
    return _distances(np.ascontiguousarray(points, dtype=np.float64), corners, low, high, LEAF)


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
