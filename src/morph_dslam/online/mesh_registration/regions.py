"""Where in a map an object may be: what stands out of its planes, in connected pieces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

Array = NDArray[np.float64]

#: A plane holds at least this part of the map; at most so many are taken out.
PLANE_SHARE, MOST_PLANES = 0.12, 4
#: Planes are this thick, in units of the map's usual spacing between points.
PLANE_THICKNESS = 0.15
#: Points of one piece are joined over so many times the usual spacing, each in turn.
JOINED_OVER = (0.6, 0.9, 1.3, 2.0, 3.0)
#: A piece has at least so many points.
FEWEST_POINTS = 25
TRIALS = 400


def usual_spacing(points: Array) -> float:
    """Median distance of points (n, 3) to their fourth neighbour."""
    distances, _ = KDTree(points).query(points, k=min(5, len(points)))
    return float(np.median(distances[:, -1]))


def without_strays(points: Array) -> NDArray[np.bool_]:
    """Points (n,) that have neighbours as close as is usual, up to a factor of four."""
    distances, _ = KDTree(points).query(points, k=min(5, len(points)))
    return distances[:, -1] <= 4.0 * np.median(distances[:, -1])


def plane_points(points: Array, thickness: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Points (n,) of the plane that holds most of them, by RANSAC; none if it holds too few."""
    chosen = np.array([rng.choice(len(points), 3, replace=False) for _ in range(TRIALS)])
    a, b, c = points[chosen].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    planes = lengths > 0.0
    a, normals = a[planes], normals[planes] / lengths[planes, None]
    near = np.abs(normals @ points.T - np.einsum("tx,tx->t", normals, a)[:, None]) <= thickness
    if not len(near):
        return np.zeros(len(points), dtype=bool)
    best = near[near.sum(axis=1).argmax()]
    if best.sum() < 3:
        return np.zeros(len(points), dtype=bool)
    centre = points[best].mean(axis=0)
    normal = np.linalg.svd(points[best] - centre)[2][-1]
    return np.abs((points - centre) @ normal) <= thickness


@dataclass(frozen=True)
class Planes:
    """What a map is made of that may be tables and walls.

    Attributes
    ----------
    spacing : usual distance between points, the map's unit.
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
        return np.linalg.svd(flat - flat.mean(axis=0))[2][-1]


def find_planes(points: Array, seed: int = 0) -> Planes:
    """The planes of a map (n, 3), one after the other as long as one holds enough of the points."""
    rng = np.random.default_rng(seed)
    spacing = usual_spacing(points)
    usable = np.flatnonzero(without_strays(points))
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
    points : (n, 3) of the map. planes : of the map, from `find_planes`.
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
