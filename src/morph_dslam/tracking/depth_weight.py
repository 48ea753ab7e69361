"""How much depths count beside texture, by what they show that they are off by in common.

The noise of a depth camera is taken for granted. Beside it depths are off by what lens, sensor and mesh make, which is
alike over wide parts of the surface and does not average out over points. Neighbours have that in common in their
residuals, and the noise not: the variance of a mean over n points is that of the noise over n, and the common one over
as many parts as a keyframe counts for (`EFFECTIVE_POINTS`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.even_rows import evenly
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.outline_weight import MOST_COMPARED, NEAR_PX, near_products
from morph_dslam.tracking.refinement import EFFECTIVE_POINTS

Array = NDArray[np.float64]


def weighed_by_residuals(depths: PointDepths, residuals: Array, pixels: Array) -> PointDepths:
    """Depths that count by what an independent one of them is worth; never for more than by their noise.

    Parameters
    ----------
    depths : (p,) weighed by their noise.
    residuals : (p,) that an estimate leaves of them, pixels.
    pixels : (p, 2) of the points.
    """
    rows = np.flatnonzero(depths.weights > 0.0)
    sizes = depths.bounded(residuals) / np.sqrt(depths.squared_px)
    some = rows[evenly(len(rows), MOST_COMPARED)]
    variance = float(np.sum(sizes[rows] ** 2)) / max(len(rows), 1)
    common = float(np.clip(near_products(pixels[some], sizes[some, None], NEAR_PX)[0], 0.0, variance))
    worth = variance - common + common * max(len(rows) / EFFECTIVE_POINTS, 1.0)
    root = float(np.sqrt(1.0 / max(worth, 1.0)))
    return replace(depths, weights=root * depths.weights, huber_px=root * depths.huber_px)
