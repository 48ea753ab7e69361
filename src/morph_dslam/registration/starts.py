"""Shapes and poses from which the state of an object is searched."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import ReducedModel
from morph_dslam.tracking.rig import PointsEstimator
from morph_dslam.tracking.state import BoundPoints, State

Array = NDArray[np.float64]


def shape_starts(model: ReducedModel, largest: int = 243) -> list[Array]:
    """Parameters (d,) to start from: the default, then a coarse grid over the box.

    Each range is cut at 1/6, 1/2 and 5/6; when that makes more than ``largest`` shapes, one parameter at a
    time leaves its default. Unknown loads are zero in all of them.
    """
    if model.n_loads:
        none = np.zeros(model.n_loads)
        return [np.concatenate([shape, none]) for shape in shape_starts(model.without_loads, largest)]
    shares = (1 / 6, 1 / 2, 5 / 6)
    lower, upper, default = model.lower, model.upper, model.default
    d = len(lower)
    if len(shares) ** d < largest + 1:
        grid = [lower + np.array(choice) * (upper - lower) for choice in product(shares, repeat=d)]
    else:
        grid = []
        for k, share in product(range(d), (shares[0], shares[-1])):
            shape = default.copy()
            shape[k] = lower[k] + share * (upper[k] - lower[k])
            grid.append(shape)
    return [default, *grid]


def pose_starts(
    shapes: Sequence[Array], estimator: PointsEstimator, bound: BoundPoints, pixels: Array
) -> Iterator[State]:
    """PnP poses of every start shape, by the camera that saw most of the points (k,) at ``pixels`` (k, 2)."""
    number = int(np.bincount(estimator.of_points).argmax())
    part, rows = estimator.cameras[number], np.flatnonzero(estimator.of_points == number)
    bound, pixels = bound.take(rows), np.ascontiguousarray(pixels[rows])
    for parameters in shapes:
        for pose in solve_pnp(bound.rest + bound.field.value(parameters), pixels, part.camera):
            yield part.in_rig(State(parameters, pose))


def solve_pnp(points: Array, pixels: Array, camera: Camera) -> list[RigidTransform]:
    """Poses (camera from object) that put points (k, 3) in front of the camera near their pixels (k, 2).

    SQPNP (Terzakis & Lourakis 2020) for any shape, and both poses of IPPE (Collins & Bartoli 2014) where the
    points lie in a plane; of three points up to four poses by P3P (Ding et al., Revisiting the P3P problem, 2023, as in
    OpenCV).
    """
    if len(points) == 3:
        pixels = np.ascontiguousarray(pixels)
        _, rotations, translations = cv2.solveP3P(points, pixels, camera.matrix, None, flags=cv2.SOLVEPNP_P3P)
        return _in_front(points, rotations, translations)
    centred = points - points.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False)
    methods = [cv2.SOLVEPNP_SQPNP]
    if spread[2] < 1e-6 * spread[0]:
        methods.append(cv2.SOLVEPNP_IPPE)
    poses = []
    for method in methods:
        try:
            _, rotations, translations, _ = cv2.solvePnPGeneric(points, pixels, camera.matrix, None, flags=method)
        except cv2.error:
            continue  # a degenerate configuration for this method; the others decide
        poses += _in_front(points, rotations, translations)
    return poses


def _in_front(points: Array, rotations: Sequence[Any], translations: Sequence[Any]) -> list[RigidTransform]:
    """OpenCV's poses as transforms, those that have all points in front of the camera."""
    poses = [
        RigidTransform(rotation_exp(np.asarray(r, dtype=float).ravel()), np.asarray(t, dtype=float).ravel())
        for r, t in zip(rotations, translations, strict=True)
    ]
    return [pose for pose in poses if (pose.apply(points)[:, 2] > 0.0).all()]
