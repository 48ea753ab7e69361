"""The evaluation of a run: figures, and for a run folder pictures and a report, written into it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.depth import depth_error, read_depths, summarise_depth
from morph_dslam.evaluation.force import force_error, summarise_force
from morph_dslam.evaluation.force_curves import ForceCurve, load_curve
from morph_dslam.evaluation.frame_numbers import point_notes, track_notes
from morph_dslam.evaluation.picture_axes import axes_notes
from morph_dslam.evaluation.pixels import PixelTracks, load_tracks, pixel_error, summarise_pixels
from morph_dslam.evaluation.points import PointTruth, load_truth, material_error, summarise
from morph_dslam.evaluation.rolling_shutter import shutter_notes
from morph_dslam.evaluation.run_folder import Run, load_run
from morph_dslam.evaluation.trajectory import summarise_alignment
from morph_dslam.evaluation.truth_in_camera import check_truth
from morph_dslam.io.writing import writing

# What draws is imported where it draws: matplotlib takes long to load.


def evaluate(run: str | Path | Run, truth: str | Path | PointTruth, bind_frame: int | None = None) -> dict[str, Any]:
    """Compare a run with truth points.

    Of a run folder, ``evaluation.json``, pictures and ``report.html`` are written into it.

    Parameters
    ----------
    run : a run folder, or a run in memory.
    truth : a truth file, or truth in memory.
    bind_frame : the frame whose pixels bind the points; where absent, the first one of the truth that the run tracked.

    Returns
    -------
    The content of ``evaluation.json``.

    Raises
    ------
    EvaluationError
        If the run and the truth cannot be read or do not fit together, or the folder
        cannot be written to.
    """
    tracked = run if isinstance(run, Run) else load_run(run)
    points = truth if isinstance(truth, PointTruth) else load_truth(Path(truth))
    notes = check_truth(tracked, points, bind_frame)
    error = material_error(tracked, points, bind_frame)
    figures = {
        **summarise(error),
        **summarise_alignment(error),
        "notes": [*notes, *point_notes(tracked, points, error)],
        "truth": None if isinstance(truth, PointTruth) else str(truth),
        **_counts(tracked),
        "median_ms": float(np.nanmedian(tracked.frame_times)),
        "p95_ms": float(np.nanpercentile(tracked.frame_times, 95)),
    }
    if not isinstance(run, Run):
        folder = Path(run)
        from morph_dslam.evaluation.run_report import plot_error_map, plot_errors_by_frame, write_run_report

        with writing(EvaluationError, folder):
            (folder / "evaluation.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
            plot_errors_by_frame(folder / "evaluation.png", error)
            plot_error_map(folder / "error_map.png", error, tracked.model)
            write_run_report(folder, tracked)
    return figures


def evaluate_depth(
    run: str | Path | Run,
    depth: str | Path | Iterable[tuple[int, NDArray[np.floating]]],
    base_frame: int | None = None,
    values_per_metre: float | None = None,
) -> dict[str, Any]:
    """Compare a run's surfaces with depth images.

    Of a run folder, ``depth_evaluation.json`` and pictures are written into it.

    Parameters
    ----------
    run : a run folder, or a run in memory.
    depth : a path, see `read_depths`; or frame numbers, each with its image (h, w) in metres, NaN where unknown.
    base_frame : a frame in which the object is not deformed, whose error stands beside the others'.
    values_per_metre : of the images of a folder.

    Returns
    -------
    The content of ``depth_evaluation.json``.

    Raises
    ------
    EvaluationError
        If the run or the depth images cannot be read or do not fit together, or the folder
        cannot be written to.
    """
    tracked = run if isinstance(run, Run) else load_run(run)
    path = str(depth) if isinstance(depth, str | Path) else None
    if isinstance(depth, str | Path):
        depth = read_depths(Path(depth), tracked.frames[tracked.tracked].tolist(), values_per_metre)
    error = depth_error(tracked, depth, base_frame)
    figures = {**summarise_depth(error), "depth": path, **_counts(tracked)}
    if not isinstance(run, Run):
        folder = Path(run)
        from morph_dslam.evaluation.run_report import plot_depth_error_map, plot_depth_errors_by_frame

        with writing(EvaluationError, folder):
            (folder / "depth_evaluation.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
            plot_depth_errors_by_frame(folder / "depth_evaluation.png", error)
            plot_depth_error_map(folder / "depth_error_map.png", error, tracked.model)
    return figures


def evaluate_pixels(
    run: str | Path | Run, tracks: str | Path | PixelTracks, bind_frame: int | None = None
) -> dict[str, Any]:
    """Compare a run with points followed in its images.

    Of a run folder, ``pixel_evaluation.json``, pictures and ``report.html`` are written into it.

    Parameters
    ----------
    run : a run folder, or a run in memory.
    tracks : a file, see `load_tracks`, or tracks in memory.
    bind_frame : the frame whose pixels bind all tracks; where absent, each is bound in the first of its frames that the
        run tracked.

    Returns
    -------
    The content of ``pixel_evaluation.json``: pixels, and millimetres across the sight line.

    Raises
    ------
    EvaluationError
        If the run and the tracks cannot be read or do not fit together, or the folder
        cannot be written to.
    """
    tracked = run if isinstance(run, Run) else load_run(run)
    measured = tracks if isinstance(tracks, PixelTracks) else load_tracks(tracks)
    error = pixel_error(tracked, measured, bind_frame)
    figures = {
        **summarise_pixels(error),
        "notes": [
            *axes_notes(tracked, measured, error, bind_frame),
            *track_notes(tracked, measured, error, bind_frame),
            *shutter_notes(tracked, {*error.frames.tolist(), *error.bind_frames.tolist()}),
        ],
        "tracks": None if isinstance(tracks, PixelTracks) else str(tracks),
        **_counts(tracked),
    }
    if not isinstance(run, Run):
        folder = Path(run)
        from morph_dslam.evaluation.run_report import plot_pixel_error_map, plot_pixel_errors_by_frame, write_run_report

        with writing(EvaluationError, folder):
            (folder / "pixel_evaluation.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
            plot_pixel_errors_by_frame(folder / "pixel_evaluation.png", error)
            plot_pixel_error_map(folder / "pixel_error_map.png", error, tracked.model)
            write_run_report(folder, tracked)
    return figures


def evaluate_force(
    run: str | Path | Run, curve: str | Path | ForceCurve, column: str | None = None, reaction: str | None = None
) -> dict[str, Any]:
    """Compare a measured force with the reaction of the model: the factor between them, an offset, and what is left.

    Of a run folder, ``force_evaluation.json``, a picture and ``report.html`` are written into it.

    Parameters
    ----------
    run : a run folder, or a run in memory.
    curve : a file, see `load_curve`, or a curve in memory.
    column : of the file, where it has several columns of forces.
    reaction : "SET", "SET:x", "SET:+x" or "SET:-x", support and direction; see `force_error` for what is taken without
        them.

    Returns
    -------
    The content of ``force_evaluation.json``, newtons. ``factor`` times the model's force plus ``offset_N`` fits the
    measured one best; ``relative_rms`` is what is left over the range of the measured force.

    Raises
    ------
    EvaluationError
        If the run and the curve cannot be read or do not fit together, the model holds no reactions, or the folder
        cannot be written to.
    """
    tracked = run if isinstance(run, Run) else load_run(run)
    measured = curve if isinstance(curve, ForceCurve) else load_curve(curve, tracked.model, column)
    error = force_error(tracked, measured, reaction)
    path = None if isinstance(curve, ForceCurve) else str(curve)
    figures = {**summarise_force(error), "curve": path, **_counts(tracked)}
    if not isinstance(run, Run):
        folder = Path(run)
        from morph_dslam.evaluation.run_report import plot_force, write_run_report

        with writing(EvaluationError, folder):
            (folder / "force_evaluation.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
            plot_force(folder / "force_evaluation.png", error)
            write_run_report(folder, tracked)
    return figures


def _counts(run: Run) -> dict[str, int]:
    return {"n_frames": len(run.frames), "n_frames_tracked": int(run.tracked.sum())}
