"""Depth at pixels of a frame, from a depth image or the right image of a stereo pair.

Both say it as the column at which a right camera sees the pixel's point, u - b / z with the baseline b times
the focal length, because errors of that column are about the same at all depths (Mur-Artal and Tardós,
ORB-SLAM2, 2017).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.slam.options import LEAST_CORRELATION, PATCH_HALF
from morph_dslam.tracking.patches import follow, patch_correlation

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

#: Largest disparity of stereo pairs, pixels; nearer points have no depth from one frame.
MOST_DISPARITY_PX = 128
#: Disparities of neighbouring pixels of a depth image that differ by more are an edge, pixels.
MOST_STEP = 1.5
#: How far a measured column may be from the expected one, pixels.
SEARCH_PX = 6
#: Half width of the patches compared along a row, and how much worse the second best place has to be.
ROW_HALF, ROW_CLEARNESS = 5, 1.25
#: A point's rows in both rectified images differ by less than this, pixels.
MOST_ROW_ERROR = 0.75


class FrameDepth(Protocol):
    """What a frame knows of depth."""

    def right_columns(self, pixels: Array, expected: Array | None = None) -> Array:
        """Columns (n,) of pixels (n, 2) in the right image, NaN if not measured or not near ``expected``."""
        ...


def depth_of(pixels: Array, right: Array, baseline_px: float) -> Array:
    """Depths (n,), metres, of pixels (n, 2) and their columns in the right image; NaN where not measured."""
    disparity = pixels[:, 0] - right
    return baseline_px / np.where(disparity > 0.0, disparity, np.nan)


@dataclass(frozen=True)
class DepthImage:
    """Depth (h, w), metres, of every pixel of the undistorted image; NaN where not measured."""

    depth: NDArray[np.float32]
    baseline_px: float

    def right_columns(self, pixels: Array, expected: Array | None = None) -> Array:
        """As `FrameDepth` says; between pixels the disparity is linear, as on a plane."""
        result = np.full(len(pixels), np.nan)
        height, width = self.depth.shape
        x, y = np.floor(pixels).astype(int).T
        rows = np.flatnonzero((x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1))
        x, y = x[rows], y[rows]
        around = np.stack([self.depth[y + j, x + i] for j in (0, 1) for i in (0, 1)]).astype(float)
        disparity = self.baseline_px / np.where(around > 0.0, around, np.nan)
        right, down = (pixels[rows] - np.column_stack([x, y])).T
        weights = np.stack([(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down])
        # At an edge, or next to a hole (NaN), the corner may belong to either side.
        smooth = disparity.max(axis=0) - disparity.min(axis=0) < MOST_STEP
        result[rows[smooth]] = (pixels[rows, 0] - (weights * disparity).sum(axis=0))[smooth]
        return _near(result, expected)


@dataclass(frozen=True)
class StereoImages:
    """Both contrast-normalized images (h, w) of a rectified pair."""

    left: Image
    right: Image

    def right_columns(self, pixels: Array, expected: Array | None = None) -> Array:
        """As `FrameDepth` says: the place in the row that looks most alike, refined by Lucas-Kanade."""
        low, high = np.zeros(len(pixels)), np.full(len(pixels), float(MOST_DISPARITY_PX))
        if expected is not None:
            disparity = np.nan_to_num(pixels[:, 0] - expected)
            low, high = np.maximum(disparity - SEARCH_PX, 0.0), disparity + SEARCH_PX
        clearness = ROW_CLEARNESS if expected is None else 1.0
        rough = _row_disparities(self.left, self.right, pixels, low, high, ROW_HALF, clearness)
        result, rows = np.full(len(pixels), np.nan), np.flatnonzero(np.isfinite(rough))
        seen, guesses = pixels[rows], pixels[rows] - np.column_stack([rough[rows], np.zeros(len(rows))])
        found, good = follow(self.left, self.right, seen, guesses, 0)
        likeness = patch_correlation(self.left, self.right, seen, found, PATCH_HALF)
        good &= (likeness > LEAST_CORRELATION) & (np.abs(found[:, 1] - seen[:, 1]) < MOST_ROW_ERROR)
        result[rows[good]] = found[good, 0]
        return _near(result, expected)


def _near(columns: Array, expected: Array | None) -> Array:
    if expected is None:
        return columns
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(columns - expected) < SEARCH_PX, columns, np.nan)


@njit(cache=True, nogil=True)
def _row_disparities(left, right, pixels, low, high, half, clearness):
    """Whole disparities (n,) in [low, high] of the least sum of absolute differences; NaN if not clear."""
    height, width = left.shape
    result = np.full(len(pixels), np.nan)
    for n in range(len(pixels)):
        x, y = int(pixels[n, 0] + 0.5), int(pixels[n, 1] + 0.5)
        if x < half or y < half or x >= width - half or y >= height - half:
            continue
        first, last = int(low[n]), min(int(high[n]) + 1, x - half)
        costs = np.empty(max(last - first + 1, 0))
        best = -1
        for k in range(len(costs)):
            cost, shifted = 0, x - first - k
            for j in range(-half, half + 1):
                for i in range(-half, half + 1):
                    cost += abs(np.int64(left[y + j, x + i]) - np.int64(right[y + j, shifted + i]))
            costs[k] = cost
            if best < 0 or cost < costs[best]:
                best = k
        if best < 0:
            continue
        clear = True
        for k in range(len(costs)):
            if abs(k - best) > 2 and costs[k] <= clearness * costs[best]:
                clear = False
        if clear:
            result[n] = first + best
    return result
