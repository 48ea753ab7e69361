"""The evaluation of a trajectory: figures and a picture, written beside it."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.trajectory_error import (
    AbsoluteError,
    RelativeError,
    Statistics,
    absolute_error,
    match,
    relative_error,
)
from morph_dslam.io.trajectory import Trajectory, load_trajectory

#: The relative error is taken over motions this long, seconds, where the trajectory allows it.
INTERVAL = 1.0
DPI = 110
TRUTH, ESTIMATE = "#1b1f24", "#b4530a"


def evaluate_trajectory(run: Path, truth_path: Path) -> dict[str, Any]:
    """Compare the camera path of a run with the truth.

    Writes ``trajectory_evaluation.json`` and ``trajectory_evaluation.png`` beside the trajectory.

    Parameters
    ----------
    run : a run folder with ``trajectory.txt``, or any trajectory file. truth_path : a trajectory.

    Returns
    -------
    The content of the JSON file; lengths in millimetres, angles in degrees.

    Raises
    ------
    EvaluationError
        If the run has no trajectory, or it and the truth do not overlap in time.
    TrajectoryError
        If one of them cannot be read.
    """
    path = run / "trajectory.txt" if run.is_dir() else run
    if not path.is_file():
        raise EvaluationError(
            f"there is no trajectory {path}: give a run folder with one, or a trajectory file"
        )
    loaded, loaded_truth = load_trajectory(path), load_trajectory(truth_path)
    estimate, truth = match(loaded, loaded_truth)
    figures: dict[str, Any] = {
        "truth": str(truth_path),
        "n_poses": len(loaded),
        "n_pairs": len(estimate),
        "truth_length_m": truth.length,
        "relative_interval_s": _interval(estimate),
    }
    errors = {}
    for name, with_scale in (("se3", False), ("sim3", True)):
        absolute = absolute_error(estimate, truth, with_scale)
        scale = absolute.truth_from_estimate.scale
        relative = relative_error(estimate, truth, figures["relative_interval_s"], scale)
        figures[name] = {
            "scale": scale,
            "absolute_mm": asdict(Statistics.of(1e3 * absolute.distances)),
            "relative_mm": asdict(Statistics.of(1e3 * relative.translations)),
            "relative_deg": asdict(Statistics.of(np.rad2deg(relative.rotations))),
        }
        errors[name] = absolute, relative
    path.with_name(f"{path.stem}_evaluation.json").write_text(json.dumps(figures, indent=2) + "\n")
    plot_trajectory(path.with_name(f"{path.stem}_evaluation.png"), estimate, truth, *errors["sim3"])
    return figures


def _interval(trajectory: Trajectory) -> float:
    """`INTERVAL`, less for a short trajectory, and at least the time between poses."""
    times = trajectory.timestamps
    return max(min(INTERVAL, 0.5 * float(times[-1] - times[0])), float(np.median(np.diff(times))))


def trajectory_line(figures: dict[str, Any]) -> str:
    """The one line that sums up an evaluation."""
    rigid, similar = figures["se3"], figures["sim3"]
    return (
        f"pairs={figures['n_pairs']}/{figures['n_poses']} "
        f"ate_se3_mm={rigid['absolute_mm']['rmse']:.2f} ate_sim3_mm={similar['absolute_mm']['rmse']:.2f} "
        f"scale={similar['scale']:.4f} rpe_mm={similar['relative_mm']['rmse']:.2f} "
        f"rpe_deg={similar['relative_deg']['rmse']:.3f}"
    )


def plot_trajectory(
    path: Path, estimate: Trajectory, truth: Trajectory, absolute: AbsoluteError, relative: RelativeError
) -> None:
    """The path beside the truth, seen along its thinnest direction, and the errors over time."""
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.2])
    first, second = sorted(np.argsort(np.ptp(truth.positions, axis=0))[-2:])
    left.plot(*truth.positions[:, [first, second]].T, color=TRUTH, linewidth=1.0, label="truth")
    left.plot(
        *absolute.aligned[:, [first, second]].T, color=ESTIMATE, linewidth=1.0, label="estimate, aligned"
    )
    left.set_aspect("equal", adjustable="datalim")
    left.set_xlabel(f"{'xyz'[first]} [m]")
    left.set_ylabel(f"{'xyz'[second]} [m]")
    left.legend(fontsize=8, frameon=False)
    start = estimate.timestamps[0]
    right.plot(
        estimate.timestamps - start, 1e3 * absolute.distances, color=ESTIMATE, linewidth=1.0, label="absolute"
    )
    right.plot(
        relative.timestamps - start,
        1e3 * relative.translations,
        color="#8fb3d9",
        linewidth=1.0,
        label="relative",
    )
    right.set_xlabel("time [s]")
    right.set_ylabel("error after Sim(3) alignment [mm]")
    right.set_ylim(bottom=0.0)
    right.legend(fontsize=8, frameon=False)
    rmse = Statistics.of(1e3 * absolute.distances).rmse
    scale = absolute.truth_from_estimate.scale
    right.set_title(f"absolute RMSE {rmse:.2f} mm, scale {scale:.4f}, {len(estimate)} poses", fontsize=10)
    figure.savefig(path, dpi=DPI)
