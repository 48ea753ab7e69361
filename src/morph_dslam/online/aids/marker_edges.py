"""Corners of square markers to a tenth of a pixel: where the lines through their four edges meet."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Places on an edge, the part of it they spread over, and how far across it its brightness is looked at, as a
#: share of its length and pixels.
N_PLACES, INNER, REACH_SHARE, REACHES_PX = 15, (0.12, 0.88), 0.08, (1.5, 4.0)
ITERATIONS = 3


def refined_corners(grey: NDArray[np.uint8], markers: Array) -> Array:
    """Corners (m, 4, 2) of dark markers on white, in an image (h, w), from those of a detector.

    A corner-shaped window is drawn inwards by blur; the steepest places of straight edges are not.
    """
    smooth = grey.astype(np.float32)
    corners = markers.astype(np.float64)
    for _ in range(ITERATIONS):
        corners = _from_edges(smooth, corners)
    # A detector's corner is never further off than that: an edge that went elsewhere was not the marker's.
    kept = np.linalg.norm(corners - markers, axis=2, keepdims=True) < REACHES_PX[1]
    return np.where(kept, corners, markers)


def _from_edges(image: NDArray[np.float32], corners: Array) -> Array:
    following = np.roll(corners, -1, axis=1)
    along = following - corners
    lengths = np.linalg.norm(along, axis=2, keepdims=True)
    along = along / np.maximum(lengths, 1e-9)
    outwards = np.stack([along[..., 1], -along[..., 0]], axis=2)
    centre = corners.mean(axis=1, keepdims=True)
    outwards *= np.sign(np.sum(outwards * (corners - centre), axis=2, keepdims=True))
    places = (
        corners[:, :, None]
        + np.linspace(*INNER, N_PLACES)[None, None, :, None] * (following - corners)[:, :, None]
    )
    steps = np.linspace(-1.0, 1.0, 17)
    reach = np.clip(REACH_SHARE * lengths, *REACHES_PX)  # (m, 4, 1)
    offsets = steps * reach  # (m, 4, s)
    sampled = places[:, :, :, None] + offsets[:, :, None, :, None] * outwards[:, :, None, None]
    flat = sampled.reshape(len(corners) * 4, -1, 2).astype(np.float32)
    values = cv2.remap(image, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    values = np.asarray(values, dtype=np.float64).reshape(sampled.shape[:-1])
    rise = np.maximum(np.diff(values, axis=3), 0.0) + 1e-6
    between = 0.5 * (offsets[:, :, 1:] + offsets[:, :, :-1])[:, :, None]
    shifts = np.sum(rise * between, axis=3) / rise.sum(axis=3)
    edges = places + shifts[..., None] * outwards[:, :, None]
    middle = edges.mean(axis=2)
    _, _, axes = np.linalg.svd(edges - middle[:, :, None], full_matrices=False)
    normals = axes[:, :, 1]
    # A corner is where the edge before it meets the edge after it.
    before_normals, before_middle = np.roll(normals, 1, axis=1), np.roll(middle, 1, axis=1)
    rows = np.stack([before_normals, normals], axis=2)
    right = np.stack(
        [np.sum(before_normals * before_middle, axis=2), np.sum(normals * middle, axis=2)], axis=2
    )
    straight = np.abs(np.linalg.det(rows)) > 0.05
    rows = np.where(straight[..., None, None], rows, np.eye(2))
    right = np.where(straight[..., None], right, corners)
    return np.linalg.solve(rows, right[..., None])[..., 0]
