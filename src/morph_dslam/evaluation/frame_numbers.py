"""Measurements whose frames are counted from another number than the run's: truth points, tracks, forces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.pixels import PixelError, PixelTracks, pixel_error
from morph_dslam.evaluation.points import MaterialError, PointTruth, material_error
from morph_dslam.evaluation.run_folder import Run
from morph_dslam.even_rows import evenly

Array = NDArray[np.float64]
#: Numbers that a file may be off by, as where it counts frames from one.
SHIFTS = (-1, 1)
#: Other numbers are meant if with them the error is so many times less. Frames that are compared for it.
CLEARLY, COMPARED = 2.0, 60
#: Smaller errors are rounding, mm or px.
ROUNDING = 1e-6
#: Fewer forces with others beside them tell nothing. Forces that are another part of a frame off are late, as those of
#: a body with friction are: it is no number that is wrong.
FEWEST_FORCES, WHOLE = 8, 0.1
HOW_FRAMES_COUNT = (
    "a run counts the frames of a video from 0, and images have the numbers in the names of their files. Correct the "
    "numbers if they are counted otherwise"
)


def in_words(shift: int) -> str:
    """One of `SHIFTS`."""
    return "one more" if shift > 0 else "one less"


def point_notes(run: Run, truth: PointTruth, error: MaterialError) -> list[str]:
    """What other numbers of the truth's frames explain, if they do.

    Parameters
    ----------
    run : as it was compared.
    truth : as it was given.
    error : as it was found.
    """
    bind_frame = error.binding.frame
    rows = np.isin(truth.frames, [bind_frame, *spread_over(error.frames)])
    few = PointTruth(truth.frames[rows], truth.points[rows], truth.pixels[rows], truth.hidden[rows])

    def mean_error(shift: int) -> float:
        shifted = material_error(run, replace(few, frames=few.frames + shift), bind_frame + shift)
        return 1e3 * float(np.nanmean(shifted.distances))

    return _notes(mean_error, "the truth", "mm")


def track_notes(run: Run, tracks: PixelTracks, error: PixelError, bind_frame: int | None = None) -> list[str]:
    """What other numbers of the tracks' frames explain, if they do; ``error`` is what `pixel_error` found."""
    rows = np.isin(tracks.frames, [*error.bind_frames, *spread_over(error.frames)])
    few = PixelTracks(tracks.ids, tracks.frames[rows], tracks.pixels[rows])

    def mean_error(shift: int) -> float:
        binds = None if bind_frame is None else bind_frame + shift
        shifted = pixel_error(run, replace(few, frames=few.frames + shift), binds)
        return float(np.nanmean(shifted.distances_px))

    return _notes(mean_error, "the tracks", "px")


def spread_over(frames: NDArray[np.int64]) -> NDArray[np.int64]:
    """`COMPARED` of them, spread over all."""
    return frames[evenly(len(frames), COMPARED)]


def _notes(mean_error: Callable[[int], float], of: str, unit: str) -> list[str]:
    """A note where ``mean_error`` is clearly less with so many more in each frame number."""

    def error_with(shift: int) -> float:
        try:
            return mean_error(shift)
        except EvaluationError:  # nothing can be compared
            return np.inf

    errors = {shift: error_with(shift) for shift in (0, *SHIFTS)}
    best = min(errors, key=lambda shift: errors[shift])
    if best == 0 or not errors[0] > max(CLEARLY * errors[best], ROUNDING):
        return []
    return [
        f"with {in_words(best)} in each frame number of {of} the mean error is {errors[best]:.3g} {unit}, not "
        f"{errors[0]:.3g}: {HOW_FRAMES_COUNT}"
    ]


def force_shift(
    frames: Array, modelled: Array, places: Array, measured: Array
) -> tuple[int, float, float, float] | None:
    """Whether other frame numbers of measured forces explain what a factor and an offset leave.

    Parameters
    ----------
    frames : (e,) of the run.
    modelled : (e,) the model's force there.
    places : (k,) frame numbers of the measured forces.
    measured : (k,).

    Returns
    -------
    What each number lacks, one of `SHIFTS`; the factor of the model's forces then; the rms of what this and an offset
    leave then, and as the numbers were given.
    """
    of = dict(zip(frames.tolist(), modelled.tolist(), strict=True))
    # Only those with forces of the model for each shift and on both sides of it, so that all shifts compare the same.
    reach = range(min(SHIFTS) - 1, max(SHIFTS) + 2)
    rows = [row for row, place in enumerate(places.tolist()) if all(place + step in of for step in reach)]
    if len(rows) < FEWEST_FORCES:
        return None
    at = {step: np.array([of[place + step] for place in places[rows].tolist()]) for step in reach}
    fits = {shift: fit_columns(measured[rows], at[shift]) for shift in (0, *SHIFTS)}
    best = min(fits, key=lambda shift: fits[shift][1])
    (factor, *_), rms = fits[best]
    if best == 0 or not fits[0][1] > CLEARLY * rms:
        return None
    (scale, late, _), _ = fit_columns(measured[rows], at[best], (at[best + 1] - at[best - 1]) / 2.0)
    if not abs(late) <= WHOLE * abs(scale):
        return None
    return best, float(factor), rms, fits[0][1]


def fit_columns(measured: Array, *columns: Array) -> tuple[Array, float]:
    """Least squares of columns (n,) and a constant: their factors, and the rms of what is left."""
    design = np.column_stack([*columns, np.ones(len(measured))])
    factors = np.asarray(np.linalg.lstsq(design, measured, rcond=None)[0], dtype=np.float64)
    return factors, float(np.sqrt(np.mean((design @ factors - measured) ** 2)))
