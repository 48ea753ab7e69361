"""A mesh's surface laid through the points of a map by iterative closest points with an unknown scale."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.geometry import SimilarityTransform
from morph_dslam.model.reduced_model import spread_over, triangle_normals
from morph_dslam.registration.increments import moved_similarity
from morph_dslam.registration.registration import Axis
from morph_dslam.registration.scene import MapPoints
from morph_dslam.small_arrays import cholesky_solve

Array = NDArray[np.float64]
#: Points spread over the surface.
N_SAMPLES = 12000
#: A surface turned about its axis of revolution stays where it was, up to this part of its size.
SYMMETRY_TOLERANCE = 0.01
#: Second moments of the area that differ by less than this share are equal.
EQUAL_MOMENTS = 0.02
#: At 95 % of a surface, a sample is nearer than so many times the median distance of samples; of random ones it is
#: nearer than twice that.
FARTHEST_SAMPLE = 4.0
#: Weight of staying in directions that the points leave open, over the weight of all points.
PRIOR = 1e-4
#: A wall of a hollow body, whose other side may be nearer to a point, is at most so thick over its size.
WALL = 0.02


@dataclass(frozen=True)
class Surface:
    """A mesh's surface as evenly spread points.

    Attributes
    ----------
    points : (n, 3) object frame, metres.
    normals : (n, 3) of unit length.
    closed : whether it has an inside, and is seen from the side to which its normals point.
    axes : (3 or 6, 3) of unit length, of which one is the axis of any symmetry: the principal axes of the area's
        inertia, that of the largest moment first. Equal moments leave them open: then also those of the mesh's frame.
    """

    points: Array
    normals: Array
    closed: bool
    axes: Array

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
        return cls(points, normals, bool((uses == 2).all()), _symmetry_axes(nodes, triangles))

    @cached_property
    def tree(self) -> KDTree:
        """Nearest-point search."""
        return KDTree(self.points, leafsize=20)  # a quarter faster than with ten

    def nearest(self, points: Array, viewpoints: Array) -> NDArray[np.int64]:
        """The nearest sample (p,) to each point (p, 3) that faces its viewpoint (p, 3), object frame.

        On a thin wall the nearest sample may be on the other side. Open surfaces are seen from both sides.
        """
        found = np.asarray(self.tree.query(points)[1], dtype=np.int64)
        if not self.closed:
            return found
        # Of most points the nearest one faces them, and asking for many takes several times as long.
        away = np.einsum("px,px->p", self.normals[found], viewpoints - points) <= 0.0
        if away.any():
            _, near = self.tree.query(points[away], k=self._n_neighbours)
            found[away] = first_facing(near, self.points, self.normals, points[away], viewpoints[away])
        return found

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

        Turned about it by a few angles, of which none is a simple fraction of a turn, the surface has to lie on itself.
        """
        spacing = float(np.median(self.tree.query(self.points, k=2)[0][:, 1]))
        allowed = SYMMETRY_TOLERANCE * self.size
        for direction in self.axes:
            axis = Axis(self.centre, direction)
            farthest = 0.0
            for angle in (0.37, 1.0, 1.93, 2.81):
                turned = axis.turned(self.points, angle)
                away, nearest = self.tree.query(turned)
                if np.percentile(away, 95) > FARTHEST_SAMPLE * spacing:  # over the rim of an open surface
                    farthest = np.inf
                # Across the surface: along it the nearest sample is up to a spacing away.
                off = np.abs(np.einsum("px,px->p", turned - self.points[nearest], self.normals[nearest]))
                farthest = max(farthest, float(np.percentile(off, 95)))
            if farthest <= max(allowed, 0.5 * spacing):
                return axis
        return None


def _symmetry_axes(nodes: Array, triangles: NDArray[np.int64]) -> Array:
    """Directions (3 or 6, 3) as of `Surface.axes`, from the exact second moments of the triangles.

    Those of samples would tilt the axis of a body whose moments are nearly equal. The second moments of a triangle are
    those of its three corners and of its middle with nine times their weight, of a twelfth of the area.
    """
    corners = nodes[triangles]
    areas = np.linalg.norm(triangle_normals(nodes, triangles), axis=1)
    middles = corners.mean(axis=1)
    centre = areas @ middles / areas.sum()
    places = np.concatenate([corners - centre, 3.0 * (middles - centre)[:, None]], axis=1)
    moments = np.einsum("m,mcx,mcy->xy", areas, places, places) / (12.0 * areas.sum())
    values, vectors = np.linalg.eigh(moments)
    principal = vectors.T[::-1]
    return np.vstack([principal, np.eye(3)]) if np.diff(values).min() < EQUAL_MOMENTS * values[-1] else principal


def fit_surface(
    points: MapPoints, surface: Surface, start: SimilarityTransform, widths: Array, metric: bool = False
) -> tuple[SimilarityTransform, Array]:
    """Gauss-Newton on distances from the planes at the nearest points of the surface, with Tukey's biweight.

    It converges fast from near; from far, `surface_search.laid` is the safer guide. Distances are measured in the
    world, where shrinking the surface does not make them smaller.

    Parameters
    ----------
    points : of the map.
    surface : to lay through them.
    start : world_from_object.
    widths : (k,) one iteration each: points farther from the surface than this do not count, world unit.
    metric : keep the scale of ``start``, for maps that have one.

    Returns
    -------
    The similarity world_from_object, and how far each point counts (n,), 0 to 1.
    """
    transform = start
    for width in widths:
        matrix, right, weights = surface_equations(points, surface, transform, surface.centre, width)
        prior = step_prior(weights.sum(), surface.radius * transform.scale, metric)
        step = damped_step(matrix, right, prior)
        transform = moved_similarity(transform, step, surface.centre)
    return transform, weights


def surface_equations(
    points: MapPoints, surface: Surface, place: SimilarityTransform, about: Array, width: float
) -> tuple[Array, Array, Array]:
    """Gauss-Newton's matrix (7, 7) and right side (7,) of points on a surface, and their weights (n,), 0 to 1.

    Parameters
    ----------
    points : of the map.
    surface : on which they are to lie.
    place : world_from_object.
    about : (3,) the point, object frame, about which the similarity's step scales and turns.
    width : points farther from the surface than this do not count, world unit.
    """
    inverse = place.inverse
    nearest = surface.nearest(inverse.apply(points.positions), inverse.apply(points.viewpoints))
    return normal_equations(
        points.positions, surface.points, surface.normals, nearest,
        place.rotation, place.apply(about), place.scale, about, width, True,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def first_facing(near, samples, normals, points, viewpoints):
    """The first (p,) of each point's nearest samples that faces its viewpoint; the very first if none does.

    Parameters
    ----------
    near : (p, k) rows of samples, the nearest first.
    samples, normals : (n, 3).
    points, viewpoints : (p, 3).
    """
    found = np.empty(len(points), np.int64)
    for p in range(len(points)):
        found[p] = near[p, 0]
        for k in range(near.shape[1]):
            n = near[p, k]
            facing = 0.0
            for x in range(3):
                facing += normals[n, x] * (viewpoints[p, x] - points[p, x])
            if facing > 0.0:
                found[p] = n
                break
    return found


@njit(cache=True, nogil=True)
def normal_equations(positions, samples, normals, nearest, rotation, middle, scale, about, width, to_planes):
    """Gauss-Newton's matrix (7, 7) and right side (7,), and Tukey's weights (p,) of the points.

    Parameters
    ----------
    positions : (p, 3) of the points, world.
    samples, normals : (n, 3) of the surface, object frame.
    nearest : (p,) sample of each point.
    rotation, scale : (3, 3) and factor of world_from_object.
    middle, about : (3,) the point about which the step scales and turns, world and object frame.
    width : points farther from the surface do not count, world unit.
    to_planes : whether distances are measured along the samples' normals only.
    """
    matrix, right, weights = np.zeros((7, 7)), np.zeros(7), np.zeros(len(positions))
    row, axes, arm, gap, normal = np.empty(7), np.eye(3), np.empty(3), np.empty(3), np.empty(3)
    for p in range(len(positions)):
        n = nearest[p]
        along = square = 0.0
        for x in range(3):
            arm[x] = normal[x] = 0.0
            for y in range(3):
                arm[x] += scale * rotation[x, y] * (samples[n, y] - about[y])
                normal[x] += rotation[x, y] * normals[n, y]
            gap[x] = positions[p, x] - middle[x] - arm[x]
            along += gap[x] * normal[x]
            square += gap[x] ** 2
        square = along**2 if to_planes else square
        if square >= width**2:
            continue
        weights[p] = (1.0 - square / width**2) ** 2
        for direction in range(1 if to_planes else 3):
            d = normal if to_planes else axes[direction]
            row[0] = arm[0] * d[0] + arm[1] * d[1] + arm[2] * d[2]
            row[1] = arm[1] * d[2] - arm[2] * d[1]
            row[2] = arm[2] * d[0] - arm[0] * d[2]
            row[3] = arm[0] * d[1] - arm[1] * d[0]
            row[4], row[5], row[6] = d[0], d[1], d[2]
            measured = along if to_planes else gap[direction]
            for i in range(7):
                right[i] += weights[p] * row[i] * measured
                for j in range(7):
                    matrix[i, j] += weights[p] * row[i] * row[j]
    return matrix, right, weights


@njit(cache=True, nogil=True)
def step_prior(weight, size, metric):
    """Weights (7,) of staying in directions that points of a total ``weight`` leave open.

    Parameters
    ----------
    weight : of all points.
    size : of the surface, world unit.
    metric : whether the scale stays: its weight is infinite.
    """
    prior = np.full(7, PRIOR * max(weight, 1.0))
    for i in range(4):
        prior[i] *= size**2
    if metric:
        prior[0] = np.inf
    return prior


@njit(cache=True, nogil=True)
def damped_step(matrix, right, prior):
    """The step (7,) of equations (7, 7) and (7,), at most 0.3 in scale and turns; what has an infinite prior stays."""
    damped, aim = matrix.copy(), right.copy()
    for i in range(7):
        if np.isinf(prior[i]):
            damped[i, :], damped[:, i], aim[i], damped[i, i] = 0.0, 0.0, 0.0, 1.0
        else:
            damped[i, i] += prior[i]
    step = cholesky_solve(damped, aim)
    for i in range(4):
        step[i] = min(max(step[i], -0.3), 0.3)
    return step


#: Two places are one if the surfaces are this near to each other, over their size; not where their middles are farther
#: apart than that.
SAME_PLACE, SAME_MIDDLE = 0.05, 0.4


def same_place(a: SimilarityTransform, b: SimilarityTransform, surface: Surface) -> bool:
    """Whether two similarities lay the surface, as a set of points, in the same place."""
    between = b.inverse @ a
    if not abs(np.log(between.scale)) < 0.1:
        return False
    if np.linalg.norm(between.apply(surface.centre) - surface.centre) > SAME_MIDDLE * surface.size:
        return False
    points = surface.points[::20]
    left = SAME_PLACE * surface.size * len(points)
    # Most places are far apart, which a part of the points tells already.
    for first in range(4):
        distances, _ = surface.tree.query(between.apply(points[first::4]))
        left -= float(distances.sum())
        if not left > 0.0:
            return False
    return True
