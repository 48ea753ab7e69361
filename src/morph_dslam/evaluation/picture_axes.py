"""Pixels whose axes, or whose picture, are not those of the run's camera: what one change explains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.frame_numbers import spread_over
from morph_dslam.evaluation.pixels import PixelError, PixelTracks, pixel_error
from morph_dslam.evaluation.run_folder import Run

Array = NDArray[np.float64]
#: A change is named if with it the error is so many times less, and less by so many pixels. A bar that is stretched
#: looks much the same upside down: there the wrong axis makes five times the error.
CLEARLY, LEAST_PX = 4.0, 2.0
#: Another size is named only if so many times more tracks begin on the object with it: a run that moves too little or
#: too much also leaves less with scaled tracks.
MORE_BEGIN = 1.6
SIZES = ("are those of a picture of half the size", "are those of a picture of double the size")


def picture_changes(camera: Camera) -> dict[str, Callable[[Array], Array]]:
    """What pixels (..., 2) of other programs have or are, in words, and what makes them pixels of the camera."""
    last = np.array([camera.width, camera.height]) - 1.0
    return {
        "have v counted from below": lambda pixels: np.stack([pixels[..., 0], last[1] - pixels[..., 1]], axis=-1),
        "have u counted from the right": lambda pixels: np.stack([last[0] - pixels[..., 0], pixels[..., 1]], axis=-1),
        "have u and v counted from the other corner": lambda pixels: last - pixels,
        "have u and v exchanged": lambda pixels: pixels[..., ::-1],
        SIZES[0]: lambda pixels: 2.0 * pixels + 0.5,
        SIZES[1]: lambda pixels: (pixels - 0.5) / 2.0,
    }


def axes_notes(run: Run, tracks: PixelTracks, error: PixelError, bind_frame: int | None = None) -> list[str]:
    """What other axes of the tracks' pixels explain, if they do.

    Parameters
    ----------
    run : as it was compared.
    tracks : as they were given.
    error : what `pixel_error` found.
    bind_frame : as it was given.
    """
    rows = np.isin(tracks.frames, [*error.bind_frames, *spread_over(error.frames)])
    few = PixelTracks(tracks.ids, tracks.frames[rows], tracks.pixels[rows])
    n_begin = max(len(error.ids), (len(tracks.ids) + 1) // 2)

    def mean_error(words: str, change: Callable[[Array], Array]) -> float:
        try:
            changed = pixel_error(run, replace(few, pixels=change(few.pixels)), bind_frame)
        except EvaluationError:  # nothing can be compared
            return np.inf
        fewest = max(n_begin, MORE_BEGIN * len(error.ids)) if words in SIZES else n_begin
        return float(np.nanmean(changed.distances_px)) if len(changed.ids) >= fewest else np.inf

    given = float(np.nanmean(error.distances_px))
    errors = {words: mean_error(words, change) for words, change in picture_changes(run.camera).items()}
    best = min(errors, key=lambda words: errors[words])
    if not given > max(CLEARLY * errors[best], errors[best] + LEAST_PX):
        return []
    return [
        f"the tracks fit the run much better if their pixels {best}: the mean error is {errors[best]:.3g} px then, not "
        f"{given:.3g}. Pixels count from the centre of the first one of the image as recorded "
        f"({run.camera.width} x {run.camera.height}), u to the right and v down"
    ]
