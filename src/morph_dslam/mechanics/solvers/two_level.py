"""Iterative solution of K_ff x = b for elements of higher order, with the tangent of lower ones on the same cells.

With c the dofs that the lower order has too and a the added ones, block elimination

    y = K_aa^-1 b_a,   x_c = S^-1 (b_c - K_ca y),   x_a = y - K_aa^-1 K_ac x_c,   S = K_cc - K_ca K_aa^-1 K_ac

is the preconditioner of GMRES, with two substitutes (Axelsson and Gustafsson, Math. Comp. 40, 1983). S becomes the
tangent of the lower order: elements that do not lock in bending come close to it. K_aa^-1 becomes a polynomial of
Chebyshev's in single precision: added functions are short waves, so that K_aa is well conditioned, whatever the size of
the mesh. Memory grows with the matrix K alone, and the number of iterations hardly at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, gmres

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solvers.linear_solver import Integers, Matrix, TangentSolver
from morph_dslam.mechanics.solvers.newton import Linearisation

Array = NDArray[np.float64]
#: Degree of the polynomial, and the ratio of the eigenvalues between which it is small; the others lie below.
DEGREE, COVERED = 10, 40.0
#: Power iterations to the largest eigenvalue, and the factor that makes an upper bound of their result.
POWER_ITERATIONS, MARGIN = 15, 1.15
#: Where GMRES ends, in units of the right-hand side, also where more equations build on its results (motions of
#: couplings follow from small differences of large forces), where it starts anew, and where it is given up.
RELATIVE_RESIDUAL, BUILT_ON, RESTART, MOST_ITERATIONS = 0.01, 1e-3, 30, 60
#: Parts in which the matrix of the added dofs is cut out.
PORTIONS = 16


@dataclass(frozen=True)
class LowerOrder:
    """The tangent of the lower order.

    Attributes
    ----------
    linearisation : it.
    own : (k,) its dofs that the higher order has too.
    kept : (k,) their numbers there.
    """

    linearisation: Linearisation
    own: NDArray[np.integer]
    kept: NDArray[np.integer]

    def correction(self, forces: Array) -> Array:
        """Dofs (n,) of the higher order that balance its ``forces`` (n,)."""
        own, result = np.zeros_like(self.linearisation.residual), np.zeros_like(forces)
        own[self.own] = forces[self.kept]
        result[self.kept] = self.linearisation.solve(own)[self.own]
        return result


class TwoLevelSolver(TangentSolver):
    """The solver; it gives no inertia.

    Parameters
    ----------
    free : see `TangentSolver`.
    symmetric : see `TangentSolver`.
    lower : see `LowerOrder`; where none of its dofs is free the polynomial serves alone.
    all_free : see `TangentSolver`.

    Attributes
    ----------
    kept : (n,) free dofs that the lower order has too.
    added : numbers of the other free ones.
    tolerance : where GMRES ends, in units of the right-hand side.
    """

    def __init__(
        self, free: NDArray[np.bool_], symmetric: bool, lower: LowerOrder, all_free: NDArray[np.bool_] | None = None
    ) -> None:
        super().__init__(free, symmetric, all_free)
        self.lower = lower
        self.tolerance = RELATIVE_RESIDUAL if len(self.all_free) == len(self.free) else BUILT_ON
        self.kept = np.zeros_like(self.free)
        self.kept[lower.kept] = True
        self.kept &= self.free
        self.added = np.flatnonzero(self.free & ~self.kept)

    def factorise(self, data: Array, indices: Integers, indptr: Integers) -> _Prepared:
        """See `TangentSolver`."""
        if not np.all(np.isfinite(data)):
            raise SolverError("the tangent matrix is not finite: the deformation is too large or inside out")
        matrix = sp.csr_matrix((data, indices, indptr), shape=(len(self.free), len(self.free)))
        if self.symmetric and self.is_triangle(matrix):
            matrix = matrix + sp.tril(matrix, -1).T + sp.triu(matrix, 1).T
        return _Prepared(self, sp.csr_matrix(matrix))


class _Prepared:
    """One matrix with its preconditioner."""

    current, negative_pivots = True, None

    def __init__(self, solver: TwoLevelSolver, matrix: Matrix) -> None:
        self._solver, self._matrix = solver, matrix
        # A few rows at a time: a copy of them all would be the largest array of the solver.
        parts = np.array_split(solver.added, PORTIONS)
        blocks = [matrix[rows][:, solver.added].astype(np.float32) for rows in parts]
        self._polynomial = _Chebyshev(sp.csr_matrix(sp.vstack(blocks)))

    def _precondition(self, forces: Array) -> Array:
        """Dofs (n,) that balance ``forces`` (n,) roughly."""
        solver, result = self._solver, np.zeros_like(forces)
        result[solver.added] = self._polynomial.apply(forces[solver.added])
        if solver.kept.any():
            rest = np.where(solver.kept, forces - self._matrix @ result, 0.0)
            lower = np.where(solver.kept, solver.lower.correction(rest), 0.0)
            lower[solver.added] -= self._polynomial.apply((self._matrix @ lower)[solver.added])
            result += lower
        return result

    def solve(self, right: Array) -> Array:
        """K_ff^-1 right_f for (n,) or (k, n), zero at prescribed dofs, roughly.

        Raises SolverError if that takes more than `MOST_ITERATIONS`.
        """
        return np.array([self._gmres(row) for row in np.atleast_2d(right)]).reshape(right.shape)

    def _gmres(self, right: Array) -> Array:
        """The solution by GMRES (Saad and Schultz, 1986), preconditioned from the right: its residual is that of K."""
        free, shape = self._solver.free, self._matrix.shape
        right = np.where(free, right, 0.0)
        if not np.all(np.isfinite(right)):
            raise SolverError("the right-hand side of a linear solve is not finite")

        def image(forces: Array) -> Array:
            return np.where(free, self._matrix @ self._precondition(forces), 0.0)

        operator = LinearOperator(shape, matvec=image, dtype=np.float64)  # type: ignore[call-arg]
        restarts = MOST_ITERATIONS // RESTART
        found, missed = gmres(operator, right, rtol=self._solver.tolerance, restart=RESTART, maxiter=restarts)
        if missed:
            raise SolverError(f"the iterative solver has not converged in {MOST_ITERATIONS} iterations")
        return self._precondition(found)


class _Chebyshev:
    """A polynomial of D^-1 A in place of A^-1, in single precision as A is; D is the diagonal of A.

    Saad, Iterative Methods for Sparse Linear Systems, 2003, section 12.3.
    """

    def __init__(self, matrix: Matrix) -> None:
        self._matrix = matrix
        self._inverse = 1.0 / self._matrix.diagonal()
        vector, largest = np.random.default_rng(0).standard_normal(matrix.shape[0]).astype(np.float32), 0.0
        for _ in range(POWER_ITERATIONS):
            vector = self._inverse * (self._matrix @ vector)
            largest = float(np.linalg.norm(vector))
            vector /= largest
        self._middle = 0.5 * MARGIN * largest * (1.0 + 1.0 / COVERED)
        self._half = 0.5 * MARGIN * largest * (1.0 - 1.0 / COVERED)

    def apply(self, right: Array) -> NDArray[np.float32]:
        """About A^-1 ``right`` (m,)."""
        given, sigma = right.astype(np.float32), self._middle / self._half
        rho = 1.0 / sigma
        step = self._inverse * given / np.float32(self._middle)
        solution = step.copy()
        for _ in range(DEGREE - 1):
            following = 1.0 / (2.0 * sigma - rho)
            rest = self._inverse * (given - self._matrix @ solution)
            step = np.float32(following * rho) * step + np.float32(2.0 * following / self._half) * rest
            rho = following
            solution += step
        return solution
