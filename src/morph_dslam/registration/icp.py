"""A mesh's surface laid through the points of a map by iterative closest points with an unknown scale."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.geometry import SimilarityTransform, rotation_exp
from morph_dslam.model.reduced_model import spread_over, triangle_normals
from morph_dslam.registration.registration import Axis
from morph_dslam.registration.scene import MapPoints

Array = NDArray[np.float64]
#: Points spread over the surface.
N_SAMPLES = 12000
#: A surface turned about its axis of revolution stays where it was, up to this part of its size.
SYMMETRY_TOLERANCE = 0.01
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
                away, nearest = self.tree.query(turned)
                if np.percentile(away, 95) > FARTHEST_SAMPLE * spacing:  # over the rim of an open surface
                    farthest = np.inf
                # Across the surface: along it the nearest sample is up to a spacing away.
                off = np.abs(np.einsum("px,px->p", turned - self.points[nearest], self.normals[nearest]))
                farthest = max(farthest, float(np.percentile(off, 95)))
            if farthest <= max(allowed, 0.5 * spacing):
                return axis
        return None


def fit_surface(
    points: MapPoints,
    surface: Surface,
    start: SimilarityTransform,
    widths: Array,
    metric: bool = False,
    to_planes: bool = True,
) -> tuple[SimilarityTransform, Array]:
    """Gauss-Newton on distances to the nearest points of the surface, with Tukey's biweight.

    Distances are measured in the world, where shrinking the surface does not make them smaller.

    Parameters
    ----------
    points : of the map.
    surface : to lay through them.
    start : world_from_object.
    widths : (k,) one iteration each: points farther from the surface than this do not count, world unit.
    metric : keep the scale of ``start``, for maps that have one.
    to_planes : measure along normals only, which converges fast from near; from far, on a surface with folds,
        whole distances are the safer guide.

    Returns
    -------
    The similarity world_from_object, and how far each point counts (n,), 0 to 1.
    """
    transform = start
    for width in widths:
        matrix, right, weights = surface_equations(points, surface, transform, surface.centre, width, to_planes)
        centre = transform.apply(surface.centre)
        size = surface.radius * transform.scale
        prior = PRIOR * max(weights.sum(), 1.0) * np.array([size**2] * 4 + [1.0] * 3)
        if metric:
            prior[0] = np.inf
        step = _damped_solution(matrix, right, prior)
        scale = transform.scale * float(np.exp(step[0]))
        rotation = rotation_exp(step[1:4]) @ transform.rotation
        translation = centre + step[4:] - scale * rotation @ surface.centre
        transform = SimilarityTransform(scale, rotation, translation)
    return transform, weights


def surface_equations(
    points: MapPoints, surface: Surface, place: SimilarityTransform, about: Array, width: float, to_planes: bool = True
) -> tuple[Array, Array, Array]:
    """Gauss-Newton's matrix (7, 7) and right side (7,) of points on a surface, and their weights (n,), 0 to 1.

    Parameters
    ----------
    points : of the map.
    surface : on which they are to lie.
    place : world_from_object.
    about : (3,) the point, object frame, about which the similarity's step scales and turns.
    width : points farther from the surface than this do not count, world unit.
    to_planes : as of `fit_surface`.
    """
    inverse = place.inverse
    nearest = surface.nearest(inverse.apply(points.positions), inverse.apply(points.viewpoints))
    arms = place.scale * (surface.points[nearest] - about) @ place.rotation.T
    gaps = points.positions - place.apply(about) - arms
    return normal_equations(gaps, arms, surface.normals[nearest] @ place.rotation.T, width, to_planes)


@njit(cache=True, nogil=True)
def normal_equations(gaps, arms, normals, width, to_planes):
    """Gauss-Newton's matrix (7, 7) and right side (7,), and Tukey's weights (n,) of the points.

    Parameters
    ----------
    gaps : (n, 3) from the surface to the points.
    arms : (n, 3) from the surface's centre to its points.
    normals : (n, 3) there.
    width : gaps as large do not count.
    to_planes : as in `fit_surface`.
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


def _damped_solution(matrix: Array, right: Array, prior: Array) -> Array:
    """The step (7,); what has an infinite prior stays, and no step turns or scales by more than 0.3."""
    free = np.isfinite(prior)
    step = np.zeros(7)
    step[free] = np.linalg.solve(matrix[np.ix_(free, free)] + np.diag(prior[free]), right[free])
    step[:4] = np.clip(step[:4], -0.3, 0.3)
    return step


#: Two places are one if the surfaces are this near to each other, over their size.
SAME_PLACE = 0.05


def same_place(a: SimilarityTransform, b: SimilarityTransform, surface: Surface) -> bool:
    """Whether two similarities lay the surface, as a set of points, in the same place."""
    between = b.inverse @ a
    if not abs(np.log(between.scale)) < 0.1:
        return False
    distances, _ = surface.tree.query(between.apply(surface.points[::20]))
    return float(distances.mean()) < SAME_PLACE * surface.size
