"""Weak greedy choice of samples, as reduced-basis methods make it.

The next full solution is taken where the reduced model is estimated to err most among candidates. An estimate
hardly ever grows as the basis does, so one from an earlier round bounds the present one (the saturation
assumption: Hesthaven, Stamm and Zhang, ESAIM: M2AN 48, 2014): candidates are estimated anew from the largest
down, until those on top are all up to date. Most keep their old estimate, and cost nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.model.basis_functions import chebyshev_basis
from morph_dslam.model.functions import Functions
from morph_dslam.reduction.galerkin import FullSolutions, ReducedSolver, solid_equations
from morph_dslam.reduction.grid_functions import (
    MOST_NODES,
    functions_on_grid,
    interpolation_nodes,
    sizes_along_lines,
    values_on_grid,
)
from morph_dslam.reduction.pod import keep_modes
from morph_dslam.reduction.sampled_fields import SampledFields, field_modes
from morph_dslam.reduction.separable_problem import SeparableProblem, factorise
from morph_dslam.reduction.separation import ScatteredValues, expansion_train, fit_expansion, polynomial_functions
from morph_dslam.reduction.task import ReductionTask, field_names, model_of, parameter_bases

Array = NDArray[np.float64]


def worst_candidates(estimate: Callable[[int], float], earlier: Array, count: int) -> tuple[NDArray[np.int64], Array]:
    """The candidates with the largest estimated errors.

    Parameters
    ----------
    estimate : present estimate at a candidate, by its index.
    earlier : (n,) last estimate of each; infinite where there is none, minus infinity for candidates that are
        out of the choice.
    count : how many to choose.

    Returns
    -------
    chosen : (count,) indices, the largest estimate first; fewer where no more are in the choice.
    estimates : (n,) with those made anew.
    """
    estimates, current = earlier.copy(), np.isneginf(earlier)
    while True:
        chosen = np.argsort(-estimates, kind="stable")[: min(count, int(np.sum(~np.isneginf(estimates))))]
        stale = chosen[~current[chosen]]
        if not len(stale):
            return chosen, estimates
        estimates[stale[0]] = estimate(int(stale[0]))
        current[stale[0]] = True


# The dual norm of a separated solution's residual: the stopping measure of PGD.


class DualResidual:
    """sqrt(int r(mu)^T K0^-1 r(mu) dmu), K0 the problem's metric.

    It equals the energy norm of the error where the operator is K0 for all parameters, and is equivalent to
    it otherwise. As the residual is a sum of products, its norm needs only the Gram matrices of its space
    vectors and of its functions of each parameter. These cancel, so relative values below about 1e-7 mean no
    more than "small".
    """

    def __init__(self, problem: SeparableProblem) -> None:
        self._problem = problem
        self._inverse = factorise(problem.metric, True)
        self._lifted = self._inverse.solve(problem.loads)
        self.load_norm = self._norm(problem.loads, self._lifted, list(problem.load_functions))

    def _norm(self, vectors: Array, lifted: Array, functions: list[Array]) -> float:
        """Of sum_s vectors[:, s] prod_k functions[k][s], with ``lifted`` = K0^-1 vectors."""
        product = vectors.T @ lifted
        for axis, values in zip(self._problem.axes, functions, strict=True):
            product = product * ((values * axis.weights) @ values.T)
        return float(np.sqrt(max(np.sum(product), 0.0)))

    def relative(self, modes: Array, coefficients: list[Array]) -> float:
        """Residual of the sum with ``modes`` (n, m) and ``coefficients`` [(n_free, m)], over that of zero."""
        problem = self._problem
        images = np.concatenate([matrix @ modes for matrix in problem.matrices], axis=1)
        functions = [
            np.concatenate([g, np.swapaxes(image @ c, 1, 2).reshape(images.shape[1], -1)])
            for g, image, c in zip(problem.load_functions, problem.images, coefficients, strict=True)
        ]
        vectors = np.concatenate([problem.loads, -images], axis=1)
        lifted = np.concatenate([self._lifted, -self._inverse.solve(images)], axis=1)
        return self._norm(vectors, lifted, functions) / self.load_norm


# The method "galerkin": few full solutions, many reduced ones, functions of the parameters through these.
# The equations are projected on the modes of the training solutions (`galerkin`), solved wherever the
# functions need it (`reduced_solver`), and each field is recovered there as it is from full solutions. Up to
# four parameters the samples form a full grid (`grid_functions`); beyond, a sparse expansion is fitted to
# scattered ones (`scattered_functions`). Last, every field keeps the modes that the tolerance asks for.


#: A full grid is sampled up to so many parameters.
MOST_GRID_PARAMETERS = 4

#: Part of the tolerance that interpolation and the separated form may each use.
SHARE = 0.5


def reduce_by_galerkin(task: ReductionTask) -> ReducedModel:
    """A reduced model of every field from densely sampled Galerkin solutions.

    Raises
    ------
    StudyError
        If the study is not that of a hyperelastic solid.
    """
    problem = solid_equations(task.problem() if task.problem else None)
    snapshots = [snapshot for group in task.groups for snapshot in group]
    box, tolerance = task.box, task.options.tolerance
    solver = ReducedSolver(problem, FullSolutions.read(task.files), box, tolerance)
    spread = np.diff(box, axis=1)[:, 0]
    modes = {
        name: field_modes(snapshots, name, task.mesh.weights, spread, tolerance) for name in field_names(snapshots)
    }
    sampled = SampledFields(solver, problem, modes, SHARE * tolerance)
    dense = _on_grid(task, sampled) if _grid_is_used(task) else _scattered(task, sampled)
    fields, summaries = {}, {}
    for name, part in sampled.parts.items():
        flat = dense.coefficients[part].reshape(part.stop - part.start, -1)
        kept = keep_modes(task, name, modes[name].modes, flat)
        fields[name] = kept.field(dense.functions(kept.rotation, part, task, SHARE * tolerance))
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
    return model_of(task, fields, summary)


def _grid_is_used(task: ReductionTask) -> bool:
    return len(task.parameters) <= MOST_GRID_PARAMETERS and task.options.format != "polynomial"


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
        degrees = self.indices.max(axis=0)
        bases = tuple(
            chebyshev_basis(lower, upper, int(degree)) for (lower, upper), degree in zip(task.box, degrees, strict=True)
        )
        return expansion_train(self.indices, found, bases, tolerance)


def _on_grid(task: ReductionTask, sampled: SampledFields) -> _Grid:
    """All fields on the grid that lines through the box ask for."""
    basis = task.options.basis or "chebyshev"
    leading = sampled.parts["displacement"]
    sizes = sizes_along_lines(sampled.in_allowed_units, task.parameters, basis, leading, MOST_NODES)
    bases = parameter_bases(basis, task.parameters, sizes)
    values = values_on_grid(sampled, tuple(interpolation_nodes(basis) for basis in bases))
    return _Grid(bases, values, {"format": task.options.format or "tucker", "basis": basis, "grid": list(sizes)})


def _scattered(task: ReductionTask, sampled: SampledFields) -> _Expansion:
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
