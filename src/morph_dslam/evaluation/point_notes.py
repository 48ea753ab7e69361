"""Mistakes in truth points that their comparison shows: frames that are counted from another number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.points import MaterialError, PointTruth, material_error
from morph_dslam.evaluation.run_folder import Run

#: Numbers that a truth file may be off by, as where it counts frames from one.
SHIFTS = (-1, 1)
#: Other numbers are meant if with them the mean error is so many times less. Frames that are compared for it.
CLEARLY, COMPARED = 2.0, 60


def frame_notes(run: Run, truth: PointTruth, error: MaterialError) -> list[str]:
    """What other numbers of the truth's frames explain, if they do.

    Parameters
    ----------
    run : as it was compared.
    truth : as it was given.
    error : as it was found.
    """
    bind_frame = error.binding.frame
    chosen = np.unique(np.linspace(0, len(error.frames) - 1, COMPARED).astype(int))
    rows = np.isin(truth.frames, [bind_frame, *error.frames[chosen]])
    few = PointTruth(truth.frames[rows], truth.points[rows], truth.pixels[rows], truth.hidden[rows])
    means = {shift: _mean_error(run, few, bind_frame, shift) for shift in (0, *SHIFTS)}
    best = min(means, key=lambda shift: means[shift])
    if best == 0 or not means[0] > CLEARLY * means[best]:
        return []
    return [
        f"with {'one more' if best > 0 else 'one less'} in each frame number of the truth the mean error is "
        f"{1e3 * means[best]:.3g} mm, not {1e3 * means[0]:.3g}: a run counts its frames from 0. Correct the "
        "truth's numbers if they are counted from another one"
    ]


def _mean_error(run: Run, truth: PointTruth, bind_frame: int, shift: int) -> float:
    """Mean error, metres, with other frame numbers; infinite where nothing can be compared with them."""
    try:
        error = material_error(run, replace(truth, frames=truth.frames + shift), bind_frame + shift)
    except EvaluationError:
        return np.inf
    return float(np.nanmean(error.distances))
