"""Key frames: values given at a few frames, joined by a curve with continuous second derivative."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

Array = NDArray[np.float64]


def interpolate_key_frames(frames: Sequence[int] | NDArray, values: Array, wanted: NDArray) -> Array:
    """Values at the ``wanted`` frames on a cubic spline through the key frames.

    The spline rests at its ends: it starts and stops with no velocity, and holds its end values outside.

    Parameters
    ----------
    frames : (k,) strictly increasing frame numbers. values : (k, ...) values there. wanted : (T,) frames.

    Returns
    -------
    (T, ...).
    """
    if len(frames) == 1:
        return np.repeat(np.asarray(values, dtype=float), len(wanted), axis=0)
    spline = CubicSpline(frames, values, bc_type="clamped")
    return spline(np.clip(wanted, frames[0], frames[-1]))
