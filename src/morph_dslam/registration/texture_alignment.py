"""Refining a registration by images: the similarity with which all keyframes agree on the object's texture.

The displacements between the keyframes on the mesh (`texture_comparison`) say how far the surface has to
move, the cameras being where the map has them: the linear equations of point-to-plane ICP, from thousands of
pixels in place of the map's few points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, SimilarityTransform, rotation_exp
from morph_dslam.registration.scene import View, camera_from_object, views_of
from morph_dslam.registration.texture import PairDisplacements, TextureComparison

Array = NDArray[np.float64]

TEXTURE_ITERATIONS = 6

#: Keyframes used, spread over all that see the object.
MOST_VIEWS = 8

#: Displacements that differ more from the fit count less (Huber), pixels.
HUBER_PX = 0.5

#: Fewer measurements are no evidence.
FEWEST = 60


@dataclass(frozen=True)
class Alignment:
    """A refined registration.

    Attributes
    ----------
    rms_px : root mean square misfit of a pixel coordinate. count : measurements.
    """

    world_from_object: SimilarityTransform
    rms_px: float
    count: int


class TextureAlignment:
    """Compares views of one object.

    Parameters
    ----------
    nodes : (n, 3) of the undeformed mesh, metres. triangles : (m, 3). camera : without distortion.
    views : keyframes of the map. metric : keep the scale.
    """

    def __init__(
        self, nodes: Array, triangles: NDArray[np.int64], camera: Camera, views: Sequence[View], metric: bool = False
    ) -> None:
        self._comparison = TextureComparison(nodes, triangles, camera)
        self._nodes, self._camera, self._views = nodes, camera, views
        self._centre, self._first_free = nodes.mean(axis=0), 1 if metric else 0

    def refine(self, start: SimilarityTransform) -> Alignment | None:
        """The similarity near ``start`` with which all views agree; None where too little can be compared."""
        views = views_of(self._nodes, start, self._views, self._camera, MOST_VIEWS)
        images, transform, result = [view.normalized for view in views], start, None
        for _ in range(TEXTURE_ITERATIONS):
            poses = [camera_from_object(view, transform) for view in views]
            measured = self._comparison.measure(images, poses)
            count = sum(len(pair.offsets) for pair in measured)
            if count < FEWEST:
                return None
            step, rms = self._solve(measured, poses, transform)
            transform = moved_similarity(transform, step, self._centre)
            result = Alignment(transform, rms, count)
        return result

    def _solve(
        self, measured: list[PairDisplacements], poses: list[RigidTransform], transform: SimilarityTransform
    ) -> tuple[Array, float]:
        """The step (7,), and the root mean square misfit in pixels."""
        slopes = [similarity_jacobian(pose, transform, self._centre) for pose in poses]
        rows = np.concatenate(
            [pair.by_first @ slopes[pair.first] + pair.by_second @ slopes[pair.second] for pair in measured]
        )
        offsets = np.concatenate([pair.offsets for pair in measured])
        # Unknowns in comparable units, of which those that the images leave open stay as they are.
        size = transform.scale * float(np.sqrt(np.mean(np.sum((self._nodes - self._centre) ** 2, axis=1))))
        units, free = np.array([1.0 / size] * 4 + [1.0] * 3), slice(self._first_free, 7)
        rows = rows * units
        step, misfit, weights = np.zeros(7), offsets, np.ones(len(rows))
        for _ in range(10):
            weights = HUBER_PX / np.maximum(np.linalg.norm(misfit, axis=1), HUBER_PX)
            matrix = np.einsum("pij,p,pik->jk", rows, weights, rows, optimize=True)
            right = np.einsum("pij,p,pi->j", rows, weights, offsets, optimize=True)
            inverse = np.linalg.pinv(matrix[free, free], rcond=1e-5, hermitian=True)
            step[free] = inverse @ right[free]
            misfit = offsets - rows @ step
        mean_square = np.average(np.mean(misfit**2, axis=1), weights=weights)
        return step * units, float(np.sqrt(mean_square))


def moved_similarity(transform: SimilarityTransform, step: Array, centre: Array) -> SimilarityTransform:
    """A world_from_object moved by log scale, rotation vector, translation (7,) about ``centre``, world."""
    scale = transform.scale * float(np.exp(step[0]))
    rotation = rotation_exp(step[1:4]) @ transform.rotation
    place = transform.apply(centre) + step[4:]
    return SimilarityTransform(scale, rotation, place - scale * rotation @ centre)


def similarity_jacobian(pose: RigidTransform, transform: SimilarityTransform, centre: Array) -> Array:
    """How a view's camera_from_object, metres, moves with the similarity, (6, 7).

    Of the increments of `texture_comparison.pose_jacobian` and of `moved_similarity`: where the object grows
    in the map, the camera comes nearer to it in metres.
    """
    camera_from_world = pose.rotation @ transform.rotation.T
    middle = pose.apply(centre)
    arm = pose.translation - middle
    across = np.array([[0.0, arm[2], -arm[1]], [-arm[2], 0.0, arm[0]], [arm[1], -arm[0], 0.0]])
    result = np.zeros((6, 7))
    result[3:, 0] = -middle
    result[:3, 1:4], result[3:, 1:4] = camera_from_world, across @ camera_from_world
    result[3:, 4:] = camera_from_world / transform.scale
    return result
