"""Plots of a run over its frames: parameters, residual and points, stage times."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from morph_dslam.model.shown_field import shown_kind
from morph_dslam.tracking.reactions import VectorEstimate
from morph_dslam.tracking.result import STAGES
from morph_dslam.tracking.run_results import RunResults

DPI = 110
#: Width of a figure over the frames, the room around its axes, and between them, inches.
WIDTH, LEFT, RIGHT, BOTTOM, TOP, GAP = 9.0, 0.95, 0.15, 0.5, 0.15, 0.12
#: Stages that are drawn with a colour of their own: as many as there are colours, with this part of the time.
MOST_STAGES, LEAST_SHARE = 10, 0.005
#: A moment that is a smaller share of the largest force times the object's size is rounding.
ROUNDING = 1e-6


def write_plots(folder: Path, run: RunResults) -> None:
    """Write ``residual.png``, ``timings.png`` and, where there is something in them, the other plots of the run."""
    folder.mkdir(exist_ok=True)
    if run.model.study_parameters:
        plot_confidence(folder / "confidence.png", run)
        plot_parameters(folder / "parameters.png", run)
    if run.points is not None:
        plot_points(folder / "points.png", run)
    if run.reactions():
        plot_reactions(folder / "reactions.png", run)
    plot_residual(folder / "residual.png", run)
    plot_timings(folder / "timings.png", run)
    if any(result.jumps for result in run.results):
        plot_jumps(folder / "jumps.png", run)


def _shade_lost(axes: Axes, run: RunResults) -> None:
    for frame, tracked in zip(run.frames, run.tracked, strict=True):
        if not tracked:
            axes.axvspan(frame - 0.5, frame + 0.5, color="#d9534f", alpha=0.18, linewidth=0)


def plot_parameters(path: Path, run: RunResults) -> None:
    """Each parameter in its unit with a band of two standard deviations and the ends of its range."""
    parameters, frames = run.model.study_parameters, np.array(run.frames)
    figure, all_axes = _rows(len(parameters), 1.9)
    values, deviations, at_bound = run.parameters(), run.parameter_std(), run.at_bound()
    for k, (axes, parameter) in enumerate(zip(all_axes, parameters, strict=True)):
        unit, held = parameter.display(1.0), at_bound[:, k]
        value, low, high = values[:, k] * unit, parameter.lower * unit, parameter.upper * unit
        margin = 0.06 * (high - low)
        deviation = np.nan_to_num(deviations[:, k] * unit, posinf=0.5 * (high - low))
        _plot_band(axes, run, value, deviation, (low - margin, high + margin))
        axes.plot(frames[held], value[held], "o", color="#d9534f", markersize=3.5, label="at a bound")
        for bound in (low, high):
            axes.axhline(bound, color="#888888", linewidth=0.8, linestyle="--")
        axes.set_ylabel(f"{parameter.name} [{parameter.unit}]")
    all_axes[0].legend(loc="upper left", fontsize=8)
    figure.savefig(path, dpi=DPI)


def plot_confidence(path: Path, run: RunResults) -> None:
    """The largest displacement and the largest stress, each with a band of two standard deviations."""
    rows = [("largest displacement [mm]", 1e3 * run.largest_displacements())]
    if run.model.stresses:
        kind = shown_kind(run.model, "stress")
        rows.append((f"largest {kind.name} [{kind.unit}]", run.largest_stresses() / kind.si_factor))
    figure, all_axes = _rows(len(rows), 2.2)
    for axes, (label, both) in zip(all_axes, rows, strict=True):
        # A frame that tells nothing must not hide what the others tell.
        top = 1.5 * float(np.nanmax(both[:, 0], initial=0.0)) or 1.0
        _plot_band(axes, run, both[:, 0], both[:, 1], (0.0, top))
        axes.set_ylabel(label)
    all_axes[0].legend(loc="upper left", fontsize=8)
    figure.savefig(path, dpi=DPI)


def plot_reactions(path: Path, run: RunResults) -> None:
    """Size of force and moment of each support, each with a band of two standard deviations.

    A moment that is rounding beside what the forces give at the object's size is left out.
    """
    reactions = run.reactions()
    sizes = {
        kind: {name: _with_deviations([getattr(one, kind, None) for one in found]) for name, found in reactions.items()}
        for kind in ("force", "moment")
    }
    largest = max(float(np.nanmax(both[:, 0], initial=0.0)) for both in sizes["force"].values())
    least = ROUNDING * largest * float(np.linalg.norm(np.ptp(run.model.nodes, axis=0)))
    rows = list[tuple[str, NDArray]]()
    for name in reactions:
        rows.append((f"force on {name} [N]", sizes["force"][name]))
        if np.nanmax(sizes["moment"][name][:, 0], initial=0.0) > least:
            rows.append((f"moment on {name} [N mm]", 1e3 * sizes["moment"][name]))
    figure, all_axes = _rows(len(rows), 1.9)
    for axes, (label, both) in zip(all_axes, rows, strict=True):
        top = 1.2 * float(np.nanmax(both[:, 0], initial=0.0)) or 1.0
        _plot_band(axes, run, both[:, 0], both[:, 1], (0.0, top))
        axes.set_ylabel(label, fontsize=8)
    all_axes[0].legend(loc="upper left", fontsize=8)
    figure.savefig(path, dpi=DPI)


def plot_points(path: Path, run: RunResults) -> None:
    """Displacement and rotation of each named point about x, y and z, each with a band of two standard deviations."""
    turns, rows = run.point_turns(), list[tuple[str, float, Sequence[VectorEstimate | None]]]()
    for name, moved in run.point_displacements().items():
        rows += [
            (f"displacement of {name} [mm]", 1e3, moved),
            (f"rotation of {name} [deg]", float(np.degrees(1.0)), turns[name]),
        ]
    figure, all_axes = _rows(len(rows), 1.9)
    lost = np.full(3, np.nan)
    for axes, (label, factor, frames) in zip(all_axes, rows, strict=True):
        values = factor * np.array([lost if one is None else one.value for one in frames])
        deviations = factor * np.array([lost if one is None else one.std for one in frames])
        reach = 1.2 * float(np.nanmax(np.abs(values), initial=0.0)) or 1.0
        for k, axis in enumerate("xyz"):
            low, high = (np.clip(values[:, k] + side * 2.0 * deviations[:, k], -reach, reach) for side in (-1.0, 1.0))
            axes.fill_between(run.frames, low, high, color=f"C{k}", alpha=0.25, linewidth=0)
            axes.plot(run.frames, values[:, k], color=f"C{k}", linewidth=1.4, label=axis)
        axes.set_ylim(-reach, reach)
        axes.set_ylabel(label, fontsize=8)
        _shade_lost(axes, run)
    all_axes[0].legend(loc="upper left", fontsize=8, ncols=3, title="±2 standard deviations", title_fontsize=8)
    figure.savefig(path, dpi=DPI)


def _with_deviations(found: Sequence[VectorEstimate | None]) -> NDArray:
    """Sizes of vectors and their standard deviations (f, 2), NaN where there is none."""
    return np.array([(np.nan, np.nan) if one is None else (one.size, one.size_std) for one in found])


def _rows(count: int, height: float, top: float = TOP) -> tuple[Figure, NDArray]:
    """A figure with axes one below the other over the frames, each of a height, inches, and room above them.

    Their places are given: a layout engine would draw everything twice to find them, most of the time of a plot.
    """
    total = BOTTOM + top + count * height
    figure = Figure(figsize=(WIDTH, total))
    all_axes = np.atleast_1d(figure.subplots(count, 1, sharex=True))
    figure.subplots_adjust(
        left=LEFT / WIDTH, right=1.0 - RIGHT / WIDTH, bottom=BOTTOM / total, top=1.0 - top / total, hspace=GAP / height
    )
    figure.align_ylabels(all_axes)
    all_axes[-1].set_xlabel("frame")
    return figure, all_axes


def _plot_band(axes: Axes, run: RunResults, value: NDArray, deviation: NDArray, limits: tuple[float, float]) -> None:
    low, high = np.clip(value - 2.0 * deviation, *limits), np.clip(value + 2.0 * deviation, *limits)
    band = {"color": "#4878a8", "alpha": 0.25, "linewidth": 0, "label": "±2 standard deviations"}
    axes.fill_between(run.frames, low, high, **band)
    axes.plot(run.frames, value, color="#1f4e79", linewidth=1.4)
    axes.set_ylim(*limits)
    _shade_lost(axes, run)


def plot_residual(path: Path, run: RunResults) -> None:
    """Residual of the supporting points, and how many they are."""
    figure, (upper, lower) = _rows(2, 1.9)
    upper.plot(run.frames, run.residuals_px(), color="#1f4e79", linewidth=1.4)
    upper.set_ylabel("residual (RMS) [px]")
    upper.set_ylim(bottom=0.0)
    counts = run.counts()
    lower.plot(run.frames, counts[:, 0], color="#888888", linewidth=1.2, label="not hidden by the object")
    lower.plot(run.frames, counts[:, 1], color="#1f4e79", linewidth=1.4, label="supporting the estimate")
    lower.set_ylabel("points")
    lower.set_ylim(0.0, 1.1 * max(float(counts.max()), 1.0))
    lower.legend(loc="lower left", fontsize=8)
    for axes in (upper, lower):
        _shade_lost(axes, run)
    figure.savefig(path, dpi=DPI)


def plot_timings(path: Path, run: RunResults) -> None:
    """Stage times stacked, with the time between two frames at 30 a second."""
    times = run.timings_ms()
    figure, (axes,) = _rows(1, 3.0, top=0.4)
    sums = times[:, :-1].sum(axis=0)
    used = [int(k) for k in np.sort(np.argsort(sums)[-MOST_STAGES:]) if sums[k] > LEAST_SHARE * sums.sum()]
    rest = np.maximum(times[:, -1] - times[:, used].sum(axis=1), 0.0)
    colours = [*(f"C{k}" for k in range(len(used))), "#d0d7de"]
    axes.stackplot(
        run.frames,
        [*times[:, used].T, rest],
        labels=[*(STAGES[k] for k in used), "all else"],
        colors=colours,
        step="mid",
        linewidth=0,
    )
    axes.plot(run.frames, times[:, -1], color="#1b1f24", linewidth=0.9, label="total")
    axes.axhline(1e3 / 30, color="#d9534f", linewidth=1.0, linestyle="--", label="30 frames a second")
    axes.set_ylabel("time a frame [ms]")
    axes.set_title(f"median {np.median(times[:, -1]):.1f} ms", fontsize=10)
    axes.set_ylim(0.0, max(36.0, 1.1 * float(np.percentile(times[:, -1], 98))))
    axes.legend(loc="upper right", fontsize=8, ncols=4)
    figure.savefig(path, dpi=DPI)


def plot_jumps(path: Path, run: RunResults) -> None:
    """Where the undeformed surface opened or slipped along a line, seen from where it is broadest."""
    nodes = 1e3 * run.model.nodes[np.unique(run.model.triangles)]
    jumps = next(result.jumps for result in reversed(run.results) if result.jumps)
    across = int(np.ptp(nodes, axis=0).argmin())
    u, v = (axis for axis in range(3) if axis != across)
    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(nodes[:, u], nodes[:, v], ".", color="#c5ccd3", markersize=2.0)
    for jump in jumps:
        middle = (1e3 * float(jump.place[u]), 1e3 * float(jump.place[v]))
        axes.add_patch(Circle(middle, 1e3 * jump.reach, facecolor="#d9534f", alpha=0.12))
    places, sizes = np.array([1e3 * jump.place for jump in jumps]), [1e3 * jump.size for jump in jumps]
    drawn = axes.scatter(places[:, u], places[:, v], c=sizes, cmap="viridis", vmin=0.0, s=45, zorder=3)
    figure.colorbar(drawn, ax=axes, label="largest jump [mm]")
    axes.set_aspect("equal")
    axes.set_xlabel(f"{'xyz'[u]} [mm]")
    axes.set_ylabel(f"{'xyz'[v]} [mm]")
    axes.set_title("where the surface opens or slips and the model does not; stress in the shade does not hold")
    figure.savefig(path, dpi=DPI)
