"""A-priori proper generalized decomposition (PGD) of linear problems with separated parameters.

U(X, mu) = sum_i F_i(X) prod_k G_i^k(mu_k) is found without any snapshot: each enrichment alternates between
space and the parameters until the new product settles (Cueto, Gonzalez and Alfaro, "Proper Generalized
Decompositions", 2016); then the functions of each parameter are refitted for all modes at once. The iteration
stops on the dual norm of the residual, which is the energy error where the operator does not depend on the
parameters; the ratio of the last mode to the first is no measure of the error.

Operators that are not symmetric are treated by minimal residual (Nouy, Comput. Methods Appl. Mech. Eng.
2010): Galerkin's alternating directions minimise nothing there and need not converge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from tqdm import tqdm

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.loads import FORCE, MOMENT, REACTION, reaction_names
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.basis_functions import Basis, chebyshev_basis
from morph_dslam.model.tensor_functions import CPFunctions
from morph_dslam.reduction.galerkin_method import DualResidual
from morph_dslam.reduction.linear_solid import LinearSolid, linear_solid
from morph_dslam.reduction.separable_problem import (
    SeparableProblem,
    SeparatedSystem,
    Terms,
    galerkin_system,
    minimal_residual_system,
    multiplied,
    spline_terms,
)
from morph_dslam.reduction.separation import VectorFunction, fibre_series, generic_points, separate
from morph_dslam.reduction.task import ReductionTask, model_of, parameter_basis
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studies.sections import BasisName

Array = NDArray[np.float64]

METHODS = ("galerkin", "minimal_residual")


@dataclass(frozen=True)
class PgdOptions:
    """How far and how carefully to enrich.

    Attributes
    ----------
    max_modes : at most this many products.
    tolerance : stop when the relative dual norm of the residual falls below.
    inner_tolerance, inner_iterations : the alternating directions of one enrichment stop there; the refits
        make up for what they leave.
    refit_every : all modes and all their functions are refitted after this many enrichments, and at the end.
    method : "galerkin" (symmetric positive definite) or "minimal_residual".
    """

    max_modes: int = 40
    tolerance: float = 1e-4
    inner_tolerance: float = 1e-3
    inner_iterations: int = 25
    refit_every: int = 5
    method: str = "galerkin"
    progress: bool = True

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"the method is one of {', '.join(METHODS)}, not '{self.method}'")


@dataclass(frozen=True)
class PgdSolution:
    """The separated solution.

    Attributes
    ----------
    modes : (n_modes, n), the functions F_i on the free degrees of freedom, amplitude included.
    functions : the products of the G_i^k, one for each mode, of unit norm over the parameters.
    residuals : (n_modes,), relative dual norm of the residual after each enrichment.
    iterations : (n_modes,), alternating directions spent on each.
    converged : whether the tolerance was met.
    """

    modes: Array
    functions: CPFunctions
    residuals: Array
    iterations: NDArray[np.int64]
    converged: bool


class _AlternatingDirections:
    """The state of the sum: modes (n, m), coefficients [(n_free, m)], and L_t F_i as images (terms, n, m)."""

    def __init__(self, system: SeparatedSystem) -> None:
        self.system = system
        n = len(system.loads)
        self.modes = np.zeros((n, 0))
        self.images = np.zeros((system.operators.n_terms, n, 0))
        self.coefficients = [np.zeros((len(mass), 0)) for mass in system.masses]
        self._random = np.random.default_rng(0)

    def _normalise(self, k: int, coefficients: Array) -> tuple[Array, Array]:
        """Functions (n_free, m) of axis k scaled to unit norm, and the norms taken out (m,)."""
        norms = np.sqrt(np.einsum("am,ab,bm->m", coefficients, self.system.masses[k], coefficients))
        norms = np.maximum(norms, np.finfo(float).tiny)
        return coefficients / norms, norms

    def _images(self, mode: Array) -> Array:
        """L_t F (terms, n) for one mode (n,)."""
        operators = self.system.operators
        return np.stack([operators.apply(t, mode) for t in range(operators.n_terms)])

    def _products(self, k: int, new: Array) -> tuple[Array, Array, Array]:
        """Of a new function (n_free,) of axis k: with itself (terms,), the old (terms, m), the loads (J,)."""
        images = new @ self.system.grams[k]
        return images @ new, images @ self.coefficients[k], self.system.load_vectors[k] @ new

    def enrich(self, tolerance: float, max_iterations: int) -> int:
        """Add the product that the alternating directions settle on; returns the iterations spent."""
        axes = range(len(self.coefficients))
        new = [
            self._normalise(k, 1.0 + self._random.standard_normal((len(self.coefficients[k]), 1)))[0][:, 0]
            for k in axes
        ]
        products = [self._products(k, new[k]) for k in axes]
        iterations, change, amplitude, mode = 0, np.inf, 1.0, np.zeros(len(self.modes))
        while change > tolerance and iterations < max_iterations:
            iterations, change = iterations + 1, 0.0
            mode = self._space_step(products)
            images = self._images(mode)
            for k in axes:
                found, norm = self._normalise(k, self._parameter_step(k, products, mode, images)[:, None])
                difference = found[:, 0] - new[k]
                change = max(change, float(np.sqrt(difference @ self.system.masses[k] @ difference)))
                new[k], amplitude = found[:, 0], float(norm[0])
                products[k] = self._products(k, new[k])
        mode = mode * amplitude
        self.modes = np.column_stack([self.modes, mode])
        self.images = np.concatenate([self.images, self._images(mode)[:, :, None]], axis=2)
        self.coefficients = [np.column_stack([c, v]) for c, v in zip(self.coefficients, new, strict=True)]
        return iterations

    def _space_step(self, products: list[tuple[Array, Array, Array]]) -> Array:
        """R: [sum_t c_t L_t] R = sum_j h_j (...) - sum_t,i L_t F_i (...)."""
        weights, cross, load = (np.prod([p[i] for p in products], axis=0) for i in range(3))
        right = self.system.loads @ load - np.einsum("tni,ti->n", self.images, cross, optimize=True)
        return self.system.operators.solve(weights, right)

    def _parameter_step(self, k: int, products: list[tuple[Array, Array, Array]], mode: Array, images: Array) -> Array:
        """The new function of axis k, coefficients (n_free,), for a given mode and other functions."""
        grams = self.system.grams[k]
        energy = images @ mode
        cross = np.einsum("n,tni->ti", mode, self.images, optimize=True)
        load = mode @ self.system.loads
        for other, (weights_, cross_, load_) in enumerate(products):
            if other != k:
                energy, cross, load = energy * weights_, cross * cross_, load * load_
        right = load @ self.system.load_vectors[k]
        right = right - np.einsum("tab,bi,ti->a", grams, self.coefficients[k], cross, optimize=True)
        return np.linalg.solve(np.tensordot(energy, grams, axes=1), right)

    def refit(self) -> None:
        """All functions of one parameter after the other, then the modes one by one."""
        for k in range(len(self.coefficients)):
            self._refit_axis(k)
        self._refit_modes()

    def _overlaps(self, skip: int | None = None) -> tuple[Array, Array]:
        """Products over all axes but ``skip``: of the functions (terms, m, m), with the loads (J, m)."""
        m = self.modes.shape[1]
        energy = np.ones((self.system.operators.n_terms, m, m))
        load = np.ones((self.system.loads.shape[1], m))
        for k, c in enumerate(self.coefficients):
            if k != skip:
                energy = energy * (c.T @ self.system.grams[k] @ c)
                load = load * (self.system.load_vectors[k] @ c)
        return energy, load

    def _refit_axis(self, k: int) -> None:
        """The functions of axis k of all modes at once, for fixed modes and other functions."""
        energy, load = self._overlaps(skip=k)
        energy = energy * np.einsum("nj,tni->tji", self.modes, self.images, optimize=True)
        load = load * (self.system.loads.T @ self.modes)
        # unit energy of every mode, so that modes of very different size stay well conditioned
        scale = 1.0 / np.sqrt(np.maximum(np.abs(np.einsum("tii->i", energy)), np.finfo(float).tiny))
        energy = energy * scale[:, None] * scale
        right = self.system.load_vectors[k].T @ (load * scale)
        grams = [sp.csr_array(g) for g in self.system.grams[k]]
        matrix = sum(sp.kron(g, sp.csr_array(e)) for g, e in zip(grams, energy, strict=True))
        found = splu(sp.csc_array(matrix)).solve(right.ravel()).reshape(right.shape) * scale
        self.coefficients[k], norms = self._normalise(k, found)
        self.modes = self.modes * norms
        self.images = self.images * norms

    def _refit_modes(self) -> None:
        """One Gauss-Seidel sweep over the modes, each for the residual that the others leave."""
        energy, load = self._overlaps()
        for i in range(self.modes.shape[1]):
            others = energy[:, i, :].copy()
            others[:, i] = 0.0
            right = self.system.loads @ load[:, i]
            right = right - np.einsum("tnj,tj->n", self.images, others, optimize=True)
            self.modes[:, i] = self.system.operators.solve(energy[:, i, i], right)
            self.images[:, :, i] = self._images(self.modes[:, i])


def solve_pgd(problem: SeparableProblem, options: PgdOptions | None = None) -> PgdSolution:
    """Enrich until the dual residual meets the tolerance or the modes run out.

    Raises
    ------
    SolverError
        If the space problem of a minimal-residual step does not converge.
    """
    options = options or PgdOptions()
    system = galerkin_system if options.method == "galerkin" else minimal_residual_system
    state = _AlternatingDirections(system(problem))
    dual = DualResidual(problem)
    residuals: list[float] = []
    iterations: list[int] = []
    bar = tqdm(total=options.max_modes, desc="PGD", unit="mode", disable=not options.progress)
    while len(residuals) < options.max_modes:
        iterations.append(state.enrich(options.inner_tolerance, options.inner_iterations))
        if len(iterations) == options.max_modes or len(iterations) % options.refit_every == 0:
            state.refit()
        residuals.append(dual.relative(state.modes, state.coefficients))
        bar.update()
        bar.set_postfix_str(f"residual {residuals[-1]:.1e}")
        if residuals[-1] <= options.tolerance:
            break
    bar.close()
    factors = tuple(a.all_coefficients(c) for a, c in zip(problem.axes, state.coefficients, strict=True))
    functions = CPFunctions(tuple(a.basis for a in problem.axes), factors, np.eye(len(residuals)))
    converged = residuals[-1] <= options.tolerance
    return PgdSolution(state.modes.T, functions, np.array(residuals), np.array(iterations), converged)


# Displacement, strain, stress and reactions of a linear solid from its separated solution.
# Each is linear in the displacements: the field of a sum is the sum of the fields of its modes. They are
# those of the linear theory. A snapshot's Green-Lagrange strain, Cauchy stress and moments at displaced
# points differ from them by the order of the displacement's gradient, as a real solid does from the linear
# law.


#: Points of the box at which it is seen which reactions are more than rounding.
N_PROBES = 8


@dataclass(frozen=True)
class PgdFields:
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


# The method "pgd": a linear solid solved for all parameters at once, without any snapshot.
# The separated stiffness and load of the finite elements (`linear_solid`) go to a-priori PGD, and its modes
# give strains, stresses and reactions (`pgd_fields`).


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
