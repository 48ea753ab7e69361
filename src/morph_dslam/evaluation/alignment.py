"""How much of a material error is one rigid motion: a second figure, always beside the error as it is.

A truth sensor whose place relative to the camera is not known exactly moves all truth points of a recording
by one rigid motion, and so does a wrong reference state of the estimate. What is left after the best such
motion is the error of shape and of the motion over the sequence. The figures do not say whose error the
motion is.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.evaluation.material_error import MaterialError
from morph_dslam.geometry import rotation_log
from morph_dslam.similarity import fit_similarity

Array = NDArray[np.float64]


def _statistics(distances: Array) -> dict[str, float]:
    return {
        "mean_mm": float(1e3 * np.mean(distances)),
        "median_mm": float(1e3 * np.median(distances)),
        "p95_mm": float(1e3 * np.percentile(distances, 95)),
    }


def _remaining(measured: Array, vectors: Array) -> Array:
    """Lengths (k,) of the errors (k, 3) of points (k, 3) after their best rigid motion, metres."""
    motion = fit_similarity(measured, measured + vectors, with_scale=False)
    return np.linalg.norm(motion.apply(measured) - measured - vectors, axis=1)


def summarise_alignment(error: MaterialError) -> dict[str, Any]:
    """What remains of the error after rigid motions of the truth points, least squares over the points.

    Returns
    -------
    ``after_one_rigid_motion`` : one for all frames together, with its rotation vector in degrees and the
    shift of the points' centre in millimetres, camera frame. ``after_one_in_each_frame`` : each by itself.
    """
    known = np.isfinite(error.distances)
    measured, predicted = error.measured[known], (error.measured + error.vectors)[known]
    motion = fit_similarity(measured, predicted, with_scale=False)
    shift = motion.apply(measured).mean(axis=0) - measured.mean(axis=0)
    single = [
        _remaining(error.measured[row][seen], error.vectors[row][seen])
        for row, seen in enumerate(known)
        if seen.any()
    ]
    together = np.linalg.norm(motion.apply(measured) - predicted, axis=1)
    return {
        "after_one_rigid_motion": {
            **_statistics(together),
            "rotation_deg": np.degrees(rotation_log(motion.rotation)).tolist(),
            "shift_of_centre_mm": (1e3 * shift).tolist(),
        },
        "after_one_in_each_frame": _statistics(np.concatenate(single)),
    }
