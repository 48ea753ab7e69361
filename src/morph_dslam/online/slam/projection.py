"""Map points in a camera, as arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def project(camera_from_world: Array, points: Array, intrinsics: Array) -> tuple[Array, Array]:
    """Pixels (n, 2) and depths (n,) of points (n, 3); pixels are NaN where a point is not in front."""
    local = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    depth = np.where(local[:, 2] > 1e-6, local[:, 2], np.nan)
    return local[:, :2] / depth[:, None] * intrinsics[:2] + intrinsics[2:], local[:, 2]


def rays(pixels: Array, intrinsics: Array) -> Array:
    """Directions (n, 3) with z = 1 of pixels (n, 2) in the camera frame."""
    return np.column_stack([(pixels - intrinsics[2:]) / intrinsics[:2], np.ones(len(pixels))])


def world_points(camera_from_world: Array, pixels: Array, depths: Array | float, intrinsics: Array) -> Array:
    """Points (n, 3) in the world, seen at pixels (n, 2) at these depths."""
    local = rays(pixels, intrinsics) * np.reshape(depths, (-1, 1))
    return (local - camera_from_world[:3, 3]) @ camera_from_world[:3, :3]


def inverse(pose: Array) -> Array:
    """Inverse (4, 4) of a rigid transform."""
    result = np.eye(4)
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return result


def inside(pixels: Array, shape: tuple[int, ...], margin: float) -> NDArray[np.bool_]:
    """Which pixels (n, 2) lie in an image (h, w) and this far from its border; NaN do not."""
    height, width = shape[:2]
    with np.errstate(invalid="ignore"):
        return (
            (pixels[:, 0] >= margin)
            & (pixels[:, 1] >= margin)
            & (pixels[:, 0] <= width - 1 - margin)
            & (pixels[:, 1] <= height - 1 - margin)
        )
