"""The evaluation of a run: figures, pictures and a report, written into its folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from morph_dslam.evaluation.depth import depth_error, summarise_depth
from morph_dslam.evaluation.points import load_truth, material_error, summarise
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.evaluation.run_report import (
    plot_depth_error_map,
    plot_depth_errors_by_frame,
    plot_error_map,
    plot_errors_by_frame,
    write_run_report,
)
from morph_dslam.evaluation.trajectory import summarise_alignment


def evaluate(folder: str | Path, truth_path: str | Path, bind_frame: int) -> dict[str, Any]:
    """Compare a run with truth points and write ``evaluation.json``, pictures and ``report.html`` into it.

    Parameters
    ----------
    folder : a run folder.
    truth_path : a truth file.
    bind_frame : the frame whose pixels bind the points.

    Returns
    -------
    The content of ``evaluation.json``.

    Raises
    ------
    EvaluationError
        If the run and the truth cannot be read or do not fit together.
    """
    folder, truth_path = Path(folder), Path(truth_path)
    run, truth = load_run(folder), load_truth(truth_path)
    error = material_error(run, truth, bind_frame)
    figures = {
        **summarise(error),
        **summarise_alignment(error),
        "truth": str(truth_path),
        "n_frames": len(run.frames),
        "n_frames_tracked": int(run.tracked.sum()),
        "median_ms": float(np.nanmedian(run.frame_times)),
        "p95_ms": float(np.nanpercentile(run.frame_times, 95)),
    }
    (folder / "evaluation.json").write_text(json.dumps(figures, indent=2) + "\n")
    plot_errors_by_frame(folder / "evaluation.png", error)
    plot_error_map(folder / "error_map.png", error, run.model)
    write_run_report(run, figures)
    return figures


def evaluate_depth(
    folder: str | Path, depth: str | Path, base_frame: int | None = None, values_per_metre: float | None = None
) -> dict[str, Any]:
    """Compare a run's surfaces with depth images; writes ``depth_evaluation.json`` and pictures into it.

    Parameters
    ----------
    folder : a run folder.
    depth, values_per_metre : see `read_depths`.
    base_frame : a frame in which the object is not deformed, whose error stands beside the others'.

    Returns
    -------
    The content of ``depth_evaluation.json``.

    Raises
    ------
    EvaluationError
        If the run or the depth images cannot be read or do not fit together.
    """
    folder, depth = Path(folder), Path(depth)
    run = load_run(folder)
    error = depth_error(run, depth, base_frame, values_per_metre)
    figures = {
        **summarise_depth(error),
        "depth": str(depth),
        "n_frames": len(run.frames),
        "n_frames_tracked": int(run.tracked.sum()),
    }
    (folder / "depth_evaluation.json").write_text(json.dumps(figures, indent=2) + "\n")
    plot_depth_errors_by_frame(folder / "depth_evaluation.png", error)
    plot_depth_error_map(folder / "depth_error_map.png", error, run.model)
    return figures
