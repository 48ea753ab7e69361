"""Whether depth images agree with a known map on what a metre is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import MapError
from morph_dslam.slam.frame_images import FrameDepth
from morph_dslam.slam.options import LEAST_INLIERS
from morph_dslam.sources.recorded import DEPTH_SCALE

Array = NDArray[np.float64]
#: Depth cameras are right to a few per cent; what differs by more is another scale.
MOST_RATIO = 1.1


def depth_ratio(depth: FrameDepth, pixels: Array, depths: Array) -> float | None:
    """Measured depths over those of a map: the median, if enough points have one and most agree on it.

    Parameters
    ----------
    depth : of the frame
    pixels, depths : (n, 2), (n,) map points in the frame, and how far the map has them, metres
    """
    measured = depth.at(pixels)
    known = (measured > 0.0) & (depths > 0.0)
    if known.sum() < LEAST_INLIERS:
        return None
    ratios = np.log(measured[known] / depths[known])
    middle = float(np.median(ratios))
    return float(np.exp(middle)) if np.median(np.abs(ratios - middle)) < np.log(MOST_RATIO) else None


def check_depth_ratio(ratio: float | None) -> None:
    """Raise MapError if measured depths are not those of the known map."""
    if ratio is not None and not 1.0 / MOST_RATIO < ratio < MOST_RATIO:
        raise MapError(
            f"depth and map contradict each other: measured depths are {ratio:.3g} times those of the map. Correct "
            f"--depth-per-metre here, or in the run that made the map and map again: {DEPTH_SCALE}. Without --extend, "
            "--no-depth finds the camera by the images alone"
        )
