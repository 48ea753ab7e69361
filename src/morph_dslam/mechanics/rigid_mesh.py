"""A rigid body with a closed surface of triangles, as an obstacle of contact.

Its signed distance is a tricubic spline of values on a grid around it. So contact has smooth energy and exact
derivatives where the normals of triangles jump; corners and edges are rounded to about the spacing of the grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import numpy as np
import trimesh
from numba import njit
from numpy.typing import NDArray
from scipy.interpolate import NdBSpline, make_interp_spline
from scipy.ndimage import distance_transform_edt, maximum_filter
from scipy.spatial import KDTree

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.contact import Touch, Vector
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.meshing.surface_repair import refined_surface
from morph_dslam.model.reduced_model import triangle_normals
from morph_dslam.small_arrays import dot

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: The longest side of the body over the spacing of the grid, where none is given; and the most points of a grid.
DIVISIONS, MOST_POINTS = 64, 4_000_000
#: Spacings by which the grid is larger than the body on every side.
MARGIN = 4
#: Triangles, by the distance of their centres, among which the nearest is sought.
NEAREST = 8
#: Spacings from the surface within which distances are exact.
BAND = 5
#: Spacings by which the distances of neighbours may differ across the surface; the exact ones differ by one at most.
LARGEST_JUMP = 1.5
#: A surface is too thin for the grid where the distance grows by less than the first share of that along its normal, in
#: more than the second share of its area. Edges and corners of boxes have none, a wedge of 20 degrees 2.5 %.
LEAST_SLOPE, LARGEST_FLAT = 0.5, 0.1
#: Points along the longest side of the body among which its core is found.
CORE_POINTS = 24
#: Surfaces are off by less than such a part of the spacing, near edges.
ROUNDING = 0.2


@dataclass(frozen=True, eq=False)
class RigidMesh:
    """The inside of a closed surface of triangles.

    Raises StudyError if the spacing is not positive or too small, and when it is first touched if the surface passes
    through itself or is thinner than the spacing.

    Attributes
    ----------
    on : surface.
    points : (n, 3), m.
    triangles : (t, 3) of point indices, anticlockwise as seen from outside.
    place : how far the body is moved from there, m: numbers or expressions of parameters.
    spacing : of the grid that its distance is kept on, m; None for the longest side over `DIVISIONS`.
    """

    on: str
    points: Array
    triangles: Indices
    place: Vector = (0.0, 0.0, 0.0)
    spacing: float | None = None
    name = "mesh"

    def __post_init__(self) -> None:
        if self.spacing is not None and not self.spacing > 0.0:
            raise StudyError(f"the spacing of the contact on '{self.on}' must be positive, not {self.spacing} m")
        if np.prod(np.ptp(self.points, axis=0) / self._step + 2 * MARGIN + 1) > MOST_POINTS:
            raise StudyError(
                f"a grid of {1e3 * self._step:.3g} mm for the mesh of the contact on '{self.on}' has more than "
                f"{MOST_POINTS} points: take a larger spacing, or cut off what the solid does not touch"
            )

    @property
    def _step(self) -> float:
        return self.spacing or float(np.ptp(self.points, axis=0).max()) / DIVISIONS

    @property
    def tolerance(self) -> float:
        """See `RigidObstacle`."""
        return ROUNDING * self._step

    @cached_property
    def _distance(self) -> NdBSpline:
        low, sides = self.points.min(axis=0) - MARGIN * self._step, np.ptp(self.points, axis=0)
        counts = np.ceil(sides / self._step).astype(int) + 2 * MARGIN + 1
        axes = [start + self._step * np.arange(count) for start, count in zip(low, counts, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        coefficients, knots = _signed_distances(self.points, self.triangles, grid, self._step), []
        self._check_sides(grid, coefficients)
        for places in axes:
            spline = make_interp_spline(places, coefficients, k=3)
            knots.append(spline.t)
            coefficients = np.moveaxis(spline.c, 0, -1)
        distance = NdBSpline(tuple(knots), np.ascontiguousarray(coefficients), 3)
        self._check_thickness(distance)
        return distance

    @cached_property
    def core(self) -> Array:
        """Points (k, 3) that are deeper inside than others around them, where ``points`` are, m: none in thin walls."""
        low, sides = self.points.min(axis=0), np.ptp(self.points, axis=0)
        counts = np.maximum(np.ceil(CORE_POINTS * sides / sides.max()).astype(int), 2)
        axes = [start + side * (np.arange(n) + 0.5) / n for start, side, n in zip(low, sides, counts, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        depths = -self._distance(grid)
        deepest = (depths > self._step) & (depths >= maximum_filter(depths, size=3))
        return grid[deepest]

    def _check_sides(self, grid: Array, distances: Array) -> None:
        """Raise StudyError if the signed distance from inside to outside of the surface jumps.

        Neighbours on both sides of a surface are together no more than a spacing away from it. A surface that passes
        through itself has walls within itself, and so both sides meet far from any.
        """
        for axis in range(3):
            one, other = np.moveaxis(distances, axis, 0)[:-1], np.moveaxis(distances, axis, 0)[1:]
            jumps = np.where(one * other < 0.0, np.abs(one - other), 0.0)
            if jumps.max() > LARGEST_JUMP * self._step:
                place = np.moveaxis(grid, axis, 0)[:-1].reshape(-1, 3)[jumps.argmax()]
                where = ", ".join(f"{x:.4g}" for x in np.round(1e3 * place, 4))
                raise StudyError(
                    f"the mesh of the contact on '{self.on}' passes through itself, or has a part within another, near "
                    f"({where}) mm of its file: unite its parts, so that its surface bounds one inside"
                )

    def _check_thickness(self, distance: NdBSpline) -> None:
        """Raise StudyError if the distance does not grow across much of the surface: it is too thin for the grid."""
        points, triangles = refined_surface(self.points, self.triangles, self._step)
        normals = triangle_normals(points, triangles)
        gradient = _gradient(distance, points[triangles].mean(axis=1))
        areas = np.linalg.norm(normals, axis=1)
        flat = np.einsum("tx,tx->t", gradient, normals) < LEAST_SLOPE * areas
        if areas[flat].sum() > LARGEST_FLAT * areas.sum():
            raise StudyError(
                f"the mesh of the contact on '{self.on}' is thinner than the {1e3 * self._step:.3g} mm of the grid "
                "that its distance is kept on: give a smaller spacing"
            )

    def touch(self, symbols: ParameterSymbols, points: Array) -> Touch:
        """See `RigidObstacle`; far away the gap is only known to be positive, and outside there are no derivatives."""
        points = points - symbols.values(self.place)
        low, high = self.points.min(axis=0) - self._step, self.points.max(axis=0) + self._step
        near = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
        gap = np.full(len(points), self._step)
        normal, curvature = np.zeros((len(points), 3)), np.zeros((len(points), 3, 3))
        gap[near] = self._distance(points[near])
        inside = np.flatnonzero(gap < 0.0)
        normal[inside] = _gradient(self._distance, points[inside])
        axes = np.eye(3, dtype=np.int64)
        for i, j in combinations_with_replacement(range(3), 2):
            curvature[inside, i, j] = curvature[inside, j, i] = self._distance(points[inside], nu=axes[i] + axes[j])
        return Touch(gap, normal, curvature)

    def slopes(self, symbols: ParameterSymbols) -> tuple[Array, Array]:
        """See `RigidObstacle`."""
        return symbols.vector_slopes(self.place), np.zeros(len(symbols))


def _gradient(distance: NdBSpline, points: Array) -> Array:
    """(q, 3) at ``points`` (q, 3)."""
    return np.column_stack([distance(points, nu=axis) for axis in np.eye(3, dtype=np.int64)])


def _signed_distances(points: Array, triangles: Indices, grid: Array, step: float) -> Array:
    """Distances (x, y, z) of a ``grid`` (x, y, z, 3) from a closed surface, negative inside.

    Triangles are cut until no edge is longer than a ``step`` of the grid, so that the nearest one is among those with
    the nearest centres; beyond `BAND`, where the spline no longer acts on the surface, among those of the nearest place
    within, on whose side it is. The side is that of the normal at the nearest point, between the normals of its
    triangle's corners, each the mean of its triangles' weighted by their angles (Baerentzen & Aanaes, IEEE Trans. Vis.
    Comput. Graph. 11, 2005).
    """
    points, triangles = refined_surface(points, triangles, step)
    normals = np.asarray(trimesh.Trimesh(points, triangles, process=False).vertex_normals)
    tree = KDTree(points[triangles].mean(axis=1))
    nearest = np.asarray(tree.query(grid, NEAREST, distance_upper_bound=BAND * step)[1])
    nearest = np.where(nearest < len(triangles), nearest, nearest[..., :1])
    far = nearest[..., 0] == len(triangles)
    x, y, z = np.asarray(distance_transform_edt(far, return_distances=False, return_indices=True))
    candidates = nearest[x, y, z]
    places = grid.reshape(-1, 3)
    distances = _nearest(places, candidates.reshape(-1, NEAREST), points[triangles], normals[triangles])
    distances = distances.reshape(far.shape)
    return np.copysign(distances, distances[x, y, z])


@njit(cache=True, nogil=True)
def _nearest(places, candidates, corners, normals):
    """Signed distances (q,) from the nearest of candidates (q, k), of triangles' corners and normals (t, 3, 3)."""
    distances = np.empty(len(places))
    for q in range(len(places)):
        nearest, side = np.inf, 0.0
        for t in candidates[q]:
            shares = _foot(corners[t] - places[q])
            away, normal = np.zeros(3), np.zeros(3)
            for corner in range(3):
                away += shares[corner] * (places[q] - corners[t, corner])
                normal += shares[corner] * normals[t, corner]
            distance = np.sqrt(dot(away, away))
            if distance < nearest:
                nearest, side = distance, dot(away, normal)
        distances[q] = -nearest if side < 0.0 else nearest
    return distances


@njit(cache=True, nogil=True)
def _foot(corners):
    """Barycentric coordinates (3,) of a triangle's (3, 3) point that is nearest to the origin."""
    first, second = corners[1] - corners[0], corners[2] - corners[0]
    aa, ab, bb = dot(first, first), dot(first, second), dot(second, second)
    a, b = -dot(corners[0], first), -dot(corners[0], second)
    size = aa * bb - ab * ab
    s, t = bb * a - ab * b, aa * b - ab * a
    if s >= 0.0 and t >= 0.0 and s + t <= size and size > 0.0:
        return np.array([1.0 - (s + t) / size, s / size, t / size])
    nearest, shares = np.inf, np.zeros(3)
    for k in range(3):
        start, side = corners[k], corners[(k + 1) % 3] - corners[k]
        along = min(max(-dot(start, side) / max(dot(side, side), 1e-300), 0.0), 1.0)
        foot = start + along * side
        if dot(foot, foot) < nearest:
            nearest = dot(foot, foot)
            shares = np.zeros(3)
            shares[k], shares[(k + 1) % 3] = 1.0 - along, along
    return shares
