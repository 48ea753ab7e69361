"""The method "galerkin": few full solutions, many reduced ones, functions of the parameters through these.

The equations are projected on the modes of the training solutions and solved wherever the functions need it
(`galerkin`), and each field is recovered there as it is from full solutions. Each field has modes of its own:
those of the training snapshots and of their sensitivities times the ranges of the parameters. Up to four
parameters the samples form a full grid (`grid_functions`); beyond, a sparse expansion is fitted to scattered
ones (`sparse_expansion`). Last, every field keeps the modes that the tolerance asks for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.mechanics.loads import with_reactions
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.model.functions import Functions
from morph_dslam.reduction.galerkin import FullSolutions, ReducedSolver, solid_equations
from morph_dslam.reduction.grid_functions import (
    MOST_NODES,
    functions_on_grid,
    interpolation_nodes,
    sizes_along_lines,
    values_on_grid,
)
from morph_dslam.reduction.pod import compute_pod, truncate
from morph_dslam.reduction.registry import register_reduction
from morph_dslam.reduction.sparse_expansion import ScatteredValues, chebyshev_train, fit_expansion, polynomial_functions
from morph_dslam.reduction.task import ReductionTask, parameter_bases
from morph_dslam.studies.solid_sweep import solid_snapshot

Array = NDArray[np.float64]
#: Error allowed in all fields but the displacement, as a multiple of the tolerance.
OTHER_FIELDS = 40.0
#: Modes of a field are kept until so little is left out, as a part of the tolerance, and at most so many.
MODE_TOLERANCE, MOST_MODES = 0.1, 80


class FieldModes:
    """Orthonormal modes (k, n_points, n_components) of one field.

    Parameters
    ----------
    values : (n, n_points, n_components) vectors that the modes span.
    weights : (n_points,).
    tolerance : relative error that the reduction may have.
    n_values : how many of them, the first ones, are values of the field and no sensitivities.

    Attributes
    ----------
    largest : norm of the largest value.
    """

    def __init__(self, values: Array, weights: Array, tolerance: float, n_values: int) -> None:
        shape = values.shape[1:]
        pod = compute_pod(
            values.reshape(len(values), -1), np.repeat(weights, shape[1]), MODE_TOLERANCE * tolerance, MOST_MODES
        )
        self._pod = pod
        self.modes = pod.modes.reshape(-1, *shape)
        self.largest = float(np.linalg.norm(pod.project(values.reshape(len(values), -1)[:n_values]), axis=1).max())
        self._square, self._missed = 0.0, 0.0

    def coefficients(self, values: Array) -> Array:
        """Coefficients (k,) of a field (n_points, n_components); what is left out is added to the tally."""
        flat = values.ravel()
        found = self._pod.project(flat)
        square = float(flat @ (flat * self._pod.weights))
        self._square += square
        self._missed += max(square - float(found @ found), 0.0)
        return found

    @property
    def left_out(self) -> float:
        """Relative norm of the fields so far that the modes do not hold."""
        return float(np.sqrt(self._missed / self._square)) if self._square else 0.0


def field_modes(task: ReductionTask, name: str, spread: Array, tolerance: float) -> FieldModes:
    """Modes of a field's values and of its sensitivities times the parameters' ranges ``spread`` (d,)."""
    snapshots, values = task.snapshots, list(task.values(name))
    if name in snapshots[0].sensitivities:
        values += [
            slope * length
            for snapshot in snapshots
            for slope, length in zip(snapshot.sensitivities[name], spread, strict=True)
        ]
    return FieldModes(np.array(values), task.weights(len(values[0])), tolerance, len(snapshots))


class _SampledFields:
    """Coefficients of all fields at any parameters, one after another in one vector.

    Parameters
    ----------
    modes : of each field by name; names of reactions begin with "reaction_".
    tolerance : error allowed in the displacement, relative to its largest value.

    Attributes
    ----------
    parts : where the coefficients of each field are.
    """

    def __init__(
        self, solver: ReducedSolver, problem: SolidProblem, modes: dict[str, FieldModes], tolerance: float
    ) -> None:
        self._solver, self._problem, self.modes = solver, problem, modes
        self._reactions = [name.removeprefix("reaction_") for name in modes if name.startswith("reaction_")]
        self._allowed = tolerance * np.concatenate(
            [
                np.full(len(m.modes), m.largest * (1.0 if name == "displacement" else OTHER_FIELDS))
                for name, m in modes.items()
            ]
        )
        ends = np.cumsum([0, *(len(field.modes) for field in modes.values())])
        self.parts = {name: slice(a, b) for name, a, b in zip(modes, ends[:-1], ends[1:], strict=True)}

    def __call__(self, mu: Array) -> Array:
        """Coefficients of all fields (n,) at ``mu`` (d,)."""
        dofs = self._solver.lift(self._solver.solve(mu), mu)
        snapshot = solid_snapshot(self._problem, dofs, mu, reactions=bool(self._reactions))
        snapshot = with_reactions(snapshot, self._reactions)
        return np.concatenate([field.coefficients(snapshot.fields[name]) for name, field in self.modes.items()])

    def in_allowed_units(self, mu: Array) -> Array:
        """The same in units of the error allowed in each field."""
        return self(mu) / self._allowed


#: A full grid is sampled up to so many parameters.
MOST_GRID_PARAMETERS = 4
#: Part of the tolerance that interpolation and the separated form may each use.
SHARE = 0.5


def reduce_by_galerkin(task: ReductionTask) -> ReducedModel:
    """A reduced model of every field from densely sampled Galerkin solutions."""
    problem = solid_equations(task.problem() if task.problem else None)
    box, tolerance = task.box, task.options.tolerance
    solver = ReducedSolver(problem, FullSolutions.read(task.files), box, tolerance)
    spread = np.diff(box, axis=1)[:, 0]
    modes = {name: field_modes(task, name, spread, tolerance) for name in task.field_names}
    sampled = _SampledFields(solver, problem, modes, SHARE * tolerance)
    on_grid = len(task.parameters) <= MOST_GRID_PARAMETERS and task.options.format != "polynomial"
    dense = _on_grid(task, sampled) if on_grid else _scattered(task, sampled)
    fields, summaries = {}, {}
    for name, part in sampled.parts.items():
        flat = dense.coefficients[part].reshape(part.stop - part.start, -1)
        weights = task.weights(modes[name].modes.shape[1])
        kept = truncate(modes[name].modes, flat, weights, tolerance, task.options.max_modes)
        fields[name] = SeparatedField(kept.modes, dense.functions(kept.rotation, part, task, SHARE * tolerance))
        summaries[name] = {
            "modes": len(kept.modes),
            "singular_values": kept.singular_values[:60].tolist(),
            "left_out_by_the_snapshots_modes": modes[name].left_out,
        }
    summary = {
        "method": task.options.method or "galerkin",
        "galerkin_modes": solver.galerkin.n_dofs,
        "reduced_solves": dense.count,
        **dense.summary,
        **summaries["displacement"],
    }
    return task.model(fields, summary)


@dataclass(frozen=True)
class _Grid:
    """Coefficients (n, n_1, ..., n_d) of all fields on a grid; see `_Expansion`."""

    bases: tuple[Any, ...]
    coefficients: Array
    summary: dict[str, Any]

    @property
    def count(self) -> int:
        return int(np.prod(self.coefficients.shape[1:]))

    def functions(self, rotation: Array, part: slice, task: ReductionTask, tolerance: float) -> Functions:
        """Functions (one for each row of ``rotation``) of one field's part of the coefficients."""
        tensor = np.tensordot(rotation, self.coefficients[part], axes=1)
        return functions_on_grid(tensor, self.bases, task.options.format or "tucker", tolerance)


@dataclass(frozen=True)
class _Expansion:
    """Coefficients (n, n_terms) of all fields in a sparse Chebyshev expansion."""

    indices: NDArray[np.int64]
    coefficients: Array
    count: int
    summary: dict[str, Any]

    def functions(self, rotation: Array, part: slice, task: ReductionTask, tolerance: float) -> Functions:
        """Functions (one for each row of ``rotation``) of one field's part of the coefficients."""
        found = (rotation @ self.coefficients[part]).T
        if task.options.format == "polynomial":
            return polynomial_functions(task.box, self.indices, found)
        lower, upper = task.box.T
        return chebyshev_train(lower, upper, self.indices, found, tolerance)


def _on_grid(task: ReductionTask, sampled: _SampledFields) -> _Grid:
    """All fields on the grid that lines through the box ask for."""
    basis = task.options.basis or "chebyshev"
    leading = sampled.parts["displacement"]
    sizes = sizes_along_lines(sampled.in_allowed_units, task.parameters, basis, leading, MOST_NODES)
    bases = parameter_bases(basis, task.parameters, sizes)
    values = values_on_grid(sampled, tuple(interpolation_nodes(basis) for basis in bases))
    return _Grid(bases, values, {"format": task.options.format or "tucker", "basis": basis, "grid": list(sizes)})


def _scattered(task: ReductionTask, sampled: _SampledFields) -> _Expansion:
    """All fields at scattered samples, fitted by a sparse expansion."""
    leading = sampled.parts["displacement"]
    sizes = sizes_along_lines(sampled.in_allowed_units, task.parameters, "chebyshev", leading)
    degrees = [size - 1 for size in sizes]
    scattered = ScatteredValues(sampled, task.box)
    tolerance = SHARE * task.options.tolerance
    indices, coefficients, error = fit_expansion(scattered, task.box, degrees, tolerance, leading)
    summary = {
        "format": task.options.format or "tensor_train",
        "basis": "chebyshev",
        "degrees": indices.max(axis=0).tolist(),
        "terms": len(indices),
        "expansion_error": error,
    }
    return _Expansion(indices, coefficients.T, len(scattered.samples), summary)


def _offered_functions(dimension: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    if dimension <= MOST_GRID_PARAMETERS:
        return ("tucker", "tensor_train", "cp", "polynomial"), ("chebyshev", "cubic_spline", "hat", "fourier")
    return ("tensor_train", "polynomial"), ("chebyshev",)


_PROPERTIES = {"equations": True, "adaptive": True, "functions": _offered_functions}

register_reduction("galerkin", reduce_by_galerkin, **_PROPERTIES)
register_reduction("reduced_basis", reduce_by_galerkin, greedy=True, **_PROPERTIES)
