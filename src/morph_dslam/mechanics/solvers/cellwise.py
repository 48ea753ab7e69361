"""Linearisations of all dofs where those inside cells were eliminated when the tangent was assembled."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from morph_dslam.mechanics.solvers.linear_solver import AssembledLinearisation

Array = NDArray[np.float64]


class CellwiseLinearisation:
    """A linearisation of all dofs, from that of those which cells share.

    With a the dofs inside of m cells, of which each has c, and u all others, S = K_uu - K_ua K_aa^-1 K_au.

    Parameters
    ----------
    coupled : with S in place of K.
    first : number of the first of the a, which follow one another cell by cell.
    follow : sparse (m c, n): K_aa^-1 K_au.
    inner : (m, c, c) K_aa.
    negative : number of negative eigenvalues of K_aa.
    """

    def __init__(
        self, coupled: AssembledLinearisation, first: int, follow: sp.csr_matrix, inner: Array, negative: int
    ) -> None:
        self.residual = coupled.residual
        self._coupled, self._follow, self._inner, self._negative = coupled, follow, inner, negative
        self._added = slice(first, first + inner.shape[0] * inner.shape[1])

    @property
    def negative_pivots(self) -> int | None:
        """Those of S and of K_aa together are those of K (Haynsworth, 1968)."""
        found = self._coupled.negative_pivots
        return None if found is None else found + self._negative

    def _by_cell(self, values: Array) -> Array:
        return values.reshape(*self._inner.shape[:2], -1)

    def solve(self, right: Array) -> Array:
        columns = np.atleast_2d(right).T
        given = columns[self._added]
        solution = self._coupled.solve((columns - self._follow.T @ given).T).T
        alone = np.linalg.solve(self._inner, self._by_cell(given)).reshape(given.shape)
        solution[self._added] = alone - self._follow @ solution
        return solution.T.reshape(right.shape)

    def apply(self, vectors: Array) -> Array:
        columns = np.atleast_2d(vectors).T
        shifted = columns[self._added] + self._follow @ columns
        forces = (self._inner @ self._by_cell(shifted)).reshape(shifted.shape)
        product = self._coupled.apply(columns.T).T + self._follow.T @ forces
        product[self._added] = forces
        return product.T.reshape(vectors.shape)


class PointwiseLinearisation:
    """A linearisation of all dofs where one more was eliminated at each of some quadrature points.

    With e these dofs, v all others and the diagonal D = K_ee, K_vv is that of ``cellwise`` plus K_ve D^-1 K_ev.

    Parameters
    ----------
    cellwise : with K_vv - K_ve D^-1 K_ev in place of K_vv.
    along : sparse (p, n): K_ev. The e come last of all dofs.
    diagonal : (p,) D.
    ratio : (p,) columns of K_ve over the rows of K_ev.
    """

    def __init__(self, cellwise: CellwiseLinearisation, along: sp.csr_matrix, diagonal: Array, ratio: Array) -> None:
        self.residual = cellwise.residual
        self._cellwise, self._along, self._diagonal, self._ratio = cellwise, along, diagonal[:, None], ratio[:, None]
        self._own = slice(len(self.residual) - len(diagonal), None)

    @property
    def negative_pivots(self) -> int | None:
        """Without those of D, which are the same in every state."""
        return self._cellwise.negative_pivots

    def _forces(self, values: Array) -> Array:
        """K_ve times ``values`` (p, k)."""
        return self._along.T @ (self._ratio * values)

    def solve(self, right: Array) -> Array:
        columns = np.atleast_2d(right).T
        given = columns[self._own]
        solution = self._cellwise.solve((columns - self._forces(given / self._diagonal)).T).T
        solution[self._own] = (given - self._along @ solution) / self._diagonal
        return solution.T.reshape(right.shape)

    def apply(self, vectors: Array) -> Array:
        columns = np.atleast_2d(vectors).T
        moved, own = self._along @ columns, columns[self._own]
        product = self._cellwise.apply(columns.T).T + self._forces(moved / self._diagonal + own)
        product[self._own] = moved + self._diagonal * own
        return product.T.reshape(vectors.shape)
