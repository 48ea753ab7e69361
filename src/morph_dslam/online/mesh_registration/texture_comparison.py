"""Comparing keyframes on a mesh: what one image shows on the surface, the others must show there too.

A keyframe's image is laid on the mesh and rendered into another view. Where surface and cameras are not where
they should be, the rendering is displaced; Lucas-Kanade measures by how much, to a fraction of a pixel, at
hundreds of points of each pair of views. Each displacement depends on the two poses alone, because a point is
where the first view's ray meets the mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.online.mesh_registration.patch_alignment import align_patches, carry
from morph_dslam.render.rasteriser import Buffers, rasterise

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

#: Views between which the object turns by more than this are not compared.
LARGEST_TURN = np.radians(35.0)
#: Points of each view, and the least cosine between the surface's normal and the sight lines.
N_CORNERS, LEAST_COSINE = 150, 0.3
#: Side of the patches compared, pixels, and their least correlation.
WINDOW, LEAST_CORRELATION = 17, 0.8


@dataclass(frozen=True)
class PairDisplacements:
    """How two views differ on the mesh.

    Attributes
    ----------
    first, second : numbers of the views. places : (p, 3) points on the surface, object frame, metres.
    offsets : (p, 2) from where the second view should show the points to where it does, pixels.
    by_first, by_second : (p, 2, 6) how the expected pixel moves with each pose (`pose_jacobian`).
    """

    first: int
    second: int
    places: Array
    offsets: Array
    by_first: Array
    by_second: Array


@dataclass(frozen=True)
class _Drawn:
    """The mesh in one view: projected nodes (n, 2), depths (n,), all pixels, and corners (c, 2) on it."""

    flat: Image
    pose: RigidTransform
    pixels: Array
    depths: Array
    buffers: Buffers
    corners: Array


def pose_jacobian(points: Array, pose: RigidTransform) -> Array:
    """How points (p, 3) in the camera frame move with the pose, (p, 3, 6).

    The pose's increment is that of `online.state.moved`: a rotation vector, by which the object turns about
    its origin as the camera's axes stand, and a difference of translation.
    """
    x, y, z = (points - pose.translation).T
    zero, one = np.zeros(len(points)), np.ones(len(points))
    return np.stack(
        [
            np.column_stack([zero, z, -y, one, zero, zero]),
            np.column_stack([-z, zero, x, zero, one, zero]),
            np.column_stack([y, -x, zero, zero, zero, one]),
        ],
        axis=1,
    )


def moved_pose(pose: RigidTransform, step: Array) -> RigidTransform:
    """The pose after such an increment (6,)."""
    return RigidTransform(rotation_exp(step[:3]) @ pose.rotation, pose.translation + step[3:])


class TextureComparison:
    """Compares images of one mesh.

    Parameters
    ----------
    nodes : (n, 3) of the undeformed mesh, metres. triangles : (m, 3). camera : without distortion.
    """

    def __init__(self, nodes: Array, triangles: NDArray[np.int64], camera: PinholeCamera) -> None:
        self._nodes, self._triangles, self._camera = nodes, triangles, camera
        self._centre = nodes.mean(axis=0)

    def measure(self, images: Sequence[Image], poses: Sequence[RigidTransform]) -> list[PairDisplacements]:
        """Displacements between all views from not too different sides.

        Parameters
        ----------
        images : (h, w) flattened. poses : camera_from_object of each, metres.
        """
        drawn = [self._draw(image, pose) for image, pose in zip(images, poses, strict=True)]
        sights = [self._centre - pose.inverse.translation for pose in poses]
        sights = [sight / np.linalg.norm(sight) for sight in sights]
        pairs = [
            self._compare(drawn, a, b)
            for a, b in permutations(range(len(drawn)), 2)
            if sights[a] @ sights[b] >= np.cos(LARGEST_TURN)
        ]
        return [pair for pair in pairs if pair is not None]

    def _draw(self, flat: Image, pose: RigidTransform) -> _Drawn:
        local = pose.apply(self._nodes)
        pixels = self._camera.project(local)
        size = (self._camera.height, self._camera.width)
        buffers = rasterise(pixels, local[:, 2], self._triangles, *size)
        return _Drawn(flat, pose, pixels, local[:, 2], buffers, _corners(flat, buffers))

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
        """Which points, at pixels (p, 2) and depths (p,), nothing hides in a view."""
        columns, rows = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(int).T
        inside = (columns >= 0) & (columns < self._camera.width) & (rows >= 0) & (rows < self._camera.height)
        result = np.zeros(len(pixels), dtype=bool)
        behind = drawn.buffers.depth[rows[inside], columns[inside]]
        result[inside] = depths[inside] <= 1.01 * behind
        return result & (depths > 0.0)

    def _displaced(self, first: _Drawn, second: _Drawn, expected: Array) -> tuple[Array, NDArray[np.bool_]]:
        """How far (p, 2) from the expected pixels the second view shows what the first does; which are so."""
        carried, shown = np.zeros(first.flat.shape, np.float32), np.zeros(first.flat.shape, dtype=np.bool_)
        buffers, seen = second.buffers, first.buffers.depth
        carry(
            buffers.triangle_ids,
            buffers.weights,
            self._triangles,
            first.pixels,
            first.depths,
            seen,
            first.flat,
            carried,
            shown,
        )
        moves, alike = align_patches(carried, shown, second.flat, expected, WINDOW // 2)
        return moves, alike >= LEAST_CORRELATION


def _corners(flat: Image, buffers: Buffers) -> Array:
    """Corners (c, 2) of a view's image on the object, away from its rim."""
    mask = cv2.erode(buffers.covered.astype(np.uint8), np.ones((9, 9), np.uint8))
    corners = cv2.goodFeaturesToTrack(flat, N_CORNERS, 0.01, 5.0, mask=mask)
    return np.empty((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)
