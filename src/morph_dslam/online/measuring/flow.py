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
def _patch(image, x, y, patch):
    """Fill a patch (n, n) with the image about it, its first pixel at (x, y), bilinearly."""
    x0, y0 = int(x), int(y)
    right, down = x - x0, y - y0
    a, b = (1.0 - right) * (1.0 - down), right * (1.0 - down)
    c, d = (1.0 - right) * down, right * down
    for row in range(patch.shape[0]):
        for column in range(patch.shape[1]):
            u, v = x0 + column, y0 + row
            patch[row, column] = (
                a * image[v, u] + b * image[v, u + 1] + c * image[v + 1, u] + d * image[v + 1, u + 1]
            )


@njit(cache=True, nogil=True)
def patch_agreement(first, second, first_points, second_points, half):
    """How alike square patches of two images are, and how exactly that tells their places, compiled.

    What is left of the difference of the patches acts on Lucas and Kanade's least squares like noise: with
    its mean square s and the sum G of the outer products of the first patch's slopes, the covariance of the
    place is s G^-1 (Foerstner, Image matching, 1993).

    Parameters
    ----------
    first, second : (h, w) uint8. first_points, second_points : (p, 2) patch centres in each.
    half : the patches are (2 half + 1) pixels wide.

    Returns
    -------
    correlation : (p,) normalised, in [-1, 1]; -1 where a patch leaves its image, 0 where one has no contrast.
    spread : (p,) standard deviation of a coordinate by s G^-1, pixels; infinite where it is not determined.
    """
    height, width = first.shape
    correlation, spread = np.full(len(first_points), -1.0), np.full(len(first_points), np.inf)
    size, count = 2 * half + 1, float((2 * half + 1) ** 2)
    a, b = np.empty((size, size)), np.empty((size, size))
    for j in range(len(first_points)):
        x, y = first_points[j, 0] - half, first_points[j, 1] - half
        u, v = second_points[j, 0] - half, second_points[j, 1] - half
        inside = min(x, y, u, v) >= 0.0
        inside &= max(x, u) + 2 * half < width - 1 and max(y, v) + 2 * half < height - 1
        if not inside:
            continue
        _patch(first, x, y, a)
        _patch(second, u, v, b)
        mean_a, mean_b = a.mean(), b.mean()
        aa = bb = ab = 0.0
        for row in range(size):
            for column in range(size):
                p, q = a[row, column] - mean_a, b[row, column] - mean_b
                aa += p * p
                bb += q * q
                ab += p * q
        correlation[j] = ab / np.sqrt(aa * bb) if aa * bb > 1e-6 else 0.0
        xx = xy = yy = 0.0
        for row in range(1, size - 1):
            for column in range(1, size - 1):
                right = 0.5 * (a[row, column + 1] - a[row, column - 1])
                down = 0.5 * (a[row + 1, column] - a[row - 1, column])
                xx += right * right
                xy += right * down
                yy += down * down
        determinant = xx * yy - xy * xy
        if determinant > 1e-6:
            left = max(aa + bb - 2.0 * ab, 0.0) / count
            spread[j] = np.sqrt(0.5 * left * (xx + yy) / determinant)
    return correlation, spread


def patch_correlation(
    first: NDArray[np.uint8], second: NDArray[np.uint8], first_points: Array, second_points: Array, half: int
) -> Array:
    """The correlation (p,) alone, of `patch_agreement`."""
    return np.asarray(patch_agreement(first, second, first_points, second_points, half)[0])


def patch_agreement_numpy(first, second, first_points, second_points, half):
    """The plain twin of `patch_agreement`, on scipy's bilinear sampling."""
    from scipy.ndimage import map_coordinates

    offsets, size = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1), 2 * half + 1
    correlation, spread = np.full(len(first_points), -1.0), np.full(len(first_points), np.inf)
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
        correlation[j] = a @ b / norm if norm > 1e-3 else 0.0
        down, right = (slope[1:-1, 1:-1].ravel() for slope in np.gradient(a.reshape(size, size)))
        slopes = np.array([[right @ right, right @ down], [right @ down, down @ down]])
        if np.linalg.det(slopes) > 1e-6:
            spread[j] = np.sqrt(0.5 * np.mean((a - b) ** 2) * np.trace(np.linalg.inv(slopes)))
    return correlation, spread
