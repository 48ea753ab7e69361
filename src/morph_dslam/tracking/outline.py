"""The object's outline in the image: evidence where the surface has no texture, out to its very edge.

Points on the visible contour of the surface (`contours`) are searched for along its normal, as in Drummond and
Cipolla's edge tracking (PAMI 24, 2002). A point may slide along the contour, so it counts only across it: to first
order a smooth surface's contour moves across itself as the material there does.

How much it counts beside texture is in `outline_weight`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.model import ReducedModel, SurfacePoints
from morph_dslam.render.rasteriser import draw_depth
from morph_dslam.tracking.binding import Drawing, DrawnSurface, View, view_of
from morph_dslam.tracking.contours import Contour, SurfaceEdges, find_contour
from morph_dslam.tracking.edge_profiles import BLUR_PX, LIKELY_LEVELS, SIDE_PX, search_outline
from morph_dslam.tracking.estimator import BoundPoints, State
from morph_dslam.tracking.row_motion import RowMotion

Array = NDArray[np.float64]
#: Points on the contour, at most.
N_POINTS = 160
#: How far the outline is searched for to either side of where the estimate shows it, pixels.
REACH_PX = 14
#: While its points move by less than this, pixels, the contour is looked for along the same points of the surface.
SAME_CONTOUR_PX = 8.0
#: How often the first picture is searched: its blur is known better each time.
FIRST_ROUNDS = 4
#: What is beside an outline: from and up to so many pixels off, within so many median deviations, by so many points.
BESIDE_PX, SPREADS, FEWEST_KNOWN = (4, 9), 4.5, 12


@dataclass(frozen=True)
class OutlineMeasurement:
    """Where the outline was found.

    Attributes
    ----------
    points : (p,) on the contour as it was expected; always `N_POINTS`, those that are not needed at any place.
    pixels : (p, 2) on the outline, each on the normal of its point
    normals : (p, 2) outwards.
    expected : (p,) which points there are.
    weights : (p,) relative to a point of the texture; zero for those that were not found or do not agree.
    """

    points: BoundPoints
    pixels: Array
    normals: Array
    expected: NDArray[np.bool_]
    weights: Array

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which points (p,) were found."""
        return self.weights > 0.0

    def weighted(self, weight: float, agreeing: NDArray[np.bool_] | None = None) -> OutlineMeasurement:
        """The same, with this weight for all that were found, or of them for those that agree (p,)."""
        counts = self.valid if agreeing is None else self.valid & agreeing
        return replace(self, weights=np.where(counts, weight, 0.0))


def n_absent(grey: NDArray[np.uint8], seen: OutlineMeasurement) -> int:
    """How many points of an outline show behind them, where the object should be, what the found ones show beside it.

    Of an object that is torn or cut that is the part which is gone; what covers it looks otherwise, for the most part.
    None where the object does not stand out from what is beside it.

    Parameters
    ----------
    grey : (h, w) undistorted image.
    """
    inner, outer = (_grey_beside(grey, seen.pixels, side * seen.normals) for side in (-1.0, 1.0))
    found, missing = seen.expected & seen.valid, seen.expected & ~seen.valid
    known = found & np.isfinite(inner) & np.isfinite(outer)
    if known.sum() < FEWEST_KNOWN:
        return 0
    beside = float(np.median(outer[known]))
    limit = max(SPREADS * float(np.median(np.abs(outer[known] - beside))), LIKELY_LEVELS)
    if abs(float(np.median(inner[known])) - beside) < 2.0 * limit:
        return 0
    with np.errstate(invalid="ignore"):
        return int((np.abs(inner[missing] - beside) < limit).sum())


def _grey_beside(grey: NDArray[np.uint8], pixels: Array, away: Array) -> Array:
    """Mean grey (p,) of an image `BESIDE_PX` from pixels (p, 2) along directions (p, 2); NaN outside of it."""
    places = np.rint(pixels[:, None] + np.arange(*BESIDE_PX)[None, :, None] * away[:, None]).astype(np.int64)
    column, row = places[:, :, 0], places[:, :, 1]
    inside = (column >= 0) & (row >= 0) & (column < grey.shape[1]) & (row < grey.shape[0])
    found = grey[np.where(inside, row, 0), np.where(inside, column, 0)].mean(axis=1)
    return np.where(inside.all(axis=1), found, np.nan)


@dataclass(frozen=True)
class _Picture:
    """What the object looked like once.

    Attributes
    ----------
    grey : (h, w) smoothed
    nodes : (n, 3) of the drawn surface in the camera frame.
    depth : (h, w) of it.
    """

    grey: NDArray[np.uint8]
    nodes: Array
    depth: NDArray[np.float32]


class Outline:
    """The contour of a model's surface, and how bright the surface was inside of it once.

    Parameters
    ----------
    surface : what of the model is drawn.

    Attributes
    ----------
    points : where it was looked for last (`N_POINTS`,).
    """

    def __init__(self, model: ReducedModel, camera: Camera, surface: DrawnSurface) -> None:
        self._model, self._camera, self._surface = model, camera, surface
        self._triangles = np.ascontiguousarray(surface.model.triangles, dtype=np.int64)
        self._edges = SurfaceEdges.of(self._triangles)
        self._size = float(np.linalg.norm(np.ptp(surface.model.nodes, axis=0)))
        slots = SurfacePoints(np.zeros(N_POINTS, dtype=np.int64), np.tile([1.0, 0.0, 0.0], (N_POINTS, 1)))
        self.points = BoundPoints.from_surface(model, slots)
        self._used = np.zeros(N_POINTS, dtype=bool)
        self._picture: _Picture | None = None
        self._blur: float | None = None

    @property
    def knows_brightness(self) -> bool:
        """Whether a picture of the object was given."""
        return self._picture is not None

    def extent(self, state: State) -> float:
        """Diagonal of the object in the image, pixels; 0 where it is behind the camera."""
        pixels = view_of(self._surface.model, self._camera, state).pixels
        seen = pixels[np.isfinite(pixels).all(axis=1)]
        return float(np.linalg.norm(np.ptp(seen, axis=0))) if len(seen) else 0.0

    def take_brightness(self, grey: NDArray[np.uint8], state: State, seen: NDArray[np.bool_] | None = None) -> None:
        """Remember how bright the object is in an undistorted image (h, w).

        Parameters
        ----------
        state : of the object in it.
        seen : (h, w) where it shows the object; None where it is all that it covers.
        """
        drawing = self._drawn(state)
        depth = drawing.depth if seen is None else np.where(seen, drawing.depth, np.float32(np.inf))
        self._picture = _Picture(cv2.blur(grey, (3, 3)), drawing.view.nodes, depth)  # type: ignore[arg-type]

    def measure(
        self,
        grey: NDArray[np.uint8],
        state: State,
        reach: int,
        occluder_depth: NDArray[np.float32] | None = None,
        drawing: Drawing | None = None,
        motion: RowMotion | None = None,
    ) -> OutlineMeasurement:
        """Search for the outline around where ``state`` shows it.

        Parameters
        ----------
        grey : (h, w) undistorted image
        reach : how far to search to either side, pixels.
        occluder_depth : (h, w) of other objects, metres, infinite where there are none.
        drawing : of the object in a state that may be near enough; None to draw it here.
        motion : while a rolling shutter recorded the image.
        """
        if drawing is None:
            self._take_contour(self._drawn(state), occluder_depth)
            return self._searched(grey, self._contour.pixels, reach, self._drift(motion, state))
        self._take_contour(drawing, occluder_depth)
        return self.measure_again(grey, state, reach, occluder_depth, motion)

    def measure_again(
        self,
        grey: NDArray[np.uint8],
        state: State,
        reach: int,
        occluder_depth: NDArray[np.float32] | None = None,
        motion: RowMotion | None = None,
    ) -> OutlineMeasurement:
        """`measure` along the same points of the surface as the last time, unless they have moved far since then.

        By first order the contour of a smooth surface moves as the points on it do.
        """
        places = self._places(state)
        moved = np.linalg.norm(places - self._contour.pixels, axis=1)
        if not len(moved) or not moved.max() < SAME_CONTOUR_PX:
            return self.measure(grey, state, reach, occluder_depth, motion=motion)
        return self._searched(grey, places, reach, self._drift(motion, state))

    def _places(self, state: State) -> Array:
        """Where the contour's points (k, 2) are in the image in a state."""
        return self._camera.project(self.points.in_camera(state)[self._slots])

    def _drift(self, motion: RowMotion | None, state: State) -> Array:
        """How far (k, 2) from there a rolling shutter shows them."""
        return np.zeros(2) if motion is None else motion.drift(self._places, state)

    def _take_contour(self, drawing: Drawing, occluder_depth: NDArray[np.float32] | None) -> None:
        """Find the contour in a drawing, and how bright the object is beside it."""
        view, focal = drawing.view, 0.5 * (self._camera.fx + self._camera.fy)
        self._contour = contour = find_contour(
            self._edges, view.nodes, view.pixels, drawing.depth, focal, self._size, N_POINTS, occluder_depth
        )
        self._beside = self._brightness(contour, view, drawing.triangle_ids)
        self._slots = self._assigned(contour, drawing.state)
        triangles, weights = self.points.surface.triangles.copy(), self.points.surface.weights.copy()
        triangles[self._slots], weights[self._slots] = contour.points.triangles, contour.points.weights
        self.points = BoundPoints.from_surface(self._model, SurfacePoints(triangles, weights))
        self._used = np.zeros(N_POINTS, dtype=bool)
        self._used[self._slots] = True

    def _searched(self, grey: NDArray[np.uint8], places: Array, reach: int, drift: Array) -> OutlineMeasurement:
        """Search along the contour's normals from ``places`` (k, 2), where its points are by now, and ``drift`` (k, 2).

        Points stay in the places of those that were near them last: what one errs by is then known as the same.
        """
        slots, normals_there = self._slots, self._contour.normals
        contour, offsets = self._contour, np.full(len(slots), np.nan)
        asked = grey, places + drift, normals_there, contour.turns_away, contour.width, self._beside, reach
        blur, rounds = (BLUR_PX, FIRST_ROUNDS) if self._blur is None else (self._blur, 1)
        for _ in range(rounds):
            offsets, blur = search_outline(*asked, blur)
        self._blur = blur
        found = np.zeros(N_POINTS)
        found[slots] = is_found = np.isfinite(offsets)
        pixels, normals = np.zeros((N_POINTS, 2)), np.zeros((N_POINTS, 2))
        normals[:, 0] = 1.0  # of points that are not there; they count as ones of an outline all the same
        pixels[slots] = places + np.where(is_found, offsets, 0.0)[:, None] * normals_there
        normals[slots] = normals_there
        return OutlineMeasurement(self.points, pixels, normals, self._used, found)

    def _drawn(self, state: State) -> Drawing:
        """The object in a state."""
        camera, surface = self._camera, self._surface
        view = view_of(surface.model, camera, state)
        depths = np.ascontiguousarray(view.nodes[:, 2])
        drawn = draw_depth(view.pixels, depths, self._triangles, surface.closed, camera.height, camera.width)
        return Drawing(state, view, *drawn)

    def _brightness(self, contour: Contour, view: View, ids: NDArray[np.int32]) -> Array:
        """Grey (k, 2, `SIDE_PX`) of the object inside and outside of each point, in the picture that is known.

        So many pixels from the contour, from one on; NaN where that does not show it, or the object is not there.
        """
        known = self._picture
        if known is None:
            return np.full((len(contour), 2, SIDE_PX), np.nan)
        away = np.outer([-1.0, 1.0], np.arange(1, SIDE_PX + 1)).ravel()
        places = contour.pixels[:, None] + away[None, :, None] * contour.normals[:, None]
        args = ids, self._triangles, view.nodes, known.nodes, known.depth, known.grey, self._camera.intrinsics
        return look_up(places.reshape(-1, 2), *args).reshape(len(contour), 2, SIDE_PX)

    def _assigned(self, contour: Contour, state: State) -> NDArray[np.int64]:
        """The place of each point (k,): that of the one before it is nearest to, or a free one."""
        slots = np.full(len(contour), -1)
        if self._used.any() and len(contour):
            places = self._camera.project(self.points.in_camera(state))
            slots = nearest_to_each_other(contour.pixels, np.where(self._used[:, None], places, np.nan))
        is_free = np.ones(N_POINTS, dtype=bool)
        is_free[slots[slots >= 0]] = False
        slots[slots < 0] = np.flatnonzero(is_free)[: (slots < 0).sum()]
        return slots


@njit(cache=True, nogil=True)
def nearest_to_each_other(first, second):
    """The row (n,) of the nearest of ``second`` (m, 2), NaN for none, to each of ``first`` (n, 2) which is also the
    nearest to that one; -1 where there is none."""
    nearest, to_other = np.full(len(first), -1), np.full(len(second), -1)
    squared = np.full(len(second), np.inf)
    for i in range(len(first)):
        least = np.inf
        for j in range(len(second)):
            distance = (first[i, 0] - second[j, 0]) ** 2 + (first[i, 1] - second[j, 1]) ** 2
            if distance < least:
                least, nearest[i] = distance, j
            if distance < squared[j]:
                squared[j], to_other[j] = distance, i
    for i in range(len(first)):
        if nearest[i] >= 0 and to_other[nearest[i]] != i:
            nearest[i] = -1
    return nearest


@njit(cache=True, nogil=True)
def _volume(a, b, c):
    """Product (a, b, c) of three vectors (3,)."""
    return a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])


@njit(cache=True, nogil=True)
def look_up(pixels, ids, triangles, nodes, known_nodes, known_depth, known_grey, intrinsics):
    """Grey (k,) in a known picture of the surface points that pixels (k, 2) see; NaN where it is not shown there.

    Parameters
    ----------
    ids : (h, w) the triangle that each pixel sees, -1 for none.
    nodes, known_nodes : (n, 3) in the camera frame now and in the picture.
    known_depth, known_grey : (h, w) of the picture.
    """
    height, width = ids.shape
    result = np.full(len(pixels), np.nan)
    ray, there = np.empty(3), np.empty(3)
    for j in range(len(pixels)):
        column, row = int(np.rint(pixels[j, 0])), int(np.rint(pixels[j, 1]))
        if column < 0 or row < 0 or column >= width or row >= height or ids[row, column] < 0:
            continue
        a, b, c = triangles[ids[row, column]]
        ray[0], ray[1] = (column - intrinsics[2]) / intrinsics[0], (row - intrinsics[3]) / intrinsics[1]
        ray[2] = 1.0
        # Where the ray meets the plane: a combination of the corners whose weights add up to 1.
        p, q, s = nodes[a], nodes[b], nodes[c]
        first, second, third = _volume(ray, q, s), _volume(ray, s, p), _volume(ray, p, q)
        total = first + second + third
        if not abs(total) > 0.0:
            continue
        for k in range(3):
            there[k] = (first * known_nodes[a, k] + second * known_nodes[b, k] + third * known_nodes[c, k]) / total
        if not there[2] > 0.0:
            continue
        x = int(np.rint(intrinsics[0] * there[0] / there[2] + intrinsics[2]))
        y = int(np.rint(intrinsics[1] * there[1] / there[2] + intrinsics[3]))
        if 0 <= x < width and 0 <= y < height and 0.99 < there[2] / known_depth[y, x] < 1.01:
            result[j] = known_grey[y, x]
    return result
