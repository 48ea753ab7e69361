"""How much of the force of a moving load lands on its surface (`loads.MovingPatch`, `loads.MovingLine`).

Their densities are those of a load on an endless plane, so that what would act beyond the surface's rim is missing.
"""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.special import ndtr

from morph_dslam.meshing.meshes import Mesh

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Widths from its centre beyond which a density is zero.
REACH = 5.0
#: Longest edge of the triangles that a surface is cut into, in widths, and most pieces of an edge.
FINE, MOST_PIECES = 0.3, 60
#: Places along a line at which its force is looked at.
STATIONS = 9


def smallest_cell(mesh: Mesh, faces: Indices) -> float:
    """The edge of the square, or of the right-angled half of one, that is as large as the smallest face, m.

    Parameters
    ----------
    faces : (f, 2) cell and local face number.
    """
    nodes = mesh.face_nodes(faces, corners_only=True)
    corners = mesh.nodes[nodes]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    doubled = np.linalg.norm(np.cross(first, second), axis=1)
    if nodes.shape[1] > 3:
        diagonals = np.cross(second, corners[:, 3] - corners[:, 1])
        doubled = np.where(nodes[:, 3] >= 0, np.linalg.norm(diagonals, axis=1) / 2.0, doubled)
    return float(np.sqrt(doubled.min()))


def nearest_point(triangles: Array, point: Array) -> Array:
    """The point (3,) of a surface of triangles (t, 3, 3) that is nearest to ``point`` (3,)."""
    feet = trimesh.triangles.closest_point(triangles, np.repeat(point[None], len(triangles), axis=0))
    return np.asarray(feet[np.linalg.norm(feet - point, axis=1).argmin()])


def distance_from_rim(nodes: Array, triangles: Indices, point: Array) -> float:
    """How far ``point`` (3,) is from the nearest edge of one triangle alone; infinite where the surface is closed.

    Parameters
    ----------
    nodes : (n, 3) m.
    triangles : (t, 3) of node indices.
    """
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, counts = np.unique(edges, axis=0, return_counts=True)
    start, stop = nodes[edges[counts == 1].T]
    if not len(start):
        return float("inf")
    along = stop - start
    where = np.einsum("ex,ex->e", point - start, along) / np.maximum(np.einsum("ex,ex->e", along, along), 1e-300)
    return float(np.linalg.norm(start + np.clip(where, 0.0, 1.0)[:, None] * along - point, axis=1).min())


def share_of_patch(triangles: Array, centre: Array, width: float) -> float:
    """The part of a patch's force that lands on a surface.

    Parameters
    ----------
    triangles : (t, 3, 3) corners, m.
    centre : (3,) m.
    width : standard deviation of the density, m.
    """
    points, areas = _points_near(triangles, centre, None, width)
    square = np.sum((points - centre) ** 2, axis=1)
    return float(areas @ np.exp(-square / (2.0 * width**2)) / (2.0 * np.pi * width**2))


def share_of_line(triangles: Array, centre: Array, direction: Array, width: float) -> float:
    """The part of a line's force that lands on a surface, on at least half of the length that it crosses.

    Where it ends is no loss: its force is per length. It crosses where the surface is not farther from it than a width.

    Parameters
    ----------
    triangles : (t, 3, 3) corners, m.
    centre : a point of the line (3,), m.
    direction : (3,) of the line; its length does not matter.
    width : standard deviation of the density across it, m.
    """
    unit = direction / np.linalg.norm(direction)
    points, areas = _points_near(triangles, centre, unit, width)
    along, square = (points - centre) @ unit, _squares(points - centre, unit)
    crossed = along[square <= width**2]
    if not len(crossed):
        return 0.0
    start, stop = crossed.min(), crossed.max() + 1e-9 * width
    stations = start + (stop - start) * (np.arange(STATIONS) + 0.5) / STATIONS
    # About a station the force counts as a patch's does, whose part beyond both ends is no loss.
    squares = square + (along - stations[:, None]) ** 2
    landed = np.exp(-squares / (2.0 * width**2)) @ areas / (2.0 * np.pi * width**2)
    within = ndtr((stop - stations) / width) - ndtr((start - stations) / width)
    return float(np.median(landed / within))


def _squares(arms: Array, unit: Array | None) -> Array:
    """Squared distances of points at ``arms`` (..., 3) from a centre, or from a line through it."""
    square = np.sum(arms**2, axis=-1)
    return square if unit is None else square - (arms @ unit) ** 2


def _points_near(triangles: Array, centre: Array, unit: Array | None, width: float) -> tuple[Array, Array]:
    """Points (p, 3) spread over those triangles that a density reaches, and the area (p,) that each stands for."""
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    distance = np.sqrt(np.maximum(_squares(triangles[:, 0] - centre, unit), 0.0))
    near = distance <= edges + REACH * width
    triangles, edges = triangles[near], edges[near]
    pieces = np.clip(np.ceil(edges / (FINE * width)), 1, MOST_PIECES).astype(int)
    areas = np.linalg.norm(np.cross(*np.moveaxis(triangles[:, 1:] - triangles[:, :1], 1, 0)), axis=1) / 2.0
    points, shares = [np.empty((0, 3))], [np.empty(0)]
    for count in np.unique(pieces):
        chosen, places = pieces == count, _centres(count)
        points.append(np.einsum("pc,tcx->tpx", places, triangles[chosen]).reshape(-1, 3))
        shares.append(np.repeat(areas[chosen] / count**2, count**2))
    return np.concatenate(points), np.concatenate(shares)


def _centres(count: int) -> Array:
    """Barycentric coordinates (count^2, 3) of the centres of equal parts of a triangle, ``count`` along each edge."""
    i, j = (index.ravel() for index in np.meshgrid(np.arange(count), np.arange(count)))
    upright, turned = i + j < count, i + j < count - 1
    first = np.concatenate([i[upright] + 1 / 3, i[turned] + 2 / 3]) / count
    second = np.concatenate([j[upright] + 1 / 3, j[turned] + 2 / 3]) / count
    return np.column_stack([1.0 - first - second, first, second])
