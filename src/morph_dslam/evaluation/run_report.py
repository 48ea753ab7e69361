"""The report of an evaluated run, and the pictures of its errors."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.depth import DepthError
from morph_dslam.evaluation.force import ForceError, noticed
from morph_dslam.evaluation.model_summary import flatten, summarise_model
from morph_dslam.evaluation.pixels import PixelError, pixel_remarks
from morph_dslam.evaluation.points import MaterialError
from morph_dslam.evaluation.report import Link, Picture, Section, Table, Text, write_report
from morph_dslam.evaluation.run_folder import Run, remarks
from morph_dslam.model import ReducedModel
from morph_dslam.sources.frames import frame_rate, open_capture

DPI = 110
MEDIAN, MEAN = "#b4530a", "#1b1f24"
#: More frames than this are drawn as bands.
MOST_BOXES = 30


def _draw_boxes(axes: Axes, frames: NDArray[np.int64], distances: list[NDArray]) -> None:
    rng = np.random.default_rng(0)
    for position, values in enumerate(distances, start=1):
        shift = rng.uniform(-0.25, 0.25, len(values))
        axes.plot(position + shift, values, ".", color="#8fb3d9", markersize=2.5, zorder=1)
    axes.boxplot(
        distances,
        whis=(5, 95),
        showfliers=False,
        showmeans=True,
        widths=0.6,
        medianprops={"color": MEDIAN, "linewidth": 1.6},
        meanprops={"marker": "D", "markerfacecolor": MEAN, "markeredgecolor": MEAN, "markersize": 4},
    )
    axes.set_xticks(range(1, len(distances) + 1), [str(frame) for frame in frames])


def _draw_bands(axes: Axes, frames: NDArray[np.int64], distances: list[NDArray]) -> None:
    low, lower, median, upper, high = np.array([np.percentile(v, (5, 25, 50, 75, 95)) for v in distances]).T
    axes.fill_between(frames, low, high, color="#d4e2f1", linewidth=0.0, label="5th to 95th percentile")
    axes.fill_between(frames, lower, upper, color="#8fb3d9", linewidth=0.0, label="quartiles")
    axes.plot(frames, median, color=MEDIAN, linewidth=1.4, label="median")
    axes.plot(frames, [values.mean() for values in distances], color=MEAN, linewidth=1.4, label="mean")
    axes.margins(x=0.01)
    axes.legend(fontsize=8, frameon=False, loc="upper left")


def plot_errors_by_frame(path: Path, error: MaterialError) -> None:
    """The spread of the material error over the points of each truth frame."""
    measured = np.isfinite(error.distances).any(axis=1)
    distances = [1e3 * row[np.isfinite(row)] for row in error.distances[measured]]
    title = f"bound in frame {error.binding.frame}"
    _plot_by_frame(path, error.frames[measured], distances, distances, "material error [mm]", title)


def plot_depth_errors_by_frame(path: Path, error: DepthError) -> None:
    """The spread of the surface error over the sensor's points of each frame, beside that of the sensor."""
    # In a frame that shows something else before the whole object, all points are left out.
    frames, rows = zip(
        *((f, row) for f, row in zip(error.frames, error.distances, strict=True) if len(row)), strict=True
    )
    distances = [1e3 * row for row in rows]
    base = error.base
    title = "no base frame"
    if base is not None and len(base):
        title = f"sensor and registration in frame {error.base_frame}: mean {1e3 * base.mean():.2f} mm (dotted)"
    shown = None if base is None or not len(base) else 1e3 * float(base.mean())
    label = "distance to the estimated surface [mm]"
    _plot_by_frame(path, np.array(frames), distances, [1e3 * error.compared], label, title, shown)


def plot_pixel_errors_by_frame(path: Path, error: PixelError) -> None:
    """The spread of the pixel error over the tracks of each frame."""
    distances = [row[np.isfinite(row)] for row in error.distances_px]
    across = 1e3 * error.across[np.isfinite(error.across)]
    title = f"across the line of sight: mean {across.mean():.3f} mm, 95th percentile {np.percentile(across, 95):.3f} mm"
    _plot_by_frame(path, error.frames, distances, distances, "pixel error [px]", title, unit="px")


def _plot_by_frame(
    path: Path,
    frames: NDArray[np.int64],
    distances: list[NDArray],
    counted: list[NDArray],
    label: str,
    title: str,
    base: float | None = None,
    unit: str = "mm",
) -> None:
    """Boxes for few frames, bands for many; the mean of ``counted`` dashed, ``base`` dotted."""
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    axes = figure.add_subplot()
    draw = _draw_boxes if len(distances) <= MOST_BOXES else _draw_bands
    draw(axes, frames, distances)
    values = np.concatenate(counted)
    axes.axhline(values.mean(), color=MEAN, linewidth=0.8, linestyle="--")
    if base is not None:
        axes.axhline(base, color=MEAN, linewidth=1.0, linestyle=":")
    axes.set_xlabel("frame")
    axes.set_ylabel(label)
    axes.set_ylim(bottom=0.0)
    axes.set_title(
        f"mean {values.mean():.2f} {unit} (dashed), median {np.median(values):.2f} {unit}, "
        f"95th percentile {np.percentile(values, 95):.2f} {unit}\n{title}",
        fontsize=10,
    )
    figure.savefig(path, dpi=DPI)


def plot_force(path: Path, error: ForceError) -> None:
    """The measured force and the model's, as it is and fitted, by frame or by the parameter's value."""
    curve, order = error.curve, np.argsort(error.places)
    by_frame = curve.against == "frame"
    scale, label = (1.0, "frame") if by_frame else error.axis
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    axes = figure.add_subplot()
    places = scale * error.places[order]
    measured = np.argsort(curve.places)
    axes.plot(scale * curve.places[measured], curve.forces[measured], color=MEAN, linewidth=1.4, label="measured")
    axes.plot(places, error.modelled[order], color="#8fb3d9", linewidth=1.2, label="model")
    fitted = (error.measured + error.residuals)[order]
    name = f"{error.factor:.4g} x model {error.offset:+.3g} N"
    axes.plot(places, fitted, color=MEDIAN, linewidth=1.4, linestyle="--", label=name)
    axes.set_xlabel(label)
    axes.set_ylabel(f"force on {error.support}, direction {error.direction} [N]")
    axes.set_title(f"rms {np.sqrt(np.mean(error.residuals**2)):.3g} N after the fit", fontsize=10)
    axes.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=DPI)


def outline_edges(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Edges (e, 2) that belong to one triangle only."""
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    return unique[counts == 1]


def plot_error_map(path: Path, error: MaterialError, model: ReducedModel) -> None:
    """Mean error of each material point where it lies on the undeformed object."""
    measured = np.isfinite(error.distances).any(axis=0)
    mean = np.nanmean(error.distances[:, measured], axis=0)
    rest = model.rest_positions(error.binding.points)[measured]
    _plot_map(path, rest, mean, model, "mean material error [mm]")


def plot_pixel_error_map(path: Path, error: PixelError, model: ReducedModel) -> None:
    """Mean error across the line of sight of each track where its point lies on the undeformed object."""
    measured = np.isfinite(error.across).any(axis=0)
    rest = model.rest_positions(error.points)[measured]
    _plot_map(
        path, rest, np.nanmean(error.across[:, measured], axis=0), model, "mean error across\nthe line of sight [mm]"
    )


def plot_depth_error_map(path: Path, error: DepthError, model: ReducedModel) -> None:
    """Mean distance of the sensor's points around each mesh node, on the undeformed object."""
    means = error.node_means(len(model.nodes))
    seen = np.isfinite(means)
    _plot_map(path, model.nodes[seen], means[seen], model, "mean distance to the surface [mm]")


def _plot_map(path: Path, rest: NDArray, mean: NDArray, model: ReducedModel, label: str) -> None:
    """Points (p, 3) of the undeformed object coloured by their means (p,); both in metres."""
    # The two longest directions of the object span the picture.
    first, second = sorted(np.argsort(np.ptp(model.nodes, axis=0))[-2:])
    wide, high = np.ptp(model.nodes[:, [first, second]], axis=0)
    height = float(np.clip(5.5 * high / wide, 2.5, 5.2))
    figure = Figure(figsize=(height * float(np.clip(wide / high, 0.4, 2.2)) + 2.2, height), layout="constrained")
    axes = figure.add_subplot()
    flat = 1e3 * model.nodes[:, [first, second]]
    axes.add_collection(PolyCollection(list(flat[model.triangles]), facecolors="#e3e7eb", edgecolors="#e3e7eb"))
    segments = flat[outline_edges(model.triangles)]  # a closed surface has none
    axes.add_collection(LineCollection(list(segments), colors="#57606a", linewidths=1.0))
    dots = axes.scatter(1e3 * rest[:, first], 1e3 * rest[:, second], c=1e3 * mean, s=26, cmap="viridis", vmin=0.0)
    axes.set_aspect("equal")
    axes.autoscale()
    axes.set_xlabel(f"{'xyz'[first]} on the undeformed object [mm]")
    axes.set_ylabel(f"{'xyz'[second]} [mm]")
    figure.colorbar(dots, label=label)
    figure.savefig(path, dpi=DPI)


VIDEO = "augmented.mp4"
N_FRAMES_SHOWN = 4
#: Keys of ``summary.json`` that the figures of the evaluation repeat.
_SHOWN_ABOVE = ("model", "n_frames", "n_tracked", "median_ms", "p95_ms")


def sample_video(path: Path, count: int) -> list[tuple[float, bytes]]:
    """Up to ``count`` frames spread over a video, as (seconds, JPEG); none if it cannot be read."""
    capture = open_capture(str(path))
    total = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    wanted = set(np.linspace(0, total - 1, count + 2).round().astype(int)[1:-1].tolist()) if total > 0 else set()
    pictures = []
    # Seeking is not exact in every container; reading on is.
    for position in range(max(wanted, default=-1) + 1):
        read, image = capture.read()
        if not read:
            break
        if position in wanted:
            jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()
            pictures.append((position / frame_rate(capture), jpeg))
    capture.release()
    return pictures


def _error_section(folder: Path, figures: Mapping[str, Any]) -> Section:
    rows = {
        "mean": f"{figures['mean_mm']:.3f} mm",
        "median": f"{figures['median_mm']:.3f} mm",
        "95th percentile": f"{figures['p95_mm']:.3f} mm",
        "largest": f"{figures['max_mm']:.3f} mm",
        "mean along the line of sight": f"{figures['mean_along_sight_mm']:.3f} mm",
        "mean across the line of sight": f"{figures['mean_across_sight_mm']:.3f} mm",
        "mean after one rigid motion of the truth": f"{figures['after_one_rigid_motion']['mean_mm']:.3f} mm",
        "mean after one in each frame": f"{figures['after_one_in_each_frame']['mean_mm']:.3f} mm",
        "points compared": f"{figures['n_points_bound']} of {figures['n_points']}",
        "frames compared": f"{len(figures['frames_compared'])}, bound in frame {figures['bind_frame']}",
        "frames tracked": f"{figures['n_frames_tracked']} of {figures['n_frames']}",
        "time a frame": f"median {figures['median_ms']:.2f} ms, 95th percentile {figures['p95_ms']:.2f} ms",
    }
    captions = {
        "evaluation.png": "Material error over the points of each frame with truth.",
        "error_map.png": "Mean material error where each point lies on the undeformed object.",
    }
    blocks = [Table.of(rows), *_warnings(remarks(figures)), *_pictures(folder, captions)]
    return Section("Material error, without alignment", blocks)


def _pixel_section(folder: Path, figures: Mapping[str, Any]) -> Section:
    names = {"mean": "mean", "median": "median", "p95": "95th percentile", "max": "largest"}
    rows = {
        name: f"{figures[f'{key}_px']:.3f} px, {figures[f'{key}_mm']:.4f} mm across the line of sight"
        for key, name in names.items()
    }
    rows["mean shift to the right and down"] = ", ".join(f"{shift:.3f} px" for shift in figures["mean_shift_px"])
    rows["tracks compared"] = f"{figures['n_tracks_compared']} of {figures['n_tracks']}"
    rows["frames compared"] = str(len(figures["frames_compared"]))
    rows["frames tracked"] = f"{figures['n_frames_tracked']} of {figures['n_frames']}"
    worst = [
        (name, *(f"{of[key]:.3f}" for key in ("mean_px", "max_px", "mean_mm")), str(of["n_frames"]))
        for name, of in ((name, figures["per_track"][name]) for name in figures["worst_tracks"])
    ]
    captions = {
        "pixel_evaluation.png": "Pixel error over the tracks of each frame.",
        "pixel_error_map.png": "Mean error across the line of sight where each track lies on the undeformed object.",
    }
    table = Table(worst, ("largest errors: track", "mean px", "largest px", "mean mm", "frames"))
    blocks = [Table.of(rows), *_warnings(pixel_remarks(figures)), *_pictures(folder, captions), table]
    return Section("Error of tracks in the images, without alignment", blocks)


def _force_section(folder: Path, figures: Mapping[str, Any]) -> Section:
    rows = {
        "reaction": f"force on '{figures['support']}', direction {figures['direction']} of the object frame",
        "factor": f"{figures['factor']:.4f}, standard deviation {figures['factor_std']:.4f}",
        "offset": f"{figures['offset_N']:.4g} N",
        "rms after the fit": f"{figures['rms_N']:.4g} N, {100.0 * figures['relative_rms']:.2f} % of the measured range",
        "rms without it": f"{figures['rms_without_fit_N']:.4g} N",
        "frames compared": f"{len(figures['frames_compared'])} of {figures['n_frames']}",
    }
    plot = _pictures(folder, {"force_evaluation.png": f"Measured force ({figures['column']}) and the model's."})
    return Section("Force", [Table.of(rows), *_warnings(noticed(figures)), *plot])


def _warnings(lines: Sequence[str]) -> list[Text]:
    return [Text(line, warning=True) for line in lines]


def _pictures(folder: Path, captions: Mapping[str, str]) -> list[Picture]:
    return [Picture.read(folder / name, caption) for name, caption in captions.items()]


#: What each file with figures adds to the report.
_EVALUATIONS = {
    "evaluation.json": _error_section,
    "pixel_evaluation.json": _pixel_section,
    "force_evaluation.json": _force_section,
}


def _evaluations(folder: Path) -> list[Section]:
    files = [(folder / name, make) for name, make in _EVALUATIONS.items()]
    return [make(folder, _content(path)) for path, make in files if path.is_file()]


def _video_section(folder: Path) -> Section:
    if not (folder / VIDEO).is_file():
        return Section("Augmented video", [])
    # The number of the frame is in the picture. Its place in the video does not give it: a live run's video stands
    # still where frames were dropped, a rig's leaves out what the first camera lacks.
    frames = [Picture(data, ".jpg", f"At {s:.1f} s") for s, data in sample_video(folder / VIDEO, N_FRAMES_SHOWN)]
    return Section("Augmented video", [Link(VIDEO, f"The whole video ({VIDEO})"), *frames])


def _lost_section(run: Run) -> Section:
    lost = np.flatnonzero(~run.tracked)
    rows = [(str(run.frames[row]), run.status[row], run.reasons[row]) for row in lost]
    return Section("Frames that were not tracked", [Table(rows, ("frame", "status", "reason"))] if rows else [])


def _content(path: Path) -> dict[str, Any]:
    """The figures in a file of the run, none where there is no file; raises EvaluationError if damaged."""
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise EvaluationError(f"{path} is damaged ({error}): restore or delete it") from error
    if not isinstance(content, dict):
        raise EvaluationError(f"{path} does not hold figures of a run: restore or delete it")
    return content


def _tracking_sections(folder: Path) -> list[Section]:
    summary = _content(folder / "summary.json")
    flags = [Text(str(flag), warning=True) for flag in summary.pop("flags", [])]
    background = {key: summary.pop(key) for key in ("inputs", "settings", "versions") if key in summary}
    facts = flatten({key: value for key, value in summary.items() if key not in _SHOWN_ABOVE})
    plots = [Picture.read(plot, plot.stem) for plot in sorted((folder / "plots").glob("*.png"))]
    return [
        Section("Tracking", [*flags, *([Table.of(facts)] if facts else []), *plots]),
        Section("Settings and versions", [Table.of(flatten(background))] if background else []),
    ]


def write_run_report(folder: Path, run: Run) -> Path:
    """Write ``report.html`` into a run folder, with every evaluation whose figures are in it."""
    tracking, settings = _tracking_sections(folder)
    sections = [
        *_evaluations(folder),
        _video_section(folder),
        _lost_section(run),
        tracking,
        *(Section(f"Model: {name}", [table]) for name, table in summarise_model(run.model.without_loads).items()),
        settings,
    ]
    path = folder / "report.html"
    write_report(path, f"{run.model.name}: tracked in {len(run.frames)} frames", sections)
    return path
