"""The method "pgd": a linear solid solved for all parameters at once, without any snapshot.

The separated stiffness and load of the finite elements (`linear_solid`) go to a-priori PGD, and its modes
give strains, stresses and reactions (`pgd_fields`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.model.basis_functions import Basis, chebyshev_basis
from morph_dslam.offline.reduction.bases import parameter_basis
from morph_dslam.offline.reduction.fields import model_of
from morph_dslam.offline.reduction.linear_solid import LinearSolid, linear_solid
from morph_dslam.offline.reduction.pgd import PgdOptions, PgdSolution, solve_pgd
from morph_dslam.offline.reduction.pgd_fields import PgdFields
from morph_dslam.offline.reduction.separated_terms import Terms, spline_terms
from morph_dslam.offline.reduction.separation import VectorFunction, fibre_series, generic_points
from morph_dslam.offline.reduction.task import ReductionTask
from morph_dslam.offline.studies.study_sections import BasisName

Array = NDArray[np.float64]

#: Numbers of functions of one parameter that are tried.
SIZES = (5, 9, 17, 33, 65, 129)
#: Part of the reduction's tolerance that the functions of a parameter and the compression may each leave out.
SHARE = 0.1


def reduce_by_pgd(task: ReductionTask) -> ReducedModel:
    """A reduced model of a linear solid; no solutions are needed, and none are looked at.

    ``options.basis`` names the functions of the parameters (cubic splines if absent), of which as many are
    used as load, prescribed displacements and flexibility ask for. There are at most ``options.max_modes``
    products; the enrichment ends earlier where the relative dual residual is below ``options.tolerance``.

    Raises
    ------
    StudyError
        If the study is not linear, or not separable in its parameters; see `linear_solid`.
    """
    if task.problem is None:
        raise StudyError(
            'reduction.method = "pgd" solves equations, and solutions of another program have none: '
            'use method = "sparse_pgd"'
        )
    solid, options = linear_solid(task.problem()), task.options
    name = options.basis or "cubic_spline"
    bases, notes = suited_bases(solid, name, SHARE * options.tolerance)
    pgd = PgdOptions(max_modes=options.max_modes, tolerance=options.tolerance)
    solution = solve_pgd(solid.separable(bases), pgd)
    fields = PgdFields(solid, _all_dofs(solid, solution, bases), task.mesh.weights, SHARE * options.tolerance)
    displacement, singular_values = fields.displacement()
    summary: dict[str, Any] = {
        "method": "pgd",
        "basis": name,
        "modes": displacement.n_modes,
        "singular_values": singular_values[:60].tolist(),
        "products": len(solution.modes),
        "dual_residual": solution.residuals.tolist(),
        "converged": solution.converged,
        "stiffness_terms": solid.stiffness.n_terms,
        "load_terms": solid.load.n_terms,
        "functions": {p.name: b.size for p, b in zip(task.parameters, bases, strict=True)},
    }
    if notes:
        summary["warnings"] = notes
    others = {"stress_solid": fields.stress(), "strain": fields.strain(), **fields.reactions()}
    return model_of(task, {"displacement": displacement, **others}, summary)


def _all_dofs(solid: LinearSolid, solution: PgdSolution, bases: tuple[Basis, ...]) -> Terms:
    """Displacements of all dofs: the prescribed ones and what PGD has found."""
    vectors = np.zeros((solid.problem.n_dofs, len(solution.modes)))
    vectors[solid.free] = solution.modes.T
    return spline_terms(solid.prescribed, bases) + Terms(vectors, solution.functions.factors, bases)


def suited_bases(
    solid: LinearSolid, name: BasisName, tolerance: float
) -> tuple[tuple[Basis, ...], list[str]]:
    """As few functions of each parameter as follow the problem along a line to a relative ``tolerance``.

    Along parameters that the stiffness depends on it is solved for that, at tens of points; elsewhere the
    solution depends on the parameter as the load does. Notes say where the most functions are too few.
    """
    found = [_suited_basis(solid, name, tolerance, k, p) for k, p in enumerate(solid.parameters)]
    notes = [
        f"{basis.size} functions of {parameter.name} leave out {missed:.1e} of the solution: narrow its range"
        for parameter, (basis, missed) in zip(solid.parameters, found, strict=True)
        if missed > tolerance
    ]
    return tuple(basis for basis, _ in found), notes


def _suited_basis(
    solid: LinearSolid, name: BasisName, tolerance: float, k: int, parameter: Parameter
) -> tuple[Basis, float]:
    """The basis, and the largest relative part of a function along the parameter that it leaves out."""
    points = np.linspace(parameter.lower, parameter.upper, 4 * SIZES[-1])
    varies = bool(np.ptp(solid.stiffness.functions(k, points), axis=1).any())
    functions = solid.solve if varies else solid.load.value, solid.prescribed.value
    samples = [_along(f, solid.load.box, k, parameter, points, SHARE * tolerance) for f in functions]
    found = parameter_basis(name, parameter, SIZES[0]), np.inf
    for size in SIZES:
        if found[1] > tolerance:
            basis = parameter_basis(name, parameter, size)
            found = basis, max(_left_out(basis, points, values) for values in samples)
    return found


def _along(
    function: VectorFunction, box: Array, k: int, parameter: Parameter, points: Array, tolerance: float
) -> Array:
    """Values (p, N) of a function at ``points`` (p,) of one parameter, the others anywhere."""
    series = fibre_series(function, box, k, generic_points(box, 1, k), tolerance)
    if series is None:
        raise StudyError(
            f'reduction.method = "pgd": the solution varies too sharply with {parameter.name}: narrow its '
            'range, or use method = "galerkin"'
        )
    line = chebyshev_basis(parameter.lower, parameter.upper, len(series) - 1)
    return line.evaluate(points) @ series


def _left_out(basis: Basis, points: Array, values: Array) -> float:
    """Relative norm of what the basis cannot follow of ``values`` (p, N) at ``points`` (p,)."""
    missed = values - basis.evaluate(points) @ basis.interpolate(points, values)
    return float(np.linalg.norm(missed)) / max(float(np.linalg.norm(values)), np.finfo(float).tiny)
