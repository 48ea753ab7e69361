"""Refining a registration by images: what one keyframe sees on the surface, the others must see there too.

A keyframe's image is laid on the mesh and rendered into another view. Where the surface is not where it
should be, the rendering is displaced along the line on which that view sees the first one's rays. The
displacements, measured by Lucas-Kanade to a fraction of a pixel, say how far the surface has to move along
its normals: the linear equations of point-to-plane ICP, from thousands of pixels in place of the map's few
points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.geometry import rotation_exp
from morph_dslam.online.flow import NEUTRAL, FlowOptions, follow, patch_correlation
from morph_dslam.online.mesh_registration.scene import View, spread_views
from morph_dslam.render.rasteriser import Buffers, rasterise
from morph_dslam.render.texture import render_textured
from morph_dslam.similarity import SimilarityTransform

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

ITERATIONS = 6
#: Keyframes used, spread over all; views between which the object turns by more than this are not compared.
MOST_VIEWS, LARGEST_TURN = 8, np.radians(35.0)
#: Points of each view, and the least cosine between the surface's normal and the sight lines.
N_CORNERS, LEAST_COSINE = 150, 0.3
FLOW = FlowOptions(window=17, levels=2)
LEAST_CORRELATION, HALF_PATCH = 0.8, 6
#: Displacements that differ more from the fit count less (Huber), pixels.
HUBER_PX = 0.5
#: Fewer measurements are no evidence.
FEWEST = 60


@dataclass(frozen=True)
class Alignment:
    """A refined registration.

    Attributes
    ----------
    covariance : (7, 7) of log scale, rotation vector and translation about the mean node, world.
    rms_px : root mean square misfit. count : measurements.
    """

    world_from_object: SimilarityTransform
    covariance: Array
    rms_px: float
    count: int


@dataclass(frozen=True)
class _Drawn:
    """The mesh in one view: its projected nodes (n, 2), what every pixel sees, and corners (c, 2) on it."""

    view: View
    pixels: Array
    buffers: Buffers
    corners: Array


@dataclass(frozen=True)
class _Measured:
    """Displacements between two views.

    Attributes
    ----------
    points, normals : (p, 3) on the surface, world. offsets : (p,) pixels along the line of motion.
    gains : (p,) pixels that the point moves when the surface moves by a unit along its normal.
    """

    points: Array
    normals: Array
    offsets: Array
    gains: Array


class TextureAlignment:
    """Compares views of one object.

    Parameters
    ----------
    nodes : (n, 3) of the undeformed mesh, metres. triangles : (m, 3). camera : without distortion.
    views : keyframes that see the object. metric : keep the scale.
    """

    def __init__(
        self,
        nodes: Array,
        triangles: NDArray[np.int64],
        camera: PinholeCamera,
        views: Sequence[View],
        metric: bool = False,
    ) -> None:
        self._nodes, self._triangles, self._camera = nodes, triangles, camera
        self._centre, self._first_free = nodes.mean(axis=0), 1 if metric else 0
        self._views = spread_views(views, MOST_VIEWS)

    def refine(self, start: SimilarityTransform) -> Alignment | None:
        """The similarity near ``start`` with which all views agree; None where too little can be compared."""
        transform, result = start, None
        for _ in range(ITERATIONS):
            measured = self._measure(transform)
            if measured is None or len(measured.offsets) < FEWEST:
                return None
            step, covariance, rms = self._solve(measured, transform.apply(self._centre))
            centre = transform.apply(self._centre) + step[4:]
            scale = transform.scale * float(np.exp(step[0]))
            rotation = rotation_exp(step[1:4]) @ transform.rotation
            transform = SimilarityTransform(scale, rotation, centre - scale * rotation @ self._centre)
            result = Alignment(transform, covariance, rms, len(measured.offsets))
        return result

    def _solve(self, measured: _Measured, centre: Array) -> tuple[Array, Array, float]:
        """The step (7,), its covariance (7, 7), and the root mean square misfit in pixels."""
        arms, normals = measured.points - centre, measured.normals
        rows = np.column_stack([np.einsum("px,px->p", arms, normals), np.cross(arms, normals), normals])
        # Unknowns in comparable units, of which those that the images leave open stay as they are.
        units = np.array([1.0 / np.sqrt(np.mean(np.sum(arms**2, axis=1)))] * 4 + [1.0] * 3)
        rows = rows * measured.gains[:, None] * units
        free = slice(self._first_free, 7)
        step, covariance = np.zeros(7), np.zeros((7, 7))
        misfit, weights = measured.offsets, np.ones(len(rows))
        for _ in range(10):
            weights = HUBER_PX / np.maximum(np.abs(misfit), HUBER_PX)
            matrix = (rows * weights[:, None]).T @ rows
            inverse = np.linalg.pinv(matrix[free, free], rcond=1e-5, hermitian=True)
            step[free] = inverse @ (rows.T @ (weights * measured.offsets))[free]
            misfit = measured.offsets - rows @ step
        rms = float(np.sqrt(np.average(misfit**2, weights=weights)))
        covariance[free, free] = rms**2 * inverse
        return step * units, covariance * units * units[:, None], rms

    def _measure(self, transform: SimilarityTransform) -> _Measured | None:
        world = transform.apply(self._nodes)
        drawn = [self._draw(view, world) for view in self._views]
        middle = transform.apply(self._centre)
        sights = [middle - view.camera_from_world.inverse.translation for view in self._views]
        sights = [sight / np.linalg.norm(sight) for sight in sights]
        parts = [
            self._compare(drawn[a], drawn[b], world)
            for a, b in permutations(range(len(drawn)), 2)
            if sights[a] @ sights[b] >= np.cos(LARGEST_TURN)
        ]
        parts = [part for part in parts if part is not None]
        if not parts:
            return None
        return _Measured(
            np.concatenate([part.points for part in parts]),
            np.concatenate([part.normals for part in parts]),
            np.concatenate([part.offsets for part in parts]),
            np.concatenate([part.gains for part in parts]),
        )

    def _draw(self, view: View, world: Array) -> _Drawn:
        local = view.camera_from_world.apply(world)
        pixels = self._camera.project(local)
        size = (self._camera.height, self._camera.width)
        buffers = rasterise(pixels, local[:, 2], self._triangles, *size)
        return _Drawn(view, pixels, buffers, _corners(view.flat, buffers))

    def _compare(self, first: _Drawn, second: _Drawn, world: Array) -> _Measured | None:
        """Displacements in the second view of points that the first one sees."""
        corners = first.corners
        if not len(corners):
            return None
        columns, rows = np.rint(corners).astype(int).T
        nodes = world[self._triangles[first.buffers.triangle_ids[rows, columns]]]
        normals = np.cross(nodes[:, 1] - nodes[:, 0], nodes[:, 2] - nodes[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        world_from_first = first.view.camera_from_world.inverse
        rays = self._camera.rays(corners) @ world_from_first.rotation.T
        along = np.einsum("px,px->p", normals, rays)
        far = np.einsum("px,px->p", normals, nodes[:, 0] - world_from_first.translation) / along
        points = world_from_first.translation + far[:, None] * rays
        local = second.view.camera_from_world.apply(points)
        expected = self._camera.project(local)
        kept = self._seen(second, expected, local[:, 2])
        for eye in (world_from_first.translation, second.view.camera_from_world.inverse.translation):
            sight = points - eye
            cosine = np.abs(np.einsum("px,px->p", normals, sight)) / np.linalg.norm(sight, axis=1)
            kept &= cosine >= LEAST_COSINE
        if not kept.any():
            return None
        # How the expected pixel moves when the surface moves along its normal, and the ray's end with it.
        slopes = np.einsum(
            "pix,px->pi",
            self._camera.projection_jacobian(local[kept]),
            (rays[kept] / along[kept, None]) @ second.view.camera_from_world.rotation.T,
        )
        gains = np.linalg.norm(slopes, axis=1)
        moved, found = self._displaced(first, second, expected[kept])
        found &= gains > 0.0
        offsets = np.einsum("pi,pi->p", moved - expected[kept], slopes)[found] / gains[found]
        return _Measured(points[kept][found], normals[kept][found], offsets, gains[found])

    def _seen(self, drawn: _Drawn, pixels: Array, depths: Array) -> NDArray[np.bool_]:
        """Which points, at pixels (p, 2) and depths (p,), nothing hides in a view."""
        columns, rows = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(int).T
        inside = (columns >= 0) & (columns < self._camera.width) & (rows >= 0) & (rows < self._camera.height)
        result = np.zeros(len(pixels), dtype=bool)
        behind = drawn.buffers.depth[rows[inside], columns[inside]]
        result[inside] = depths[inside] <= 1.01 * behind
        return result & (depths > 0.0)

    def _displaced(self, first: _Drawn, second: _Drawn, expected: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Where the second image has what the first one shows at the expected pixels; which were found."""
        textured = render_textured(second.buffers, self._triangles, first.pixels, first.view.flat)
        rendering = np.where(second.buffers.covered, textured, np.uint8(NEUTRAL)).astype(np.uint8)
        moved, found = follow(rendering, second.view.flat, expected, expected, FLOW)
        alike = patch_correlation(rendering, second.view.flat, expected, moved, HALF_PATCH)
        return moved, found & (alike >= LEAST_CORRELATION)


def _corners(flat: Image, buffers: Buffers) -> Array:
    """Corners (c, 2) of a view's image on the object, away from its rim."""
    mask = cv2.erode(buffers.covered.astype(np.uint8), np.ones((9, 9), np.uint8))
    corners = cv2.goodFeaturesToTrack(flat, N_CORNERS, 0.01, 5.0, mask=mask)
    return np.empty((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)
