"""The pictures of a build's report: errors, modes in space, functions of the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.evaluation.report import Picture
from morph_dslam.io.text import read_csv
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.render.model_view import draw_shapes

Array = NDArray[np.float64]
OURS, REFERENCE, FAILED = "#0b5cad", "#b4530a", "#c1272d"
#: Width of the page's text, inches.
WIDTH = 10.3
#: Colours of the first modes, distinct for colour-blind readers too (Okabe and Ito 2008).
CYCLE = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
#: Errors below this are rounding; they are drawn here, where a logarithm still has a meaning, mm.
LEAST_MM = 1e-12
#: Points at which functions of a parameter are drawn.
N_POINTS = 201
#: Pixels of a picture of a mode, its largest displacement as a part of the body's size, and how many are drawn.
SIZE, AMPLITUDE, MOST_MODES = (480, 400), 0.15, len(CYCLE)
#: Bodies whose height is below this part of their width are looked down upon.
FLAT = 0.3
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


def _panels(n_panels: int, height: float, of_four: int = 2, **options) -> tuple[Figure, list[Axes]]:
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


def _picture(figure: Figure, caption: str, suffix: str = ".svg") -> Picture:
    """A figure for the page: lines and letters as .svg, rendered pictures as .png."""
    options: dict[str, Any] = {"metadata": {"Date": None}} if suffix == ".svg" else {"dpi": 144}
    with matplotlib.rc_context(_STYLE):
        buffer = BytesIO()
        figure.savefig(buffer, format=suffix[1:], **options)
    return Picture(buffer.getvalue(), suffix, caption)


def plot_errors_by_parameter(model: ReducedModel) -> Picture:
    """Mean and largest error of each held-out solve against each parameter."""
    held_out = model.certificate["held_out"]
    failed = [entry["coordinates"] for entry in model.certificate.get("samples", {}).get("failed", [])]
    figure, axes = _panels(len(model.parameters), 2.7, sharey=True)
    for k, (parameter, panel) in enumerate(zip(model.parameters, axes, strict=True)):
        places = [parameter.display(mu[k]) for mu in held_out["coordinates"]]
        panel.plot(places, np.maximum(held_out["max_mm"], LEAST_MM), "^", color=REFERENCE, markersize=4)
        panel.plot(places, np.maximum(held_out["mean_mm"], LEAST_MM), "o", color=OURS, markersize=4)
        for mu in failed:
            panel.axvline(parameter.display(mu[k]), color=FAILED, linewidth=0.8, alpha=0.5)
        panel.set_yscale("log")
        panel.set_xlabel(_label(parameter))
    axes[0].set_ylabel("displacement error [mm]")
    caption = "Mean over the nodes (dots) and largest (triangles) displacement error of each held-out solve."
    return _picture(figure, caption + (" Lines: samples that failed." if failed else ""))


def _label(parameter: Parameter) -> str:
    return f"{parameter.name} [{parameter.unit}]".removesuffix(" [1]")


def plot_convergence(model: ReducedModel, reference: ReferenceCurve | None) -> Picture:
    """Error of the model cut to its first modes, and singular values if the method states them."""
    errors = model.certificate["displacement"]["mean_mm_by_modes"]
    singular_values = model.certificate.get("reduction", {}).get("singular_values")
    if singular_values and not singular_values[0] > 0.0:
        singular_values = None  # the body never moves
    figure, axes = _panels(2 if singular_values else 1, 3.4)
    _draw_errors(axes[0], errors, reference)
    caption = "Left: mean displacement error over all nodes and held-out solves, of the first modes alone."
    if singular_values:
        _draw_singular_values(axes[1], singular_values, model.displacement.n_modes)
        caption += " Right: singular values of the solutions over the largest; the line marks the modes kept."
    return _picture(figure, caption if singular_values else caption.removeprefix("Left: ").capitalize())


def _draw_errors(axes: Axes, errors: Sequence[float], reference: ReferenceCurve | None) -> None:
    drawn = np.maximum(errors, LEAST_MM)
    axes.semilogy(range(1, len(errors) + 1), drawn, "o-", color=OURS, markersize=4, label="this model")
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
    """The functions H_i along each parameter, the others half way out, each over its largest value."""
    field = model.displacement
    shown = min(field.n_modes, MOST_MODES)
    curves = [_along(model, k)[:, :shown] for k in range(len(model.parameters))]
    largest = np.abs(curves).max(axis=(0, 1))
    # Times the largest length of its mode in space, a function is a displacement.
    lengths = 1e3 * largest * np.linalg.norm(field.modes[:shown], axis=2).max(axis=1)
    figure, axes = _panels(len(model.parameters), 2.7, sharey=True)
    for curve, parameter, panel in zip(curves, model.parameters, axes, strict=True):
        values = np.linspace(parameter.display(parameter.lower), parameter.display(parameter.upper), N_POINTS)
        for mode in range(shown):
            relative = curve[:, mode] / max(largest[mode], 1e-300)
            label = f"mode {mode + 1}, {lengths[mode]:.2g} mm"
            panel.plot(values, relative, color=CYCLE[mode], linewidth=1.4, label=label)
        panel.set_xlabel(_label(parameter))
    axes[0].set_ylabel("function / largest")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=MOST_MODES, frameon=False, fontsize=8)
    return _picture(
        figure,
        "Functions of the first modes along each parameter, the others half way from their defaults to the farther "
        "ends of their ranges. The legend gives the largest displacement that a mode stands for on these lines.",
    )


def _along(model: ReducedModel, k: int) -> Array:
    """All functions (N_POINTS, n_modes) along parameter ``k``, the others half way out."""
    states = np.tile(half_way_out(model), (N_POINTS, 1))
    states[:, k] = np.linspace(model.lower[k], model.upper[k], N_POINTS)
    return np.array([model.displacement.functions.evaluate(mu)[0] for mu in states])


def half_way_out(model: ReducedModel) -> Array:
    """The state (d,) half way from the defaults to the farther ends: defaults are often states of rest."""
    above, below = model.upper - model.default, model.default - model.lower
    return (model.default + np.where(above >= below, model.upper, model.lower)) / 2.0


def draw_modes(model: ReducedModel) -> Picture:
    """The first modes in space, each added to the undeformed body with one largest displacement."""
    modes = model.displacement.modes[:MOST_MODES]
    extent = np.ptp(model.nodes[np.unique(model.triangles)], axis=0)
    lengths = [np.linalg.norm(mode, axis=1) for mode in modes]
    largest = [max(float(length.max()), 1e-300) for length in lengths]
    size = AMPLITUDE * float(np.ptp(model.nodes, axis=0).max())
    shapes = [model.nodes + size * mode / top for mode, top in zip(modes, largest, strict=True)]
    relative = [length / top for length, top in zip(lengths, largest, strict=True)]
    direction = np.array([0.35, 1.0, -1.0 if extent[2] < FLAT * extent[:2].max() else -0.4])
    images = draw_shapes(model.triangles, shapes, relative, (0.0, 1.0), direction, SIZE, "viridis")
    figure, axes = _panels(len(images), 2.7, of_four=4)
    for number, (image, panel) in enumerate(zip(images, axes, strict=True), start=1):
        panel.imshow(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
        panel.set_title(f"mode {number}")
        panel.set_axis_off()
    colours = ScalarMappable(Normalize(0.0, 1.0), "viridis")
    figure.colorbar(colours, ax=axes, label="displacement / largest", shrink=0.7, pad=0.01)
    note = (
        f"The first {len(modes)} of {model.displacement.n_modes} modes in space, added to the undeformed "
        f"body; each is enlarged to {AMPLITUDE:.0%} of the body's size."
    )
    return _picture(figure, note, ".png")


@dataclass(frozen=True)
class ReferenceCurve:
    """Mean displacement errors ``mean_mm`` (n,) of somebody else with so many ``modes`` (n,)."""

    label: str
    modes: Array
    mean_mm: Array


def read_reference_curve(path: str | Path) -> ReferenceCurve:
    """Read a CSV file of two columns: numbers of modes, and mean errors in mm under the curve's label.

    Raises
    ------
    StudyError
        If there is no such file, or it does not hold numbers in two columns under a line of titles.
    """
    path = Path(path)
    form = 'a line of titles, "modes,the paper" for example, and lines "3,0.935", the error in mm'
    if not path.is_file():
        raise StudyError(f"there is no reference curve {path}: it needs {form}")
    try:
        (_, label), *rows = [cells for _, cells in read_csv(path, "reference curve", StudyError)]
        values = np.array(rows, dtype=np.float64)
        modes, errors = values.T
    except ValueError as error:
        raise StudyError(f"{path} is no reference curve ({error}): it needs {form}") from error
    if not (np.isfinite(values).all() and (values > 0.0).all()):
        raise StudyError(f"{path}: numbers of modes and errors must be positive")
    return ReferenceCurve(label, modes, errors)
