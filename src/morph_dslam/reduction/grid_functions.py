"""Functions of the parameters through values on a full grid.

Along lines through the middle and towards the corners of the box the sought functions are sampled finely; each
parameter gets as many nodes as interpolation along its lines needs. The values on the grid of these nodes are then
decomposed (`tensor_formats`). `EvenGrid` recognises samples that are all points of an evenly spaced grid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.model import Parameter
from morph_dslam.model.basis_functions import Basis
from morph_dslam.model.tensor_functions import TensorFunctions
from morph_dslam.reduction.task import parameter_basis
from morph_dslam.reduction.tensor_formats import (
    cp,
    cp_functions,
    tensor_train,
    tensor_train_functions,
    tucker,
    tucker_functions,
)
from morph_dslam.studies.sections import BasisName, FormatName

Array = NDArray[np.float64]
#: Least points along a parameter that cubic splines can interpolate.
LEAST = 4


@dataclass(frozen=True)
class EvenGrid:
    """Where samples lie on a full grid.

    Attributes
    ----------
    counts : points along each parameter.
    order : (n,) the samples in the grid's order, the last parameter running fastest.
    """

    counts: tuple[int, ...]
    order: NDArray[np.int64]

    @staticmethod
    def of(samples: Array, box: Array) -> EvenGrid | None:
        """The grid of samples (n, d) over a box (d, 2); None if there is none or it is too coarse."""
        unit = (samples - box[:, 0]) / np.diff(box, axis=1)[:, 0]
        counts = tuple(len(np.unique(np.round(column, 9))) for column in unit.T)
        if min(counts) < LEAST or int(np.prod([float(n) for n in counts])) != len(samples):
            return None
        steps = np.array(counts) - 1.0
        places = np.rint(unit * steps).astype(np.int64)
        if np.abs(unit * steps - places).max() > 1e-6 or places.min() < 0 or np.any(places > steps):
            return None
        flat = np.asarray(np.ravel_multi_index(tuple(places.T), counts))
        order = np.argsort(flat)
        return EvenGrid(counts, order) if np.array_equal(flat[order], np.arange(len(flat))) else None

    def tensor(self, values: Array) -> Array:
        """Values (n, m) at the samples as a tensor (m, n_1, ..., n_d) over the grid."""
        return np.moveaxis(values[self.order].reshape(*self.counts, -1), -1, 0)


#: Nodes along the lines that decide the size of a grid, and how far from the middle lines run.
FINEST, OFF_CENTRE = 17, 0.7
#: Most nodes of a grid.
MOST_NODES = 1000
#: Error of a derivative along a line that is good enough, relative to the largest on the parameter's lines.
SLOPE_ERROR = 2e-2
#: Most terms of a CP form.
MOST_TERMS = 60


def interpolation_nodes(basis: Basis) -> Array:
    """As many points as the basis has functions, at which it interpolates stably.

    Chebyshev polynomials have their extrema, which include both ends; all others even spacing, Fourier
    functions without the upper end.
    """
    if basis.size == 1:
        return np.array([(basis.lower + basis.upper) / 2.0])
    if basis.kind == "chebyshev":
        unit = -np.cos(np.pi * np.arange(basis.size) / (basis.size - 1))
        return (basis.lower + basis.upper) / 2.0 + unit * (basis.upper - basis.lower) / 2.0
    return np.linspace(basis.lower, basis.upper, basis.size, endpoint=basis.kind != "fourier")


def sizes_along_lines(
    evaluate: Callable[[Array], Array],
    parameters: tuple[Parameter, ...],
    basis: BasisName,
    leading: slice,
    most_nodes: float = np.inf,
) -> tuple[int, ...]:
    """For each parameter the least number of functions that interpolates well enough along its lines.

    Parameters
    ----------
    evaluate : values (n,) at parameters (d,), in units of the error allowed.
    leading : the values whose derivatives count too (`SLOPE_ERROR`).
    most_nodes : of the grid; where more are asked for, all errors allowed are doubled until fewer will do.
    """
    lower = np.array([parameter.lower for parameter in parameters])
    upper = np.array([parameter.upper for parameter in parameters])
    middle, half = (lower + upper) / 2.0, (upper - lower) / 2.0
    signs = np.array([(-1.0) ** k for k in range(len(parameters))])
    starts = [middle, middle + OFF_CENTRE * half, middle - OFF_CENTRE * signs * half]
    starts = starts if len(parameters) > 1 else starts[:1]
    sampled = []
    with tqdm(total=len(parameters) * len(starts) * FINEST, desc="choosing the grid", unit="sample") as progress:
        for k, parameter in enumerate(parameters):
            fine, lines = parameter_basis("chebyshev", parameter, FINEST), []
            for start in starts:
                points = np.repeat(start[None], FINEST, axis=0)
                points[:, k] = interpolation_nodes(fine)
                lines.append(fine.interpolate(points[:, k], np.array([evaluate(p) for p in points])))
                progress.update(FINEST)
            sampled.append((np.array(lines), fine))
    factor = 1.0
    while True:
        sizes = tuple(
            _size_for(factor, values, fine, basis, parameter, leading)
            for (values, fine), parameter in zip(sampled, parameters, strict=True)
        )
        if np.prod([float(size) for size in sizes]) <= most_nodes or max(sizes) == LEAST:
            return sizes
        factor *= 2.0


def _size_for(factor: float, lines: Array, fine: Basis, name: BasisName, parameter: Parameter, leading: slice) -> int:
    """The least size of a basis good enough, to a ``factor``, for lines (n_lines, FINEST, n) in ``fine``."""
    between = np.linspace(fine.lower, fine.upper, 4 * FINEST)
    truth = fine.evaluate(between) @ lines
    slopes = fine.evaluate(between, 1) @ lines[:, :, leading]
    # an error of one unit over the range is always good enough for a slope
    allowed = max(SLOPE_ERROR * _largest(slopes), 1.0 / (fine.upper - fine.lower))
    largest = FINEST if name == "chebyshev" else 4 * FINEST
    for size in range(LEAST, largest):
        basis = parameter_basis(name, parameter, size)
        nodes = interpolation_nodes(basis)
        through = np.linalg.pinv(basis.evaluate(nodes)) @ fine.evaluate(nodes)
        if _largest(basis.evaluate(between) @ through @ lines - truth) > factor:
            continue
        if _largest(basis.evaluate(between, 1) @ through @ lines[:, :, leading] - slopes) <= factor * allowed:
            return basis.size
    return largest


def _largest(vectors: Array) -> float:
    return float(np.linalg.norm(vectors, axis=-1).max())


def values_on_grid(evaluate: Callable[[Array], Array], nodes: tuple[Array, ...]) -> Array:
    """``evaluate`` (n,) at all points of a grid: (n, n_1, ..., n_d)."""
    points = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, len(nodes))
    values = [evaluate(point) for point in tqdm(points, desc="sampling the reduced solver", unit="sample")]
    return np.moveaxis(np.array(values).reshape(*[len(n) for n in nodes], -1), -1, 0)


def functions_on_grid(tensor: Array, bases: tuple[Basis, ...], form: FormatName, tolerance: float) -> TensorFunctions:
    """Functions in a separated form through values (n_functions, n_1, ..., n_d) at the bases' nodes."""
    nodes = tuple(interpolation_nodes(basis) for basis in bases)
    if form == "tensor_train":
        return tensor_train_functions(tensor_train(tensor, tolerance), nodes, bases)
    if form == "cp":
        return cp_functions(cp(tensor, tolerance, MOST_TERMS), nodes, bases)
    return tucker_functions(tucker(tensor, tolerance), nodes, bases)
