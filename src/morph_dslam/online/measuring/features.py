"""Feature points of the reference view: evenly spread corners to follow, and descriptors to find it again."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def interior(covered: NDArray[np.bool_], margin: int) -> NDArray[np.uint8]:
    """Mask (h, w), 255 at pixels that the object covers at least ``margin`` pixels inside its outline."""
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    padded = cv2.copyMakeBorder(covered.astype(np.uint8) * 255, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    return cv2.erode(padded, kernel)[1:-1, 1:-1]  # type: ignore[return-value]


def spread_corners(flat: NDArray[np.uint8], mask: NDArray[np.uint8], count: int) -> Array:
    """About ``count`` corners (p, 2) inside the mask, spread over it and the strongest of their surroundings.

    Shi and Tomasi's corners are taken in order of strength, at most as many from each cell of a grid as an
    even spread would put there, then the strongest of the rest until there are enough.
    """
    area = int(np.count_nonzero(mask))
    if area == 0:
        return np.empty((0, 2))
    spacing = np.sqrt(area / count)
    corners = cv2.goodFeaturesToTrack(
        flat, maxCorners=8 * count, qualityLevel=0.005, minDistance=max(3.0, 0.4 * spacing), mask=mask
    )
    if corners is None:
        return np.empty((0, 2))
    corners = corners.reshape(-1, 2).astype(float)
    cells = (corners // (3.0 * spacing)).astype(int)
    share, taken = 9, {}
    first, rest = [], []
    for row, cell in enumerate(map(tuple, cells)):
        taken[cell] = taken.get(cell, 0) + 1
        (first if taken[cell] <= share else rest).append(row)
    return corners[(first + rest)[:count]]


def detect_orb(
    grey: NDArray[np.uint8], count: int, mask: NDArray[np.uint8] | None = None
) -> tuple[Array, NDArray[np.uint8]]:
    """Positions (k, 2) and descriptors (k, 32) of at most ``count`` ORB features (Rublee et al. 2011)."""
    keypoints, descriptors = cv2.ORB_create(nfeatures=count, fastThreshold=10).detectAndCompute(grey, mask)  # type: ignore[attr-defined]
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 32), dtype=np.uint8)
    return np.array([k.pt for k in keypoints]), descriptors


def match_descriptors(
    first: NDArray[np.uint8], second: NDArray[np.uint8], ratio: float = 0.85
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows (k,) of descriptors that match one another: nearest both ways, clearly nearer than the second.

    Parameters
    ----------
    first, second : (n, 32) and (m, 32) binary descriptors.
    ratio : of the distances to the two nearest, at most.
    """
    if len(first) < 2 or len(second) < 2:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    back = np.full(len(second), -1)
    for match in matcher.match(second, first):
        back[match.queryIdx] = match.trainIdx
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, runner_up in matcher.knnMatch(first, second, k=2)
        if best.distance < ratio * runner_up.distance and back[best.trainIdx] == best.queryIdx
    ]
    rows = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]
