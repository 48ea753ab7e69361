"""Displacement, strain, stress and reactions of a linear solid from its separated solution.

Each is linear in the displacements: the field of a sum is the sum of the fields of its modes. They are those
of the linear theory. A snapshot's Green-Lagrange strain, Cauchy stress and moments at displaced points differ
from them by the order of the displacement's gradient, as a real solid does from the linear law.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import SeparatedField
from morph_dslam.offline.problem import Snapshot
from morph_dslam.offline.reactions import FORCE, MOMENT, REACTION, reaction_names
from morph_dslam.offline.reduction.linear_solid import LinearSolid
from morph_dslam.offline.reduction.separated_terms import Terms, multiplied, spline_terms
from morph_dslam.offline.reduction.separation import generic_points, separate

Array = NDArray[np.float64]

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

        factor = separate(
            lambda mu: elastic(vectors, mu), parameters, "the reaction", lambda mu: elastic(probe, mu)
        )
        loads = separate(lambda mu: problem.residual(rest, mu), parameters, "the load")
        at_sets = np.array([self._resultants(load, sets) for load in loads.vectors.T]).reshape(
            -1, 6 * len(sets)
        )
        terms = multiplied(self.solution, factor) + spline_terms(
            replace(loads, vectors=at_sets.T), self.solution.bases
        )
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
