"""An object laid by its edges: the outline, and where its surface is bent sharply, against the edges of keyframes.

Points of the mesh's visible edges are searched along their normals for the edge of the image (Harris, Tracking with
rigid models, 1992; Drummond & Cipolla, Real-time visual tracking of complex structures, 2002). One similarity is fitted
to all keyframes; each may be shifted a little by itself, because the camera path of a map has errors of its own.

A cluttered image has edges everywhere. So an edge counts as much as it says more than chance: its likelihood where
the mesh has an edge, over that of an edge as near in the same image a little to the sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, SimilarityTransform
from morph_dslam.registration.dense_points import PointsOnSurface
from morph_dslam.registration.increments import moved_similarity, pose_jacobian, similarity_jacobian
from morph_dslam.registration.mesh_edges import MeshEdges, see_edges, seen_from
from morph_dslam.registration.scene import View, camera_from_object

Array = NDArray[np.float64]
#: Change of grey in a pixel that is an edge, and cosine to the direction expected.
LEAST_EDGE, PARALLEL = 3.0, 0.8
#: How far to either side edges are searched in turn, pixels.
REACHES = (16, 12, 10, 8, 6, 5, 4, 3, 3, 3)
#: Standard deviation of an edge's place and of a keyframe's own shift, pixels.
EDGE_PX, SHIFT_PX = 1.0, 2.0
#: Where a smooth surface turns away it is shaded, and its edge in the image seems to lie inside or outside of its
#: outline: by this standard deviation, pixels, in all views alike.
INWARD_PX = 0.7
#: So many points of a view's edges count as independent.
INDEPENDENT = 40.0
#: By so many standard deviations: one-sided, 5 %.
ONE_SIDED = 1.645
#: Standard deviation of a landmark that was clicked, pixels.
CLICK_PX = 2.0
#: An edge is where it is expected if it is as near, pixels; chance is asked this far to the sides.
NEAR_PX, ASIDE_PX = 2.0, (8.0, 12.0, 16.0)
#: Share of an object's edges that an image shows.
SHOWN = 0.8
#: Fewer points of edges in the images are no evidence.
FEWEST = 30


class Slopes(NamedTuple):
    """Change of grey in an image.

    Attributes
    ----------
    x, y : (h, w) in a pixel to the right, and downwards.
    steep : (h, w) whether it is at least `LEAST_EDGE` in a pixel or the next ones to the right and below: between these
        four it is less everywhere if it is less in all.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    steep: NDArray[np.bool_]

    @classmethod
    def of(cls, image: NDArray[np.uint8]) -> Slopes:
        """Those of an image (h, w), a little smoothed."""
        smooth = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32)
        x, y = (np.asarray(cv2.Sobel(smooth, cv2.CV_32F, *way) / 8.0, np.float32) for way in ((1, 0), (0, 1)))
        steep = (x * x + y * y >= LEAST_EDGE**2).astype(np.uint8)
        return cls(x, y, cv2.dilate(steep, np.ones((2, 2), np.uint8), anchor=(0, 0)) > 0)


@njit(cache=True, nogil=True)
def _strength(slopes, x, y, nx, ny):
    """Change of grey along a direction (nx, ny) at a place in an image; 0 if it is not steepest about there."""
    height, width = slopes.x.shape
    column, row = int(np.floor(x)), int(np.floor(y))
    if column < 1 or row < 1 or column >= width - 2 or row >= height - 2:
        return 0.0
    a, b = x - column, y - row
    gx = (1 - b) * ((1 - a) * slopes.x[row, column] + a * slopes.x[row, column + 1]) + b * (
        (1 - a) * slopes.x[row + 1, column] + a * slopes.x[row + 1, column + 1]
    )
    gy = (1 - b) * ((1 - a) * slopes.y[row, column] + a * slopes.y[row, column + 1]) + b * (
        (1 - a) * slopes.y[row + 1, column] + a * slopes.y[row + 1, column + 1]
    )
    along = abs(gx * nx + gy * ny)
    return along if along > PARALLEL * np.sqrt(gx * gx + gy * gy) else 0.0


@njit(cache=True, nogil=True)
def _may_be_edge(slopes, x, y):
    """Whether a place is so far inside of an image that it may be an edge, and some pixel around it is steep."""
    height, width = slopes.x.shape
    if not (x >= 1.0 and y >= 1.0 and x < width - 2.0 and y < height - 2.0):
        return False
    return slopes.steep[int(y), int(x)]


@njit(cache=True, nogil=True)
def find_edges(slopes, pixels, normals, reach):
    """The strongest edge (p,) near each of some points, in pixels along the normal; NaN where there is none.

    Parameters
    ----------
    slopes : `Slopes` of the image.
    pixels : (p, 2) where to search.
    normals : (p, 2) along which.
    reach : pixels to either side; nearer edges are preferred.
    """
    n = int(2 * reach) * 2 + 1
    offsets, first = np.full(len(pixels), np.nan), -0.5 * int(2 * reach)
    for p in range(len(pixels)):
        best, u, v, nx, ny = 0.0, pixels[p, 0], pixels[p, 1], normals[p, 0], normals[p, 1]
        known, before, here, after = -1, 0.0, 0.0, 0.0
        for k in range(1, n - 1):
            away = first + 0.5 * k
            if not _may_be_edge(slopes, u + away * nx, v + away * ny):
                continue
            # The place before was looked at already where it may have been an edge, too.
            if known == k - 1:
                before, here = here, after
            else:
                before = _strength(slopes, u + (away - 0.5) * nx, v + (away - 0.5) * ny, nx, ny)
                here = _strength(slopes, u + away * nx, v + away * ny, nx, ny)
            after = _strength(slopes, u + (away + 0.5) * nx, v + (away + 0.5) * ny, nx, ny)
            known = k
            if here < LEAST_EDGE or here < before or here <= after:
                continue
            weight = min(here, 20.0) * np.exp(-2.0 * (away / reach) ** 2)
            if weight > best:
                best = weight
                offsets[p] = away + 0.25 * (before - after) / min(before - 2.0 * here + after, -1e-9)
    return offsets


@njit(cache=True, nogil=True)
def edge_equations(points, turned_about, normals, smooth, offsets, reach, intrinsics, inward_px):
    """Normal equations (7, 7) of a pose's step by edges found along normals, the right side as last row and column.

    Edges that were not found, at NaN, do not count. The image's own shift is eliminated, and so is how far outwards
    smooth outlines seem to be.

    Parameters
    ----------
    points : (p, 3) of the edges, in the camera.
    turned_about : (3,) the point about which the pose's step turns, as in `pose_jacobian`.
    normals : (p, 2) across the edges, outwards where these are smooth.
    smooth : (p,) whether a smooth surface turns away there.
    offsets : (p,) where they were found along these, pixels.
    reach : pixels searched.
    intrinsics : fx, fy, cx, cy.
    inward_px : standard deviation of a view's smooth outlines, all together.
    """
    count, width = np.isfinite(offsets).sum(), max(0.5 * reach, 1.5)
    # Neighbours share their errors: a view's edges count as so many independent points.
    independent = min(1.0, INDEPENDENT / max(count, 1)) / EDGE_PX**2
    # The pose's step, the right side, the shift, and that of smooth outlines.
    matrix, row = np.zeros((10, 10)), np.empty(10)
    matrix[7, 7] = matrix[8, 8] = 1.0 / SHIFT_PX**2
    matrix[9, 9] = 1.0 / inward_px**2
    for p in range(len(points)):
        if not np.isfinite(offsets[p]):
            continue
        x, y, z = points[p]
        a, b = normals[p, 0] * intrinsics[0] / z, normals[p, 1] * intrinsics[1] / z
        c = -(a * x + b * y) / z
        x, y, z = points[p] - turned_about
        row[0], row[1], row[2] = y * c - z * b, z * a - x * c, x * b - y * a
        row[3], row[4], row[5], row[6] = a, b, c, offsets[p]
        row[7], row[8], row[9] = normals[p, 0], normals[p, 1], 1.0 if smooth[p] else 0.0
        weight = independent / (1.0 + (offsets[p] / width) ** 2) ** 2
        for i in range(10):
            for j in range(i + 1):
                matrix[i, j] += weight * row[i] * row[j]
    for k in (9, 8, 7):
        for i in range(k):
            for j in range(i + 1):
                matrix[i, j] -= matrix[k, i] * matrix[k, j] / matrix[k, k]
    for i in range(7):
        for j in range(i):
            matrix[j, i] = matrix[i, j]
    return matrix[:7, :7]


@njit(cache=True, nogil=True)
def view_equations(edges, rotation, translation, intrinsics, width, height, slopes, reach, inward_px):
    """Normal equations (7, 7) of a pose's step by a view's edges (`edge_equations`); zero if it shows too few.

    Parameters
    ----------
    edges : `EdgePoints` of the object.
    rotation, translation, intrinsics, width, height : of the view, as of `seen_from`.
    slopes : `Slopes` of the image.
    reach : pixels to search to either side.
    inward_px : as of `edge_equations`.
    """
    rows, points, pixels, normals, _ = see_edges(edges, rotation, translation, intrinsics, width, height)
    if len(points) < FEWEST:
        return np.zeros((7, 7))
    offsets = find_edges(slopes, pixels, normals, reach)
    if np.isfinite(offsets).sum() < FEWEST:
        return np.zeros((7, 7))
    return edge_equations(points, translation, normals, ~edges.sharp[rows], offsets, reach, intrinsics, inward_px)


@dataclass(frozen=True)
class Sighting:
    """Points of an object and where a camera in the map sees them.

    Attributes
    ----------
    frame : number of the frame.
    camera_from_world : the camera's pose.
    points : (k, 3) object frame, metres.
    pixels : (k, 2) undistorted.
    """

    frame: int
    camera_from_world: RigidTransform
    points: Array
    pixels: Array


def add_clicks(
    matrix: Array, right: Array, click: Sighting, place: SimilarityTransform, centre: Array, camera: Camera
) -> None:
    """Add landmarks to the normal equations (7, 7) and (7,) of a place's step; each has `CLICK_PX`."""
    pose = camera_from_object(click, place)
    points = pose.apply(click.points)
    by_pose = camera.projection_jacobian(points) @ pose_jacobian(points, pose)
    rows = (by_pose @ similarity_jacobian(pose, place, centre)).reshape(-1, 7)
    misses = (click.pixels - camera.project(points)).ravel()
    weights = 1.0 / (1.0 + (misses / (3.0 * CLICK_PX)) ** 2) ** 2 / CLICK_PX**2
    matrix += rows.T @ (weights[:, None] * rows)
    right += rows.T @ (weights * misses)


@dataclass(frozen=True)
class EdgeEvidence:
    """How much of an object's edges keyframes show where it is.

    Attributes
    ----------
    share : of the points of its outline, those on edges.
    chance : the same, where the outline is not.
    inner : as ``share``, of the sharp edges inside of the outline.
    inner_chance : likewise.
    count : number of points of the outline.
    n_inner : of the inner edges.
    gain_std : standard deviation of ``gain``, by how far the keyframes are apart on it; 0 of a single one.
    """

    share: float
    chance: float
    inner: float
    inner_chance: float
    count: int
    n_inner: int = 0
    gain_std: float = 0.0

    @property
    def total(self) -> float:
        """The mean log likelihood of all edges on the object over that by chance, 1 where all are seen.

        Of the object's edges an image shows the part `SHOWN`, or what it shows by chance if that is more.
        """
        every = max(self.count + self.n_inner, 1)
        share = (self.count * self.share + self.n_inner * self.inner) / every
        chance = (self.count * self.chance + self.n_inner * self.inner_chance) / every
        chance = float(np.clip(chance, 0.01, 0.95))
        seen = np.log(max(SHOWN, chance) / chance)
        missed = np.log((1.0 - max(SHOWN, chance)) / (1.0 - chance))
        return float(share + (1.0 - share) * missed / max(seen, 1e-9)) if seen > 0.0 else 0.0

    @property
    def gain(self) -> float:
        """How much more of the outline than by chance is on edges, of what could be."""
        return _beyond_chance(self.share, self.chance)

    def is_below(self, gain: float) -> bool:
        """Whether its gain is less than another one by more than the keyframes leave open."""
        return self.gain + ONE_SIDED * self.gain_std < gain

    def is_above(self, gain: float) -> bool:
        """Whether its gain is more than another one by more than the keyframes leave open."""
        return self.gain - ONE_SIDED * self.gain_std > gain


def _beyond_chance(share: float, chance: float) -> float:
    """How much a share exceeds that by chance, of what it could."""
    return (share - chance) / max(1.0 - chance, 1e-9)


class EdgeImages:
    """Edges of the keyframes of a map.

    Parameters
    ----------
    views : keyframes.
    camera : of the views, without distortion.
    scale_std : standard deviation of the logarithm of the map's scale about 1; infinite where its unit is unknown.
    """

    def __init__(self, views: Sequence[View], camera: Camera, scale_std: float = np.inf) -> None:
        self.views, self.camera, self._scale_std = list(views), camera, scale_std

    @cached_property
    def slopes(self) -> list[Slopes]:
        """Of every view."""
        return [Slopes.of(view.normalized) for view in self.views]

    def refine(
        self,
        edges: MeshEdges,
        start: SimilarityTransform,
        reaches: Sequence[float] = REACHES,
        clicks: Sequence[Sighting] = (),
        points: PointsOnSurface | None = None,
        keep_scale: bool = False,
    ) -> tuple[SimilarityTransform, Array]:
        """The place near ``start`` that has its edges on those of the images.

        Parameters
        ----------
        edges : of the object.
        start : metres to the map's unit.
        reaches : pixels to search, in turn.
        clicks : landmarks, which keep the place near to where they were set.
        points : of the map, which are to lie on the object.
        keep_scale : whether the scale stays as it is.

        Returns
        -------
        The place, and the covariance (7, 7) of log scale, rotation vector and translation about the mean node. What
        the mesh's edges and the image's are off is taken for the same in all views.
        """
        centre, place = edges.nodes.mean(axis=0), start
        units = np.array([1.0] * 4 + [edges.size * start.scale] * 3)
        free = slice(1 if keep_scale else 0, None)
        near = None if points is None else points.near(start)
        covariance, known = np.zeros((7, 7)), np.diag([self._scale_std**-2, *[0.0] * 6])
        for reach in reaches:
            matrix, right = self._equations(edges, place, reach, centre)
            for click in clicks:
                add_clicks(matrix, right, click, place, centre, self.camera)
            if near is not None:
                of_points = near.equations(place, centre, reach)
                matrix, right = matrix + of_points[0], right + of_points[1]
            right = right * units - known[0] * np.log(place.scale)
            # What the edges leave open stays.
            matrix = matrix * np.outer(units, units)
            matrix += np.diag(1e-4 * np.diag(matrix) + 1e-6)
            step = np.zeros(7)
            step[free] = np.clip(np.linalg.solve((matrix + known)[free, free], right[free]), -0.15, 0.15)
            covariance = np.zeros((7, 7))
            covariance[free, free] = np.linalg.inv((matrix / max(1, len(self.views)) + known)[free, free])
            place = moved_similarity(place, step * units, centre)
        return place, covariance * np.outer(units, units)

    def _equations(
        self, edges: MeshEdges, place: SimilarityTransform, reach: float, centre: Array
    ) -> tuple[Array, Array]:
        """Normal matrix (7, 7) and right side (7,) of a step of the place."""
        matrix, right = np.zeros((7, 7)), np.zeros(7)
        # What all views share, each for itself: their mean is no better known than one.
        inward_px = INWARD_PX * np.sqrt(len(self.views))
        for view, slopes in zip(self.views, self.slopes, strict=True):
            pose = camera_from_object(view, place)
            own = view_equations(edges.arrays, *seen_from(pose, self.camera), slopes, float(reach), inward_px)
            by_place = similarity_jacobian(pose, place, centre)
            matrix += by_place.T @ own[:6, :6] @ by_place
            right += by_place.T @ own[:6, 6]
        return matrix, right

    def evidence(self, edges: MeshEdges, place: SimilarityTransform) -> EdgeEvidence:
        """How much of the object's edges the keyframes show at a place."""
        on, chance, outline = [], [], []
        for view, slopes in zip(self.views, self.slopes, strict=True):
            seen = edges.visible(camera_from_object(view, place), self.camera)
            if len(seen.points) < FEWEST:
                continue
            shift = _own_shift(find_edges(slopes, seen.pixels, seen.normals, 4.0), seen.normals)
            pixels = seen.pixels + shift
            aside = [side * away for away in ASIDE_PX for side in (-1.0, 1.0)]

            def near(
                away: float, pixels: Array = pixels, normals: Array = seen.normals, slopes: Slopes = slopes
            ) -> Array:
                found = find_edges(slopes, pixels + away * normals, normals, NEAR_PX)
                return np.isfinite(found)

            on.append(near(0.0))
            chance.append(np.mean([near(away) for away in aside], axis=0))
            outline.append(seen.outline)
        if not on:
            return EdgeEvidence(0.0, 0.0, 0.0, 0.0, 0)
        found, by_chance, rim = np.concatenate(on), np.concatenate(chance), np.concatenate(outline)

        def mean(values: NDArray, rows: NDArray[np.bool_]) -> float:
            return float(np.mean(values[rows])) if rows.any() else 0.0

        gains = [
            _beyond_chance(*(mean(part, r) for part in (f, c))) for f, c, r in zip(on, chance, outline, strict=True)
        ]
        return EdgeEvidence(
            mean(found, rim),
            mean(by_chance, rim),
            mean(found, ~rim),
            mean(by_chance, ~rim),
            int(rim.sum()),
            int((~rim).sum()),
            float(np.std(gains, ddof=1) / np.sqrt(len(gains))) if len(gains) > 1 else 0.0,
        )


@njit(cache=True, nogil=True)
def _own_shift(offsets, normals):
    """The shift (2,) of all points that brings most of them onto the edges found (p,), within `SHIFT_PX` or so."""
    shift = np.zeros(2)
    for _ in range(5):
        xx = yy = 20.0 / SHIFT_PX**2
        xy = x = y = 0.0
        for p in range(len(offsets)):
            if not np.isfinite(offsets[p]):
                continue
            a, b = normals[p]
            weight = 1.0 / (1.0 + ((offsets[p] - a * shift[0] - b * shift[1]) / 1.5) ** 2) ** 2
            xx, xy, yy = xx + weight * a * a, xy + weight * a * b, yy + weight * b * b
            x, y = x + weight * a * offsets[p], y + weight * b * offsets[p]
        determinant = xx * yy - xy * xy
        shift[0], shift[1] = (yy * x - xy * y) / determinant, (xx * y - xy * x) / determinant
    return shift
