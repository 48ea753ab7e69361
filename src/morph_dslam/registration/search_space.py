"""Where in a map an object may be, and how turned: what stands out of its planes, and attitudes to start in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from morph_dslam.registration.registration import Axis
from morph_dslam.small_arrays import cross

Array = NDArray[np.float64]
#: A plane holds at least this part of the map; at most so many are taken out.
PLANE_SHARE, MOST_PLANES = 0.12, 4
#: A large plane of a map by stereo of its keyframes holds at least this part of it.
LARGE_SHARE = 0.1
#: Planes are this thick, in units of the map's usual spacing between points.
PLANE_THICKNESS = 0.15
#: Points of one piece are joined over so many times the usual spacing, each in turn.
JOINED_OVER = (0.6, 0.9, 1.3, 2.0, 3.0)
#: A piece has at least so many points.
FEWEST_POINTS = 25
#: Trials of RANSAC for one plane, and how many times farther than usual a stray's neighbours are.
TRIALS, STRAY = 400, 4.0
#: Turns about the normal of a plane that a body may stand on.
TURNS = 8
#: Directions of an axis nearer to each other than this (rad) are one.
ALIKE = 0.1


def plane_points(points: Array, thickness: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Points (n,) of the plane that holds most of them, by RANSAC; none if it holds too few."""
    if not len(points):
        return np.zeros(0, dtype=bool)
    normal, offset = fullest_plane(points, rng.integers(len(points), size=(TRIALS, 3)), thickness)
    best = np.abs(points @ normal - offset) <= thickness
    if best.sum() < 3 or not normal.any():
        return np.zeros(len(points), dtype=bool)
    centre = points[best].mean(axis=0)
    normal = np.linalg.svd(points[best] - centre, full_matrices=False)[2][-1]
    return np.abs((points - centre) @ normal) <= thickness


@njit(cache=True, nogil=True)
def fullest_plane(points, triples, thickness):
    """The plane through three points that has most of them within its thickness.

    Parameters
    ----------
    points : (n, 3).
    triples : (t, 3) indices of the points to try; those on one line are left out.
    thickness : to either side.

    Returns
    -------
    The unit normal (3,) of the plane, and its distance from the origin along it; 0 if there is none.
    """
    normal, offset, most = np.zeros(3), 0.0, 0
    for t in range(len(triples)):
        a, b, c = points[triples[t, 0]], points[triples[t, 1]], points[triples[t, 2]]
        x, y, z = cross(b - a, c - a)
        length, count = np.sqrt(x**2 + y**2 + z**2), 0
        if length == 0.0:
            continue
        x, y, z = x / length, y / length, z / length
        away = x * a[0] + y * a[1] + z * a[2]
        for p in range(len(points)):
            here = x * points[p, 0] + y * points[p, 1] + z * points[p, 2]
            count += abs(here - away) <= thickness
        if count > most:
            normal[0], normal[1], normal[2], offset, most = x, y, z, away, count
    return normal, offset


def on_large_planes(points: Array, thickness: float) -> NDArray[np.bool_]:
    """Which points (n, 3) lie on a plane that holds many of them, as a table, a board or a wall does."""
    rng, left, on_plane = np.random.default_rng(0), np.arange(len(points)), np.zeros(len(points), dtype=bool)
    for _ in range(MOST_PLANES):
        found = plane_points(points[left], thickness, rng) if len(left) >= FEWEST_POINTS else np.zeros(0, dtype=bool)
        if found.sum() < LARGE_SHARE * len(points):
            break
        on_plane[left[found]] = True
        left = left[~found]
    return on_plane


@dataclass(frozen=True)
class Planes:
    """What a map is made of that may be tables and walls.

    Attributes
    ----------
    spacing : usual distance between points, the map's unit: the median to a point's fourth neighbour.
    usable : (k,) indices of points that are no strays.
    taken_out : indices of the points of each plane, in the order in which they were found; a point is in one.
    """

    spacing: float
    usable: NDArray[np.int64]
    taken_out: list[NDArray[np.int64]]

    def largest_normal(self, points: Array) -> Array | None:
        """Unit normal (3,) of the plane that holds most of the map's points (n, 3); None if there is none."""
        if not self.taken_out:
            return None
        flat = points[self.taken_out[0]]
        return np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2][-1]


def find_planes(points: Array) -> Planes:
    """The planes of a map (n, 3), one after the other as long as one holds enough points; few points have none."""
    if len(points) < FEWEST_POINTS:
        return Planes(0.0, np.empty(0, dtype=np.int64), [])
    rng = np.random.default_rng(0)
    distances = KDTree(points).query(points, k=5)[0][:, -1]
    spacing = float(np.median(distances))
    usable = np.flatnonzero(distances <= STRAY * spacing)
    left, taken_out = usable, []
    while len(taken_out) < MOST_PLANES and len(left) >= FEWEST_POINTS:
        on_plane = plane_points(points[left], PLANE_THICKNESS * spacing, rng)
        if on_plane.sum() < PLANE_SHARE * len(usable):
            break
        taken_out.append(left[on_plane])
        left = left[~on_plane]
    return Planes(spacing, usable, taken_out)


def candidate_regions(points: Array, planes: Planes) -> list[NDArray[np.int64]]:
    """Indices of the points of each region where an object may be.

    The pieces that there are at first, and those left when one plane after the other is taken out, joined
    over short and long distances, the largest first; then the whole map, for objects that are planes
    themselves.

    Parameters
    ----------
    points : (n, 3) of the map.
    planes : of the map, from `find_planes`.
    """
    regions: list[NDArray[np.int64]] = []
    left = planes.usable
    # A scene may have no plane to speak of, and the next one may be a face of the object: so the pieces
    # count that are there before each plane is taken out.
    for plane in (np.empty(0, dtype=np.int64), *planes.taken_out):
        left = np.setdiff1d(left, plane)
        for reach in JOINED_OVER:
            for piece in _pieces(points, left, reach * planes.spacing):
                if not any(_alike(piece, other) for other in regions):
                    regions.append(piece)
    regions.sort(key=len, reverse=True)
    return [*regions, planes.usable] if len(planes.usable) >= FEWEST_POINTS else regions


def _alike(piece: NDArray[np.int64], other: NDArray[np.int64]) -> bool:
    """Whether two pieces are the same but for a tenth of their points."""
    return len(np.intersect1d(piece, other)) > 0.9 * max(len(piece), len(other))


def _pieces(points: Array, indices: NDArray[np.int64], reach: float) -> list[NDArray[np.int64]]:
    if len(indices) < FEWEST_POINTS:
        return []
    near = KDTree(points[indices]).sparse_distance_matrix(KDTree(points[indices]), reach)
    _, label = connected_components(near, directed=False)
    pieces = [indices[label == number] for number in np.unique(label)]
    return sorted((piece for piece in pieces if len(piece) >= FEWEST_POINTS), key=len, reverse=True)


def attitudes(axis: Axis | None, normal: Array | None) -> list[Array]:
    """Rotations (3, 3), world from object: some spread over all, and those in which the body stands upright.

    Spread over all are those of the icosahedron. A body stands on the plane when one of the six directions of
    its frame's axes is along the plane's normal. Of a body of revolution only the direction of its axis
    counts.

    Parameters
    ----------
    axis : of a body of revolution.
    normal : (3,) of the plane that holds most of the map, if there is one.
    """
    rotations = list(Rotation.create_group("I").as_matrix())
    if normal is not None:
        rotations = [*_standing(normal, axis), *rotations]
    if axis is None:
        return rotations
    kept: list[Array] = []
    for rotation in rotations:
        if all(np.linalg.norm((rotation - other) @ axis.direction) > ALIKE for other in kept):
            kept.append(rotation)
    return kept


def _standing(normal: Array, axis: Axis | None) -> list[Array]:
    """Rotations that lay a direction of the object along a plane's normal, either side up."""
    if axis is not None:
        return [_onto(axis.direction, sign * normal) for sign in (1.0, -1.0)]
    turns = [Rotation.from_rotvec(2.0 * np.pi * k / TURNS * normal).as_matrix() for k in range(TURNS)]
    upright = [_onto(direction, normal) for direction in (*np.eye(3), *-np.eye(3))]
    return [turn @ rotation for rotation in upright for turn in turns]


def _onto(direction: Array, target: Array) -> Array:
    """A rotation that takes one direction to another; both of unit length."""
    return Rotation.align_vectors(target[None], direction[None])[0].as_matrix()
