"""A surface laid through a map's points from many starts at once, where nothing says yet how it lies.

On a surface with folds, from far, whole distances are a safer guide than those along normals. Few points and samples
do, so that all pairs are compared in compiled code, a share of the starts on each core.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.geometry import SimilarityTransform, rotation_exp
from morph_dslam.registration.icp import WALL, Surface, damped_step, normal_equations, step_prior
from morph_dslam.registration.scene import MapPoints
from morph_dslam.threads import on_all_cores

Array = NDArray[np.float64]
#: Starts are worked on in so many parts.
N_PARTS = 8


def laid(
    points: MapPoints, surface: Surface, starts: Sequence[SimilarityTransform], widths: Array, metric: bool
) -> list[SimilarityTransform]:
    """The surface laid through points from each start, the place on which most of them lie first.

    Gauss-Newton on distances to the nearest points of the surface that face where a point was seen from, with Tukey's
    biweight.

    Parameters
    ----------
    points : of the map.
    surface : to lay through them.
    starts : world_from_object.
    widths : (k,) one iteration each: points farther from the surface than this do not count, over its size.
    metric : keep the scales of the starts.
    """
    scales = np.array([start.scale for start in starts])
    rotations = np.array([start.rotation for start in starts])
    translations = np.array([start.translation for start in starts])
    weights = np.zeros(len(starts))

    def lay(part: NDArray[np.int64]) -> None:
        # Parts are slices, so that the arrays themselves are filled.
        some = slice(part[0], part[-1] + 1)
        lay_all(
            points.positions, points.viewpoints, surface.points, surface.normals, surface.closed,
            surface.centre, surface.size, surface.radius, widths, metric,
            scales[some], rotations[some], translations[some], weights[some],
        )  # fmt: skip

    on_all_cores(lay, [part for part in np.array_split(np.arange(len(starts)), N_PARTS) if len(part)])
    return [
        SimilarityTransform(float(scales[k]), rotations[k], translations[k])
        for k in np.argsort(-weights, kind="stable").tolist()
    ]


@njit(cache=True, nogil=True)
def lay_all(
    positions, viewpoints, samples, normals, closed, centre, size, radius, widths, metric,
    scales, rotations, translations, weights,
):  # fmt: skip
    """Move each start to where it ends, and fill in the sums of the points' weights there.

    Parameters
    ----------
    positions, viewpoints : (p, 3) of the points, world.
    samples, normals : (n, 3) of the surface, object frame.
    closed, centre, size, radius : of the surface, as in `Surface`.
    widths : (k,) over the size.
    metric : keep the scales.
    scales, rotations, translations : (s,), (s, 3, 3) and (s, 3) of the starts, changed.
    weights : (s,) filled.
    """
    for s in range(len(scales)):
        first = scales[s] * size
        for width in widths:
            nearest = nearest_facing(
                (positions - translations[s]) @ rotations[s] / scales[s],
                (viewpoints - translations[s]) @ rotations[s] / scales[s],
                samples, normals, closed, WALL * size,
            )  # fmt: skip
            middle = translations[s] + scales[s] * (rotations[s] @ centre)
            matrix, right, of_points = normal_equations(
                positions, samples, normals, nearest,
                rotations[s], middle, scales[s], centre, first * width, False,
            )  # fmt: skip
            weights[s] = of_points.sum()
            step = damped_step(matrix, right, step_prior(weights[s], radius * scales[s], metric))
            scales[s] *= np.exp(step[0])
            rotations[s] = rotation_exp(step[1:4]) @ rotations[s]
            translations[s] = middle + step[4:] - scales[s] * (rotations[s] @ centre)


@njit(cache=True, nogil=True)
def nearest_facing(points, viewpoints, samples, normals, closed, wall):
    """The nearest sample (p,) of each point that faces its viewpoint.

    Where that is farther than the nearest of all by more than a ``wall``, or the surface is open, it is that one.

    Parameters
    ----------
    points, viewpoints : (p, 3).
    samples, normals : (n, 3).
    closed : whether the surface has an inside.
    wall : how thick a wall of a hollow body is at most.
    """
    nearest = np.empty(len(points), np.int64)
    for p in range(len(points)):
        x, y, z = points[p]
        u, v, w = viewpoints[p, 0] - x, viewpoints[p, 1] - y, viewpoints[p, 2] - z
        least = least_facing = np.inf
        of_all = facing = 0
        for n in range(len(samples)):
            square = (samples[n, 0] - x) ** 2 + (samples[n, 1] - y) ** 2 + (samples[n, 2] - z) ** 2
            if square < least:
                least, of_all = square, n
            if square < least_facing and normals[n, 0] * u + normals[n, 1] * v + normals[n, 2] * w > 0.0:
                least_facing, facing = square, n
        nearest[p] = facing if closed and np.sqrt(least_facing) <= np.sqrt(least) + wall else of_all
    return nearest
