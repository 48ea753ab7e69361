"""The contour of a surface in the image: where it ends, or turns away, before something farther off.

An edge of the mesh belongs to it where one triangle only has the edge (an open rim), or where both triangles
lie on the same side of it in the image: one faces the camera, the other does not. Rims of holes and notches
are such edges too. Of these count what no other part of the object, and no known occluder, hides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.model import SurfacePoints
from morph_dslam.small_arrays import cross, dot

Array = NDArray[np.float64]
#: Pixels between candidates along the contour, and the least distance from the image's border.
STEP_PX, BORDER_PX = 2.0, 2.0
#: Where, pixels outwards, something farther off must be seen, and inwards the object itself: there is room then for
#: the sides that are compared.
OUTSIDE_PX, INSIDE_PX = (1.5, 3.0), 3.0
#: What is behind must be farther off than by this share of the object's size, and by so many pixels at its distance.
JUMP_SHARE, JUMP_PX = 0.01, 2.0
#: Cosine of the angle between two triangles' normals across an edge that is only the mesh's and not the body's.
SMOOTH = 0.75
#: How far inwards of the contour, which is itself drawn to half a pixel, the object is looked for, pixels: from and to.
FIRST_PX, FARTHEST_PX = 2, 9
#: Points of nearly parallel stretches of the contour count as neighbours: cosine of the angle between their normals.
PARALLEL = 0.5


@dataclass(frozen=True)
class SurfaceEdges:
    """The edges of a triangle mesh.

    Attributes
    ----------
    nodes : (e, 4) start and end, then the node opposite to the edge in each of its two triangles; -1 where only one
        triangle has it.
    triangles : (e,) the first of them.
    corners : (e, 2) which corners of that triangle start and end are.
    """

    nodes: NDArray[np.int64]
    triangles: NDArray[np.int64]
    corners: NDArray[np.int64]

    @classmethod
    def of(cls, triangles: NDArray[np.int64]) -> SurfaceEdges:
        """Those of triangles (m, 3); edges that more than two triangles share are left out."""
        sides = np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1]])
        half = triangles[:, sides].reshape(-1, 3)
        number = np.repeat(np.arange(len(triangles)), 3)
        keys = np.sort(half[:, :2], axis=1) @ np.array([triangles.max(initial=0) + 1, 1])
        order = np.argsort(keys, kind="stable")
        _, first, counts = np.unique(keys[order], return_index=True, return_counts=True)
        first, counts = first[counts <= 2], counts[counts <= 2]
        one, other = order[first], order[np.minimum(first + 1, len(order) - 1)]
        opposite = np.where(counts == 2, half[other, 2], -1)
        nodes = np.column_stack([half[one], opposite])
        return cls(nodes, number[one], sides[one % 3, :2])


@dataclass(frozen=True)
class Contour:
    """Points on the visible contour.

    Attributes
    ----------
    points : (k,) on the surface.
    pixels : (k, 2) where they are seen
    normals : (k, 2) across the contour, outwards.
    turns_away : (k,) whether a smooth surface turns away there; it ends, or has a sharp edge, elsewhere.
    width : (k,) how far the object goes on inwards before nothing of it is seen; infinite beyond `FARTHEST_PX`.
    """

    points: SurfacePoints
    pixels: Array
    normals: Array
    turns_away: NDArray[np.bool_]
    width: Array

    def __len__(self) -> int:
        return len(self.pixels)


def find_contour(
    edges: SurfaceEdges,
    nodes: Array,
    pixels: Array,
    depth: NDArray[np.float32],
    focal: float,
    size: float,
    count: int,
    occluder_depth: NDArray[np.float32] | None = None,
) -> Contour:
    """Points spread evenly along the visible contour.

    Parameters
    ----------
    edges : of the mesh
    nodes, pixels : (n, 3) in the camera frame, metres, and (n, 2), NaN behind the camera.
    depth : (h, w) of the object, metres, infinite where it is not.
    focal : length, pixels.
    size : of the object, metres.
    count : about so many points, never more.
    occluder_depth : (h, w) of other objects, infinite where there are none.
    """
    occluders = np.empty((0, 0), dtype=np.float32) if occluder_depth is None else occluder_depth
    found = _candidates(edges.nodes, nodes, pixels, depth, occluders, focal, size)
    rows, shares, turns_away = found[:, 0].astype(np.int64), found[:, 1], found[:, 6] > 0.0
    places, normals = np.ascontiguousarray(found[:, 2:4]), np.ascontiguousarray(found[:, 4:6])
    chosen = _spread(places, normals, len(rows) / max(count, 1), count)
    rows, shares = rows[chosen], shares[chosen]
    weights = np.zeros((len(rows), 3))
    every = np.arange(len(rows))
    weights[every, edges.corners[rows, 0]] = 1.0 - shares
    weights[every, edges.corners[rows, 1]] = shares
    points = SurfacePoints(edges.triangles[rows], weights)
    width = _widths(places[chosen], normals[chosen], depth)
    return Contour(points, places[chosen], normals[chosen], turns_away[chosen], width)


@njit(cache=True, nogil=True)
def _widths(places, normals, depth):
    """How far (k,) from places (k, 2) against their normals (k, 2) the first pixel is in which nothing was drawn."""
    height, width = depth.shape
    result = np.full(len(places), np.inf)
    for j in range(len(places)):
        for away in range(FIRST_PX, FARTHEST_PX + 1):
            column = int(np.rint(places[j, 0] - away * normals[j, 0]))
            row = int(np.rint(places[j, 1] - away * normals[j, 1]))
            if not (0 <= column < width and 0 <= row < height):
                break
            if np.isinf(depth[row, column]):
                result[j] = away - 0.5
                break
    return result


@njit(cache=True, nogil=True)
def _side(pixels, start, end, other):
    """On which side of an edge a node is seen: the sign of the area between."""
    return (pixels[end, 0] - pixels[start, 0]) * (pixels[other, 1] - pixels[start, 1]) - (
        pixels[end, 1] - pixels[start, 1]
    ) * (pixels[other, 0] - pixels[start, 0])


@njit(cache=True, nogil=True)
def _normal(edge, nodes, nx, ny):
    """Outward normal in the image of the contour at an edge whose own normal is (nx, ny), and whether it is smooth.

    Where a smooth surface turns away, edges run zigzag along its contour. There the plane that touches the surface
    holds the sight line, and its trace in the image is the contour's tangent.
    """
    if edge[3] < 0:
        return nx, ny, False
    a, b = nodes[edge[0]], nodes[edge[1]]
    first, second = cross(b - a, nodes[edge[2]] - a), cross(a - b, nodes[edge[3]] - b)
    sizes = np.sqrt(dot(first, first)), np.sqrt(dot(second, second))
    if not min(sizes) > 0.0 or dot(first, second) < SMOOTH * sizes[0] * sizes[1]:
        return nx, ny, False
    x, y = first[0] / sizes[0] + second[0] / sizes[1], first[1] / sizes[0] + second[1] / sizes[1]
    along, length = x * nx + y * ny, np.hypot(x, y)
    if not abs(along) > PARALLEL * length:
        return nx, ny, True
    length = np.copysign(length, along)
    return x / length, y / length, True


@njit(cache=True, nogil=True)
def _is_seen(x, y, nx, ny, z, jump, depth, occluders):
    """Whether a point of the object's edge at depth z is before something farther off, with the object inside."""
    height, width = depth.shape
    for k in range(3):
        away = OUTSIDE_PX[k] if k < 2 else -INSIDE_PX
        column, row = int(np.rint(x + away * nx)), int(np.rint(y + away * ny))
        if column < 0 or row < 0 or column >= width or row >= height:
            return False
        there = depth[row, column]
        if k < 2 and there < z + jump:
            return False
        if k == 2 and not there < z + jump:
            return False
        if occluders.size and occluders[row, column] < z:
            return False
    return True


@njit(cache=True, nogil=True)
def _candidates(edges, nodes, pixels, depth, occluders, focal, size):
    """What is seen of the contour (k, 7): edge, share of its length, pixel (2), outward normal (2), 1 if smooth there.

    Every `STEP_PX` pixels along the edges, one after the other.
    """
    height, width = depth.shape
    found, count, left = np.empty((4096, 7)), 0, 0.5 * STEP_PX
    for e in range(len(edges)):
        start, end = edges[e, 0], edges[e, 1]
        side = _side(pixels, start, end, edges[e, 2])
        if edges[e, 3] >= 0 and not side * _side(pixels, start, end, edges[e, 3]) > 0.0:
            continue
        dx, dy = pixels[end, 0] - pixels[start, 0], pixels[end, 1] - pixels[start, 1]
        length = np.hypot(dx, dy)
        if not (length > 0.0 and side != 0.0):
            continue
        # The side of the opposite node is inside.
        turn = -1.0 if side > 0.0 else 1.0
        nx, ny, is_smooth = _normal(edges[e], nodes, -turn * dy / length, turn * dx / length)
        along = left
        while along < length:
            share = along / length
            along += STEP_PX
            x, y = pixels[start, 0] + share * dx, pixels[start, 1] + share * dy
            if not (BORDER_PX <= x < width - BORDER_PX and BORDER_PX <= y < height - BORDER_PX):
                continue
            first, last = (1.0 - share) / nodes[start, 2], share / nodes[end, 2]
            z = 1.0 / (first + last)
            if not _is_seen(x, y, nx, ny, z, max(JUMP_SHARE * size, JUMP_PX * z / focal), depth, occluders):
                continue
            if count == len(found):
                longer = np.empty((2 * count, 7))
                for row in range(count):
                    for k in range(7):
                        longer[row, k] = found[row, k]
                found = longer
            found[count, 0], found[count, 1], found[count, 2], found[count, 3] = e, last * z, x, y
            found[count, 4], found[count, 5], found[count, 6] = nx, ny, is_smooth
            count += 1
        left = along - length
    return found[:count]


@njit(cache=True, nogil=True)
def _spread(places, normals, apart, most):
    """Indices of at most ``most`` candidates, none nearer to another of its direction than about ``apart`` steps.

    The distance shrinks until most of what fits is found. Along a straight stretch candidates are whole steps apart,
    but for rounding and a slight bend. So the least distance lies midway between two numbers of steps.
    """
    chosen = np.empty(most, np.int64)
    count = 0
    for factor in (1.0, 0.75, 0.5):
        least = (STEP_PX * (np.ceil(factor * apart) - 0.5)) ** 2
        for j in range(len(places)):
            if count == most:
                break
            free = True
            for i in range(count - 1, -1, -1):  # those that were chosen last are mostly the nearest
                other = chosen[i]
                dx, dy = places[j, 0] - places[other, 0], places[j, 1] - places[other, 1]
                if not dx * dx + dy * dy < least:
                    continue
                if normals[j, 0] * normals[other, 0] + normals[j, 1] * normals[other, 1] > PARALLEL:
                    free = False
                    break
            if free:
                chosen[count] = j
                count += 1
    return chosen[:count]
