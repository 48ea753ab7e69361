"""Plots of the held-out errors over the parameter box: where the model is good, and where it is worst."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from numpy.typing import NDArray

from morph_dslam.evaluation.report import Picture
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.offline.report.plotting import FAILED, OURS, REFERENCE, drawing, panels

Array = NDArray[np.float64]

#: Pairs of parameters that are mapped: all of six parameters.
MOST_MAPS = 15
#: Errors below this are rounding; they are drawn here, where a logarithm still has a meaning, mm.
LEAST_MM = 1e-12


def plot_errors_by_parameter(model: ReducedModel) -> Picture:
    """Mean and largest error of each held-out solve against each parameter."""
    held_out = model.certificate["held_out"]
    places = _displayed(model.parameters, held_out["coordinates"])
    failed = _displayed(model.parameters, _failed(model))
    figure, axes = panels(len(model.parameters), 2.7, sharey=True)
    for k, (parameter, panel) in enumerate(zip(model.parameters, axes, strict=True)):
        panel.plot(places[:, k], _positive(held_out["max_mm"]), "^", color=REFERENCE, markersize=4)
        panel.plot(places[:, k], _positive(held_out["mean_mm"]), "o", color=OURS, markersize=4)
        for value in failed[:, k]:
            panel.axvline(value, color=FAILED, linewidth=0.8, alpha=0.5)
        panel.set_yscale("log")
        _name_axis(panel, "x", parameter)
    axes[0].set_ylabel("displacement error [mm]")
    caption = "Mean over the nodes (dots) and largest (triangles) displacement error of each held-out solve."
    return drawing(figure, caption + (" Lines: samples that failed." if len(failed) else ""))


def plot_error_maps(model: ReducedModel) -> Picture:
    """The mean error of each held-out solve over every pair of parameters; there must be two or more."""
    held_out = model.certificate["held_out"]
    places = _displayed(model.parameters, held_out["coordinates"])
    failed = _displayed(model.parameters, _failed(model))
    errors = _positive(held_out["mean_mm"])
    worst, low, high = int(errors.argmax()), errors.min(), errors.max()
    scale = LogNorm(low, high) if high > 10.0 * low else Normalize(0.0, high)
    pairs = list(combinations(range(len(model.parameters)), 2))[:MOST_MAPS]
    figure, axes = panels(len(pairs), 2.8)
    dots = None
    for (first, second), panel in zip(pairs, axes, strict=True):
        dots = panel.scatter(places[:, first], places[:, second], c=errors, norm=scale, s=26, cmap="viridis")
        panel.plot(places[worst, first], places[worst, second], "o", mfc="none", mec=FAILED, markersize=11)
        panel.plot(failed[:, first], failed[:, second], "x", color=FAILED, markersize=6)
        _name_axis(panel, "x", model.parameters[first])
        _name_axis(panel, "y", model.parameters[second])
    assert dots is not None
    figure.colorbar(dots, ax=axes, label="mean error [mm]", shrink=0.8)
    caption = "Mean displacement error of the held-out solves over the parameter box, the worst one circled."
    return drawing(figure, caption + (" Crosses: samples that failed." if len(failed) else ""))


def _failed(model: ReducedModel) -> list[Any]:
    return [entry["coordinates"] for entry in model.certificate.get("samples", {}).get("failed", [])]


def _displayed(parameters: Sequence[Parameter], samples: Sequence[Any]) -> Array:
    """Samples (n, d) in the parameters' units."""
    rows = np.reshape(np.array(samples, dtype=np.float64), (-1, len(parameters)))
    return rows / np.array([1.0 / parameter.display(1.0) for parameter in parameters])


def _positive(errors: Sequence[float]) -> Array:
    return np.maximum(np.array(errors), LEAST_MM)


def _name_axis(axes: Axes, which: str, parameter: Parameter) -> None:
    """Name an axis after a parameter, and let it show the parameter's whole range."""
    ends = np.array([parameter.display(parameter.lower), parameter.display(parameter.upper)])
    margin = 0.03 * np.array([-1.0, 1.0]) * np.ptp(ends)
    label = f"{parameter.name} [{parameter.unit}]".removesuffix(" [1]")
    axes.set(**{f"{which}label": label, f"{which}lim": tuple(ends + margin)})
