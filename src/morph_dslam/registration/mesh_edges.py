"""Points along the edges of a mesh, and which of them a camera sees: its outline, and where it is bent sharply.

Registration looks at them ten thousand times, in threads beside each other: what depends on the pose is compiled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import fast_simplification
import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform
from morph_dslam.model.reduced_model import triangle_normals
from morph_dslam.render.rasteriser import draw_depth
from morph_dslam.small_arrays import dot

Array = NDArray[np.float64]
#: Cosine of the angle between two triangles from which their edge is seen, points along the edges of the size of the
#: object, and the factor by which depth is drawn smaller.
SHARP, SPACING, SHRINK = 0.85, 80, 2.0
#: The same cosine, from which on the two triangles lie in one plane.
FLAT = 1.0 - 1e-9
#: Surfaces of more triangles than this are drawn with so many. A scan of 56 000 and a seal of 29 000 triangles then
#: differ by 0.0003 of their size in the mean: a tenth of a pixel where they fill an image.
MOST_TRIANGLES = 8000
#: A point that is hidden lies behind what is drawn there by more than this part of the object's size.
BEHIND = 0.01


class EdgePoints(NamedTuple):
    """What compiled loops need of an object's edges; all in its frame, metres.

    Attributes
    ----------
    points : (p, 3) along the edges.
    along : (p, 3) their edges, from end to end.
    sides : (2, p, 3) normals of the triangles on both sides.
    away : (2, p) how far the planes of these are from the origin.
    sharp : (p,) whether the surface is bent so sharply that the edge is seen from all around.
    nodes : (n, 3) that are drawn, to see what is hidden.
    triangles : (m, 3) of them.
    closed : whether the surface has an inside, so that its triangles that are turned away are hidden.
    tolerance : by which a point may be behind what is drawn.
    """

    points: Array
    along: Array
    sides: Array
    away: Array
    sharp: NDArray[np.bool_]
    nodes: Array
    triangles: NDArray[np.int64]
    closed: bool
    tolerance: float


@dataclass(frozen=True)
class VisibleEdges:
    """Edges of a mesh that a view sees.

    Attributes
    ----------
    points : (p, 3) object frame, metres.
    pixels : (p, 2) where they are seen.
    normals : (p, 2) across them in the image.
    outline : (p,) whether something else is seen behind, and not another side of the object.
    """

    points: Array
    pixels: Array
    normals: Array
    outline: NDArray[np.bool_]


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


class MeshEdges:
    """Points along the edges of a mesh.

    Parameters
    ----------
    nodes : (n, 3) metres.
    triangles : (m, 3) node indices.
    """

    def __init__(self, nodes: Array, triangles: NDArray[np.int64]) -> None:
        self.nodes, self.triangles = nodes, triangles
        #: Nodes and triangles that are drawn, to see what is hidden.
        self.drawn = simplified(nodes, triangles)
        self.size = float(np.linalg.norm(np.ptp(nodes, axis=0)))
        sides = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        owner = np.repeat(np.arange(len(triangles)), 3)
        keys = np.sort(sides, axis=1)
        order = np.lexsort((keys[:, 1], keys[:, 0]))
        _, first, uses = np.unique(keys[order], axis=0, return_index=True, return_counts=True)
        closed = bool((uses == 2).all())
        ends, one = keys[order][first], owner[order[first]]
        other = np.where(uses == 2, owner[order[np.minimum(first + 1, len(order) - 1)]], -1)
        normals = triangle_normals(nodes, triangles)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        # An edge within a plane is never seen.
        bent = (other < 0) | (np.einsum("ex,ex->e", normals[one], normals[other]) < FLAT)
        ends, one, other = ends[bent], one[bent], other[bent]
        length = np.linalg.norm(nodes[ends[:, 1]] - nodes[ends[:, 0]], axis=1)
        edge, share = _spaced(length, self.size / SPACING)
        start, along = nodes[ends[edge, 0]], (nodes[ends[:, 1]] - nodes[ends[:, 0]])[edge]
        points, one, other = start + share[:, None] * along, one[edge], other[edge]
        sides = np.stack([normals[one], np.where(other[:, None] >= 0, normals[other], -normals[one])])
        #: For compiled loops.
        self.arrays = EdgePoints(
            points, along, sides, np.einsum("kpx,px->kp", sides, points), np.einsum("px,px->p", *sides) < SHARP,
            np.ascontiguousarray(self.drawn[0], dtype=np.float64), np.ascontiguousarray(self.drawn[1], dtype=np.int64),
            closed, BEHIND * self.size,
        )  # fmt: skip

    def visible(self, pose: RigidTransform, camera: Camera) -> VisibleEdges:
        """What a camera sees of them; ``pose`` is camera_from_object, metres."""
        rows, _, pixels, normals, turns = see_edges(self.arrays, *seen_from(pose, camera))
        return VisibleEdges(self.arrays.points[rows], pixels, normals, turns)

    def depth(self, pose: RigidTransform, camera: Camera, shrink: int = 1) -> Array:
        """The object's depth in every pixel of a camera with so many times fewer of them; inf beside it."""
        whole = np.full((camera.height // shrink, camera.width // shrink), np.inf)
        drawn, left, top = drawn_depth(self.arrays, *seen_from(pose, camera), float(shrink))
        whole[top : top + drawn.shape[0], left : left + drawn.shape[1]] = drawn
        return whole


def seen_from(pose: RigidTransform, camera: Camera) -> tuple[Array, Array, Array, int, int]:
    """What compiled loops need of a view: camera_from_object's rotation and translation, the camera and its size."""
    turn = np.ascontiguousarray(pose.rotation)
    return turn, np.ascontiguousarray(pose.translation), camera.intrinsics, camera.width, camera.height


@njit(cache=True, nogil=True)
def turn_vector(rotation, vector):
    """A vector (3,) after a rotation."""
    return dot(rotation[0], vector), dot(rotation[1], vector), dot(rotation[2], vector)


@njit(cache=True, nogil=True)
def move_point(rotation, translation, point):
    """A point (3,) after a rotation and a translation."""
    x, y, z = turn_vector(rotation, point)
    return x + translation[0], y + translation[1], z + translation[2]


@njit(cache=True, nogil=True)
def drawn_depth(edges, rotation, translation, intrinsics, width, height, shrink):
    """The depth of an object in an image that is so many times smaller, where it is; and the region's left and top.

    Nothing if part of it is not in front of the camera. For the parameters see `EdgePoints` and `seen_from`.
    """
    fx, fy, cx, cy = intrinsics
    nothing = np.empty((0, 0), np.float32)
    pixels, depths = np.empty((len(edges.nodes), 2)), np.empty(len(edges.nodes))
    least_u = least_v = np.inf
    most_u = most_v = -np.inf
    for n in range(len(edges.nodes)):
        x, y, z = move_point(rotation, translation, edges.nodes[n])
        if not z > 0.0:
            return nothing, 0, 0
        u, v = (fx * x / z + cx + 0.5) / shrink - 0.5, (fy * y / z + cy + 0.5) / shrink - 0.5
        pixels[n, 0], pixels[n, 1], depths[n] = u, v, z
        least_u, least_v, most_u, most_v = min(least_u, u), min(least_v, v), max(most_u, u), max(most_v, v)
    wide, high = float(width // shrink), float(height // shrink)
    left, top = int(min(max(np.floor(least_u), 0.0), wide)), int(min(max(np.floor(least_v), 0.0), high))
    right = int(min(max(np.ceil(most_u) + 1.0, 0.0), wide))
    bottom = int(min(max(np.ceil(most_v) + 1.0, 0.0), high))
    if left >= right or top >= bottom:
        return nothing, 0, 0
    for n in range(len(pixels)):
        pixels[n, 0] -= left
        pixels[n, 1] -= top
    return draw_depth(pixels, depths, edges.triangles, edges.closed, bottom - top, right - left)[1], left, top


@njit(cache=True, nogil=True)
def see_edges(edges, rotation, translation, intrinsics, width, height):
    """Which points along the edges of an object a camera sees. For the parameters see `EdgePoints` and `seen_from`.

    Returns
    -------
    Numbers (k,) of the points, where they are in the camera (k, 3) and in the image (k, 2), directions (k, 2) across
    their edges there, and whether (k,) the surface turns away, so that something else is behind.
    """
    fx, fy, cx, cy = intrinsics
    depth, left, top = drawn_depth(edges, rotation, translation, intrinsics, width, height, SHRINK)
    count, k = len(edges.points), 0
    rows, turned = np.empty(count, np.int64), np.empty(count, np.bool_)
    local, pixels, normals = np.empty((count, 3)), np.empty((count, 2)), np.empty((count, 2))
    eye = turn_vector(-rotation.T, translation)
    for p in range(count):
        first = dot(edges.sides[0, p], eye) > edges.away[0, p]
        second = dot(edges.sides[1, p], eye) > edges.away[1, p]
        if first == second and not (edges.sharp[p] and first):
            continue
        x, y, z = move_point(rotation, translation, edges.points[p])
        if not z > 0.0:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        small_u, small_v = (u + 0.5) / SHRINK - 0.5, (v + 0.5) / SHRINK - 0.5
        if not _is_ahead(depth, left, top, width // SHRINK, height // SHRINK, small_u, small_v, z - edges.tolerance):
            continue
        rows[k], turned[k] = p, first != second
        local[k, 0], local[k, 1], local[k, 2], pixels[k, 0], pixels[k, 1] = x, y, z, u, v
        _across(edges, p, rotation, fx, fy, local[k], normals[k])
        k += 1
    return rows[:k], local[:k], pixels[:k], normals[:k], turned[:k]


@njit(cache=True, nogil=True)
def _is_ahead(depth, left, top, width, height, u, v, nearest):
    """Whether a pixel is at least two inside of an image, and a point there not behind what is drawn around it."""
    column, row = np.rint(u), np.rint(v)
    if not (column >= 2.0 and row >= 2.0 and column < width - 2.0 and row < height - 2.0):
        return False
    farthest = 0.0
    for y in range(int(row) - top - 1, int(row) - top + 2):
        for x in range(int(column) - left - 1, int(column) - left + 2):
            inside = 0 <= x < depth.shape[1] and 0 <= y < depth.shape[0]
            farthest = max(farthest, depth[y, x]) if inside else np.inf
    return nearest <= farthest


@njit(cache=True, nogil=True)
def _across(edges, p, rotation, fx, fy, local, normal):
    """The direction across an edge in the image. Where a smooth surface turns away, its own normal is across."""
    if edges.sharp[p]:
        x, y, z = turn_vector(rotation, edges.along[p])
        ahead_u = fx * (x - local[0] / local[2] * z) / local[2]
        ahead_v = fy * (y - local[1] / local[2] * z) / local[2]
        normal[0], normal[1] = -ahead_v, ahead_u
    else:
        one, other = edges.sides[0, p], edges.sides[1, p]
        normal[0] = dot(rotation[0], one) + dot(rotation[0], other)
        normal[1] = dot(rotation[1], one) + dot(rotation[1], other)
    length = max(np.sqrt(normal[0] ** 2 + normal[1] ** 2), 1e-300)
    normal[0], normal[1] = normal[0] / length, normal[1] / length


def _spaced(lengths: Array, spacing: float) -> tuple[NDArray[np.int64], Array]:
    """Edges (p,) and shares of their lengths (p,) at equal distances along all of them, one after the other."""
    total = np.concatenate([[0.0], np.cumsum(lengths)])
    places = np.arange(0.5 * spacing, total[-1], spacing)
    edges = np.searchsorted(total, places, side="right") - 1
    return edges, (places - total[edges]) / np.maximum(lengths[edges], 1e-300)
