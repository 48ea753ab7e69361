"""The object's outline in the image: evidence where the surface has no texture, out to its very edge.

Points on the rim of the surface are searched for along the outline's normal, as in Drummond and Cipolla's
edge tracking (PAMI 24, 2002). An outline point may slide along the outline, so it counts only across it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.model import ReducedModel, SurfacePoints
from morph_dslam.tracking.estimator import BoundPoints, State

Array = NDArray[np.float64]
#: Points on the rim, evenly spread.
N_POINTS = 120
#: How far the outline is searched for to either side of where the estimate shows it, pixels.
REACH_PX = 14
#: Pixels averaged on each side of a candidate.
SIDE_PX = 4
#: Grey levels by which the two sides must differ.
LEAST_CONTRAST = 10.0
#: Largest difference of the inner side from its brightness in the reference view, relative to that; shading
#: changes it as the surface bends.
BRIGHTNESS_TOLERANCE = 0.35
#: Weight of an outline point relative to a texture point: it gives one number, not two, and stands for all of
#: the bare margin behind it.
OUTLINE_WEIGHT = 2.0


@dataclass(frozen=True)
class OutlineMeasurement:
    """Where the outline was found.

    Attributes
    ----------
    pixels : (p, 2) on the outline, each on the normal of its point
    normals : (p, 2) outwards.
    valid : (p,) which were found.
    """

    pixels: Array
    normals: Array
    valid: NDArray[np.bool_]


def rim(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Edges (k, 2) that only one triangle has, each with the surface on its left."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    return edges[first[count == 1]]


class Outline:
    """The rim of a model's surface and what lies inside it in the reference view.

    Parameters
    ----------
    grey : (h, w) undistorted reference image
    state : the object in it.
    """

    def __init__(self, model: ReducedModel, camera: Camera, grey: NDArray[np.uint8], state: State) -> None:
        self._camera = camera
        edges = _spread(model.nodes, rim(model.triangles), N_POINTS)
        self.points = BoundPoints.from_surface(model, _on_edges(model.triangles, edges))
        # The direction along the rim comes from the edge's own ends; evaluated with the points at once.
        ends = [BoundPoints.from_surface(model, _at_nodes(model.triangles, edges[:, k])) for k in range(2)]
        self._with_ends = self.points.joined(ends[0]).joined(ends[1])
        pixels, normals = self._predict(state)
        self._brightness = _inner_brightness(grey, pixels, normals)

    def _predict(self, state: State) -> tuple[Array, Array]:
        """Pixels (p, 2) of the rim points and outward normals (p, 2); NaN behind the camera."""
        seen = self._camera.project(self._with_ends.in_camera(state))
        pixels, start, end = seen.reshape(3, -1, 2)
        along = end - start
        length = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
        normals = np.column_stack([along[:, 1], -along[:, 0]]) / length[:, None]
        # The image's y axis points down, so whether the surface lies left or right depends on the side seen.
        centre = np.nanmean(pixels, axis=0)
        outward = np.nansum(normals * (pixels - centre)) >= 0.0
        return pixels, normals if outward else -normals

    def measure(self, grey: NDArray[np.uint8], state: State, reach: int) -> OutlineMeasurement:
        """Search for the outline around where ``state`` shows it.

        Parameters
        ----------
        grey : (h, w) undistorted image
        reach : how far to search to either side, pixels.
        """
        pixels, normals = self._predict(state)
        offsets = search_outline(
            grey, pixels, normals, self._brightness, reach, SIDE_PX, LEAST_CONTRAST, BRIGHTNESS_TOLERANCE
        )
        valid = np.isfinite(offsets)
        moved = pixels + np.where(valid, offsets, 0.0)[:, None] * normals
        return OutlineMeasurement(np.nan_to_num(moved), np.nan_to_num(normals), valid)


def _spread(nodes: Array, edges: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """About ``count`` of the edges, evenly spread in number along the rim."""
    step = max(1, round(len(edges) / count))
    middles = nodes[edges].mean(axis=1)
    angle = np.arctan2(middles[:, 1] - nodes[:, 1].mean(), middles[:, 0] - nodes[:, 0].mean())
    return edges[np.argsort(angle)][::step]


def _on_edges(triangles: NDArray[np.int64], edges: NDArray[np.int64]) -> SurfacePoints:
    """The middles of edges, as surface points."""
    start, end = (_at_nodes(triangles, edges[:, 0], edges[:, 1]), _at_nodes(triangles, edges[:, 1], edges[:, 0]))
    return SurfacePoints(start.triangles, 0.5 * (start.weights + end.weights))


def _at_nodes(
    triangles: NDArray[np.int64], nodes: NDArray[np.int64], partners: NDArray[np.int64] | None = None
) -> SurfacePoints:
    """Nodes as surface points, on a triangle that has the partner node too."""
    chosen, weights = np.zeros(len(nodes), dtype=np.int64), np.zeros((len(nodes), 3))
    for row, node in enumerate(nodes):
        has = (triangles == node).any(axis=1)
        if partners is not None:
            has &= (triangles == partners[row]).any(axis=1)
        chosen[row] = np.flatnonzero(has)[0]
        weights[row] = triangles[chosen[row]] == node
    return SurfacePoints(chosen, weights)


def _inner_brightness(grey: NDArray[np.uint8], pixels: Array, normals: Array) -> Array:
    """Mean grey (p,) of the `SIDE_PX` pixels just inside each rim point; NaN outside the image."""
    height, width = grey.shape
    total = np.zeros(len(pixels))
    for depth in range(2, SIDE_PX + 2):
        x, y = np.round(pixels - depth * normals).T
        with np.errstate(invalid="ignore"):
            inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        values = grey[np.where(inside, y, 0).astype(int), np.where(inside, x, 0).astype(int)].astype(float)
        total += np.where(inside, values, np.nan)
    return total / SIDE_PX


@njit(cache=True, nogil=True)
def search_outline(grey, pixels, normals, brightness, reach, side, least_contrast, tolerance):
    """Signed distances (p,) along the normals to the strongest step whose inner side looks right, or NaN.

    A candidate's inner side must be as bright as in the reference view within the tolerance, the contrast of
    its two sides is its score, and the step is refined to a fraction of a pixel by the parabola through the
    scores beside it.
    """
    height, width = grey.shape
    length = 2 * (reach + side) + 1
    profile = np.empty(length)
    scores = np.empty(2 * reach + 1)
    result = np.full(len(pixels), np.nan)
    for j in range(len(pixels)):
        if not (np.isfinite(pixels[j, 0]) and np.isfinite(brightness[j])):
            continue
        inside = True
        for k in range(length):
            x = pixels[j, 0] + (k - reach - side) * normals[j, 0]
            y = pixels[j, 1] + (k - reach - side) * normals[j, 1]
            if x < 0.0 or y < 0.0 or x >= width - 1 or y >= height - 1:
                inside = False
                break
            x0, y0 = int(x), int(y)
            a, b = x - x0, y - y0
            above = (1.0 - a) * grey[y0, x0] + a * grey[y0, x0 + 1]
            below = (1.0 - a) * grey[y0 + 1, x0] + a * grey[y0 + 1, x0 + 1]
            profile[k] = (1.0 - b) * above + b * below
        if not inside:
            continue
        best = -1
        for k in range(2 * reach + 1):
            inner, outer = 0.0, 0.0
            for i in range(1, side + 1):
                inner += profile[k + side - i]
                outer += profile[k + side + i]
            inner, outer = inner / side, outer / side
            scores[k] = abs(inner - outer)
            if abs(inner - brightness[j]) > tolerance * brightness[j]:
                scores[k] = 0.0
            if scores[k] > least_contrast and (best < 0 or scores[k] > scores[best]):
                best = k
        if best <= 0 or best >= 2 * reach:
            continue
        bend = scores[best - 1] - 2.0 * scores[best] + scores[best + 1]
        shift = 0.5 * (scores[best - 1] - scores[best + 1]) / bend if bend < 0.0 else 0.0
        result[j] = best - reach + min(max(shift, -0.5), 0.5)
    return result
