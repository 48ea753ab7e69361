"""Image motion: contrast-flattened images and pyramidal Lucas-Kanade.

Tracking works on flattened images (each pixel minus its neighbourhood's mean), so that shading, which changes
as the surface bends, does not count as motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
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
