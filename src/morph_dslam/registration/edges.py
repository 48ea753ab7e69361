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

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, SimilarityTransform
from morph_dslam.model.reduced_model import triangle_normals
from morph_dslam.registration.dense_points import PointsOnSurface
from morph_dslam.registration.increments import moved_similarity, pose_jacobian, similarity_jacobian
from morph_dslam.registration.scene import View, camera_from_object
from morph_dslam.registration.simplified import simplified
from morph_dslam.render.rasteriser import draw_depth, image_region

Array = NDArray[np.float64]
#: Cosine of the angle between two triangles from which their edge is seen, points along the edges of the size of the
#: object, and the factor by which depth is drawn smaller.
SHARP, SPACING, SHRINK = 0.85, 80, 2
#: The same cosine, from which on the two triangles lie in one plane.
FLAT = 1.0 - 1e-9
#: Change of grey in a pixel that is an edge, and cosine to the direction expected.
LEAST_EDGE, PARALLEL = 3.0, 0.8
#: How far to either side edges are searched in turn, pixels.
REACHES = (16, 12, 10, 8, 6, 5, 4, 3, 3, 3)
#: Standard deviation of an edge's place and of a keyframe's own shift, pixels.
EDGE_PX, SHIFT_PX = 1.0, 2.0
#: So many points of a view's edges count as independent.
INDEPENDENT = 40.0
#: Standard deviation of a landmark that was clicked, pixels.
CLICK_PX = 2.0
#: An edge is where it is expected if it is as near, pixels; chance is asked this far to the sides.
NEAR_PX, ASIDE_PX = 2.0, (8.0, 12.0, 16.0)
#: Share of an object's edges that an image shows.
SHOWN = 0.8
#: Fewer points of edges in the images are no evidence.
FEWEST = 30


@dataclass(frozen=True)
class VisibleEdges:
    """Edges of a mesh that a view sees.

    Attributes
    ----------
    points : (p, 3) object frame, metres.
    pixels : (p, 2) where they are seen.
    normals : (p, 2) across them in the image.
    outline : (p,) whether something else is seen behind, and not another side of the object.
    """

    points: Array
    pixels: Array
    normals: Array
    outline: NDArray[np.bool_]


class MeshEdges:
    """Points along the edges of a mesh.

    Parameters
    ----------
    nodes : (n, 3) metres.
    triangles : (m, 3) node indices.
    """

    def __init__(self, nodes: Array, triangles: NDArray[np.int64]) -> None:
        self.nodes, self.triangles = nodes, triangles
        #: Nodes and triangles that are drawn, to see what is hidden.
        self.drawn = simplified(nodes, triangles)
        self.size = float(np.linalg.norm(np.ptp(nodes, axis=0)))
        sides = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        owner = np.repeat(np.arange(len(triangles)), 3)
        keys = np.sort(sides, axis=1)
        order = np.lexsort((keys[:, 1], keys[:, 0]))
        _, first, uses = np.unique(keys[order], axis=0, return_index=True, return_counts=True)
        #: Whether the surface has an inside, so that its triangles that are turned away are hidden.
        self._closed = bool((uses == 2).all())
        ends, one = keys[order][first], owner[order[first]]
        other = np.where(uses == 2, owner[order[np.minimum(first + 1, len(order) - 1)]], -1)
        normals = triangle_normals(nodes, triangles)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        # An edge within a plane is never seen.
        bent = (other < 0) | (np.einsum("ex,ex->e", normals[one], normals[other]) < FLAT)
        ends, one, other = ends[bent], one[bent], other[bent]
        length = np.linalg.norm(nodes[ends[:, 1]] - nodes[ends[:, 0]], axis=1)
        edge, share = _spaced(length, self.size / SPACING)
        start, self._along = nodes[ends[edge, 0]], (nodes[ends[:, 1]] - nodes[ends[:, 0]])[edge]
        self._points = start + share[:, None] * self._along
        one, other = one[edge], other[edge]
        #: Normals (2, p, 3) of the triangles on both sides, their sum, and how far their planes are from the origin.
        self._sides = np.stack([normals[one], np.where(other[:, None] >= 0, normals[other], -normals[one])])
        self._sum, self._away = self._sides.sum(axis=0), np.einsum("kpx,px->kp", self._sides, self._points)
        self._sharp = np.einsum("px,px->p", *self._sides) < SHARP

    def visible(self, pose: RigidTransform, camera: Camera) -> VisibleEdges:
        """What a camera sees of them; ``pose`` is camera_from_object, metres."""
        eye = pose.inverse.translation
        facing = self._sides @ eye > self._away
        turns = facing[0] != facing[1]
        rows = np.flatnonzero(turns | (self._sharp & facing.any(axis=0)))
        local = pose.apply(self._points[rows])
        pixels = camera.project(local)
        seen = self._seen(pose, camera, local, pixels)
        rows, local, pixels = rows[seen], local[seen], pixels[seen]
        return VisibleEdges(self._points[rows], pixels, self._normals(rows, pose, camera, local), turns[rows])

    def _normals(self, rows: NDArray[np.int64], pose: RigidTransform, camera: Camera, local: Array) -> Array:
        """Across the edges, (p, 2). Where a smooth surface turns away, its own normal is across the outline."""
        ahead = np.einsum("pij,pj->pi", camera.projection_jacobian(local), self._along[rows] @ pose.rotation.T)
        across = np.column_stack([-ahead[:, 1], ahead[:, 0]])
        smooth = ~self._sharp[rows]
        across[smooth] = (self._sum[rows[smooth]] @ pose.rotation.T)[:, :2]
        return across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)

    def depth(self, pose: RigidTransform, camera: Camera, shrink: int = 1) -> Array:
        """The object's depth in every pixel of a camera with so many times fewer of them; inf beside it."""
        whole = np.full((camera.height // shrink, camera.width // shrink), np.inf)
        drawn, left, top = self._drawn(pose, camera, shrink)
        whole[top : top + drawn.shape[0], left : left + drawn.shape[1]] = drawn
        return whole

    def _drawn(self, pose: RigidTransform, camera: Camera, shrink: int) -> tuple[NDArray[np.float32], int, int]:
        """The depth of `depth` where the object is, and the region's left and top."""
        nodes, triangles = pose.apply(self.drawn[0]), self.drawn[1]
        pixels = (camera.project(nodes) + 0.5) / shrink - 0.5
        region = image_region(pixels, camera.height // shrink, camera.width // shrink)
        if region is None or nodes[:, 2].min() <= 0.0:
            return np.empty((0, 0), np.float32), 0, 0
        top, left = region[0].start, region[1].start
        size = region[0].stop - top, region[1].stop - left
        pixels -= [left, top]
        return (
            draw_depth(np.ascontiguousarray(pixels), nodes[:, 2].copy(), triangles, self._closed, *size)[1],
            left,
            top,
        )

    def _seen(self, pose: RigidTransform, camera: Camera, local: Array, pixels: Array) -> NDArray[np.bool_]:
        """Which points (p,) are in the image, and not behind the object."""
        small = (pixels + 0.5) / SHRINK - 0.5
        size = camera.width // SHRINK, camera.height // SHRINK
        return not_behind(*self._drawn(pose, camera, SHRINK), *size, small, local[:, 2], 0.01 * self.size)


@njit(cache=True, nogil=True)
def not_behind(depth, left, top, width, height, pixels, depths, tolerance):
    """Which points (p,) are at least two pixels inside of an image, and not behind what is drawn around them.

    Parameters
    ----------
    depth : (h, w) drawn, inf where nothing is.
    left, top : where this is in the image.
    width, height : of the image.
    pixels : (p, 2) of the points, NaN behind the camera.
    depths : (p,) of the points.
    tolerance : by which a point may be behind the farthest of the pixels around it.
    """
    seen = np.zeros(len(pixels), dtype=np.bool_)
    for p in range(len(pixels)):
        if not (np.isfinite(pixels[p, 0]) and np.isfinite(pixels[p, 1])):
            continue
        column, row = int(np.rint(pixels[p, 0])), int(np.rint(pixels[p, 1]))
        if column < 2 or row < 2 or column >= width - 2 or row >= height - 2:
            continue
        farthest = 0.0
        for y in range(row - top - 1, row - top + 2):
            for x in range(column - left - 1, column - left + 2):
                inside = 0 <= x < depth.shape[1] and 0 <= y < depth.shape[0]
                farthest = max(farthest, depth[y, x]) if inside else np.inf
        seen[p] = depths[p] <= farthest + tolerance
    return seen


def _spaced(lengths: Array, spacing: float) -> tuple[NDArray[np.int64], Array]:
    """Edges (p,) and shares of their lengths (p,) at equal distances along all of them, one after the other."""
    total = np.concatenate([[0.0], np.cumsum(lengths)])
    places = np.arange(0.5 * spacing, total[-1], spacing)
    edges = np.searchsorted(total, places, side="right") - 1
    return edges, (places - total[edges]) / np.maximum(lengths[edges], 1e-300)


@njit(cache=True, nogil=True)
def find_edges(slope_x, slope_y, pixels, normals, reach, least):
    """The strongest edge (p,) near each of some points, in pixels along the normal; NaN where there is none.

    Parameters
    ----------
    slope_x : (h, w) change of grey to the right in a pixel.
    slope_y : (h, w) downwards.
    pixels : (p, 2) where to search.
    normals : (p, 2) along which.
    reach : pixels to either side; nearer edges are preferred.
    least : change of grey of an edge.
    """
    height, width = slope_x.shape
    n = int(2 * reach) * 2 + 1
    offsets, strengths = np.full(len(pixels), np.nan), np.zeros(n)
    for p in range(len(pixels)):
        best, nx, ny = 0.0, normals[p, 0], normals[p, 1]
        for k in range(n):
            away = 0.5 * k - int(2 * reach) * 0.5
            x, y = pixels[p, 0] + away * nx, pixels[p, 1] + away * ny
            column, row = int(np.floor(x)), int(np.floor(y))
            strengths[k] = 0.0
            if column < 1 or row < 1 or column >= width - 2 or row >= height - 2:
                continue
            a, b = x - column, y - row
            gx = (1 - b) * ((1 - a) * slope_x[row, column] + a * slope_x[row, column + 1]) + b * (
                (1 - a) * slope_x[row + 1, column] + a * slope_x[row + 1, column + 1]
            )
            gy = (1 - b) * ((1 - a) * slope_y[row, column] + a * slope_y[row, column + 1]) + b * (
                (1 - a) * slope_y[row + 1, column] + a * slope_y[row + 1, column + 1]
            )
            along = abs(gx * nx + gy * ny)
            if along > PARALLEL * np.sqrt(gx * gx + gy * gy):
                strengths[k] = along
        for k in range(1, n - 1):
            if strengths[k] < least or strengths[k] < strengths[k - 1] or strengths[k] <= strengths[k + 1]:
                continue
            away = 0.5 * k - int(2 * reach) * 0.5
            weight = min(strengths[k], 20.0) * np.exp(-2.0 * (away / reach) ** 2)
            if weight > best:
                best = weight
                bend = strengths[k - 1] - 2.0 * strengths[k] + strengths[k + 1]
                offsets[p] = away + 0.25 * (strengths[k - 1] - strengths[k + 1]) / min(bend, -1e-9)
    return offsets


@njit(cache=True, nogil=True)
def edge_equations(points, turned_about, normals, offsets, reach, intrinsics):
    """Normal equations of a pose's step and of the image's own shift by edges found along normals.

    Parameters
    ----------
    points : (p, 3) of the edges, in the camera.
    turned_about : (3,) the point about which the pose's step turns, as in `pose_jacobian`.
    normals : (p, 2) across the edges.
    offsets : (p,) where they were found along these, pixels.
    reach : pixels searched.
    intrinsics : fx, fy, cx, cy.

    Returns
    -------
    Matrix and right side (7, 7) of the pose's step, the latter as last row and column; the same against the shift
    (7, 2); and the shift's matrix (2, 2).
    """
    count, width = len(points), max(0.5 * reach, 1.5)
    # Neighbours share their errors: a view's edges count as so many independent points.
    independent = min(1.0, INDEPENDENT / max(count, 1)) / EDGE_PX**2
    own, by_shift, shift, row = np.zeros((7, 7)), np.zeros((7, 2)), np.eye(2) / SHIFT_PX**2, np.empty(7)
    for p in range(count):
        x, y, z = points[p]
        a, b = normals[p, 0] * intrinsics[0] / z, normals[p, 1] * intrinsics[1] / z
        c = -(a * x + b * y) / z
        x, y, z = points[p] - turned_about
        row[0], row[1], row[2] = y * c - z * b, z * a - x * c, x * b - y * a
        row[3], row[4], row[5], row[6] = a, b, c, offsets[p]
        weight = independent / (1.0 + (offsets[p] / width) ** 2) ** 2
        for i in range(7):
            for j in range(7):
                own[i, j] += weight * row[i] * row[j]
            for j in range(2):
                by_shift[i, j] += weight * row[i] * normals[p, j]
        for i in range(2):
            for j in range(2):
                shift[i, j] += weight * normals[p, i] * normals[p, j]
    return own, by_shift, shift


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


def _beyond_chance(share: float, chance: float) -> float:
    """How much a share exceeds that by chance, of what it could."""
    return (share - chance) / max(1.0 - chance, 1e-9)


class EdgeImages:
    """Edges of the keyframes of a map.

    Parameters
    ----------
    views : keyframes.
    camera : of the views, without distortion.
    """

    def __init__(self, views: Sequence[View], camera: Camera) -> None:
        self.views, self.camera = list(views), camera

    @cached_property
    def slopes(self) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Change of grey in a pixel to the right and downwards, (h, w) each, of every view."""
        smooth = [cv2.GaussianBlur(view.normalized, (0, 0), 1.0).astype(np.float32) for view in self.views]
        pairs = [(cv2.Sobel(image, cv2.CV_32F, 1, 0), cv2.Sobel(image, cv2.CV_32F, 0, 1)) for image in smooth]
        return [(np.asarray(x / 8.0, np.float32), np.asarray(y / 8.0, np.float32)) for x, y in pairs]

    def refine(
        self,
        edges: MeshEdges,
        start: SimilarityTransform,
        metric: bool,
        reaches: Sequence[float] = REACHES,
        clicks: Sequence[Sighting] = (),
        points: PointsOnSurface | None = None,
    ) -> tuple[SimilarityTransform, Array]:
        """The place near ``start`` that has its edges on those of the images.

        Parameters
        ----------
        edges : of the object.
        start : metres to the map's unit.
        metric : keep the scale.
        reaches : pixels to search, in turn.
        clicks : landmarks, which keep the place near to where they were set.
        points : of the map, which are to lie on the object.

        Returns
        -------
        The place, and the covariance (7, 7) of log scale, rotation vector and translation about the mean node.
        """
        centre, place = edges.nodes.mean(axis=0), start
        units = np.array([1.0] * 4 + [edges.size * start.scale] * 3)
        free = slice(1 if metric else 0, None)
        near = None if points is None else points.near(start)
        covariance = np.zeros((7, 7))
        for reach in reaches:
            poses = [camera_from_object(view, place) for view in self.views]
            seen = [edges.visible(pose, self.camera) for pose in poses]
            matrix, right = self._equations(seen, poses, place, reach, centre)
            for click in clicks:
                add_clicks(matrix, right, click, place, centre, self.camera)
            if near is not None:
                of_points = near.equations(place, centre, reach)
                matrix, right = matrix + of_points[0], right + of_points[1]
            matrix, right = matrix * np.outer(units, units), right * units
            # What the edges leave open stays.
            damped = matrix[free, free] + np.diag(1e-4 * np.diag(matrix[free, free]) + 1e-6)
            step = np.zeros(7)
            step[free] = np.clip(np.linalg.solve(damped, right[free]), -0.15, 0.15)
            covariance = np.zeros((7, 7))
            covariance[free, free] = np.linalg.inv(damped)
            place = moved_similarity(place, step * units, centre)
        return place, covariance * np.outer(units, units)

    def _equations(
        self,
        visible: Sequence[VisibleEdges],
        poses: Sequence[RigidTransform],
        place: SimilarityTransform,
        reach: float,
        centre: Array,
    ) -> tuple[Array, Array]:
        """Normal matrix (7, 7) and right side (7,), the keyframes' own shifts eliminated."""
        matrix, right = np.zeros((7, 7)), np.zeros(7)
        for seen, pose, slopes in zip(visible, poses, self.slopes, strict=True):
            if len(seen.points) < FEWEST:
                continue
            offsets = find_edges(slopes[0], slopes[1], seen.pixels, seen.normals, float(reach), LEAST_EDGE)
            found = np.isfinite(offsets)
            if found.sum() < FEWEST:
                continue
            points = pose.apply(seen.points[found])
            own, by_shift, shift = edge_equations(
                points, pose.translation, seen.normals[found], offsets[found], float(reach), self.camera.intrinsics
            )
            by_place = similarity_jacobian(pose, place, centre)
            # The keyframe's own shift is eliminated.
            own -= by_shift @ np.linalg.solve(shift, by_shift.T)
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
            shift = _own_shift(
                find_edges(slopes[0], slopes[1], seen.pixels, seen.normals, 4.0, LEAST_EDGE), seen.normals
            )
            pixels = seen.pixels + shift
            aside = [side * away for away in ASIDE_PX for side in (-1.0, 1.0)]

            def near(
                away: float,
                pixels: Array = pixels,
                seen: VisibleEdges = seen,
                slopes: tuple[NDArray[np.float32], NDArray[np.float32]] = slopes,
            ) -> Array:
                places = pixels + away * seen.normals
                return np.isfinite(find_edges(slopes[0], slopes[1], places, seen.normals, NEAR_PX, LEAST_EDGE))

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


def _own_shift(offsets: Array, normals: Array) -> Array:
    """The shift (2,) of all points that brings most of them onto the edges found, within `SHIFT_PX` or so."""
    found = np.isfinite(offsets)
    shift, away, across = np.zeros(2), offsets[found], normals[found]
    for _ in range(5):
        left = away - across @ shift
        weights = 1.0 / (1.0 + (left / 1.5) ** 2) ** 2
        matrix = across.T @ (weights[:, None] * across) + np.eye(2) * 20.0 / SHIFT_PX**2
        shift = np.asarray(np.linalg.solve(matrix, across.T @ (weights * away)), dtype=np.float64)
    return shift
