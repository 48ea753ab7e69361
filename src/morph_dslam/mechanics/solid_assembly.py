"""Residual, tangent and their derivatives by parameters, assembled by NGSolve from a solid's integrands.

Unknowns inside cells (bubbles, discontinuous pressures) are condensed, see `condensation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

import ngsolve as ngs
import numpy as np
import scipy.sparse as sp
from netgen.libngpy._meshing import NgException
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.contact_assembly import added
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.solvers.condensation import Condensation, CondensedLinearisation
from morph_dslam.mechanics.solvers.linear_solver import AssembledLinearisation, TangentSolver
from morph_dslam.mechanics.solvers.newton import Linearisation

Array = NDArray[np.float64]
#: Dofs up to which one thread assembles faster than several.
SMALL = 5000


def threads(n_dofs: int) -> AbstractContextManager:
    """NGSolve's threads; none for small problems, where starting them takes longer than the work."""
    return ngs.TaskManager() if n_dofs > SMALL else nullcontext()


@dataclass(frozen=True)
class Term:
    """One integral of the residual.

    Attributes
    ----------
    integrand : an energy of the trial function, or virtual work: of trial and test function.
    region : volume or boundary region that it is integrated over.
    bonus_order : added to NGSolve's order of quadrature.
    rules : quadrature rules by element type, instead of NGSolve's own; empty for these.
    on_rims : integrate over the edges of each element of the region instead, each edge once for every element.
    """

    integrand: Any
    region: ngs.Region
    bonus_order: int = 0
    has_energy: bool = True
    rules: dict[Any, ngs.IntegrationRule] = field(default_factory=dict)
    on_rims: bool = False

    def add_to(self, form: ngs.BilinearForm) -> None:
        symbol = ngs.ds if self.region.VB() == ngs.BND else ngs.dx
        measure = symbol(
            definedon=self.region, bonus_intorder=self.bonus_order, intrules=self.rules, element_boundary=self.on_rims
        )
        integral = self.integrand.Compile() * measure
        form += ngs.Variation(integral) if self.has_energy else integral

    def derivatives(self, symbols: ParameterSymbols) -> dict[int, Term]:
        """The terms of the residual's derivatives, by the index of each parameter that matters."""
        return {index: replace(self, integrand=slope) for index, slope in symbols.derivatives(self.integrand).items()}


class Assembly:
    """The forms of a solid.

    Parameters
    ----------
    n_displacements : how many of the dofs, the first ones, are displacements; the others are pressures.

    Attributes
    ----------
    symmetric : whether all terms have an energy.
    coupled : (n,) dofs that are not condensed.
    """

    def __init__(
        self, space: ngs.FESpace, terms: Sequence[Term], symbols: ParameterSymbols, n_displacements: int
    ) -> None:
        self._space, self._symbols, self._n_displacements = space, symbols, n_displacements
        self.symmetric = all(term.has_energy for term in terms)
        self.coupled = np.array(space.FreeDofs(coupling=True), dtype=bool)
        self.condensed = bool(np.any(np.array(space.FreeDofs(), dtype=bool) & ~self.coupled))
        self._form = self._make_form(terms, self.condensed)
        self._slope_forms: dict[int, ngs.BilinearForm] | None = None
        self._terms = list(terms)
        self._state = ngs.GridFunction(space)
        self._result = self._state.vec.CreateVector()
        self._pattern: tuple[NDArray[np.int32], NDArray[np.int32]] | None = None
        self._condensation = Condensation(self._form, self._threads)

    def _threads(self) -> AbstractContextManager:
        return threads(self._space.ndof)

    def _make_form(self, terms: Sequence[Term], condensed: bool) -> ngs.BilinearForm:
        form = ngs.BilinearForm(self._space, symmetric=self.symmetric, condense=condensed, store_inner=condensed)
        for term in terms:
            term.add_to(form)
        return form

    def _apply(self, form: ngs.BilinearForm, x: Array) -> Array:
        self._state.vec.FV().NumPy()[:] = x
        with self._threads():
            form.Apply(self._state.vec, self._result)
        return self._result.FV().NumPy().copy()

    def residual(self, x: Array) -> Array:
        """(n,) at ``x`` (n,) and the present parameters, without nodal forces."""
        return self._apply(self._form, x)

    def energy(self, x: Array, n_terms: int) -> float:
        """Energy of the first ``n_terms`` terms at ``x`` and the present parameters, J."""
        form = self._make_form(self._terms[:n_terms], False)
        self._state.vec.FV().NumPy()[:] = x
        return float(form.Energy(self._state.vec))

    def residual_slopes(self, x: Array) -> Array:
        """(d, n) derivatives by the parameters at fixed ``x``."""
        if self._slope_forms is None:
            by_parameter: dict[int, list[Term]] = {}
            for term in self._terms:
                for index, slope in term.derivatives(self._symbols).items():
                    by_parameter.setdefault(index, []).append(slope)
            self._slope_forms = {i: self._make_form(terms, False) for i, terms in by_parameter.items()}
        result = np.zeros((len(self._symbols), len(x)))
        for index, form in self._slope_forms.items():
            result[index] = self._apply(form, x)
        return result

    def linearise(
        self, x: Array, mu: Array, residual: Array, solver: TangentSolver, contact: sp.csr_matrix | None = None
    ) -> Linearisation:
        """Tangent at ``x``, with the ``residual`` (n,) there; ``mu`` is set already.

        ``contact`` is a tangent of the displacements alone that is to be added.
        """
        multipliers = int(np.count_nonzero(solver.free[self._n_displacements :]))
        matrix = self.tangent(x)
        if contact is not None:
            matrix = added(matrix, contact, self.symmetric and solver.is_triangle(matrix))
        linearisation = _MixedLinearisation(residual, matrix, solver, multipliers)
        if not self.condensed:
            return linearisation
        x, mu = x.copy(), mu.copy()

        def reassemble() -> None:
            self._symbols.set(mu)
            self.tangent(x)

        return CondensedLinearisation(self._condensation, linearisation, reassemble)

    def tangent(self, x: Array) -> sp.csr_matrix:
        """K, or S where inner dofs are condensed, (n, n) with all entries stored."""
        self._state.vec.FV().NumPy()[:] = x
        try:
            with self._threads():
                self._form.AssembleLinearization(self._state.vec)
        except NgException as error:  # inner unknowns of a cell that is turned inside out cannot be eliminated
            raise SolverError("the tangent of a cell is singular") from error
        data, indices, indptr = self._form.mat.CSR()
        if self._pattern is None:
            self._pattern = np.array(indices, dtype=np.int32), np.array(indptr, dtype=np.int32)
        return sp.csr_matrix((np.array(data), *self._pattern), shape=(len(x), len(x)))


class _MixedLinearisation(AssembledLinearisation):
    """A linearisation with pressures, whose block of K is negative: each adds a negative pivot of its own.

    K has as many more than K_uu - K_up K_pp^-1 K_pu, whose pivots are the solid's stability, as there are
    pressures (Haynsworth, Linear Algebra and its Applications 1, 1968).
    """

    def __init__(self, residual: Array, matrix: sp.csr_matrix, solver: TangentSolver, multipliers: int) -> None:
        super().__init__(residual, matrix, solver)
        self._multipliers = multipliers

    @property
    def negative_pivots(self) -> int | None:
        found = super().negative_pivots
        # Fewer than there are multipliers mean that the pressures' block is not negative, and tell nothing.
        return None if found is None or found < self._multipliers else found - self._multipliers
