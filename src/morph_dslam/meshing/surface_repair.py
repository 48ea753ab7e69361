"""Surfaces as files have them, mended: points and faces that are there twice, faces turned inside out, holes."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from morph_dslam.errors import StudyError
from morph_dslam.model.reduced_model import triangle_normals

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Points nearer to each other than this share of the object's diagonal are one: files of single precision and of few
#: digits hold a point of several faces several times.
SAME_POINT = 1e-5
#: A hole is closed up to this share of the surface, and up to so many edges; larger ones are openings of the object.
LARGEST_HOLE, MOST_EDGES = 0.1, 400
#: So many points of a part, at most, are looked at: all must lie within another one that holds it.
PROBES = 8


def repaired_surface(points: Array, triangles: Indices) -> tuple[Array, Indices, dict[str, int]]:
    """A surface that drawing and tracking can rely upon, and what had to be mended.

    Neighbours turn alike and outwards; a part within another one that is turned inwards is a cavity. Where an outermost
    part and all that it holds are turned the wrong way round, cavities too, all are turned. Parts that cut into each
    other stay as they are, and so do those that lie within another one and face outwards: whether they are cavities
    nobody knows.

    Parameters
    ----------
    points : (n, 3), any unit.
    triangles : (m, 3) of point indices.

    Returns
    -------
    points : (k, 3), those in use.
    triangles : (l, 3).
    repairs : how often each was done or found, by its name; without what was not needed.

    Raises
    ------
    StudyError
        If no face with an area is there.
    """
    if not len(triangles):
        raise StudyError("it has no face with an area")
    used, triangles = np.unique(triangles, return_inverse=True)
    points, triangles = points[used], triangles.reshape(-1, 3)
    labels = _same_points(points)
    merged = labels[triangles]
    _, first = np.unique(labels, return_index=True)
    kept = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
    mesh = trimesh.Trimesh(points[first], merged[kept], process=False)
    if not len(mesh.faces) or not mesh.area > 0.0:
        raise StudyError("it has no face with an area")
    single = mesh.unique_faces()
    mesh.update_faces(single)
    repairs = {"points merged": len(points) - len(first), "faces without area removed": int((~kept).sum())}
    repairs["double faces removed"] = int((~single).sum())
    repairs["faces turned"] = _turn_alike(mesh)
    faces, n_holes = _without_holes(np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64))
    mesh = trimesh.Trimesh(mesh.vertices, faces, process=False)
    repairs |= {"holes closed": n_holes, "parts turned inside out": _turn_outwards(mesh)}
    mesh.remove_unreferenced_vertices()
    counts = np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1]
    repairs |= {"open edges left": int((counts == 1).sum()), "edges of more than two faces": int((counts > 2).sum())}
    vertices, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    return vertices, faces, {name: count for name, count in repairs.items() if count}


def repairs_in_words(repairs: Mapping[str, int]) -> list[str]:
    """Each of the repairs of `repaired_surface` with its count, "1 hole closed"."""
    one = re.compile(r"s\b")
    return [f"{count} {one.sub('', name, count=1) if count == 1 else name}" for name, count in repairs.items()]


def _same_points(points: Array) -> Indices:
    """A label (n,) for each point, the same for points that are one."""
    near = KDTree(points).query_pairs(SAME_POINT * float(np.linalg.norm(np.ptp(points, axis=0))), output_type="ndarray")
    ones = np.ones(len(near))
    return connected_components(coo_array((ones, (near[:, 0], near[:, 1])), shape=(len(points),) * 2))[1].astype(
        np.int64
    )


def _parts(mesh: trimesh.Trimesh) -> list[Indices]:
    """Faces of each part whose faces are joined by edges."""
    found = trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(mesh.faces)), min_len=1)
    return [np.asarray(part, dtype=np.int64) for part in found]


def _turn_alike(mesh: trimesh.Trimesh) -> int:
    """Turn faces until neighbours run alike, in each part the fewer by area; how many were turned."""
    if mesh.is_winding_consistent:
        return 0
    before, areas = np.array(mesh.faces), np.array(mesh.area_faces)
    trimesh.repair.fix_winding(mesh)
    faces = np.array(mesh.faces)
    for part in _parts(mesh):
        turned = _turned(before[part], faces[part])
        if areas[part] @ turned > 0.5 * areas[part].sum():
            faces[part] = faces[part][:, ::-1]
    mesh.faces = faces
    return int(_turned(before, faces).sum())


def _turned(before: Indices, after: Indices) -> NDArray[np.bool_]:
    """Which triangles (m, 3) of the same corners run the other way round."""
    return np.all([(np.roll(before, shift, axis=1) != after).any(axis=1) for shift in range(3)], axis=0)


@dataclass(frozen=True)
class SurfacePart:
    """Faces that edges join.

    Attributes
    ----------
    faces : (k,) their numbers.
    turn : 1 if they face outwards, -1 inwards, 0 if they bound no volume.
    inner : whether an odd number of other parts hold it, as they hold a cavity.
    body : number of the outermost part that holds it; its own where none does.
    """

    faces: Indices
    turn: int
    inner: bool
    body: int

    @property
    def wrong(self) -> bool:
        """Whether it faces the wrong way: a cavity's faces are turned into it."""
        return self.turn == (1 if self.inner else -1)


def surface_parts(points: Array, triangles: Indices) -> list[SurfacePart]:
    """The parts of a surface (n, 3), (m, 3) whose edges join two triangles at most."""
    mesh = trimesh.Trimesh(points, triangles, process=False)
    corners, parts = np.asarray(mesh.triangles), _parts(mesh)
    boxes = np.array([(corners[part].min(axis=(0, 1)), corners[part].max(axis=(0, 1))) for part in parts])
    turns, holders = list[int](), list[list[int]]()
    for part, (low, high) in zip(parts, boxes, strict=True):
        a, b, c = np.moveaxis(corners[part] - corners[part].mean(axis=(0, 1)), 1, 0)
        volume = np.sum(a * np.cross(b, c)) / np.linalg.norm(high - low) ** 3
        turns.append(int(np.sign(volume)) if abs(volume) > 1e-9 else 0)
        around = np.flatnonzero((boxes[:, 0] < low).all(axis=1) & (high < boxes[:, 1]).all(axis=1)).tolist()
        probes = corners[part[:: -(-len(part) // PROBES)], 0]
        holders.append([other for other in around if all(_holds(corners[parts[other]], probe) for probe in probes)])
    depths = [len(others) for others in holders]
    return [
        SurfacePart(part, turn, len(others) % 2 == 1, min([number, *others], key=depths.__getitem__))
        for number, (part, turn, others) in enumerate(zip(parts, turns, holders, strict=True))
    ]


def _holds(corners: Array, point: Array) -> bool:
    """Whether triangles (m, 3, 3) surround a point (3,): their solid angles (Van Oosterom and Strackee 1983) say it."""
    a, b, c = np.moveaxis(corners - point, 1, 0)
    lengths = [np.linalg.norm(edge, axis=1) for edge in (a, b, c)]
    above = np.sum(a * np.cross(b, c), axis=1)
    dots = [np.sum(one * other, axis=1) for one, other in ((a, b), (b, c), (c, a))]
    below = np.prod(lengths, axis=0) + dots[0] * lengths[2] + dots[1] * lengths[0] + dots[2] * lengths[1]
    return bool(abs(np.sum(np.arctan2(above, below))) > np.pi)


def _turn_outwards(mesh: trimesh.Trimesh) -> int:
    """Turn parts inside out that face inwards and are no cavities, and how many were turned.

    Where an outermost part and all that it holds are wrong, all of these are turned.
    """
    faces = np.array(mesh.faces)
    parts = surface_parts(np.asarray(mesh.vertices), faces)
    partly_right = {part.body for part in parts if part.turn and not part.wrong}
    turned = [part for part in parts if part.wrong and (part.turn < 0 or part.body not in partly_right)]
    for part in turned:
        faces[part.faces] = faces[part.faces][:, ::-1]
    mesh.faces = faces
    return len(turned)


def _without_holes(points: Array, triangles: Indices) -> tuple[Indices, int]:
    """The triangles with those that close holes, and how many holes were closed."""
    largest = LARGEST_HOLE * 0.5 * float(np.linalg.norm(triangle_normals(points, triangles), axis=1).sum())
    patches = []
    for loop in _boundary_loops(triangles):
        if 3 <= len(loop) <= MOST_EDGES:
            patch, area = _smallest_patch(points, np.array(loop))
            patches += [patch] if area <= largest else []
    return np.concatenate([triangles, *patches]), len(patches)


def _boundary_loops(triangles: Indices) -> list[list[int]]:
    """Closed paths along edges of one triangle only, against its direction."""
    directed = np.concatenate([triangles[:, [1, 0]], triangles[:, [2, 1]], triangles[:, [0, 2]]])
    _, inverse, counts = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    following: dict[int, list[int]] = defaultdict(list)
    for start, end in directed[counts[inverse.ravel()] == 1].tolist():
        following[start].append(end)
    loops = []
    for start in list(following):
        path = [start]
        while following[path[-1]]:
            point = following[path[-1]].pop()
            if point in path:  # where holes touch in a point, each is a loop of its own
                at = path.index(point)
                loops.append(path[at:])
                del path[at + 1 :]
            else:
                path.append(point)
    return loops


def _smallest_patch(points: Array, loop: Indices) -> tuple[Indices, float]:
    """Triangles between the points of a loop with the least total area, and that area.

    Dynamic programming over sub-polygons (Barequet and Sharir 1995): exact for plane holes of any outline.
    """
    n, corners = len(loop), points[loop]
    costs, splits = np.zeros((n, n)), np.zeros((n, n), dtype=np.int64)
    for span in range(2, n):
        for i in range(n - span):
            k, j = np.arange(i + 1, i + span), i + span
            areas = 0.5 * np.linalg.norm(np.cross(corners[k] - corners[i], corners[j] - corners[i]), axis=1)
            totals = costs[i, k] + costs[k, j] + areas
            best = int(totals.argmin())
            costs[i, j], splits[i, j] = totals[best], k[best]
    patch, open_spans = [], [(0, n - 1)]
    while open_spans:
        i, j = open_spans.pop()
        if j - i >= 2:
            k = int(splits[i, j])
            patch.append((i, k, j))
            open_spans += [(i, k), (k, j)]
    return loop[np.array(patch, dtype=np.int64)], float(costs[0, n - 1])


#: Triangles (of corners 0 to 2, middles 3 of edge 01, 4 of 12 and 5 of 20) in place of one, by the sum of 1, 2 and 4
#: for the edges that are halved.
_CUTS = {
    0: [[0, 1, 2]],
    1: [[0, 3, 2], [3, 1, 2]],
    2: [[1, 4, 0], [4, 2, 0]],
    4: [[2, 5, 1], [5, 0, 1]],
    3: [[3, 1, 4], [0, 3, 4], [0, 4, 2]],
    6: [[4, 2, 5], [1, 4, 5], [1, 5, 0]],
    5: [[5, 0, 3], [2, 5, 3], [2, 3, 1]],
    7: [[0, 3, 5], [1, 4, 3], [2, 5, 4], [3, 4, 5]],
}


def refined_surface(points: Array, triangles: Indices, longest: float) -> tuple[Array, Indices]:
    """The same surface (n, 3), (m, 3) with edges of at most ``longest``: others are halved in both triangles."""
    while True:
        edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, numbers = np.unique(edges, axis=0, return_inverse=True)
        ends = points[edges]
        long = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > longest
        if not long.any():
            return points, triangles
        middles = np.where(long, len(points) + np.cumsum(long) - 1, -1)[numbers.reshape(-1, 3)]
        points = np.concatenate([points, ends[long].mean(axis=1)])
        corners, kind = np.hstack([triangles, middles]), (middles >= 0) @ np.array([1, 2, 4])
        triangles = np.concatenate([corners[kind == k][:, cut].reshape(-1, 3) for k, cut in _CUTS.items()])
