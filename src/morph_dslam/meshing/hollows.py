"""The wall of a hollow in a solid, also of one with an inlet, which the surface of the body runs through.

A face in a hollow meets the body again in nearly all directions; one outside, or at the mouth of an inlet, sees past
it. The wall is what hangs together of such faces. It does not matter how narrow the gaps between the walls of folds
are: no surface leads there from a hollow but through its inlet.
"""

from __future__ import annotations

from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.errors import StudyError
from morph_dslam.meshing.mesh_summary import faces_figures, unit_normals
from morph_dslam.meshing.meshes import Mesh, parts_of

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Lines, spread evenly over all directions, along which the body is looked for: a face looks along each one way.
LINES = 64
#: A face is in a hollow if the body is in more than the first share of the directions that it looks in. The wall must
#: be the same with the second one, but for a part of its area: else it has no clear end.
ENCLOSED, CLEARLY, UNCLEAR_AREA = 0.75, 0.93, 0.05


def hollow_wall(mesh: Mesh, point: Array) -> Indices:
    """Faces (f, 2) of the wall of the hollow that a point (3,), metres, lies in.

    The wall of an inlet is part of it up to near its mouth. Raises StudyError if the point is in the material, or in
    the open, or if the hollow is so open that its wall has no clear end.
    """
    faces = mesh.boundary_faces()
    seen = _seen_from(mesh, faces, point)
    shares = enclosure(mesh, faces)
    wall, clear = (_part_with(mesh, faces, shares > least, seen) for least in (ENCLOSED, CLEARLY))
    if not len(wall):
        raise StudyError("the point lies outside of the solid, in no hollow: give one in the middle of a hollow")
    largest, smallest = (faces_figures(mesh, part)[0] if len(part) else 0.0 for part in (wall, clear))
    if smallest < (1.0 - UNCLEAR_AREA) * largest:
        raise StudyError(
            f"the hollow there is so open that its wall has no clear end (it has {1e6 * smallest:.3g} to "
            f"{1e6 * largest:.3g} mm2): choose its faces by box, facing and of"
        )
    return wall


def _part_with(mesh: Mesh, faces: Indices, enclosed: NDArray[np.bool_], seen: Indices) -> Indices:
    """Of the faces (f, 2) ``enclosed`` (f,), those that hang together with most of the ones ``seen``."""
    numbers = np.flatnonzero(enclosed)
    if not np.isin(seen, numbers).any():
        return faces[:0]
    labels = parts_of(mesh, faces[numbers])
    hits = np.bincount(labels[np.searchsorted(numbers, seen[np.isin(seen, numbers)])])
    return faces[numbers[labels == np.argmax(hits)]]


def _directions() -> Array:
    """(d, 3) unit vectors on a spiral that covers half a sphere evenly, along no axis and no diagonal."""
    places = np.arange(LINES) + 0.5
    heights, turns = 1.0 - places / LINES, np.pi * (1.0 + 5.0**0.5) * places
    radii = np.sqrt(1.0 - heights**2)
    return np.column_stack([radii * np.cos(turns), radii * np.sin(turns), heights])


def _triangles(mesh: Mesh, faces: Indices) -> tuple[Array, Indices]:
    """Corners (t, 3, 3) of flat triangles over faces (f, 2), and the number (t,) of the face that each is of."""
    nodes = mesh.face_nodes(faces, corners_only=True)
    halves, numbers = [nodes[:, :3]], [np.arange(len(faces))]
    if nodes.shape[1] == 4:
        square = np.flatnonzero(nodes[:, 3] >= 0)
        halves, numbers = [*halves, nodes[square][:, [0, 2, 3]]], [*numbers, square]
    return mesh.nodes[np.concatenate(halves)], np.concatenate(numbers)


def _seen_from(mesh: Mesh, faces: Indices, point: Array) -> Indices:
    """Numbers of the faces (f, 2) that a point (3,) sees; StudyError if it lies in the material."""
    corners, owner = _triangles(mesh, faces)
    a, b, c = (corners - point).transpose(1, 0, 2)
    areas = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
    seen = []
    for direction in np.concatenate([_directions(), -_directions()]):
        # Shares of the corners in where the ray meets the plane, as `morph_dslam.render.picking` has them.
        shares = areas @ direction
        total = shares.sum(axis=0)
        met = np.flatnonzero(((shares >= 0.0).all(axis=0) | (shares <= 0.0).all(axis=0)) & (total != 0.0))
        places = np.einsum("kt,ktx->tx", shares[:, met] / total[met], np.stack([a, b, c])[:, met])
        met, far = met[places @ direction > 0.0], (places @ direction)[places @ direction > 0.0]
        if not len(met):
            continue
        first = met[np.argmin(far)]
        if total[first] > 0.0:  # the triangle turns its back to the point
            raise StudyError("the point lies in the material: give one in the middle of a hollow")
        seen.append(owner[first])
    return np.unique(np.array(seen, dtype=np.int64))


def enclosure(mesh: Mesh, faces: Indices) -> Array:
    """Share (f,) of the directions before each outer face (f, 2) of a solid in which the body is again."""
    corners, owner = _triangles(mesh, faces)
    nodes = mesh.face_nodes(faces, corners_only=True)
    middles = np.where((nodes >= 0)[..., None], mesh.nodes[nodes], 0.0).sum(axis=1) / (nodes >= 0).sum(axis=1)[:, None]
    normals = unit_normals(mesh, faces)
    met = np.zeros(len(faces))
    for line in _directions():
        face, triangle, depths = _crossings(middles, corners, line)
        ahead = (depths - (middles @ line)[face]) * (normals @ line)[face] > 0.0
        met[np.unique(face[ahead & (owner[triangle] != face)])] += 1.0
    return met / LINES


def _crossings(points: Array, corners: Array, line: Array) -> tuple[Indices, Indices, Array]:
    """Where lines of one direction (3,) through points (p, 3) cross triangles (t, 3, 3).

    Seen along the line, the point lies in the triangle: only those around are tried.

    Returns
    -------
    point, triangle : (c,) numbers.
    depths : (c,) of the crossings along the line.
    """
    across = np.linalg.svd(line[None])[2][1:]
    flat, flat_points = corners @ across.T, points @ across.T
    centres = flat.mean(axis=1)
    near = KDTree(flat_points).query_ball_point(centres, np.linalg.norm(flat - centres[:, None], axis=2).max(axis=1))
    triangle = np.repeat(np.arange(len(corners)), [len(found) for found in near])
    point = np.fromiter(chain.from_iterable(near), dtype=np.int64, count=len(triangle))
    offsets = flat[triangle] - flat_points[point][:, None]
    following = np.roll(offsets, -1, axis=1)
    areas = offsets[..., 0] * following[..., 1] - offsets[..., 1] * following[..., 0]
    shares = np.roll(areas, -1, axis=1)  # each corner's is the area that the two after it span with the point
    inside = ((shares >= 0.0).all(axis=1) | (shares <= 0.0).all(axis=1)) & (shares.sum(axis=1) != 0.0)
    point, triangle, shares = point[inside], triangle[inside], shares[inside]
    depths = np.einsum("tk,tk->t", shares, corners[triangle] @ line) / shares.sum(axis=1)
    return point, triangle, depths
