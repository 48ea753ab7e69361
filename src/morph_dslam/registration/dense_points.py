"""Many points of a map by stereo of its keyframes, where their images change: edges and texture.

A map has corners only, of which an object may hold few. At every pixel of a keyframe with enough contrast the depth is
chosen at which the other keyframes look alike, by normalized cross-correlation along the epipolar lines (plane
sweeping: Collins, A space-sweep approach to true multi-image matching, 1996; at pixels of contrast only: Engel, Schöps
& Cremers, LSD-SLAM, 2014). What other depths explain nearly as well, or other keyframes contradict, is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.camera import Camera
from morph_dslam.geometry import SimilarityTransform
from morph_dslam.registration.icp import Surface, surface_equations
from morph_dslam.registration.scene import MapPoints, View
from morph_dslam.render.packed_texture import PARTS, interpolated, pack_texture
from morph_dslam.threads import on_all_cores

Array = NDArray[np.float64]
#: Change of grey in a pixel from which on its depth is asked for; variance of a patch that can be compared.
LEAST_SLOPE, LEAST_VARIANCE = 3.0, 25.0
#: Half the side of a patch, keyframes compared, and steps along the widest epipolar line, pixels.
HALF, N_OTHERS, STEP_PX = 2, 4, 1.0
#: Depths are sought between these parts of the nearest and farthest point of the map that a keyframe sees.
NEARER, FARTHER = 0.7, 1.3
#: Correlation that a depth needs, and by how much it must exceed the next best depth's.
LEAST_CORRELATION, DISTINCT = 0.8, 0.1
#: One point is kept in each square of so many pixels.
CELL = 4
#: Largest standard deviation of a depth over itself, and the least; by how many of the largest those of two keyframes
#: may differ; how near their points are to be compared, pixels.
DEPTH_NOISE, LEAST_NOISE, AGREEING, NEAR_PX = 0.01, 0.001, 3.0, 4.0
#: So many points of a keyframe, whose errors are alike, count as independent; most that are used in a fit.
INDEPENDENT, MOST_USED = 40, 400
#: Points count in a fit within so many standard deviations, and this part of the object's size for every pixel in which
#: edges are searched.
WIDTH, WIDTH_PER_PX = 3.0, 0.01


class PointsOnSurface:
    """Points of a map that are to lie on an object.

    Parameters
    ----------
    points : of the map.
    surface : of the object.
    n_views : number of keyframes that they are from.
    """

    def __init__(self, points: MapPoints, surface: Surface, n_views: int) -> None:
        self._points, self._surface, self._n_views = points, surface, n_views

    def near(self, place: SimilarityTransform) -> PointsOnSurface:
        """Those near a place of the object, at most `MOST_USED`."""
        apart = np.linalg.norm(self._points.positions - place.apply(self._surface.centre), axis=1)
        rows = np.flatnonzero(apart < 0.75 * self._surface.size * place.scale)
        if len(rows) > MOST_USED:
            rows = np.random.default_rng(0).choice(rows, MOST_USED, replace=False)
        return PointsOnSurface(self._points[rows], self._surface, self._n_views)

    @cached_property
    def _depth(self) -> float:
        """Their median distance from where they are seen."""
        return float(np.median(np.linalg.norm(self._points.positions - self._points.viewpoints, axis=1)))

    def equations(self, place: SimilarityTransform, about: Array, reach: float) -> tuple[Array, Array]:
        """What they add to the normal equations (7, 7) and (7,) of a step of the place about a point (3,).

        ``reach`` is how far edges are searched, pixels; the less is known, the farther points may lie away.
        """
        if not len(self._points):
            return np.zeros((7, 7)), np.zeros(7)
        depth = self._depth
        width = max(WIDTH * DEPTH_NOISE * depth, WIDTH_PER_PX * reach * self._surface.size * place.scale)
        matrix, right, weights = surface_equations(self._points, self._surface, place, about, width)
        if not weights.any():
            return matrix, right
        # Tukey's weights say how far away the points are.
        gaps = width * np.sqrt(1.0 - np.sqrt(weights[weights > 0.0]))
        sigma = float(np.clip(1.48 * np.median(gaps), LEAST_NOISE * depth, DEPTH_NOISE * depth))
        counting = INDEPENDENT * self._n_views / max(float(weights.sum()), 1.0)
        return matrix * min(1.0, counting) / sigma**2, right * min(1.0, counting) / sigma**2


@dataclass(frozen=True)
class _Depths:
    """Depths (n,) of pixels (n, 2) of a view."""

    pixels: Array
    depths: Array


def with_dense_points(
    points: MapPoints, views: Sequence[View], chosen: Sequence[View], camera: Camera
) -> tuple[MapPoints, list[View]]:
    """A map with the points that depth images of its keyframes, or their stereo, add, and the keyframes with them.

    Parameters
    ----------
    points : of the map.
    views : its keyframes, whose ``point_ids`` are rows of ``points``.
    chosen : those of them that are to have points; all are compared.
    camera : of the views, without distortion.
    """

    def depths_of(view: View) -> _Depths:
        if len(view.depths):
            return _Depths(view.depths[:, :2].astype(float), view.depths[:, 2].astype(float))
        return _stereo(points, view, views, camera)

    measured = on_all_cores(depths_of, chosen)
    positions, viewpoints, count, richer = [points.positions], [points.viewpoints], len(points), []
    for view, found in zip(chosen, measured, strict=True):
        local = camera.rays(found.pixels) * found.depths[:, None]
        world = view.camera_from_world.inverse.apply(local)
        kept = _confirmed(world, [(v, d) for v, d in zip(chosen, measured, strict=True) if v is not view], camera)
        ids = np.arange(count, count + int(kept.sum()))
        count += len(ids)
        positions.append(world[kept])
        viewpoints.append(np.broadcast_to(view.camera_from_world.inverse.translation, (len(ids), 3)))
        pixels = np.concatenate([view.pixels, found.pixels[kept]])
        richer.append(replace(view, point_ids=np.concatenate([view.point_ids, ids]), pixels=pixels))
    return MapPoints(np.concatenate(positions), np.concatenate(viewpoints)), richer


def _confirmed(world: Array, others: Sequence[tuple[View, _Depths]], camera: Camera) -> NDArray[np.bool_]:
    """Which points (n, 3) agree with at least half of the other keyframes that have a depth where they see them."""
    asked, agreeing = np.zeros(len(world), dtype=np.int64), np.zeros(len(world), dtype=np.int64)
    for view, other in others:
        if not len(other.pixels) or not len(world):
            continue
        local = view.camera_from_world.apply(world)
        pixels = np.where(local[:, 2:] > 0.0, np.nan_to_num(camera.project(local), nan=-1e3), -1e3)
        apart, nearest = KDTree(other.pixels).query(pixels, distance_upper_bound=NEAR_PX)
        seen = np.flatnonzero(np.isfinite(apart))
        differ = np.abs(np.log(local[seen, 2] / other.depths[np.asarray(nearest)[seen]]))
        asked[seen] += 1
        agreeing[seen] += differ < AGREEING * DEPTH_NOISE
    return 2 * agreeing >= asked


def _stereo(points: MapPoints, view: View, views: Sequence[View], camera: Camera) -> _Depths:
    """Depths of a keyframe's pixels of most contrast, where they are distinct."""
    nothing = _Depths(np.empty((0, 2)), np.empty(0))
    known = view.camera_from_world.apply(points.positions[view.point_ids])[:, 2]
    known = known[known > 0.0]
    others = _others(view, views, float(np.median(known))) if len(known) else []
    pixels = _contrasting(view.normalized)
    if not others or not len(pixels):
        return nothing
    matrix = camera.matrix
    moved = [other.camera_from_world.matrix @ view.camera_from_world.inverse.matrix for other in others]
    farthest, nearest = FARTHER * np.percentile(known, 99), NEARER * np.percentile(known, 1)
    widest = max(float(np.linalg.norm(between[:3, 3])) for between in moved)
    steps = int(np.ceil(camera.fx * widest * (1.0 / nearest - 1.0 / farthest) / STEP_PX)) + 3
    inverse_depths = np.linspace(1.0 / farthest, 1.0 / nearest, steps)
    found, best, next_best = sweep(
        view.normalized,
        np.stack([pack_texture(other.normalized) for other in others]),
        np.array([matrix @ between[:3, :3] @ np.linalg.inv(matrix) for between in moved]),
        np.array([matrix @ between[:3, 3] for between in moved]),
        pixels,
        inverse_depths,
        HALF,
    )
    good = np.flatnonzero((best > LEAST_CORRELATION) & (best - next_best > DISTINCT) & (found > 0.0))
    column, row = (pixels[good] // CELL).T
    cells = row * camera.width + column
    order = good[np.lexsort((-best[good], cells))]
    _, first = np.unique(np.sort(cells), return_index=True)
    chosen = order[first]
    return _Depths(pixels[chosen].astype(float), 1.0 / found[chosen])


def _others(view: View, views: Sequence[View], depth: float) -> list[View]:
    """The views to compare a view with: those that are neither too near to it nor too far, over the depth."""
    eye = view.camera_from_world.inverse.translation
    apart = [
        (float(np.linalg.norm(other.camera_from_world.inverse.translation - eye)) / depth, other)
        for other in views
        if other is not view
    ]
    apart = [(share, other) for share, other in apart if share > 0.01]
    apart.sort(key=lambda pair: abs(np.log(pair[0] / 0.15)))
    return [other for _, other in apart[:N_OTHERS]]


def _contrasting(image: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Pixels (n, 2) of most contrast among their neighbours, away from the border."""
    smooth = cv2.GaussianBlur(image, (0, 0), 0.8).astype(np.float32)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)) / 8.0
    peak = (slope > LEAST_SLOPE) & (slope >= cv2.dilate(slope, np.ones((3, 3), np.uint8)))
    inner = np.zeros_like(peak)
    inner[HALF:-HALF, HALF:-HALF] = True
    row, column = np.nonzero(peak & inner)
    return np.column_stack([column, row]).astype(np.int64)


@njit(cache=True, nogil=True, error_model="numpy")
def sweep(image, others, turns, shifts, pixels, inverse_depths, half):
    """The inverse depth at which the other images look most alike at each pixel.

    Parameters
    ----------
    image : (h, w) uint8.
    others : (v, h, w) uint32, of `pack_texture`.
    turns : (v, 3, 3) that take homogeneous pixels at infinity to those of the others.
    shifts : (v, 3) to be added for every unit of inverse depth.
    pixels : (n, 2) int64, farther than ``half`` from the border.
    inverse_depths : (d,) evenly spaced, to be tried.
    half : half the side of the patches.

    Returns
    -------
    Inverse depths (n,), interpolated; the mean correlation (n,) of the better half of the others there; and that (n,)
    of the next best depth that is a maximum of its own. The correlation is -1 where there is none.
    """
    n, n_depths, n_others = len(pixels), len(inverse_depths), len(others)
    patch, scores, each = np.empty((2 * half + 1) ** 2, np.int64), np.empty(n_depths), np.empty(n_others)
    found, best, second = np.zeros(n), np.full(n, -1.0), np.full(n, -1.0)
    for p in range(n):
        x, y = pixels[p]
        k = total = square = 0
        for j in range(-half, half + 1):
            for i in range(-half, half + 1):
                patch[k] = image[y + j, x + i]
                total += patch[k]
                square += patch[k] * patch[k]
                k += 1
        mean = total / k
        variance = square / k - mean * mean
        if variance < LEAST_VARIANCE:
            continue
        deviation = np.sqrt(variance)
        for d in range(n_depths):
            seen = 0
            for v in range(n_others):
                likeness = _likeness(others[v], turns[v], inverse_depths[d] * shifts[v], x, y, half, patch, mean)
                if likeness > -np.inf:
                    each[seen] = likeness / deviation
                    seen += 1
            scores[d] = _mean_of_better_half(each, seen) if seen else -1.0
        top = 0
        for d in range(1, n_depths):
            top = d if scores[d] > scores[top] else top
        if top == 0 or top == n_depths - 1 or scores[top] <= -1.0:
            continue
        best[p] = scores[top]
        for d in range(1, n_depths - 1):
            if abs(d - top) > 3 and scores[d] >= scores[d - 1] and scores[d] >= scores[d + 1]:
                second[p] = max(second[p], scores[d])
        bend = scores[top - 1] - 2.0 * scores[top] + scores[top + 1]
        aside = 0.5 * (scores[top - 1] - scores[top + 1]) / bend if bend < -1e-9 else 0.0
        found[p] = inverse_depths[top] + aside * (inverse_depths[1] - inverse_depths[0])
    return found, best, second


#: Places in an image are whole numbers of these parts of a pixel; grey levels, of `PARTS`.
FINE_PARTS = PARTS * PARTS


@njit(cache=True, nogil=True, error_model="numpy")
def _likeness(other, turn, shift, x, y, half, patch, mean):
    """Covariance of a patch (k,) and what another image shows of it at a depth, over the deviation of the latter; minus
    infinity where it leaves that image. The patch is small: its warp is linear. ``shift`` is that of the depth."""
    height, width = other.shape
    w = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] + shift[2]
    if w <= 0.0:
        return -np.inf
    u = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] + shift[0]) / w
    t = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] + shift[1]) / w
    ux, uy = (turn[0, 0] - u * turn[2, 0]) / w, (turn[0, 1] - u * turn[2, 1]) / w
    tx, ty = (turn[1, 0] - t * turn[2, 0]) / w, (turn[1, 1] - t * turn[2, 1]) / w
    reach_u, reach_t = half * (abs(ux) + abs(uy)), half * (abs(tx) + abs(ty))
    if u < reach_u or t < reach_t or u + reach_u >= width - 1 or t + reach_t >= height - 1:
        return -np.inf
    # Whole numbers, which add up exactly and take half the time.
    right_x, right_y = np.int64(FINE_PARTS * ux), np.int64(FINE_PARTS * tx)
    down_x, down_y = np.int64(FINE_PARTS * uy), np.int64(FINE_PARTS * ty)
    line_x = np.int64(FINE_PARTS * u + 0.5 * PARTS) - half * (right_x + down_x)
    line_y = np.int64(FINE_PARTS * t + 0.5 * PARTS) - half * (right_y + down_y)
    total = square = product = np.int64(0)
    k = 0
    for _ in range(2 * half + 1):
        column, row = line_x, line_y
        for _ in range(2 * half + 1):
            four = other[np.uint64(row >> 16), np.uint64(column >> 16)]  # unsigned, so that none counts from the end
            value = interpolated(four, (column >> 8) & 255, (row >> 8) & 255) >> 8
            total += value
            square += value * value
            product += value * patch[k]
            column, row, k = column + right_x, row + right_y, k + 1
        line_x, line_y = line_x + down_x, line_y + down_y
    middle = total / (PARTS * k)
    spread = square / (FINE_PARTS * k) - middle * middle
    return (product / (PARTS * k) - mean * middle) / np.sqrt(max(spread, 1.0))


@njit(cache=True, nogil=True)
def _mean_of_better_half(values, count):
    """The mean of the larger half of the first ``count`` numbers, which are put in order; of two, of both."""
    for i in range(1, count):
        held, k = values[i], i
        while k > 0 and values[k - 1] > held:
            values[k] = values[k - 1]
            k -= 1
        values[k] = held
    first, total = count // 2 if count > 2 else 0, 0.0
    for i in range(first, count):
        total += values[i]
    return total / (count - first)
