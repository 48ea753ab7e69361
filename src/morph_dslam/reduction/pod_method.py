"""The method "pod": modes of the snapshots, functions of the parameters through their coefficients.

Snapshots over the whole range of a single parameter are interpolated by piecewise cubics, those on a full, evenly
spaced grid by splines, and those on paths in time by splines in time. Scattered ones are fitted by polynomials of the
total degree that predicts left-out samples best, with sensitivities where they are known.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.errors import StudyError
from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.model.functions import Functions
from morph_dslam.reduction.grid_functions import EvenGrid, functions_on_grid
from morph_dslam.reduction.line_functions import covers, interpolate_line
from morph_dslam.reduction.path_functions import TimePaths, fit_paths
from morph_dslam.reduction.pod import Pod, Truncation, compute_pod, truncate
from morph_dslam.reduction.registry import register_reduction
from morph_dslam.reduction.regression import fit_functions
from morph_dslam.reduction.sparse_expansion import chebyshev_train
from morph_dslam.reduction.task import ReductionTask, parameter_bases
from morph_dslam.studies.problem import Snapshot

Array = NDArray[np.float64]
#: Bases that interpolate on a grid, and error of a separated form there as a part of the tolerance.
GRID_BASES, SHARE = ("cubic_spline", "hat"), 0.2
#: Weight in a regression of the solution at the defaults, which mostly is the unloaded body at rest.
DEFAULT_WEIGHT = 3.0
#: Modes that those kept are chosen from: to this part of the tolerance, and so many times ``max_modes``.
FINER, MORE_MODES = 0.1, 3


def reduce_by_pod(task: ReductionTask) -> ReducedModel:
    """A reduced model of every field that the snapshots hold.

    Snapshots of one group (mirror images) are left out together in cross-validation.
    """
    snapshots, options, line = task.snapshots, task.options, covers(task.samples, task.box)
    grid = None if line else EvenGrid.of(task.samples, task.box)
    paths = None if line or grid is not None else TimePaths.of(task.samples, task.parameters)
    _check_choices(task, line or grid is not None, paths is not None)
    through = options.basis in (None, *GRID_BASES) and options.format != "polynomial"
    fields, summaries = {}, {}
    for name in tqdm(task.field_names, desc="modes and functions", unit="field"):
        values = task.values(name)
        shape, weights = values.shape[1:], task.weights(values.shape[1])
        flat, of_components = values.reshape(len(values), -1), np.repeat(weights, shape[1])
        pod = compute_pod(flat, of_components, FINER * options.tolerance, MORE_MODES * options.max_modes)
        # One snapshot at a time: their weighted copies would be another array as large as all of them.
        coefficients = np.array([pod.project(value.reshape(1, -1))[0] for value in values])
        modes = pod.modes.reshape(-1, *shape)
        kept = truncate(modes, coefficients.T, weights, options.tolerance, options.max_modes)
        coefficients = coefficients @ kept.rotation.T
        if grid is not None and through:
            functions, summary = _on_grid(task, grid, coefficients)
        elif paths is not None and through:
            functions, summary = _on_paths(task, paths, coefficients)
        else:
            make = _on_line if line and through else _fitted
            functions, summary = make(task, coefficients, _slopes(snapshots, name, pod, kept))
        fields[name] = SeparatedField(kept.modes, functions)
        summaries[name] = summary | {"modes": len(kept.modes), "singular_values": kept.singular_values[:60].tolist()}
    return task.model(fields, {"method": "pod", **summaries["displacement"]})


def _check_choices(task: ReductionTask, ordered: bool, on_paths: bool) -> None:
    """Refuse functions that these samples do not allow; ``ordered`` samples cover a range or a grid."""
    options = task.options
    if options.basis not in (None, "chebyshev", *GRID_BASES):
        raise StudyError(
            f'reduction.method = "pod" has no functions "{options.basis}": use "chebyshev", on samples of one '
            'parameter and grids "cubic_spline" or "hat", or method = "sparse_pgd", which has all of them'
        )
    if options.basis in GRID_BASES and not (ordered or on_paths):
        raise StudyError(
            f'reduction.basis = "{options.basis}" interpolates samples that cover the box, at least 4 along each '
            'parameter, on a grid all of them solved: use sampling.scheme = "adaptive" or "even" (one parameter) or '
            '"grid", or basis = "chebyshev"'
        )
    if (not ordered or options.basis == "chebyshev") and options.format in ("tucker", "cp"):
        raise StudyError(
            f'reduction.format = "{options.format}" of method "pod" needs samples on a grid and splines: '
            'use "polynomial" or "tensor_train", or sampling.scheme = "grid"'
        )


def _slopes(snapshots: list[Snapshot], name: str, pod: Pod, kept: Truncation) -> Array | None:
    """Derivatives (n_snapshots, d, n_modes) of a field's coefficients; None where they are unknown."""
    if name not in snapshots[0].sensitivities:
        return None
    # One snapshot at a time: the slopes of all of them together would be the largest array of a build.
    slopes = [
        pod.project(values.reshape(len(values), -1).astype(np.float64)) @ kept.rotation.T
        for values in (snapshot.sensitivities[name] for snapshot in snapshots)
    ]
    return np.array(slopes)


def _on_line(task: ReductionTask, coefficients: Array, slopes: Array | None) -> tuple[Functions, dict[str, Any]]:
    """Piecewise cubics, or hats, through coefficients (n_snapshots, n_modes) and slopes, of one parameter."""
    own = None if slopes is None else slopes[:, 0]
    functions = interpolate_line(task.samples[:, 0], coefficients, own, task.options.basis)
    basis = task.options.basis or ("cubic_spline" if own is None else "cubic_hermite")
    return functions, {"format": "tensor_train", "basis": basis, "grid": [len(coefficients)]}


def _on_grid(task: ReductionTask, grid: EvenGrid, coefficients: Array) -> tuple[Functions, dict[str, Any]]:
    """Splines through coefficients (n_snapshots, n_modes) on a grid."""
    options = task.options
    basis = options.basis or "cubic_spline"
    form = options.format or "tucker"
    bases = parameter_bases(basis, task.parameters, grid.counts)
    functions = functions_on_grid(grid.tensor(coefficients), bases, form, SHARE * options.tolerance)
    return functions, {"format": form, "basis": basis, "grid": list(grid.counts)}


def _on_paths(task: ReductionTask, paths: TimePaths, coefficients: Array) -> tuple[Functions, dict[str, Any]]:
    """Splines in time through polynomials of the other parameters, of coefficients (n_snapshots, n_modes)."""
    options = task.options
    weights, tolerance = _weights(task, paths.clock), SHARE * options.tolerance
    functions, errors = fit_paths(
        paths, task.samples, coefficients, task.box, options.max_degree, weights, tolerance, options.basis
    )
    return functions, {
        "format": "tensor_train",
        "basis": options.basis or "cubic_spline",
        "paths": len(paths.rows),
        "instants": len(paths.instants),
        "degrees": [basis.size - 1 for k, basis in enumerate(functions.bases) if k != paths.clock],
        "cross_validation": {str(degree): error for degree, error in errors.items()},
    }


def _weights(task: ReductionTask, clock: int | None = None) -> Array:
    """Of the samples (n,) in a regression; those at the defaults of all but the ``clock`` count more."""
    defaults = np.array([p.default for p in task.parameters])
    close = np.isclose(task.samples, defaults, rtol=0.0, atol=1e-9 * np.ptp(task.box, axis=1))
    if clock is not None:
        close[:, clock] = True
    return np.where(close.all(axis=1), DEFAULT_WEIGHT, 1.0)


def _fitted(task: ReductionTask, coefficients: Array, slopes: Array | None) -> tuple[Functions, dict[str, Any]]:
    """Polynomials fitted to the coefficients (n_snapshots, n_modes) of a field at scattered samples."""
    options, box = task.options, task.box
    lower, upper = box.T
    functions, errors = fit_functions(
        task.samples,
        coefficients,
        slopes,
        lower,
        upper,
        options.max_degree,
        task.labels,
        raise_single=True,
        weights=_weights(task),
    )
    summary = {
        "format": options.format or "polynomial",
        "basis": "chebyshev",
        "degree": int(functions.multi_indices.sum(axis=1).max()),
        "degrees": functions.multi_indices.max(axis=0).tolist(),
        "terms": len(functions.multi_indices),
        "cross_validation": {str(degree): error for degree, error in errors.items()},
    }
    if options.format == "tensor_train":
        indices, tolerance = functions.multi_indices, SHARE * options.tolerance
        return chebyshev_train(lower, upper, indices, functions.coefficients, tolerance), summary
    return functions, summary


def _offered_functions(dimension: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    several = ("tucker", "cp") if dimension > 1 else ()
    return ("polynomial", "tensor_train", *several), ("chebyshev", *GRID_BASES)


register_reduction("pod", reduce_by_pod, bisects=True, functions=_offered_functions)
