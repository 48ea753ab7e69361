"""The positions of the paper's sheet as a model file, and its errors on positions left out.

The parameter is the part of the path's length: shape, height and stress are smooth in it from the flat sheet
on. They are not in the height of the middle, which stops growing at the end, nor in the approach of the ends,
whose root the height is at the start.

Two forms are made. In the model file, which tracking reads, modes in space are multiplied by functions of the
position. In the paper's form, u(X, Y, mu), the coordinates of the sheet are separated too. Few positions,
equally far apart, make both; all others measure the errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

import morph_dslam as md
from morph_dslam.extend import mechanics
from morph_dslam.extend.models import CPFunctions, cubic_spline_basis, von_mises
from morph_dslam.extend.reduction import (
    ReductionSection,
    ReductionTask,
    certify,
    compression_percent,
    cp,
    cp_functions,
    reduction_method,
)
from morph_dslam.extend.studies import ModelMesh, Snapshot

Array = NDArray[np.float64]

PATH = md.Parameter("path", "ratio", "1", 0.0, 1.0, 0.0, "part of the path from the flat sheet to its full height")
OPTIONS = ReductionSection(method="pod", basis="cubic_spline", tolerance=5e-5)
#: The model file is made from about so many positions: as many splines interpolate between them.
NODES = 41
#: Cubic splines of the position, and the most products, in the paper's form; X and Y have one spline a node.
SPLINES = 24
PRODUCTS = 20
CP_TOLERANCE = 3e-5
FIELDS = ("displacement", "stress_top", "stress_bottom")


@dataclass(frozen=True)
class Grid:
    """The sheet's size (m) and cells along x and y; nodes are counted with x fastest."""

    size: tuple[float, float]
    cells: tuple[int, int]

    def axes(self) -> tuple[Array, Array]:
        """Coordinates of the nodes (nx + 1,), (ny + 1,), the origin in the middle."""
        x, y = (np.linspace(-a / 2.0, a / 2.0, n + 1) for a, n in zip(self.size, self.cells, strict=True))
        return x, y

    def mesh(self) -> ModelMesh:
        """Nodes, triangles and weights as the model file holds them."""
        nx, ny = self.cells
        x, y = self.axes()
        nodes = np.column_stack([np.tile(x, ny + 1), np.repeat(y, nx + 1), np.zeros((nx + 1) * (ny + 1))])
        corner = (np.arange(ny)[:, None] * (nx + 1) + np.arange(nx)).ravel()
        quads = np.column_stack([corner, corner + 1, corner + nx + 2, corner + nx + 1])
        return mechanics.model_mesh_of(mechanics.Mesh(nodes, (mechanics.CellBlock("quad4", quads),)))


@dataclass(frozen=True)
class Reduced:
    """Both forms of one set of positions, and their errors on the positions left out.

    Attributes
    ----------
    model : modes in space times functions of the position, with its certificate.
    separated : by field, functions of X, Y and the path, one for each component.
    errors : relative L2 errors of ``separated`` by field, and under "von_mises" that of both faces' stress.
    compression : of the separated displacement, %.
    """

    model: md.ReducedModel
    separated: dict[str, CPFunctions]
    errors: dict[str, float]
    compression: float


def reduce_positions(snapshots: Sequence[Snapshot], every: int, grid: Grid) -> Reduced:
    """Both forms from every so many positions; where that is all of them, the errors are on themselves."""
    training = list(snapshots[::every])
    held_out = [s for i, s in enumerate(snapshots) if every == 1 or i % every]
    task = ReductionTask(grid.mesh(), (PATH,), [[snapshot] for snapshot in training], OPTIONS, "paper sheet")
    model = reduction_method("pod").reduce(task)
    model.certificate.update(certify(model, held_out))
    model.certificate["compression_percent"] = compression_percent(model, len(snapshots))
    model.certificate["samples"] = {"training": len(training), "held_out": len(held_out), "failed": []}
    separated = {name: separate_space(training, name, grid) for name in FIELDS}
    stored = separated["displacement"].n_floats / (len(snapshots) * 3 * len(task.mesh.nodes))
    return Reduced(model, separated, _separated_errors(separated, held_out, grid), 100.0 * (1.0 - stored))


def separate_space(snapshots: Sequence[Snapshot], name: str, grid: Grid) -> CPFunctions:
    """A field as a sum of products of functions of X, Y and the path, one function for each component."""
    axes = (*grid.axes(), np.array([snapshot.coordinates[0] for snapshot in snapshots]))
    values = np.array([snapshot.fields[name] for snapshot in snapshots], dtype=np.float64)
    nx, ny = grid.cells
    tensor = np.ascontiguousarray(values.reshape(len(values), ny + 1, nx + 1, -1).transpose(3, 2, 1, 0))
    knots = (*axes[:2], np.linspace(0.0, 1.0, min(SPLINES, len(values))))
    bases = tuple(cubic_spline_basis(nodes) for nodes in knots)
    return cp_functions(cp(tensor, CP_TOLERANCE, PRODUCTS), axes, bases)


def evaluate_separated(functions: CPFunctions, grid: Grid, position: float, products: int | None = None) -> Array:
    """The field (n, c) at all nodes, of the first ``products`` products if wished."""
    at = (*grid.axes(), np.array([position]))
    x, y, path = (
        (basis.evaluate(points) @ factor)[:, :products]
        for basis, points, factor in zip(functions.bases, at, functions.factors, strict=True)
    )
    amplitudes = path[0, :, None] * functions.mixing[:products]
    return np.einsum("yt,xt,tc->yxc", y, x, amplitudes).reshape(-1, functions.n_functions)


def _separated_errors(separated: dict[str, CPFunctions], snapshots: Sequence[Snapshot], grid: Grid) -> dict[str, float]:
    """Relative L2 errors over snapshots, by field, and of the von Mises stress."""
    errors, missed, norm = {}, 0.0, 0.0
    for name, functions in separated.items():
        found = np.array([evaluate_separated(functions, grid, s.coordinates[0]) for s in snapshots])
        truth = np.array([s.fields[name] for s in snapshots], dtype=np.float64)
        errors[name] = float(np.linalg.norm(found - truth) / np.linalg.norm(truth))
        if name != "displacement":
            missed += float(np.sum((von_mises(found) - von_mises(truth)) ** 2))
            norm += float(np.sum(von_mises(truth) ** 2))
    return errors | {"von_mises": float(np.sqrt(missed / norm))}


def write_reduction(snapshots: Sequence[Snapshot], grid: Grid, output: Path) -> str:
    """Make both forms, keep the model file and a picture in ``output``, and print a table of errors.

    Returns
    -------
    str
        One line of figures.
    """
    print(f"{'':9s} {'modes in space x path':>34s} {'products of X, Y and path':>37s}")
    print(TABLE_HEAD)
    for every in (1, 2):
        print(_table_row(reduce_positions(snapshots, every, grid)))
    every = max(2, round((len(snapshots) - 1) / (NODES - 1)))
    reduced = reduce_positions(snapshots, every, grid)
    print(_table_row(reduced))
    md.save_model(output / "paper_sheet.morph", reduced.model)
    held_out = [snapshot for i, snapshot in enumerate(snapshots) if i % every]
    draw_reduction(output / "reduction.png", reduced, held_out, grid)
    certificate, figures = reduced.model.certificate, reduced.errors
    stress = max(certificate[f"stress_{face}"]["von_mises"]["relative_l2"] for face in ("top", "bottom"))
    return (
        f"seen={certificate['samples']['training']} held_out={certificate['samples']['held_out']} "
        f"modes={reduced.model.displacement.n_modes} "
        f"normalised_error={certificate['displacement']['relative_l2']:.2e} von_mises_error={stress:.2e} "
        f"compression_percent={certificate['compression_percent']:.2f} "
        f"products={len(reduced.separated['displacement'].mixing)} "
        f"separated_error={figures['displacement']:.2e} separated_von_mises_error={figures['von_mises']:.2e} "
        f"separated_compression_percent={reduced.compression:.2f}"
    )


TABLE_HEAD = f"{'positions':>9s}" + 2 * f" {'count':>8s} {'error':>9s} {'Mises':>9s} {'saved/%':>8s}"


def _table_row(reduced: Reduced) -> str:
    """Training positions; modes or products, errors of displacement and stress, and compression of each form."""
    certificate, separated = reduced.model.certificate, reduced.separated["displacement"]
    stress = max(certificate[f"stress_{face}"]["von_mises"]["relative_l2"] for face in ("top", "bottom"))
    return (
        f"{certificate['samples']['training']:9d} {reduced.model.displacement.n_modes:8d} "
        f"{certificate['displacement']['relative_l2']:9.1e} {stress:9.1e} "
        f"{certificate['compression_percent']:8.2f} {len(separated.mixing):8d} "
        f"{reduced.errors['displacement']:9.1e} {reduced.errors['von_mises']:9.1e} {reduced.compression:8.2f}"
    )


def draw_reduction(file: Path, reduced: Reduced, held_out: Sequence[Snapshot], grid: Grid) -> None:
    """Errors against the number of modes and of products, and the first products' functions of X, Y, path."""
    figure = Figure(figsize=(11.0, 7.5), layout="constrained")
    (error_axes, x_axes), (y_axes, path_axes) = figure.subplots(2, 2)
    by_modes = reduced.model.certificate["displacement"]["mean_mm_by_modes"]
    error_axes.semilogy(range(1, len(by_modes) + 1), by_modes, "o-", label="modes in space x path")
    functions = reduced.separated["displacement"]
    counts = range(1, len(functions.mixing) + 1)
    by_products = [_mean_distance(functions, held_out, grid, count) for count in counts]
    error_axes.semilogy(counts, by_products, "s-", label="products of X, Y and path")
    error_axes.set(xlabel="modes or products", ylabel="mean error on positions left out / mm")
    error_axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    error_axes.legend(frameon=False)
    shown = min(5, len(functions.mixing))
    for axes, basis, factor in zip((x_axes, y_axes, path_axes), functions.bases, functions.factors, strict=True):
        points = np.linspace(basis.lower, basis.upper, 401)
        curves = basis.evaluate(points) @ factor[:, :shown]
        scale = 1.0 if axes is path_axes else 1e3
        axes.plot(scale * points, curves / np.abs(curves).max(axis=0))
    x_axes.set(xlabel="X / mm", title="functions of X, over their largest values")
    y_axes.set(xlabel="Y / mm", title="functions of Y")
    path_axes.set(xlabel="part of the path", title="functions of the path")
    path_axes.legend([f"product {i + 1}" for i in range(shown)], frameon=False, fontsize=8)
    figure.savefig(file, dpi=100)


def _mean_distance(functions: CPFunctions, held_out: Sequence[Snapshot], grid: Grid, products: int) -> float:
    """Mean distance from the truth over nodes and snapshots, mm."""
    means = []
    for snapshot in held_out:
        found = evaluate_separated(functions, grid, snapshot.coordinates[0], products)
        means.append(np.linalg.norm(found - snapshot.fields["displacement"], axis=1).mean())
    return 1e3 * float(np.mean(means))
