"""Image motion: contrast-flattened images, pyramidal Lucas-Kanade, and how well patches agree.

Tracking works on flattened images (each pixel minus its neighbourhood's mean), so that shading, which changes
as the surface bends, does not count as motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Grey level of a pixel that equals its neighbourhood's mean.
NEUTRAL = 128


@dataclass(frozen=True)
class FlowOptions:
    """Lucas-Kanade's window in pixels and pyramid levels above the image itself."""

    window: int = 17
    levels: int = 3
    flatten_window: int = 31


def flatten(grey: NDArray[np.uint8], window: int) -> NDArray[np.uint8]:
    """Grey image (h, w) minus its mean over a square window, plus `NEUTRAL`; clipped to 0..255."""
    mean = cv2.boxFilter(grey, -1, (window, window), borderType=cv2.BORDER_REFLECT)
    return cv2.addWeighted(grey, 1.0, mean, -1.0, NEUTRAL)  # type: ignore[return-value]


def follow(
    source: NDArray[np.uint8], target: NDArray[np.uint8], points: Array, guesses: Array, options: FlowOptions
) -> tuple[Array, NDArray[np.bool_]]:
    """Follow points from one flattened image to another (Bouguet's pyramidal Lucas-Kanade).

    Parameters
    ----------
    points : (p, 2) in the source image, pixels. guesses : (p, 2) where to start in the target.

    Returns
    -------
    (p, 2) positions in the target and (p,) which of them were found inside the image.
    """
    if not len(points):
        return np.empty((0, 2)), np.empty(0, dtype=bool)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        points.astype(np.float32),
        guesses.astype(np.float32),
        winSize=(options.window, options.window),
        maxLevel=options.levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.02),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return found.reshape(-1, 2).astype(float), status.ravel() == 1


@njit(cache=True, nogil=True)
def _sample(image, x, y):
    x0, y0 = int(x), int(y)
    right, down = x - x0, y - y0
    above = (1.0 - right) * image[y0, x0] + right * image[y0, x0 + 1]
    below = (1.0 - right) * image[y0 + 1, x0] + right * image[y0 + 1, x0 + 1]
    return (1.0 - down) * above + down * below


@njit(cache=True, nogil=True)
def patch_correlation(first, second, first_points, second_points, half):
    """Normalised cross-correlation of square patches of two images, compiled.

    Parameters
    ----------
    first, second : (h, w) uint8. first_points, second_points : (p, 2) patch centres in each.
    half : the patches are (2 half + 1) pixels wide.

    Returns
    -------
    (p,) in [-1, 1]; -1 where a patch leaves its image, 0 where one has no contrast.
    """
    height, width = first.shape
    result = np.empty(len(first_points))
    count = float((2 * half + 1) ** 2)
    for j in range(len(first_points)):
        x, y = first_points[j, 0] - half, first_points[j, 1] - half
        u, v = second_points[j, 0] - half, second_points[j, 1] - half
        inside = min(x, y, u, v) >= 0.0
        inside &= max(x, u) + 2 * half < width - 1 and max(y, v) + 2 * half < height - 1
        if not inside:
            result[j] = -1.0
            continue
        sum_a = sum_b = sum_aa = sum_bb = sum_ab = 0.0
        for row in range(2 * half + 1):
            for column in range(2 * half + 1):
                a = _sample(first, x + column, y + row)
                b = _sample(second, u + column, v + row)
                sum_a += a
                sum_b += b
                sum_aa += a * a
                sum_bb += b * b
                sum_ab += a * b
        variance = (sum_aa - sum_a * sum_a / count) * (sum_bb - sum_b * sum_b / count)
        covariance = sum_ab - sum_a * sum_b / count
        result[j] = covariance / np.sqrt(variance) if variance > 1e-6 else 0.0
    return result


def patch_correlation_numpy(first, second, first_points, second_points, half):
    """The plain twin of `patch_correlation`, on scipy's bilinear sampling."""
    from scipy.ndimage import map_coordinates

    offsets = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    result = np.full(len(first_points), -1.0)
    limit = np.array(first.shape[::-1]) - 1.0
    for j, centres in enumerate(zip(first_points, second_points, strict=True)):
        if any((c - half < 0).any() or (c + half >= limit).any() for c in centres):
            continue
        a, b = (
            map_coordinates(image.astype(float), c[::-1, None] + offsets, order=1)
            for image, c in zip((first, second), centres, strict=True)
        )
        a, b = a - a.mean(), b - b.mean()
        norm = np.sqrt((a @ a) * (b @ b))
        result[j] = a @ b / norm if norm > 1e-3 else 0.0
    return result
