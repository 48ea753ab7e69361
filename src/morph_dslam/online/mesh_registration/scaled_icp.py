"""Iterative closest points with an unknown scale: the similarity that lays a surface through map points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.geometry import rotation_exp
from morph_dslam.online.mesh_registration.scene import MapPoints
from morph_dslam.online.mesh_registration.surface import Surface
from morph_dslam.similarity import SimilarityTransform

Array = NDArray[np.float64]

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
