"""How the report's plots look, and how they get into the page."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.evaluation.model_summary import describe_point
from morph_dslam.evaluation.report import Picture
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.render.model_view import draw_shapes

OURS, REFERENCE, FAILED, GREY = "#0b5cad", "#b4530a", "#c1272d", "#57606a"

#: Width of the page's text, inches.
WIDTH = 10.3

#: Colours of the first modes, distinct for colour-blind readers too (Okabe and Ito 2008).
CYCLE = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")

_STYLE: dict[Any, Any] = {
    "font.size": 9.5,
    "axes.titlesize": 10,
    "axes.edgecolor": "#8c959f",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e8ec",
    "grid.linewidth": 0.7,
    "svg.hashsalt": "morph-dslam",  # the same plot is the same text, every time
}


def panels(n_panels: int, height: float, of_four: int = 2, **options) -> tuple[Figure, list[Axes]]:
    """A figure of ``n_panels`` axes in rows of ``height`` inches, three in a row, or four ``of_four`` a row.

    ``options`` are those of `Figure.subplots`.
    """
    columns = of_four if n_panels == 4 else min(n_panels, 3)
    rows = -(-n_panels // columns)
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(WIDTH, height * rows), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, **options).ravel().tolist()
    for unused in axes[n_panels:]:
        unused.remove()
    for used in axes[:n_panels]:
        used.xaxis.set_major_locator(MaxNLocator(12 // columns + 1, steps=[1, 2, 2.5, 5, 10]))
    return figure, axes[:n_panels]


def drawing(figure: Figure, caption: str) -> Picture:
    """A figure of lines and letters for the page, sharp at every size."""
    with matplotlib.rc_context(_STYLE):
        buffer = BytesIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return Picture(buffer.getvalue(), ".svg", caption)


def photograph(figure: Figure, caption: str) -> Picture:
    """A figure that holds rendered pictures for the page."""
    with matplotlib.rc_context(_STYLE):
        buffer = BytesIO()
        figure.savefig(buffer, format="png", dpi=144)
    return Picture(buffer.getvalue(), ".png", caption)


# Plots of the held-out errors over the parameter box: where the model is good, and where it is worst.


Array = NDArray[np.float64]

#: Pairs of parameters that are mapped: all of six parameters.
MOST_MAPS = 15

#: Errors below this are rounding; they are drawn here, where a logarithm still has a meaning, mm.
LEAST_MM = 1e-12


def plot_errors_by_parameter(model: ReducedModel) -> Picture:
    """Mean and largest error of each held-out solve against each parameter."""
    held_out = model.certificate["held_out"]
    places = _displayed(model.parameters, held_out["coordinates"])
    failed = _displayed(model.parameters, _failed_samples(model))
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
    failed = _displayed(model.parameters, _failed_samples(model))
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


def _failed_samples(model: ReducedModel) -> list[Any]:
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


# Plots of a reduction: error against number of modes, singular values, functions of the parameters.


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
        axes.semilogy(reference.modes, reference.mean_mm, "s--", color=REFERENCE, markersize=3, label=reference.label)
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
    figure.legend(handles, labels, loc="outside upper center", ncols=MOST_FUNCTIONS, frameon=False, fontsize=8)
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


# Rendered pictures of a model: a few states coloured by stress, and its modes in space.


#: Pixels of a picture, and how many modes are drawn.
SIZE = (480, 400)

MOST_MODES = 6

#: A mode is drawn with its largest displacement this part of the body's size.
AMPLITUDE = 0.15

#: Bodies whose height is below this part of their width are looked down upon.
FLAT = 0.3


def viewing_direction(model: ReducedModel) -> Array:
    """Direction (3,) in which the camera looks, object frame."""
    extent = np.ptp(model.nodes[np.unique(model.triangles)], axis=0)
    return np.array([0.35, 1.0, -1.0 if extent[2] < FLAT * extent[:2].max() else -0.4])


def draw_model_states(model: ReducedModel) -> Picture:
    """A few states of the box, coloured by von Mises stress if the model has one, or else by displacement."""
    states, captions = states_to_show(model)
    shapes = [model.positions(mu) for mu in states]
    if model.stresses:
        place = "top" if "top" in model.stresses else next(iter(model.stresses))
        values = [1e-6 * model.von_mises(mu, place) for mu in states]
        label = "von Mises stress" + ("" if place == "solid" else f", {place} face") + " [MPa]"
    else:
        values = [1e3 * np.linalg.norm(model.displacement.value(mu), axis=1) for mu in states]
        label = "displacement [mm]"
    seen = np.unique(model.triangles)
    # Single nodes in corners would take the colours from all others.
    top = max(float(np.percentile([value[seen] for value in values], 99.5)), 1e-12)
    note = "States of the model, to scale" + (f"; {HALF_WAY_OUT}." if len(model.parameters) > 1 else ".")
    return _grid(model, shapes, values, (0.0, top), captions, label, note, "turbo")


def draw_modes(model: ReducedModel) -> Picture:
    """The first modes in space, each added to the undeformed body with one largest displacement."""
    modes = model.displacement.modes[:MOST_MODES]
    size = float(np.ptp(model.nodes, axis=0).max())
    lengths = np.linalg.norm(modes, axis=2)
    relative = [length / max(float(length.max()), 1e-300) for length in lengths]
    shapes = [
        model.nodes + AMPLITUDE * size * mode / max(float(length.max()), 1e-300)
        for mode, length in zip(modes, lengths, strict=True)
    ]
    captions = [f"mode {i}" for i in range(1, len(modes) + 1)]
    note = (
        f"The first {len(modes)} of {model.displacement.n_modes} modes in space, added to the undeformed "
        f"body; each is enlarged to {AMPLITUDE:.0%} of the body's size."
    )
    return _grid(model, shapes, relative, (0.0, 1.0), captions, "displacement / largest", note, "viridis")


def _grid(
    model: ReducedModel,
    shapes: Sequence[Array],
    values: Sequence[Array],
    value_range: tuple[float, float],
    captions: Sequence[str],
    label: str,
    note: str,
    colour_map: str,
) -> Picture:
    """Rendered shapes, three in a row, with one colour bar."""
    images = draw_shapes(model.triangles, shapes, values, value_range, viewing_direction(model), SIZE, colour_map)
    figure, axes = panels(len(images), 2.7, of_four=4)
    for image, caption, panel in zip(images, captions, axes, strict=True):
        panel.imshow(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
        panel.set_title(caption)
        panel.set_axis_off()
    figure.colorbar(ScalarMappable(Normalize(*value_range), colour_map), ax=axes, label=label, shrink=0.7, pad=0.01)
    return photograph(figure, note)


# States of a model that the report shows.


#: Pictures of states at most.
MOST_STATES = 6

#: What captions say of the parameters that are not varied.
HALF_WAY_OUT = "other parameters half way from their defaults to the farther ends of their ranges"


def far_ends(model: ReducedModel) -> Array:
    """The end of each parameter's range (d,) that is farther from its default, the upper one if both are."""
    above, below = model.upper - model.default, model.default - model.lower
    return np.where(above >= below, model.upper, model.lower)


def half_way_out(model: ReducedModel) -> Array:
    """The state (d,) half way from the defaults to the far ends: defaults are often states of rest."""
    return (model.default + far_ends(model)) / 2.0


def states_to_show(model: ReducedModel) -> tuple[list[Array], list[str]]:
    """States, and a line for each: three along a single parameter; else the default and each far end."""
    if len(model.parameters) == 1:
        states = list(np.linspace(model.lower, model.upper, 3))
        return states, [describe_point(model.parameters, mu) for mu in states]
    states, captions, ends = [model.default], ["default"], far_ends(model)
    for k, parameter in enumerate(model.parameters[: MOST_STATES - 1]):
        mu = half_way_out(model)
        mu[k] = ends[k]
        states.append(mu)
        captions.append(describe_point([parameter], [mu[k]]))
    return states, captions


# A published curve of error against number of modes, to be drawn beside a model's own.


@dataclass(frozen=True)
class ReferenceCurve:
    """Mean displacement errors ``mean_mm`` (n,) of somebody else with so many ``modes`` (n,)."""

    label: str
    modes: Array
    mean_mm: Array


def read_reference_curve(path: Path) -> ReferenceCurve:
    """Read a CSV file of two columns: numbers of modes, and mean errors in mm under the curve's label.

    Raises
    ------
    StudyError
        If there is no such file, or it does not hold numbers in two columns under a line of titles.
    """
    form = 'a line of titles, "modes,the paper" for example, and lines "3,0.935", the error in mm'
    if not path.is_file():
        raise StudyError(f"there is no reference curve {path}: it needs {form}")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            (_, label), *rows = [row for row in csv.reader(file) if row]
        values = np.array(rows, dtype=np.float64)
        modes, errors = values.T
    except ValueError as error:
        raise StudyError(f"{path} is no reference curve ({error}): it needs {form}") from error
    if not (np.isfinite(values).all() and (values > 0.0).all()):
        raise StudyError(f"{path}: numbers of modes and errors must be positive")
    return ReferenceCurve(label.strip(), modes, errors)
