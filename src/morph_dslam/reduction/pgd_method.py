"""The method "pgd": a linear solid solved for all parameters at once, without any snapshot.

The separated stiffness and load of the finite elements (`linear_solid`) go to a-priori PGD. Strains, stresses
and reactions are linear in the displacements: the field of a sum is the sum of the fields of its modes. They
are those of the linear theory, from which a snapshot's Green-Lagrange strain, Cauchy stress and moments at
displaced points differ by the order of the displacement's gradient.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.loads import FORCE, MOMENT, REACTION, reaction_names
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.basis_functions import Basis, chebyshev_basis
from morph_dslam.reduction.linear_solid import LinearSolid, linear_solid
from morph_dslam.reduction.pgd import solve_pgd
from morph_dslam.reduction.registry import register_reduction
from morph_dslam.reduction.separated_terms import Terms, multiplied, spline_terms
from morph_dslam.reduction.separation import VectorFunction, fibre_series, generic_points, separate
from morph_dslam.reduction.task import ReductionTask, parameter_basis
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studies.sections import BasisName

Array = NDArray[np.float64]
#: Points of the box at which it is seen which reactions are more than rounding.
N_PROBES = 8


@dataclass(frozen=True)
class _PgdFields:
    """The fields of a solution.

    Attributes
    ----------
    solution : all dofs (n_dofs, T) of the separated displacements. weights : (n_nodes,) of the nodes.
    tolerance : relative norm that each field's compression may leave out.
    """

    solid: LinearSolid
    solution: Terms
    weights: Array
    tolerance: float

    def displacement(self) -> tuple[SeparatedField, Array]:
        """At the nodes, m, with its singular values."""
        nodal = [self.solid.problem.nodal_displacement(dofs).ravel() for dofs in self.solution.vectors.T]
        terms = Terms(np.stack(nodal, axis=1), self.solution.coefficients, self.solution.bases)
        return terms.field(self.weights, 3, self.tolerance)

    def strain(self) -> SeparatedField:
        """At the nodes."""
        values = self._recovered("strain", self.solution.vectors, self.solid.problem.symbols.default)
        terms = Terms(values.T, self.solution.coefficients, self.solution.bases)
        return terms.field(self.weights, 6, self.tolerance)[0]

    def stress(self) -> SeparatedField:
        """At the nodes, Pa."""
        vectors, probe = self.solution.vectors, self._probe()
        factor = separate(
            lambda mu: self._recovered("stress", vectors, mu).ravel(),
            self.solid.parameters,
            "the stress",
            lambda mu: self._recovered("stress", probe, mu).ravel(),
        )
        return multiplied(self.solution, factor).field(self.weights, 6, self.tolerance)[0]

    def _probe(self) -> Array:
        """One displacement (n_dofs, 1) in which all terms take part."""
        vectors = self.solution.vectors
        sizes = np.maximum(np.abs(vectors).max(axis=0), np.finfo(float).tiny)
        return (vectors / sizes) @ np.random.default_rng(0).standard_normal((len(sizes), 1))

    def _recovered(self, name: str, dofs: Array, mu: Array) -> Array:
        """A field (T, n_nodes * 6), linear in the ``dofs`` (n_dofs, T)."""
        problem = self.solid.problem
        return problem.sample_slopes(np.zeros(problem.n_dofs), mu, dofs.T)[name].reshape(dofs.shape[1], -1)

    # -- reactions ----------------------------------------------------------------------------------------

    def reactions(self) -> dict[str, SeparatedField]:
        """Force (N) and moment (N m, about the origin) on each set held, by the names of their fields."""
        problem, parameters = self.solid.problem, self.solid.parameters
        sets = list(dict.fromkeys(support.on for support in problem.supports))
        vectors, probe, rest = self.solution.vectors, self._probe(), np.zeros(problem.n_dofs)

        def elastic(dofs: Array, mu: Array) -> Array:
            loads = problem.residual(rest, mu)
            return np.array([self._resultants(problem.residual(x, mu) - loads, sets) for x in dofs.T]).ravel()

        factor = separate(lambda mu: elastic(vectors, mu), parameters, "the reaction", lambda mu: elastic(probe, mu))
        loads = separate(lambda mu: problem.residual(rest, mu), parameters, "the load")
        at_sets = np.array([self._resultants(load, sets) for load in loads.vectors.T]).reshape(-1, 6 * len(sets))
        terms = multiplied(self.solution, factor) + spline_terms(replace(loads, vectors=at_sets.T), self.solution.bases)
        names = [kind + name for name in sets for kind in (FORCE, MOMENT)]
        fields = {
            name: Terms(terms.vectors[3 * i : 3 * i + 3], terms.coefficients, terms.bases).field(
                np.ones(1), 3, self.tolerance
            )[0]
            for i, name in enumerate(names)
        }
        return {REACTION + name: fields[name] for name in self._not_rounding(fields)}

    def _resultants(self, residual: Array, sets: list[str]) -> Array:
        """Forces and moments (6 a set) of a ``residual`` (n_dofs,) at held dofs, nothing displaced."""
        problem = self.solid.problem
        at_rest = np.zeros((3, problem.displacements.n_scalar))
        forces = np.where(problem.constraints.held, residual[: at_rest.size], 0.0).reshape(3, -1)
        pairs = [problem.constraints.resultant(name, forces, at_rest, np.zeros(3)) for name in sets]
        return np.concatenate([part for pair in pairs for part in pair])

    def _not_rounding(self, fields: dict[str, SeparatedField]) -> list[str]:
        box = self.solid.load.box
        probes = [
            Snapshot(mu, {}, {}, {name: field.value(mu)[0] for name, field in fields.items()})
            for mu in generic_points(box, N_PROBES, 0)
        ]
        return reaction_names(probes, self.solid.problem.length)


#: Numbers of functions of one parameter that are tried.
SIZES = (5, 9, 17, 33, 65, 129)
#: Part of the reduction's tolerance that the functions of a parameter and the compression may each leave out.
SHARE = 0.1


def reduce_by_pgd(task: ReductionTask) -> ReducedModel:
    """A reduced model of a linear solid; no solutions are needed, and none are looked at.

    ``options.basis`` names the functions of the parameters (cubic splines if absent), of which as many are
    used as load, prescribed displacements and flexibility ask for. There are at most ``options.max_modes``
    products; the enrichment ends earlier where the relative dual residual is below ``options.tolerance``.
    """
    if task.problem is None:
        raise StudyError(
            'reduction.method = "pgd" solves equations, and solutions of another program have none: '
            'use method = "sparse_pgd"'
        )
    solid, options = linear_solid(task.problem()), task.options
    name = options.basis or "cubic_spline"
    bases, notes = suited_bases(solid, name, SHARE * options.tolerance)
    solution = solve_pgd(solid.separable(bases), options.max_modes, options.tolerance)
    vectors = np.zeros((solid.problem.n_dofs, len(solution.modes)))
    vectors[solid.free] = solution.modes.T
    dofs = spline_terms(solid.prescribed, bases) + Terms(vectors, solution.functions.factors, bases)
    fields = _PgdFields(solid, dofs, task.mesh.weights, SHARE * options.tolerance)
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
    return task.model({"displacement": displacement, **others}, summary)


def suited_bases(solid: LinearSolid, name: BasisName, tolerance: float) -> tuple[tuple[Basis, ...], list[str]]:
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


register_reduction(
    "pgd",
    reduce_by_pgd,
    equations=True,
    solutions=False,
    modes=False,
    functions=lambda dimension: (("cp",), get_args(BasisName)),
)
