"""Pictures of the material error and of the surface error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from morph_dslam.evaluation.depth_error import DepthError
from morph_dslam.evaluation.material_error import MaterialError
from morph_dslam.model import ReducedModel

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
    distances = [1e3 * row for row in error.distances]
    base = error.base
    title = "no base frame"
    if base is not None and len(base):
        title = (
            f"sensor and registration in frame {error.base_frame}: mean {1e3 * base.mean():.2f} mm (dotted)"
        )
    shown = None if base is None or not len(base) else 1e3 * float(base.mean())
    label = "distance to the estimated surface [mm]"
    _plot_by_frame(path, error.frames, distances, [1e3 * error.compared], label, title, shown)


def _plot_by_frame(
    path: Path,
    frames: NDArray[np.int64],
    distances: list[NDArray],
    counted: list[NDArray],
    label: str,
    title: str,
    base: float | None = None,
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
        f"mean {values.mean():.2f} mm (dashed), median {np.median(values):.2f} mm, "
        f"95th percentile {np.percentile(values, 95):.2f} mm\n{title}",
        fontsize=10,
    )
    figure.savefig(path, dpi=DPI)


def outline_edges(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Edges (e, 2) that belong to one triangle only."""
    edges = np.sort(
        np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1
    )
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    return unique[counts == 1]


def plot_error_map(path: Path, error: MaterialError, model: ReducedModel) -> None:
    """Mean error of each material point where it lies on the undeformed object."""
    measured = np.isfinite(error.distances).any(axis=0)
    mean = np.nanmean(error.distances[:, measured], axis=0)
    rest = model.rest_positions(error.binding.points)[measured]
    _plot_map(path, rest, mean, model, "mean material error [mm]")


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
    figure = Figure(
        figsize=(height * float(np.clip(wide / high, 0.4, 2.2)) + 2.2, height), layout="constrained"
    )
    axes = figure.add_subplot()
    flat = 1e3 * model.nodes[:, [first, second]]
    axes.add_collection(
        PolyCollection(list(flat[model.triangles]), facecolors="#e3e7eb", edgecolors="#e3e7eb")
    )
    segments = flat[outline_edges(model.triangles)]  # a closed surface has none
    axes.add_collection(LineCollection(list(segments), colors="#57606a", linewidths=1.0))
    dots = axes.scatter(
        1e3 * rest[:, first], 1e3 * rest[:, second], c=1e3 * mean, s=26, cmap="viridis", vmin=0.0
    )
    axes.set_aspect("equal")
    axes.autoscale()
    axes.set_xlabel(f"{'xyz'[first]} on the undeformed object [mm]")
    axes.set_ylabel(f"{'xyz'[second]} [mm]")
    figure.colorbar(dots, label=label)
    figure.savefig(path, dpi=DPI)
