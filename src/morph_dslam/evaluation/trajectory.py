"""Camera paths against true ones, and how much of a material error is one rigid motion.

A truth sensor whose place relative to the camera is not known exactly moves all truth points of a recording
by one rigid motion, and so does a wrong reference state of the estimate. What is left after the best such
motion is the error of shape and of the motion over the sequence. The figures do not say whose error the
motion is.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.points import MaterialError, millimetres
from morph_dslam.evaluation.trajectory_notes import (
    check_numbers,
    clock_advice,
    clock_notes,
    no_scale,
    pair_notes,
    pose_notes,
    size_notes,
)
from morph_dslam.geometry import SimilarityTransform, fit_similarity, rotation_log
from morph_dslam.io.text import read_text
from morph_dslam.io.trajectory import Trajectory, load_trajectory
from morph_dslam.io.writing import writing
from morph_dslam.slam.map_files import has_known_scale

Array = NDArray[np.float64]


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
        _remaining(error.measured[row][seen], error.vectors[row][seen]) for row, seen in enumerate(known) if seen.any()
    ]
    together = np.linalg.norm(motion.apply(measured) - predicted, axis=1)
    return {
        "after_one_rigid_motion": {
            **millimetres(together),
            "rotation_deg": np.degrees(rotation_log(motion.rotation)).tolist(),
            "shift_of_centre_mm": (1e3 * shift).tolist(),
        },
        "after_one_in_each_frame": millimetres(np.concatenate(single)),
    }


#: Poses of estimate and truth belong together if they are at most this far apart in time, seconds.
MOST_TIME_DIFFERENCE = 0.01


def statistics(errors: Array) -> dict[str, float]:
    """Of errors (n,), at least one, in their unit."""
    figures = {name: float(getattr(np, name)(errors)) for name in ("mean", "median", "std", "min", "max")}
    return {"rmse": float(np.sqrt(np.mean(errors**2))), **figures}


@dataclass(frozen=True)
class AbsoluteError:
    """Distances between the camera centres after the estimate was moved to the truth.

    Attributes
    ----------
    truth_from_estimate : the alignment.
    aligned : (n, 3) estimated centres in the truth's world, metres.
    distances : (n,) metres.
    """

    truth_from_estimate: SimilarityTransform
    aligned: Array
    distances: Array


@dataclass(frozen=True)
class RelativeError:
    """Errors of the motion over an interval: drift.

    Attributes
    ----------
    timestamps : (m,) when each motion begins, seconds.
    translations : (m,) metres.
    rotations : (m,) radians.
    """

    timestamps: Array
    translations: Array
    rotations: Array


def associate(first: Array, second: Array, most: float = MOST_TIME_DIFFERENCE) -> NDArray[np.int64]:
    """Pairs (n, 2) of indices of timestamps (a,) and (b,), both ascending, that are close in time.

    Each timestamp is used once; the closest pairs are made first (as the TUM benchmark's tools do).
    """
    low = np.searchsorted(second, first - most, side="left")
    high = np.searchsorted(second, first + most, side="right")
    rows = np.repeat(np.arange(len(first)), high - low)
    columns = np.concatenate([np.arange(a, b) for a, b in zip(low, high, strict=True)] or [np.arange(0)])
    order = np.argsort(np.abs(first[rows] - second[columns]), kind="stable")
    free_rows, free_columns = np.ones(len(first), dtype=bool), np.ones(len(second), dtype=bool)
    pairs = []
    for row, column in zip(rows[order], columns[order], strict=True):
        if free_rows[row] and free_columns[column]:
            free_rows[row] = free_columns[column] = False
            pairs.append((row, column))
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def match(estimate: Trajectory, truth: Trajectory, most: float = MOST_TIME_DIFFERENCE) -> tuple[Trajectory, Trajectory]:
    """The poses of both trajectories (n each) that belong together in time."""
    pairs = associate(estimate.timestamps, truth.timestamps, most)
    if len(pairs) < 3:
        spans = [f"{t.timestamps[0]:.3f} to {t.timestamps[-1]:.3f} s" for t in (estimate, truth)]
        raise EvaluationError(
            f"only {len(pairs)} poses of estimate and truth are within {most:g} s of each other; the "
            f"estimate spans {spans[0]}, the truth {spans[1]}: {clock_advice(estimate, truth)}"
        )
    rows, columns = pairs.T
    return (
        Trajectory(estimate.timestamps[rows], estimate.world_from_camera[rows]),
        Trajectory(truth.timestamps[columns], truth.world_from_camera[columns]),
    )


def absolute_error(estimate: Trajectory, truth: Trajectory, with_scale: bool) -> AbsoluteError:
    """The absolute trajectory error of matched trajectories after SE(3), or ``with_scale`` Sim(3), alignment."""
    try:
        alignment = fit_similarity(estimate.positions, truth.positions, with_scale)
    except ValueError as error:
        raise EvaluationError(f"the estimate cannot be aligned with the truth: {error}") from error
    aligned = alignment.apply(estimate.positions)
    return AbsoluteError(alignment, aligned, np.linalg.norm(aligned - truth.positions, axis=1))


def relative_error(estimate: Trajectory, truth: Trajectory, interval: float, scale: float = 1.0) -> RelativeError:
    """The relative pose error of matched trajectories over motions that last ``interval``.

    Motions whose time is off by more than half the usual time between poses, over gaps, are left out.

    Parameters
    ----------
    interval : seconds (frames where trajectories are stamped with frame numbers).
    scale : of the truth over the estimate; multiplies the estimate's translations.
    """
    times = estimate.timestamps
    ends = np.searchsorted(times, times + interval)
    # The neighbour that is nearer in time.
    before, after = np.clip(ends - 1, 0, len(times) - 1), np.clip(ends, 0, len(times) - 1)
    goal = times + interval
    ends = np.where(np.abs(times[before] - goal) < np.abs(times[after] - goal), before, after)
    starts = np.flatnonzero(np.abs(times[ends] - goal) <= 0.5 * np.median(np.diff(times)))
    ends = ends[starts]
    if not len(starts):
        raise EvaluationError(f"no two poses of the estimate are {interval:g} s apart: choose another interval")
    scaled = estimate.world_from_camera.copy()
    scaled[:, :3, 3] *= scale
    moved = np.linalg.inv(scaled[starts]) @ scaled[ends]
    expected = np.linalg.inv(truth.world_from_camera[starts]) @ truth.world_from_camera[ends]
    difference = np.linalg.inv(expected) @ moved
    angles = Rotation.from_matrix(difference[:, :3, :3]).magnitude()
    return RelativeError(times[starts], np.linalg.norm(difference[:, :3, 3], axis=1), angles)


#: The relative error is taken over motions this long, seconds, where the trajectory allows it.
INTERVAL = 1.0
OTHER_INSTANTS = "poses of other instants have no common scale"
SCALE_UNKNOWN = (
    "the scale of the run's map is unknown, because one camera cannot measure lengths: there is no ate_se3_mm, and "
    "ate_sim3_mm is what the best scale leaves (truth = scale x estimate)"
)
DPI = 110
TRUTH, ESTIMATE = "#1b1f24", "#b4530a"


def evaluate_trajectory(run: str | Path | Trajectory, truth: str | Path | Trajectory) -> dict[str, Any]:
    """Compare the camera path of a run with the truth.

    Of a run folder or a file, ``trajectory_evaluation.json`` and ``trajectory_evaluation.png`` are written beside the
    trajectory.

    Parameters
    ----------
    run : a run folder with ``trajectory.txt``, any trajectory file, or a trajectory in memory. If the map beside
        ``trajectory.txt`` has no known scale, ``se3`` is None; if one of the paths stands still, ``sim3`` is.
    truth : a trajectory or its file. One that has frame numbers for times belongs to the frames of a run folder.

    Returns
    -------
    The content of the JSON file; lengths in millimetres, angles in degrees.

    Raises
    ------
    EvaluationError
        If the run has no trajectory, or it and the truth do not overlap in time, or one has frame numbers
        and the other seconds, or the scale is unknown and one of them stands still.
    TrajectoryError, MapError
        If one of them, or the run's map, cannot be read.
    """
    if isinstance(run, Trajectory):
        path, loaded = None, run
    else:
        path = _trajectory_file(Path(run))
        loaded = load_trajectory(path)
    whole = truth if isinstance(truth, Trajectory) else load_trajectory(Path(truth))
    # Numbers of frames are compared as they are where the estimate has them too.
    whole = whole if loaded.is_numbered else _timed(whole, path)
    estimate, expected = match(loaded, whole)
    check_numbers(len(estimate), loaded, whole)
    figures: dict[str, Any] = {
        "truth": None if isinstance(truth, Trajectory) else str(truth),
        "n_poses": len(loaded),
        "n_pairs": len(estimate),
        "truth_length_m": expected.length,
        "relative_interval_s": _interval(estimate),
    }
    errors = {}
    is_metric = path is None or _is_in_metres(path)
    still = no_scale(estimate, expected, is_metric)
    if still and not is_metric:
        raise EvaluationError(f"{still}, nor has the run's map: give a recording in which the camera moves")
    for name, with_scale in (("se3", False), ("sim3", True)):
        if still if with_scale else not is_metric:
            figures[name] = None
            continue
        absolute = absolute_error(estimate, expected, with_scale)
        scale = absolute.truth_from_estimate.scale
        relative = relative_error(estimate, expected, figures["relative_interval_s"], scale)
        figures[name] = {
            "scale": scale,
            "absolute_mm": statistics(1e3 * absolute.distances),
            "relative_mm": statistics(1e3 * relative.translations),
            "relative_deg": statistics(np.rad2deg(relative.rotations)),
        }
        errors[name] = absolute, relative
    clocks = list(clock_notes(loaded, whole))
    # Poses of other instants tell nothing of conventions, nor of a scale.
    poses = [] if clocks else pose_notes(estimate, expected)
    mistakes = [*clocks, *pair_notes(len(estimate), loaded, whole), *poses]
    still = OTHER_INSTANTS if still and clocks else still
    figures["notes"] = [*mistakes, *_scale_notes(figures, bool(mistakes), still, expected)]
    if path is not None:
        with writing(EvaluationError, path.parent):
            content, picture = trajectory_evaluation_files(path)
            content.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
            shown, alignment = ("se3", "SE(3)") if still else ("sim3", "Sim(3)")
            absolute, relative = errors[shown]
            plot_trajectory(picture, estimate, expected, absolute, relative, alignment)
    return figures


def trajectory_evaluation_files(run: str | Path) -> tuple[Path, Path]:
    """Figures and picture that `evaluate_trajectory` writes for a run folder or a trajectory file."""
    run = Path(run)
    path = _trajectory_file(run)
    return path.with_name(f"{path.stem}_evaluation.json"), path.with_name(f"{path.stem}_evaluation.png")


def _trajectory_file(path: Path) -> Path:
    path = path / "trajectory.txt" if path.is_dir() else path
    if not path.is_file():
        raise EvaluationError(f"there is no trajectory {path}: give a run folder with one, or a trajectory file")
    return path


def _timed(truth: Trajectory, path: Path | None) -> Trajectory:
    """A truth that has frame numbers for times, stamped with the seconds that a run has for its frames.

    Poses of frames that the run has not are left out. Without a run's table of frames nothing changes.
    """
    table = None if path is None else path.with_name("frames.csv")
    if table is None or not truth.is_numbered or not table.is_file():
        return truth
    try:
        rows = list(csv.DictReader(read_text(table, "table of frames", EvaluationError).splitlines()))
        seconds = {float(row["frame"]): float(row["timestamp_s"]) for row in rows}
    except (KeyError, TypeError, ValueError) as error:
        raise EvaluationError(f"{table} does not say when frames were: give the run folder as it was made") from error
    known = np.array([number in seconds for number in truth.timestamps.tolist()], dtype=bool)
    if not known.any():
        raise EvaluationError(
            f"the truth has poses of the frames {truth.timestamps[0]:.0f} to {truth.timestamps[-1]:.0f}, and none of "
            f"them is in {table}: give the truth of this recording"
        )
    times = np.array([seconds[number] for number in truth.timestamps[known].tolist()])
    order = np.argsort(times, kind="stable")
    return Trajectory(times[order], truth.world_from_camera[known][order])


def _is_in_metres(path: Path) -> bool:
    """Whether a trajectory's lengths may be metres: not those of a map whose scale nobody gave or measured."""
    rigid_map = path.with_name("map.h5")
    return path.name != "trajectory.txt" or not rigid_map.is_file() or has_known_scale(rigid_map)


def _interval(trajectory: Trajectory) -> float:
    """`INTERVAL`, less for a short trajectory, and at least the time between poses."""
    times = trajectory.timestamps
    return max(min(INTERVAL, 0.5 * float(times[-1] - times[0])), float(np.median(np.diff(times))))


def _scale_notes(figures: dict[str, Any], are_wrong: bool, still: str, truth: Trajectory) -> Iterator[str]:
    """What a reader must know of the lengths of an evaluated path.

    Parameters
    ----------
    figures : of the evaluation.
    are_wrong : whether its times or poses are.
    still : why there is no scale, as `no_scale` says it.
    truth : the true path.
    """
    rigid, similar = figures["se3"], figures["sim3"]
    if still:
        yield f"{still}: there are no ate_sim3_mm and scale, and rpe_mm is that of the lengths as they are"
    elif rigid is None:
        yield SCALE_UNKNOWN
    elif not are_wrong:
        yield from size_notes(similar["scale"], rigid["absolute_mm"]["rmse"], similar["absolute_mm"]["rmse"], truth)


def trajectory_line(figures: dict[str, Any]) -> str:
    """The line that sums up an evaluation, below its notes."""
    rigid, similar = figures["se3"], figures["sim3"]
    relative = rigid if similar is None else similar
    absolute = {
        name: np.nan if figures[name] is None else figures[name]["absolute_mm"]["rmse"] for name in ("se3", "sim3")
    }
    notes = "".join(f"note: {note}\n" for note in figures["notes"])
    return (
        f"{notes}pairs={figures['n_pairs']}/{figures['n_poses']} "
        f"ate_se3_mm={absolute['se3']:.2f} ate_sim3_mm={absolute['sim3']:.2f} "
        f"scale={np.nan if similar is None else similar['scale']:.4f} rpe_mm={relative['relative_mm']['rmse']:.2f} "
        f"rpe_deg={relative['relative_deg']['rmse']:.3f}"
    )


def plot_trajectory(
    path: Path,
    estimate: Trajectory,
    truth: Trajectory,
    absolute: AbsoluteError,
    relative: RelativeError,
    alignment: str = "Sim(3)",
) -> None:
    """The path beside the truth, seen along its thinnest direction, and the errors after an ``alignment`` over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.2])
    first, second = sorted(np.argsort(np.ptp(truth.positions, axis=0))[-2:])
    left.plot(*truth.positions[:, [first, second]].T, color=TRUTH, linewidth=1.0, label="truth")
    left.plot(*absolute.aligned[:, [first, second]].T, color=ESTIMATE, linewidth=1.0, label="estimate, aligned")
    left.set_aspect("equal", adjustable="datalim")
    left.set_xlabel(f"{'xyz'[first]} [m]")
    left.set_ylabel(f"{'xyz'[second]} [m]")
    left.legend(fontsize=8, frameon=False)
    start = estimate.timestamps[0]
    right.plot(estimate.timestamps - start, 1e3 * absolute.distances, color=ESTIMATE, linewidth=1.0, label="absolute")
    right.plot(
        relative.timestamps - start, 1e3 * relative.translations, color="#8fb3d9", linewidth=1.0, label="relative"
    )
    right.set_xlabel("time [s]")
    right.set_ylabel(f"error after {alignment} alignment [mm]")
    right.set_ylim(bottom=0.0)
    right.legend(fontsize=8, frameon=False)
    rmse = statistics(1e3 * absolute.distances)["rmse"]
    scale = absolute.truth_from_estimate.scale
    right.set_title(f"absolute RMSE {rmse:.2f} mm, scale {scale:.4f}, {len(estimate)} poses", fontsize=10)
    figure.savefig(path, dpi=DPI)
