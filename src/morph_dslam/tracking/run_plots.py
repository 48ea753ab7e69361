"""Plots of a run over its frames: parameters, residual and points, stage times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from morph_dslam.tracking.result import STAGES
from morph_dslam.tracking.run_results import RunResults

DPI = 110

#: Stages that are drawn with a colour of their own: as many as there are colours, with this part of the time.
MOST_STAGES, LEAST_SHARE = 10, 0.005


def write_plots(folder: Path, run: RunResults) -> None:
    """Write ``parameters.png``, ``confidence.png``, ``residual.png`` and ``timings.png``."""
    folder.mkdir(exist_ok=True)
    plot_confidence(folder / "confidence.png", run)
    plot_parameters(folder / "parameters.png", run)
    plot_residual(folder / "residual.png", run)
    plot_timings(folder / "timings.png", run)


def _shade_lost(axes: Axes, run: RunResults) -> None:
    for frame, tracked in zip(run.frames, run.tracked, strict=True):
        if not tracked:
            axes.axvspan(frame - 0.5, frame + 0.5, color="#d9534f", alpha=0.18, linewidth=0)


def plot_parameters(path: Path, run: RunResults) -> None:
    """Each parameter in its unit with a band of two standard deviations and the ends of its range."""
    model = run.model
    figure = Figure(figsize=(9.0, 1.0 + 1.9 * len(model.parameters)), layout="constrained")
    all_axes = np.atleast_1d(figure.subplots(len(model.parameters), 1, sharex=True))
    values, deviations, at_bound = run.parameters(), run.parameter_std(), run.at_bound()
    frames = np.array(run.frames)
    for k, (axes, parameter) in enumerate(zip(all_axes, model.parameters, strict=True)):
        unit = parameter.display(1.0)
        value = values[:, k] * unit
        low, high = parameter.lower * unit, parameter.upper * unit
        margin = 0.06 * (high - low)
        band = np.nan_to_num(2.0 * deviations[:, k] * unit, posinf=high - low)
        axes.fill_between(
            frames,
            np.maximum(value - band, low - margin),
            np.minimum(value + band, high + margin),
            color="#4878a8",
            alpha=0.25,
            linewidth=0,
            label="±2 standard deviations",
        )
        axes.plot(frames, value, color="#1f4e79", linewidth=1.4)
        held = at_bound[:, k]
        axes.plot(frames[held], value[held], "o", color="#d9534f", markersize=3.5, label="at a bound")
        for bound in (low, high):
            axes.axhline(bound, color="#888888", linewidth=0.8, linestyle="--")
        axes.set_ylim(low - margin, high + margin)
        axes.set_ylabel(f"{parameter.name} [{parameter.unit}]")
        _shade_lost(axes, run)
    all_axes[0].legend(loc="upper left", fontsize=8)
    all_axes[-1].set_xlabel("frame")
    figure.savefig(path, dpi=DPI)


def plot_confidence(path: Path, run: RunResults) -> None:
    """The largest displacement and the largest stress, each with a band of two standard deviations."""
    rows = [("largest displacement [mm]", 1e3 * run.largest_displacements())]
    if run.model.stresses:
        rows.append(("largest von Mises stress [MPa]", 1e-6 * run.largest_stresses()))
    figure = Figure(figsize=(9.0, 1.0 + 2.2 * len(rows)), layout="constrained")
    all_axes = np.atleast_1d(figure.subplots(len(rows), 1, sharex=True))
    for axes, (label, (value, deviation)) in zip(all_axes, [(n, v.T) for n, v in rows], strict=True):
        low, high = value - 2.0 * deviation, value + 2.0 * deviation
        # A frame that tells nothing must not hide what the others tell.
        top = 1.5 * float(np.nanmax(value, initial=0.0)) or 1.0
        low, high = np.clip(low, 0.0, top), np.clip(high, 0.0, top)
        axes.fill_between(
            run.frames, low, high, color="#4878a8", alpha=0.3, linewidth=0, label="±2 standard deviations"
        )
        axes.plot(run.frames, value, color="#1f4e79", linewidth=1.2)
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0.0)
        _shade_lost(axes, run)
    all_axes[0].legend(loc="upper left", fontsize=8)
    all_axes[-1].set_xlabel("frame")
    figure.savefig(path, dpi=DPI)


def plot_residual(path: Path, run: RunResults) -> None:
    """Residual of the supporting points, and how many they are."""
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    upper.plot(run.frames, run.residuals_px(), color="#1f4e79", linewidth=1.4)
    upper.set_ylabel("residual (RMS) [px]")
    upper.set_ylim(bottom=0.0)
    counts = run.counts()
    lower.plot(run.frames, counts[:, 0], color="#888888", linewidth=1.2, label="not hidden by the object")
    lower.plot(run.frames, counts[:, 1], color="#1f4e79", linewidth=1.4, label="supporting the estimate")
    lower.set_ylabel("points")
    lower.set_ylim(0.0, 1.1 * max(float(counts.max()), 1.0))
    lower.legend(loc="lower left", fontsize=8)
    lower.set_xlabel("frame")
    for axes in (upper, lower):
        _shade_lost(axes, run)
    figure.savefig(path, dpi=DPI)


def plot_timings(path: Path, run: RunResults) -> None:
    """Stage times stacked, with the time between two frames at 30 a second."""
    times = run.timings_ms()
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
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
    axes.set_xlabel("frame")
    axes.set_title(f"median {np.median(times[:, -1]):.1f} ms", fontsize=10)
    axes.set_ylim(0.0, max(36.0, 1.1 * float(np.percentile(times[:, -1], 98))))
    axes.legend(loc="upper right", fontsize=8, ncols=4)
    figure.savefig(path, dpi=DPI)
