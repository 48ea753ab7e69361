"""Static condensation: unknowns inside cells are eliminated before the factorisation.

With i the inner and c the coupled dofs, only S = K_cc - K_ci K_ii^-1 K_ic is factorised. NGSolve keeps the factors of

    K = (1 - H') (S + K_ii) (1 - H),   H = -K_ii^-1 K_ic,

in its form, until the form is assembled again.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.mechanics.solvers.linear_solver import AssembledLinearisation

Array = NDArray[np.float64]


class Condensation:
    """The factors of one condensed form, and the linearisation that they belong to.

    Parameters
    ----------
    form : made with ``condense`` and ``store_inner``.
    threads : context in which NGSolve multiplies.
    """

    def __init__(self, form: ngs.BilinearForm, threads: Callable[[], AbstractContextManager] = nullcontext) -> None:
        self.form, self._threads = form, threads
        self.latest: CondensedLinearisation | None = None

    def multiply(self, operator: str, vectors: Array) -> Array:
        """One of the form's operators applied to each of ``vectors`` (k, n)."""
        matrix = getattr(self.form, operator)
        given, result = matrix.CreateRowVector(), matrix.CreateColVector()
        products = np.empty(vectors.shape)
        with self._threads():
            for vector, product in zip(vectors, products, strict=True):
                given.FV().NumPy()[:] = vector
                result.data = matrix * given
                product[:] = result.FV().NumPy()
        return products


class CondensedLinearisation:
    """A linearisation of all dofs, from that of the coupled ones.

    Parameters
    ----------
    condensation : of the form, which has just been assembled.
    coupled : the linearisation with S in place of K.
    reassemble : assembles the form at this linearisation's point again, where another one was made since.
    """

    def __init__(
        self, condensation: Condensation, coupled: AssembledLinearisation, reassemble: Callable[[], object]
    ) -> None:
        self.residual = coupled.residual
        self._condensation, self._coupled, self._reassemble = condensation, coupled, reassemble
        condensation.latest = self

    def _operators(self) -> Callable[[str, Array], Array]:
        if self._condensation.latest is not self:
            self._reassemble()
            self._condensation.latest = self
        return self._condensation.multiply

    @property
    def negative_pivots(self) -> int | None:
        """Of S; those of K_ii are the same in every state."""
        return self._coupled.negative_pivots

    def solve(self, right: Array) -> Array:
        multiply, rows = self._operators(), np.atleast_2d(right)
        solution = self._coupled.solve(rows + multiply("harmonic_extension_trans", rows))
        solution = solution + multiply("harmonic_extension", solution) + multiply("inner_solve", rows)
        return solution.reshape(right.shape)

    def apply(self, vectors: Array) -> Array:
        multiply, rows = self._operators(), np.atleast_2d(vectors)
        reduced = rows - multiply("harmonic_extension", rows)
        product = self._coupled.apply(reduced) + multiply("inner_matrix", reduced)
        return (product - multiply("harmonic_extension_trans", product)).reshape(vectors.shape)
