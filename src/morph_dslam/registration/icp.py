"""A mesh surface as registration sees it: points with normals, nearest-point search, and its symmetry."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from morph_dslam.geometry import SimilarityTransform, rotation_exp
from morph_dslam.model.reduced_model import spread_over, triangle_normals
from morph_dslam.registration.scene import MapPoints

Array = NDArray[np.float64]

#: Points spread over the surface.
N_SAMPLES = 12000

#: A surface turned about its axis of revolution stays where it was, up to this part of its size.
SYMMETRY_TOLERANCE = 0.01

#: A wall of a hollow body, whose other side may be nearer to a point, is at most so thick over its size.
WALL = 0.02


@dataclass(frozen=True)
class Axis:
    """A line: a point (3,) on it and its unit direction (3,), object frame, metres."""

    point: Array
    direction: Array

    def turned(self, points: Array, angle: float) -> Array:
        """Points (..., 3) turned about the axis by ``angle`` (rad)."""
        return (points - self.point) @ rotation_exp(angle * self.direction).T + self.point


@dataclass(frozen=True)
class Surface:
    """Points (n, 3) spread evenly over a surface, with unit normals (n, 3), object frame, metres.

    ``closed`` surfaces have an inside, and are seen from the side to which their normals point.
    """

    points: Array
    normals: Array
    closed: bool

    @classmethod
    def of_mesh(cls, nodes: Array, triangles: NDArray[np.int64], count: int = N_SAMPLES) -> Surface:
        """Sample a triangle mesh in proportion to its area, the same way every time."""
        edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
        _, uses = np.unique(edges, axis=0, return_counts=True)
        samples = spread_over(nodes, triangles, count)
        chosen = triangles[samples.triangles]
        points = np.einsum("pc,pcx->px", samples.weights, nodes[chosen])
        normals = triangle_normals(nodes, chosen)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return cls(points, normals, closed=bool((uses == 2).all()))

    @cached_property
    def tree(self) -> KDTree:
        """Nearest-point search."""
        return KDTree(self.points, leafsize=20)  # a quarter faster than with ten

    def nearest(self, points: Array, viewpoints: Array) -> NDArray[np.int64]:
        """The nearest sample (p,) to each point (p, 3) that faces its viewpoint (p, 3), object frame.

        On a thin wall the nearest sample may be on the other side. Open surfaces are seen from both sides.
        """
        if not self.closed:
            return np.asarray(self.tree.query(points)[1], dtype=np.int64)
        neighbours = np.asarray(self.tree.query(points, k=self._n_neighbours)[1], dtype=np.int64)
        facing = np.einsum("pkx,px->pk", self.normals[neighbours], viewpoints - points) > 0.0
        return neighbours[np.arange(len(points)), facing.argmax(axis=1)]

    @cached_property
    def _n_neighbours(self) -> int:
        """So many samples lie on both sides of a wall in a disc as wide as it is thick."""
        return int(np.clip(4.0 * np.pi * (WALL / 2.0) ** 2 / self._area_share, 8, 80))

    @cached_property
    def _area_share(self) -> float:
        """Area of one sample over the square of the size."""
        spacing = float(np.median(self.tree.query(self.points[::10], k=2)[0][:, 1]))
        return (2.0 * spacing) ** 2 / self.size**2

    @cached_property
    def centre(self) -> Array:
        """Mean (3,) of the points."""
        return self.points.mean(axis=0)

    @cached_property
    def size(self) -> float:
        """Diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @cached_property
    def radius(self) -> float:
        """Root mean square distance of the points from their mean."""
        return float(np.sqrt(np.mean(np.sum((self.points - self.centre) ** 2, axis=1))))

    @cached_property
    def axis_of_revolution(self) -> Axis | None:
        """The axis about which the surface may be turned by any angle; None if there is none.

        It can only be a principal axis of the surface's inertia. Turned about it by a few angles, of which
        none is a simple fraction of a turn, the surface has to lie on itself.
        """
        _, principal = np.linalg.eigh(np.cov((self.points - self.centre).T))
        spacing = float(np.median(self.tree.query(self.points, k=2)[0][:, 1]))
        allowed = SYMMETRY_TOLERANCE * self.size
        for direction in principal.T[::-1]:
            axis = Axis(self.centre, direction)
            farthest = 0.0
            for angle in (0.37, 1.0, 1.93, 2.81):
                turned = axis.turned(self.points, angle)
                _, nearest = self.tree.query(turned)
                # Across the surface: along it the nearest sample is up to a spacing away.
                off = np.abs(np.einsum("px,px->p", turned - self.points[nearest], self.normals[nearest]))
                farthest = max(farthest, float(np.percentile(off, 95)))
            if farthest <= max(allowed, 0.5 * spacing):
                return axis
        return None


# Where in a map an object may be: what stands out of its planes, in connected pieces.


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


# Iterative closest points with an unknown scale: the similarity that lays a surface through map points.


#: Weight of staying in directions that the points leave open, over the weight of all points.
PRIOR = 1e-4


@dataclass(frozen=True)
class Fit:
    """A surface laid through points.

    Attributes
    ----------
    world_from_object : the similarity. weights : (n,) how far each point counts, 0 to 1.
    """

    world_from_object: SimilarityTransform
    weights: Array


def fit_surface(
    points: MapPoints,
    surface: Surface,
    start: SimilarityTransform,
    widths: Array,
    metric: bool = False,
    to_planes: bool = True,
) -> Fit:
    """Gauss-Newton on distances to the nearest points of the surface, with Tukey's biweight.

    Distances are measured in the world, where shrinking the surface does not make them smaller.

    Parameters
    ----------
    points : of the map. start : world_from_object.
    widths : (k,) one iteration each: points farther from the surface than this do not count, world unit.
    metric : keep the scale of ``start``, for maps that have one.
    to_planes : measure along normals only, which converges fast from near; from far, on a surface with folds,
        whole distances are the safer guide.
    """
    transform = start
    for width in widths:
        inverse = transform.inverse
        nearest = surface.nearest(inverse.apply(points.positions), inverse.apply(points.viewpoints))
        arms = transform.scale * (surface.points[nearest] - surface.centre) @ transform.rotation.T
        normals = surface.normals[nearest] @ transform.rotation.T
        centre = transform.apply(surface.centre)
        gaps = points.positions - centre - arms
        matrix, right, weights = normal_equations(gaps, arms, normals, width, to_planes)
        size = surface.radius * transform.scale
        prior = PRIOR * max(weights.sum(), 1.0) * np.array([size**2] * 4 + [1.0] * 3)
        if metric:
            prior[0] = np.inf
        step = _damped_solution(matrix, right, prior)
        scale = transform.scale * float(np.exp(step[0]))
        rotation = rotation_exp(step[1:4]) @ transform.rotation
        translation = centre + step[4:] - scale * rotation @ surface.centre
        transform = SimilarityTransform(scale, rotation, translation)
    return Fit(transform, weights)


@njit(cache=True, nogil=True)
def normal_equations(gaps, arms, normals, width, to_planes):
    """Gauss-Newton's matrix (7, 7) and right side (7,), and Tukey's weights (n,) of the points.

    Parameters
    ----------
    gaps : (n, 3) from the surface to the points. arms : (n, 3) from its centre to its points.
    normals : (n, 3) there. width : gaps as large do not count. to_planes : as in `fit_surface`.
    """
    matrix, right, weights = np.zeros((7, 7)), np.zeros(7), np.zeros(len(gaps))
    row, axes = np.empty(7), np.eye(3)
    for p in range(len(gaps)):
        g, a = gaps[p], arms[p]
        along = g[0] * normals[p, 0] + g[1] * normals[p, 1] + g[2] * normals[p, 2]
        square = along**2 if to_planes else g[0] ** 2 + g[1] ** 2 + g[2] ** 2
        if square >= width**2:
            continue
        weights[p] = (1.0 - square / width**2) ** 2
        for direction in range(1 if to_planes else 3):
            d = normals[p] if to_planes else axes[direction]
            row[0] = a[0] * d[0] + a[1] * d[1] + a[2] * d[2]
            row[1] = a[1] * d[2] - a[2] * d[1]
            row[2] = a[2] * d[0] - a[0] * d[2]
            row[3] = a[0] * d[1] - a[1] * d[0]
            row[4:] = d
            measured = along if to_planes else g[direction]
            for i in range(7):
                right[i] += weights[p] * row[i] * measured
                for j in range(7):
                    matrix[i, j] += weights[p] * row[i] * row[j]
    return matrix, right, weights


def normal_equations_numpy(
    gaps: Array, arms: Array, normals: Array, width: float, to_planes: bool
) -> tuple[Array, Array, Array]:
    """The plain twin of `normal_equations`."""
    residuals = np.einsum("px,px->p", gaps, normals)
    squares = residuals**2 if to_planes else np.einsum("px,px->p", gaps, gaps)
    weights = np.clip(1.0 - squares / width**2, 0.0, None) ** 2
    if to_planes:
        rows, measured, counted = _rows(arms, normals), residuals, weights
    else:
        axes = [np.tile(axis, (len(arms), 1)) for axis in np.eye(3)]
        rows = np.concatenate([_rows(arms, axis) for axis in axes])
        measured, counted = gaps.T.ravel(), np.tile(weights, 3)
    return (rows * counted[:, None]).T @ rows, rows.T @ (counted * measured), weights


def _rows(arms: Array, directions: Array) -> Array:
    """Derivatives (n, 7) of points along ``directions`` (n, 3) by log scale, rotation and translation."""
    return np.column_stack([np.einsum("px,px->p", arms, directions), np.cross(arms, directions), directions])


def _damped_solution(matrix: Array, right: Array, prior: Array) -> Array:
    """The step (7,); what has an infinite prior stays, and no step turns or scales by more than 0.3."""
    free = np.isfinite(prior)
    step = np.zeros(7)
    step[free] = np.linalg.solve(matrix[np.ix_(free, free)] + np.diag(prior[free]), right[free])
    step[:4] = np.clip(step[:4], -0.3, 0.3)
    return step
