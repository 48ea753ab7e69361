"""Plots of a reduction: error against number of modes, singular values, functions of the parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from morph_dslam.evaluation.report import Picture
from morph_dslam.model import ReducedModel
from morph_dslam.offline.report.chosen_states import HALF_WAY_OUT, half_way_out
from morph_dslam.offline.report.plotting import CYCLE, OURS, REFERENCE, drawing, panels
from morph_dslam.offline.report.reference_curve import ReferenceCurve

Array = NDArray[np.float64]

#: Points at which functions of a parameter are drawn.
N_POINTS = 201
#: Modes whose functions are drawn.
MOST_FUNCTIONS = len(CYCLE)


def plot_convergence(model: ReducedModel, reference: ReferenceCurve | None) -> Picture:
    """Error of the model cut to its first modes, and singular values if the method states them."""
    errors = model.certificate["displacement"]["mean_mm_by_modes"]
    singular_values = model.certificate.get("reduction", {}).get("singular_values")
    figure, axes = panels(2 if singular_values else 1, 3.4)
    _draw_errors(axes[0], errors, reference)
    caption = "Left: mean displacement error over all nodes and held-out solves, of the first modes alone."
    if singular_values:
        _draw_singular_values(axes[1], singular_values, model.displacement.n_modes)
        caption += " Right: singular values of the solutions over the largest; the line marks the modes kept."
    return drawing(figure, caption if singular_values else caption.removeprefix("Left: ").capitalize())


def _draw_errors(axes: Axes, errors: Sequence[float], reference: ReferenceCurve | None) -> None:
    axes.semilogy(range(1, len(errors) + 1), errors, "o-", color=OURS, markersize=4, label="this model")
    if reference is not None:
        axes.semilogy(
            reference.modes, reference.mean_mm, "s--", color=REFERENCE, markersize=3, label=reference.label
        )
        axes.legend(frameon=False)
    axes.set_xlabel("number of modes")
    axes.set_ylabel("mean error [mm]")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _draw_singular_values(axes: Axes, values: Sequence[float], n_modes: int) -> None:
    relative = np.array(values) / values[0]
    # What lies below rounding says nothing of the solutions.
    relative = relative[relative > 1e-15]
    axes.semilogy(range(1, len(relative) + 1), relative, "o", color=OURS, markersize=3)
    axes.axvline(n_modes + 0.5, color=REFERENCE, linewidth=1.0, linestyle="--")
    axes.set_xlabel("index")
    axes.set_ylabel("singular value / largest")


def plot_parameter_functions(model: ReducedModel) -> Picture:
    """The functions H_i along each parameter from the state half way out, each over its largest value."""
    field = model.displacement
    shown = min(field.n_modes, MOST_FUNCTIONS)
    curves = [_along(model, k)[:, :shown] for k in range(len(model.parameters))]
    largest = np.abs(curves).max(axis=(0, 1))
    # Times the largest length of its mode in space, a function is a displacement.
    lengths = 1e3 * largest * np.linalg.norm(field.modes[:shown], axis=2).max(axis=1)
    figure, axes = panels(len(model.parameters), 2.7, sharey=True)
    for curve, parameter, panel in zip(curves, model.parameters, axes, strict=True):
        values = np.linspace(parameter.display(parameter.lower), parameter.display(parameter.upper), N_POINTS)
        for mode in range(shown):
            relative = curve[:, mode] / max(largest[mode], 1e-300)
            label = f"mode {mode + 1}, {lengths[mode]:.2g} mm"
            panel.plot(values, relative, color=CYCLE[mode], linewidth=1.4, label=label)
        panel.set_xlabel(f"{parameter.name} [{parameter.unit}]".removesuffix(" [1]"))
    axes[0].set_ylabel("function / largest")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=MOST_FUNCTIONS, frameon=False, fontsize=8
    )
    return drawing(
        figure,
        f"Functions of the parameters of the first modes{_others(model)}. The legend gives the largest "
        "displacement that a mode stands for on these lines.",
    )


def _along(model: ReducedModel, k: int) -> Array:
    """All functions (N_POINTS, n_modes) along parameter ``k``, the others half way out."""
    states = np.tile(half_way_out(model), (N_POINTS, 1))
    states[:, k] = np.linspace(model.lower[k], model.upper[k], N_POINTS)
    return np.array([model.displacement.functions.evaluate(mu)[0] for mu in states])


def _others(model: ReducedModel) -> str:
    return f"; {HALF_WAY_OUT}" if len(model.parameters) > 1 else ""
