"""Keyframes compared on a mesh: what one image shows on the surface, the others must show there too.

A keyframe's image is laid on the mesh and rendered into another view. Where surface and cameras are not where
they should be, the rendering is displaced; Lucas-Kanade measures by how much, to a fraction of a pixel, at
hundreds of points of each pair of views. Each displacement depends on the two poses alone, because a point is
where the first view's ray meets the mesh.

The displacements say how far the surface has to move, the cameras being where the map has them: the linear
equations of point-to-plane ICP, from thousands of pixels in place of the map's few points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, SimilarityTransform
from morph_dslam.registration.increments import moved_similarity, pose_jacobian, similarity_jacobian
from morph_dslam.registration.scene import View, camera_from_object, views_of
from morph_dslam.render.rasteriser import Buffers, rasterise
from morph_dslam.threads import on_all_cores

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
#: Views between which the object turns by more than this are not compared.
LARGEST_TURN = np.radians(35.0)
#: Points of each view, and the least cosine between the surface's normal and the sight lines.
N_CORNERS, LEAST_COSINE = 150, 0.3
#: Side of the patches compared, pixels, and their least correlation.
WINDOW, LEAST_CORRELATION = 17, 0.8
#: Iterations of a refinement, and keyframes used, spread over all that see the object.
REFINEMENTS, MOST_VIEWS = 6, 8
#: Displacements that differ more from the fit count less (Huber), pixels.
HUBER_PX = 0.5
#: Fewer measurements are no evidence.
FEWEST = 60
#: Images show a surface's shape if this share of the points looks alike, and a plane would misplace them by so many
#: times what they are off.
MOST_ALIKE, CLEAR_RELIEF = 0.9, 10.0


@dataclass(frozen=True)
class PairDisplacements:
    """How two views differ on the mesh.

    Attributes
    ----------
    first : number of the view whose image is carried.
    second : number of the view that it is compared with.
    places : (p, 3) points on the surface, object frame, metres.
    offsets : (p, 2) from where the second view should show the points to where it does, pixels.
    by_first : (p, 2, 6) how the expected pixel moves with the first pose (`pose_jacobian`).
    by_second : (p, 2, 6) likewise with the second one.
    by_depth : (p,) pixels by which it moves with the point's depth in the first view, a metre.
    n_compared : points that both views see, whether they look alike or not.
    """

    first: int
    second: int
    places: Array
    offsets: Array
    by_first: Array
    by_second: Array
    by_depth: Array
    n_compared: int


@dataclass(frozen=True)
class Agreement:
    """How far images of a surface agree.

    Attributes
    ----------
    place : world_from_object with which they do.
    rms_px : root mean square misfit of a pixel coordinate.
    share : of the points that two views see, those that look alike in both.
    relief_px : root mean square by which the points that look alike would be misplaced in the second view, were the
        surface the plane nearest to them.
    """

    place: SimilarityTransform
    rms_px: float
    share: float
    relief_px: float

    @property
    def shows_its_shape(self) -> bool:
        """Whether nearly all that is seen of the surface agrees, and no flat one would."""
        return self.share >= MOST_ALIKE and self.relief_px >= CLEAR_RELIEF * self.rms_px


@dataclass(frozen=True)
class _Drawn:
    """The mesh in one view: projected nodes (n, 2), depths (n,), buffers of all pixels, and corners (c, 2)."""

    normalized: Image
    pose: RigidTransform
    pixels: Array
    depths: Array
    buffers: Buffers
    corners: Array


class TextureComparison:
    """Compares images of one mesh.

    Parameters
    ----------
    nodes : (n, 3) of the undeformed mesh, metres.
    triangles : (m, 3) node indices.
    camera : of the views, without distortion.
    """

    def __init__(self, nodes: Array, triangles: NDArray[np.int64], camera: Camera) -> None:
        self._nodes, self._triangles, self._camera = nodes, triangles, camera
        self._centre = nodes.mean(axis=0)

    def refine(self, start: SimilarityTransform, views: Sequence[View], scale_std: float = np.inf) -> Agreement | None:
        """The world_from_object near ``start`` with which all views agree.

        Parameters
        ----------
        start : metres to the map's unit.
        views : keyframes of the map.
        scale_std : standard deviation of the logarithm of the scale about 1, as of a metric map.

        Returns
        -------
        None where too little can be compared.
        """
        views = views_of(self._nodes, start, views, self._camera, MOST_VIEWS)
        images, transform, rms, measured = [view.normalized for view in views], start, 0.0, []
        for _ in range(REFINEMENTS):
            poses = [camera_from_object(view, transform) for view in views]
            measured = self.measure(images, poses)
            if sum(len(pair.offsets) for pair in measured) < FEWEST:
                return None
            step, rms = self._step(measured, poses, transform, scale_std)
            transform = moved_similarity(transform, step, self._centre)
        share = sum(len(pair.offsets) for pair in measured) / sum(pair.n_compared for pair in measured)
        return Agreement(transform, rms, share, _relief(measured))

    def alike(self, place: SimilarityTransform, views: Sequence[View]) -> tuple[int, int]:
        """How many points are seen by two views with the object at a place, and how many of them look alike."""
        views = views_of(self._nodes, place, views, self._camera, MOST_VIEWS)
        measured = self.measure(
            [view.normalized for view in views], [camera_from_object(view, place) for view in views]
        )
        return sum(pair.n_compared for pair in measured), sum(len(pair.offsets) for pair in measured)

    def _step(
        self,
        measured: list[PairDisplacements],
        poses: list[RigidTransform],
        transform: SimilarityTransform,
        scale_std: float,
    ) -> tuple[Array, float]:
        """The step (7,) of the similarity, and the root mean square misfit in pixels."""
        slopes = [similarity_jacobian(pose, transform, self._centre) for pose in poses]
        rows = np.concatenate(
            [pair.by_first @ slopes[pair.first] + pair.by_second @ slopes[pair.second] for pair in measured]
        )
        offsets = np.concatenate([pair.offsets for pair in measured])
        # Unknowns in comparable units, of which those that the images leave open stay as they are.
        size = transform.scale * float(np.sqrt(np.mean(np.sum((self._nodes - self._centre) ** 2, axis=1))))
        units = np.array([1.0 / size] * 4 + [1.0] * 3)
        rows = rows * units
        step, misfit, mean_square = np.zeros(7), offsets, 0.0
        for _ in range(10):
            weights = HUBER_PX / np.maximum(np.linalg.norm(misfit, axis=1), HUBER_PX)
            mean_square = float(np.average(np.mean(misfit**2, axis=1), weights=weights))
            # All pairs of views that show a point share what it is off.
            known = len(poses) * mean_square * (units[0] / scale_std) ** 2
            matrix = np.einsum("pij,p,pik->jk", rows, weights, rows, optimize=True)
            right = np.einsum("pij,p,pi->j", rows, weights, offsets, optimize=True)
            matrix[0, 0] += known
            right[0] -= known * np.log(transform.scale) / units[0]
            step = np.linalg.pinv(matrix, rcond=1e-5, hermitian=True) @ right
            misfit = offsets - rows @ step
        return step * units, float(np.sqrt(mean_square))

    def measure(self, images: Sequence[Image], poses: Sequence[RigidTransform]) -> list[PairDisplacements]:
        """Displacements between all views from not too different sides.

        Parameters
        ----------
        images : (h, w) contrast-normalized, of each view.
        poses : camera_from_object of each, metres.
        """
        drawn = [self._draw(image, pose) for image, pose in zip(images, poses, strict=True)]
        sights = [self._centre - pose.inverse.translation for pose in poses]
        sights = [sight / np.linalg.norm(sight) for sight in sights]
        alike = [(a, b) for a, b in permutations(range(len(drawn)), 2) if sights[a] @ sights[b] >= np.cos(LARGEST_TURN)]
        pairs = on_all_cores(lambda pair: self._compare(drawn, *pair), alike)
        return [pair for pair in pairs if pair is not None]

    def _draw(self, normalized: Image, pose: RigidTransform) -> _Drawn:
        local = pose.apply(self._nodes)
        pixels = self._camera.project(local)
        size = (self._camera.height, self._camera.width)
        buffers = rasterise(pixels, local[:, 2], self._triangles, *size)
        return _Drawn(normalized, pose, pixels, local[:, 2], buffers, _corners(normalized, buffers))

    def _compare(self, drawn: Sequence[_Drawn], a: int, b: int) -> PairDisplacements | None:
        """What the second view shows of the corners that the first one sees."""
        first, second = drawn[a], drawn[b]
        if not len(first.corners):
            return None
        points, rays, normals, along = self._on_surface(first)
        between = second.pose @ first.pose.inverse
        seen = between.apply(points)
        expected = self._camera.project(seen)
        kept = self._visible(second, expected, seen[:, 2])
        for corner, normal in ((points, normals), (seen, normals @ between.rotation.T)):
            cosine = np.abs(np.einsum("px,px->p", normal, corner)) / np.linalg.norm(corner, axis=1)
            kept &= cosine >= LEAST_COSINE
        if not kept.any():
            return None
        moves, found = self._displaced(first, second, expected[kept])
        rows = np.flatnonzero(kept)[found]
        # When the first camera moves, the point slides along its ray to stay on the surface.
        slide = np.einsum("px,py->pxy", rays[rows], normals[rows] / along[rows, None]) - np.eye(3)
        projected = self._camera.projection_jacobian(seen[rows])
        return PairDisplacements(
            a,
            b,
            first.pose.inverse.apply(points[rows]),
            moves[found],
            projected @ (between.rotation @ slide @ pose_jacobian(points[rows], first.pose)),
            projected @ pose_jacobian(seen[rows], second.pose),
            np.linalg.norm(np.einsum("pij,pj->pi", projected, rays[rows] @ between.rotation.T), axis=1),
            int(kept.sum()),
        )

    def _on_surface(self, drawn: _Drawn) -> tuple[Array, Array, Array, Array]:
        """Points (c, 3) of the corners on the mesh, their rays, normals, and how steeply these meet (c,)."""
        columns, rows = np.rint(drawn.corners).astype(int).T
        nodes = drawn.pose.apply(self._nodes[self._triangles[drawn.buffers.triangle_ids[rows, columns]]])
        normals = np.cross(nodes[:, 1] - nodes[:, 0], nodes[:, 2] - nodes[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        rays = self._camera.rays(drawn.corners)
        along = np.einsum("px,px->p", normals, rays)
        far = np.einsum("px,px->p", normals, nodes[:, 0]) / along
        return far[:, None] * rays, rays, normals, along

    def _visible(self, drawn: _Drawn, pixels: Array, depths: Array) -> NDArray[np.bool_]:
        """Which points, at pixels (p, 2) and depths (p,), are not occluded in a view."""
        columns, rows = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(int).T
        inside = (columns >= 0) & (columns < self._camera.width) & (rows >= 0) & (rows < self._camera.height)
        result = np.zeros(len(pixels), dtype=bool)
        behind = drawn.buffers.depth[rows[inside], columns[inside]]
        result[inside] = depths[inside] <= 1.01 * behind
        return result & (depths > 0.0)

    def _displaced(self, first: _Drawn, second: _Drawn, expected: Array) -> tuple[Array, NDArray[np.bool_]]:
        """How far (p, 2) from the expected pixels the second view shows what the first does; which are so."""
        carried, shown = np.zeros(first.normalized.shape, np.float32), np.zeros(first.normalized.shape, dtype=np.bool_)
        buffers, seen = second.buffers, first.buffers.depth
        carry(
            buffers.triangle_ids,
            buffers.weights,
            self._triangles,
            first.pixels,
            first.depths,
            seen,
            first.normalized,
            carried,
            shown,
        )
        moves, alike = align_patches(carried, shown, second.normalized, expected, WINDOW // 2)
        return moves, alike >= LEAST_CORRELATION


def _relief(measured: Sequence[PairDisplacements]) -> float:
    """As `Agreement.relief_px`."""
    places = np.concatenate([pair.places for pair in measured])
    off = places - places.mean(axis=0)
    _, vectors = np.linalg.eigh(off.T @ off)
    moved = (off @ vectors[:, 0]) * np.concatenate([pair.by_depth for pair in measured])
    return float(np.sqrt(np.mean(moved**2)))


def _corners(normalized: Image, buffers: Buffers) -> Array:
    """Corners (c, 2) of a view's image on the object, away from its rim."""
    mask = cv2.erode(buffers.covered.astype(np.uint8), np.ones((9, 9), np.uint8))
    corners = cv2.goodFeaturesToTrack(normalized, N_CORNERS, 0.01, 5.0, mask=mask)
    return np.empty((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)


#: A pixel is hidden in the first view if it lies behind what is seen there by this part of its depth.
HIDDEN_BY = 0.01
#: Iterations of an alignment, the step at which it ends, and the farthest that a patch may go, pixels.
ITERATIONS, LAST_STEP, FARTHEST = 25, 2e-3, 8.0
#: At least this part of a patch must be seen in both views, and the gradients must be so different (the
#: determinant of their squares over the trace's square).
LEAST_SHARE, LEAST_STRUCTURE = 0.4, 1e-3


@njit(cache=True, nogil=True)
def _cubic(t, weights):
    """Catmull-Rom weights (4,) of the pixels around a place that is ``t`` beyond the second one."""
    weights[0] = t * (-0.5 + t * (1.0 - 0.5 * t))
    weights[1] = 1.0 + t * t * (1.5 * t - 2.5)
    weights[2] = t * (0.5 + t * (2.0 - 1.5 * t))
    weights[3] = t * t * (0.5 * t - 0.5)


@njit(cache=True, nogil=True)
def _sample(image, x, y, across, along):
    """Grey level at a place at least one pixel inside; ``across``, ``along`` (4,) are scratch."""
    x0, y0 = int(x), int(y)
    _cubic(x - x0, across)
    _cubic(y - y0, along)
    value = 0.0
    for j in range(4):
        line = 0.0
        for i in range(4):
            line += across[i] * image[y0 - 1 + j, x0 - 1 + i]
        value += along[j] * line
    return value


@njit(cache=True, nogil=True)
def carry(triangle_ids, weights, triangles, coordinates, depths, depth, image, carried, shown):
    """Fill ``carried`` (h, w), and ``shown`` where the second view's pixels are seen in the first.

    Parameters
    ----------
    triangle_ids : (h, w) of the second view's buffers.
    weights : (h, w, 3) likewise.
    triangles : (m, 3) node indices.
    coordinates : (n, 2) pixels of the nodes in the first view.
    depths : (n,) of the nodes there.
    depth : (h, w) of the first view.
    image : (h, w) of the first view.
    carried : (h, w) float32.
    shown : (h, w) bool.
    """
    height, width = triangle_ids.shape
    across, along = np.empty(4), np.empty(4)
    for row in range(height):
        for column in range(width):
            shown[row, column] = False
            t = triangle_ids[row, column]
            if t < 0:
                continue
            x, y, z = 0.0, 0.0, 0.0
            for corner in range(3):
                node = triangles[t, corner]
                weight = weights[row, column, corner] * depths[node]
                x += weight * coordinates[node, 0]
                y += weight * coordinates[node, 1]
                z += weight
            if not z > 0.0:
                continue
            # Pixels of the first view are projective on a triangle, not linear: they count by their depths there.
            x, y = x / z, y / z
            x0, y0 = int(np.floor(x)), int(np.floor(y))
            if x0 < 1 or y0 < 1 or x0 + 2 >= width or y0 + 2 >= height:
                continue
            near = min(depth[y0, x0], depth[y0, x0 + 1], depth[y0 + 1, x0], depth[y0 + 1, x0 + 1])
            far = max(depth[y0, x0], depth[y0, x0 + 1], depth[y0 + 1, x0], depth[y0 + 1, x0 + 1])
            if z > near * (1.0 + HIDDEN_BY) or z < far * (1.0 - HIDDEN_BY):
                continue
            carried[row, column] = _sample(image, x, y, across, along)
            shown[row, column] = True


@njit(cache=True, nogil=True)
def _patch(carried, shown, column, row, half, xs, ys, values, slopes):
    """Pixels of a patch that are shown with their neighbours, their values and gradients; how many."""
    height, width = carried.shape
    count = 0
    for y in range(max(row - half, 1), min(row + half + 1, height - 1)):
        for x in range(max(column - half, 1), min(column + half + 1, width - 1)):
            inner = shown[y, x] and shown[y, x - 1] and shown[y, x + 1] and shown[y - 1, x]
            if not (inner and shown[y + 1, x]):
                continue
            xs[count], ys[count], values[count] = x, y, carried[y, x]
            slopes[count, 0] = 0.5 * (carried[y, x + 1] - carried[y, x - 1])
            slopes[count, 1] = 0.5 * (carried[y + 1, x] - carried[y - 1, x])
            count += 1
    return count


@njit(cache=True, nogil=True)
def _sample_patch(image, xs, ys, x, y, count, lines, seen):
    """Grey levels of a displaced patch into ``seen``; whether all of it is inside the image.

    All pixels are displaced by the same part of a pixel: the rows are interpolated once, into the scratch ``lines``.
    """
    height, width = image.shape
    left, right, top, bottom = xs[0], xs[0], ys[0], ys[count - 1]
    for i in range(1, count):
        left, right = min(left, xs[i]), max(right, xs[i])
    if left + x < 1.0 or top + y < 1.0 or right + x >= width - 2 or bottom + y >= height - 2:
        return False
    x0, y0, wide = int(np.floor(x)), int(np.floor(y)), right - left + 1
    across, along = np.empty(4), np.empty(4)
    _cubic(x - x0, across)
    _cubic(y - y0, along)
    for row in range(bottom - top + 4):
        # Slices, whose indices begin at zero, are what the compiler vectorizes.
        pixels, line = image[top + y0 - 1 + row, left + x0 - 1 : right + x0 + 3], lines[row]
        for k in range(wide):
            first, second = across[0] * pixels[k], across[1] * pixels[k + 1]
            line[k] = first + second + across[2] * pixels[k + 2] + across[3] * pixels[k + 3]
    for i in range(count):
        row, column = ys[i] - top, xs[i] - left
        value = 0.0
        for j in range(4):
            value += along[j] * lines[row + j, column]
        seen[i] = value
    return True


@njit(cache=True, nogil=True)
def _align(image, xs, ys, values, slopes, count, lines, seen):
    """Displacement and correlation of one patch, whose values and slopes have no mean."""
    a = b = c = power = 0.0
    for i in range(count):
        a += slopes[i, 0] * slopes[i, 0]
        b += slopes[i, 0] * slopes[i, 1]
        c += slopes[i, 1] * slopes[i, 1]
        power += values[i] * values[i]
    determinant = a * c - b * b
    if determinant <= LEAST_STRUCTURE * (a + c) ** 2 or power == 0.0:
        return 0.0, 0.0, -1.0
    x = y = 0.0
    for _ in range(ITERATIONS):
        if not _sample_patch(image, xs, ys, x, y, count, lines, seen):
            break
        mean = both = own = 0.0
        for i in range(count):
            mean += seen[i]
        mean /= count
        for i in range(count):
            both += values[i] * (seen[i] - mean)
            own += (seen[i] - mean) ** 2
        if both <= 0.0 or own == 0.0:
            break
        e = f = 0.0
        for i in range(count):
            left = values[i] - power / both * (seen[i] - mean)
            e += slopes[i, 0] * left
            f += slopes[i, 1] * left
        step_x, step_y = (c * e - b * f) / determinant, (a * f - b * e) / determinant
        x, y = x + step_x, y + step_y
        if max(abs(x), abs(y)) > FARTHEST:
            break
        if max(abs(step_x), abs(step_y)) < LAST_STEP:
            return x, y, both / np.sqrt(power * own)
    return x, y, -1.0


@njit(cache=True, nogil=True)
def align_patches(carried, shown, image, centres, half):
    """Displacements of patches from a carried image to the second view's own one, compiled.

    Gauss-Newton on the grey levels, whose mean and contrast are free (Evangelidis and Psarakis, Parametric
    image alignment using enhanced correlation coefficient maximization, 2008), over the shown pixels.

    Parameters
    ----------
    carried : (h, w) of `carry`.
    shown : (h, w) of `carry`.
    image : (h, w) the second view.
    centres : (p, 2) pixels.
    half : patches are 2 half + 1 pixels wide.

    Returns
    -------
    (p, 2) displacements, and (p,) the correlations there; -1 where nothing could be measured.
    """
    side = (2 * half + 1) ** 2
    moves, alike = np.zeros((len(centres), 2)), np.full(len(centres), -1.0)
    xs, ys, values = np.empty(side, np.int64), np.empty(side, np.int64), np.empty(side)
    slopes, lines, seen = np.empty((side, 2)), np.empty((2 * half + 4, 2 * half + 1)), np.empty(side)
    for p in range(len(centres)):
        column, row = int(np.rint(centres[p, 0])), int(np.rint(centres[p, 1]))
        count = _patch(carried, shown, column, row, half, xs, ys, values, slopes)
        if count < LEAST_SHARE * side:
            continue
        mean = mean_x = mean_y = 0.0
        for i in range(count):
            mean, mean_x, mean_y = mean + values[i], mean_x + slopes[i, 0], mean_y + slopes[i, 1]
        for i in range(count):
            values[i] -= mean / count
            slopes[i, 0] -= mean_x / count
            slopes[i, 1] -= mean_y / count
        moves[p, 0], moves[p, 1], alike[p] = _align(image, xs, ys, values, slopes, count, lines, seen)
    return moves, alike
