"""The libraries behind `linear_solver`: PARDISO, NGSolve's sparse Cholesky, SuperLU.

Symmetric matrices come as their upper triangle in CSR form with every diagonal entry stored.
"""

from __future__ import annotations

import weakref
from typing import Any

import ngsolve as ngs
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import NDArray

from morph_dslam.errors import SolverError

Array = NDArray[np.float64]
#: scipy.sparse.csr_matrix, which has no usable type stubs.
Matrix = Any
sla: Any = scipy.sparse.linalg

#: PARDISO's settings, numbered from 1 as in its manual: own settings; METIS ordering; refinement only where
#: pivots were perturbed (`linear_solver` refines where a residual asks for it);
#: perturbation of zero pivots 1e-8; Bunch-Kaufman pivoting.
PARDISO_SETTINGS = {1: 1, 2: 2, 8: 0, 10: 8, 21: 1}
#: Scaling and weighted matching. Saddle points need them; where all diagonals are positive they cost a fifth
#: of the time for nothing.
SCALING, MATCHING = 11, 13
REAL_SYMMETRIC_INDEFINITE, REAL_UNSYMMETRIC = -2, 11
ANALYSE, FACTORISE, SOLVE = 11, 22, 33
PERTURBED_PIVOTS, NEGATIVE_EIGENVALUES = 14, 23

#: Without PARDISO, negative eigenvalues are counted among so many nearest to zero.
LOOKED_AT = 6


class Pardiso:
    """Intel MKL's PARDISO through pypardiso; the analysis is kept while the pattern stays."""

    def __init__(self, symmetric: bool, threads: int | None) -> None:
        from pypardiso import PyPardisoSolver

        self._symmetric = symmetric
        self._handle: Any = PyPardisoSolver(REAL_SYMMETRIC_INDEFINITE if symmetric else REAL_UNSYMMETRIC)
        for number, value in PARDISO_SETTINGS.items():
            self._handle.set_iparm(number, value)
        if threads is not None:
            self._handle.libmkl.MKL_Set_Num_Threads(threads)
        self._matrix: Matrix | None = None
        self._matched = False
        weakref.finalize(self, self._handle.free_memory, everything=True)

    def _call(self, phase: int, right: Array) -> Array:
        from pypardiso.pardiso_wrapper import PyPardisoError

        self._handle.set_phase(phase)
        try:
            return self._handle._call_pardiso(self._matrix, right)
        except PyPardisoError as error:
            raise SolverError(f"PARDISO could not factorise the tangent matrix: {error}") from error

    def factorise(self, matrix: Matrix) -> None:
        known, self._matrix = self._matrix, matrix
        nothing = np.zeros((matrix.shape[0], 1))
        matched = not self._symmetric or bool(np.any(matrix.diagonal() <= 0.0))
        if known is None or not _same_pattern(known, matrix) or (matched and not self._matched):
            self._matched = matched
            for setting in (SCALING, MATCHING):
                self._handle.set_iparm(setting, int(matched))
            self._call(ANALYSE, nothing)
        self._call(FACTORISE, nothing)

    def solve(self, right: Array) -> Array:
        return self._call(SOLVE, np.asfortranarray(right))

    @property
    def negative_pivots(self) -> int | None:
        """None where a pivot had to be perturbed, for then its sign means nothing."""
        if not self._symmetric or self._handle.get_iparm(PERTURBED_PIVOTS):
            return None
        return int(self._handle.get_iparm(NEGATIVE_EIGENVALUES))

    def release(self) -> None:
        self._handle.free_memory(everything=True)
        self._matrix = None


def _same_pattern(one: Matrix, other: Matrix) -> bool:
    return np.array_equal(one.indptr, other.indptr) and np.array_equal(one.indices, other.indices)


class SparseCholesky:
    """NGSolve's sparse L D L^T, without pivoting."""

    def __init__(self) -> None:
        self._inverse: Any = None
        self._size = 0

    def factorise(self, matrix: Matrix) -> None:
        upper = matrix.tocoo()
        strict = upper.row != upper.col
        rows = np.concatenate([upper.row, upper.col[strict]])
        columns = np.concatenate([upper.col, upper.row[strict]])
        values = np.concatenate([upper.data, upper.data[strict]])
        self._size = matrix.shape[0]
        create: Any = ngs.la.SparseMatrixd.CreateFromCOO
        whole = create(rows, columns, values, self._size, self._size)
        self._inverse = whole.Inverse(inverse="sparsecholesky")

    def solve(self, right: Array) -> Array:
        vector, result = ngs.BaseVector(self._size), ngs.BaseVector(self._size)
        solution = np.empty(right.shape)
        for column in range(right.shape[1]):
            vector.FV().NumPy()[:] = right[:, column]
            result.data = self._inverse * vector
            solution[:, column] = result.FV().NumPy()
        return solution

    @property
    def negative_pivots(self) -> int | None:
        """An estimate by Lanczos' method on the inverse, since NGSolve keeps its pivots to itself.

        The eigenvalues nearest to zero are looked at: a structure that loses its stability shows it there.
        None if all of them are negative, for then there may be more, or if they are not found.
        """
        if self._size <= 4 * LOOKED_AT:
            inverse = self.solve(np.eye(self._size))
            return int(np.count_nonzero(np.linalg.eigvalsh((inverse + inverse.T) / 2.0) < 0.0))
        operator = sla.LinearOperator(
            (self._size, self._size), matvec=lambda x: self.solve(x.reshape(-1, 1)).ravel(), dtype=float
        )
        start = np.random.default_rng(0).standard_normal(self._size)
        try:
            nearest = sla.eigsh(
                operator, LOOKED_AT, which="LM", v0=start, tol=1e-3, return_eigenvectors=False
            )
        except sla.ArpackNoConvergence:
            return None
        negative = int(np.count_nonzero(nearest < 0.0))
        return None if negative == LOOKED_AT else negative

    def release(self) -> None:
        self._inverse = None


class SuperLU:
    """Scipy's SuperLU, with partial pivoting: the slowest and the safest; it tells no inertia."""

    negative_pivots = None

    def __init__(self, triangular: bool) -> None:
        self._triangular = triangular
        self._factors: Any = None

    def factorise(self, matrix: Matrix) -> None:
        whole = matrix + sp.triu(matrix, 1).T if self._triangular else matrix
        try:
            self._factors = sla.splu(whole.tocsc())
        except RuntimeError as error:
            raise SolverError(
                "the tangent matrix is singular: the body may lack supports, or be at a limit point"
            ) from error

    def solve(self, right: Array) -> Array:
        assert self._factors is not None
        return self._factors.solve(right)

    def release(self) -> None:
        self._factors = None
