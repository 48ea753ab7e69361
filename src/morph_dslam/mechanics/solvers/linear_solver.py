"""Sparse direct solution of K_ff x = b with the inertia of K_ff, every solve's residual checked.

PARDISO (Intel MKL, through the optional package pypardiso) where it is installed, NGSolve's `sparsecholesky` otherwise;
the environment variable MORPH_LINEAR_SOLVER = pardiso | sparsecholesky overrides the choice. A solve whose residual
iterative refinement cannot mend is done again by SuperLU, whose pivoting is safer and slower. With PARDISO's defaults a
saddle-point matrix comes back with a relative residual of 1e-3 and no warning: scaling and weighted matching prevent
that.

Symmetric matrices come to the libraries as their upper triangle in CSR form with every diagonal entry stored.
"""

from __future__ import annotations

import os
import sys
import weakref
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import ngsolve as ngs
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import NDArray

from morph_dslam.errors import SolverError, how_to_install

Array = NDArray[np.float64]
#: scipy.sparse.csr_matrix, which has no usable type stubs.
Matrix = Any
sla: Any = scipy.sparse.linalg
#: PARDISO's settings, numbered from 1 as in its manual: own settings; METIS ordering; refinement only where pivots were
#: perturbed (`linear_solver` refines where a residual asks for it); perturbation of zero pivots 1e-8; Bunch-Kaufman
#: pivoting.
PARDISO_SETTINGS = {1: 1, 2: 2, 8: 0, 10: 8, 21: 1}
#: Scaling and weighted matching. Saddle points need them; where all diagonals are positive they cost a fifth of the
#: time for nothing.
SCALING, MATCHING = 11, 13
REAL_SYMMETRIC_INDEFINITE, REAL_UNSYMMETRIC = -2, 11
ANALYSE, FACTORISE, SOLVE = 11, 22, 33
PERTURBED_PIVOTS, NEGATIVE_EIGENVALUES = 14, 23
#: Where pypardiso looks for MKL before it searches.
LIBRARY_VARIABLE = "PYPARDISO_MKL_RT"
#: Without PARDISO, negative eigenvalues are counted among so many nearest to zero.
LOOKED_AT = 6
#: A matrix is symmetric where it differs from its transpose by no more than this part of its largest entry: a follower
#: pressure has an energy where its surface is closed or held at the rim.
ASYMMETRY = 1e-12


class Pardiso:
    """Intel MKL's PARDISO through pypardiso; the analysis is kept while the pattern stays."""

    def __init__(self, symmetric: bool, threads: int | None) -> None:
        # pypardiso would search the whole environment's folder, when imported and for every solver: half a second.
        usual = sorted(Path(sys.prefix, "lib").glob("libmkl_rt.so*"))
        if usual:
            os.environ.setdefault(LIBRARY_VARIABLE, str(usual[0]))
        from pypardiso import PyPardisoSolver

        self._symmetric = symmetric
        self._handle: Any = PyPardisoSolver(REAL_SYMMETRIC_INDEFINITE if symmetric else REAL_UNSYMMETRIC)
        os.environ.setdefault(LIBRARY_VARIABLE, self._handle.libmkl._name)
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


def _same_pattern(one: Matrix, other: Matrix) -> bool:
    return np.array_equal(one.indptr, other.indptr) and np.array_equal(one.indices, other.indices)


class _SparseCholesky:
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

        The eigenvalues nearest to zero are looked at: a structure that loses its stability shows it there. None if all
        of them are negative, for then there may be more, or if they are not found.
        """
        if self._size <= 4 * LOOKED_AT:
            inverse = self.solve(np.eye(self._size))
            return int(np.count_nonzero(np.linalg.eigvalsh((inverse + inverse.T) / 2.0) < 0.0))
        operator = sla.LinearOperator(
            (self._size, self._size), matvec=lambda x: self.solve(x.reshape(-1, 1)).ravel(), dtype=float
        )
        start = np.random.default_rng(0).standard_normal(self._size)
        try:
            nearest = sla.eigsh(operator, LOOKED_AT, which="LM", v0=start, tol=1e-3, return_eigenvectors=False)
        except sla.ArpackNoConvergence:
            return None
        negative = int(np.count_nonzero(nearest < 0.0))
        return None if negative == LOOKED_AT else negative


class SuperLU:
    """Scipy's SuperLU, with partial pivoting: the slowest and the safest; it gives no inertia."""

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


Integers = NDArray[np.integer]
#: A solve is good when its residual is below this part of the right-hand side ...
RESIDUAL_TOLERANCE = 1e-9
#: ... or below this part of |A| |x| + |b|, which double precision cannot improve (Rigal and Gaches, 1967).
BACKWARD_ERROR = 1e-14
REFINEMENTS = 4
ENVIRONMENT_VARIABLE = "MORPH_LINEAR_SOLVER"
#: One library's factorisation of a square matrix; `factorise` replaces the one before.
_Engine = Pardiso | _SparseCholesky | SuperLU


def default_engine() -> str:
    """Name of the engine in use: the environment's choice, or PARDISO where it is installed.

    Raises SolverError if the environment asks for an engine that is unknown or not installed.
    """
    installed = find_spec("pypardiso") is not None
    chosen = os.environ.get(ENVIRONMENT_VARIABLE, "pardiso" if installed else "sparsecholesky")
    if chosen not in ("pardiso", "sparsecholesky"):
        raise SolverError(f"{ENVIRONMENT_VARIABLE}={chosen} is unknown: use pardiso or sparsecholesky")
    if chosen == "pardiso" and not installed:
        raise SolverError(f"{ENVIRONMENT_VARIABLE}=pardiso needs pypardiso: {how_to_install('pardiso')}")
    return chosen


@dataclass(frozen=True)
class _FreeBlock:
    """Pattern of K_ff in CSR form, of its upper triangle alone if it is symmetric, and where its entries lie in K.

    Attributes
    ----------
    order : index into K's data with one zero appended (the diagonals that K does not store).
    """

    indptr: Integers
    indices: Integers
    order: Integers

    @staticmethod
    def of(indices: Integers, indptr: Integers, free: NDArray[np.bool_], symmetric: bool) -> _FreeBlock:
        # NGSolve's row pointers are unsigned.
        rows = np.repeat(np.arange(len(free)), np.diff(np.asarray(indptr, dtype=np.int64)))
        columns = np.asarray(indices, dtype=np.int64)
        if symmetric and not np.any(columns > rows):
            rows, columns = columns, rows  # only the lower triangle is stored: its transpose is the upper one
        kept = free[rows] & free[columns]
        if symmetric:
            kept &= columns >= rows
        order = np.flatnonzero(kept)
        number, size = np.cumsum(free) - 1, int(np.count_nonzero(free))
        rows, columns = number[rows[kept]], number[columns[kept]]
        # PARDISO wants every diagonal entry of a symmetric matrix stored, zero or not.
        missing = np.setdiff1d(np.arange(size), rows[rows == columns])
        rows, columns = np.concatenate([rows, missing]), np.concatenate([columns, missing])
        order = np.concatenate([order, np.full(len(missing), len(indices))])
        sorting = np.lexsort((columns, rows))
        starts = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=size))])
        return _FreeBlock(starts.astype(np.int32), columns[sorting].astype(np.int32), order[sorting])

    def extract(self, data: Array) -> Matrix:
        size = len(self.indptr) - 1
        values = np.append(data, 0.0)[self.order]
        return sp.csr_matrix((values, self.indices, self.indptr), shape=(size, size))


def _is_symmetric(matrix: Matrix) -> bool:
    return bool(abs(matrix - matrix.T).max() <= ASYMMETRY * abs(matrix).max()) if matrix.shape[0] else True


def multiply(matrix: Matrix, vectors: Array, triangular: bool) -> Array:
    """Matrix times ``vectors`` (n,) or (n, k), of a symmetric matrix stored as one triangle if ``triangular``."""
    product = matrix @ vectors
    if triangular:
        diagonal = matrix.diagonal()
        product += matrix.T @ vectors - (diagonal * vectors.T).T
    return product


class Factorisation:
    """K_ff = L D L^T or L U of one matrix; good until its `LinearSolver` factorises the next."""

    def __init__(self, solver: LinearSolver, matrix: Matrix, triangular: bool) -> None:
        self._solver, self._matrix, self._triangular = solver, matrix, triangular

    @cached_property
    def _norm(self) -> float:
        """Largest sum of a row's magnitudes; worked out only for solves that are not plainly good."""
        ones = np.ones(self._matrix.shape[0])
        return float(np.max(multiply(abs(self._matrix), ones, self._triangular), initial=0.0))

    @property
    def current(self) -> bool:
        """Whether this is still the solver's latest factorisation; an older one must not be used."""
        return self._solver.latest is self

    @property
    def negative_pivots(self) -> int | None:
        """Number of negative eigenvalues of K_ff (Sylvester's law of inertia); None if it is not known."""
        return self._solver.engine.negative_pivots if self._matrix.shape[0] else 0

    def solve(self, right: Array) -> Array:
        """K_ff^-1 right_f.

        Raises SolverError if neither the engine nor SuperLU gives a small residual: the matrix is singular.

        Parameters
        ----------
        right : (n,) or (k, n) over all dofs; what it holds at prescribed dofs does not matter.

        Returns
        -------
        The same shape, zero at prescribed dofs.
        """
        free = self._solver.free
        solution = np.zeros(right.shape)
        if self._matrix.shape[0]:
            columns = np.atleast_2d(right)[:, free].T.copy()
            solution[..., free] = self._solve_checked(columns).T.reshape(*right.shape[:-1], -1)
        return solution

    def _solve_checked(self, right: Array) -> Array:
        if not np.all(np.isfinite(right)):
            raise SolverError("the right-hand side of a linear solve is not finite")
        for engine in self._solver.engines_to_try(self._matrix):
            solution = np.zeros_like(right)
            residual = right
            for _ in range(1 + REFINEMENTS):
                solution = solution + engine.solve(residual)
                if not np.all(np.isfinite(solution)):
                    break
                residual = right - multiply(self._matrix, solution, self._triangular)
                if self._good(residual, solution, right):
                    return solution
        raise SolverError("the tangent matrix is singular: the body may lack supports, or be at a limit point")

    def _good(self, residual: Array, solution: Array, right: Array) -> bool:
        remaining = np.abs(residual).max(axis=0)
        size = np.abs(right).max(axis=0)
        if np.all(remaining <= RESIDUAL_TOLERANCE * size):
            return True
        rounding = BACKWARD_ERROR * (self._norm * np.abs(solution).max(axis=0) + size)
        return bool(np.all(remaining <= np.maximum(RESIDUAL_TOLERANCE * size, rounding)))


class Solved(Protocol):
    """One matrix, ready to be solved with: a `Factorisation`, or what an iterative method has prepared."""

    @property
    def current(self) -> bool:
        """Whether it may still be used: a `LinearSolver` keeps the factors of its latest matrix alone."""
        ...

    @property
    def negative_pivots(self) -> int | None:
        """Number of negative eigenvalues of K_ff; None if it is not known."""
        ...

    def solve(self, right: Array) -> Array:
        """K_ff^-1 right_f for (n,) or (k, n), zero at prescribed dofs."""
        ...


class TangentSolver(ABC):
    """Solves with matrices that share their free dofs, one at a time.

    Parameters
    ----------
    free : (n,) dofs that are solved for.
    symmetric : whether the matrices are (then one triangle of them is enough).
    all_free : free dofs of the equations, where these have more than the matrices; None if they do not.
    """

    def __init__(self, free: NDArray[np.bool_], symmetric: bool, all_free: NDArray[np.bool_] | None = None) -> None:
        self.free, self.symmetric = np.asarray(free, dtype=bool), symmetric
        self.all_free = self.free if all_free is None else all_free
        self._triangle: tuple[Integers, bool] | None = None

    @abstractmethod
    def factorise(self, data: Array, indices: Integers, indptr: Integers) -> Solved:
        """Take the free block of K, given in CSR form with sorted indices.

        A symmetric K may come whole or as its lower or upper triangle. Raises SolverError if an entry is not finite.
        """

    def is_triangle(self, matrix: Matrix) -> bool:
        """Whether only one triangle of ``matrix`` is stored; looked at once for each array of columns."""
        if self._triangle is None or not np.may_share_memory(self._triangle[0], matrix.indices):
            one_sided = sp.triu(matrix, 1).nnz == 0 or sp.tril(matrix, -1).nnz == 0
            self._triangle = matrix.indices, one_sided
        return self._triangle[1]


class SolverMaker(Protocol):
    """Makes a `TangentSolver` of given dofs."""

    def __call__(self, free: NDArray[np.bool_], symmetric: bool, *, all_free: NDArray[np.bool_]) -> TangentSolver: ...


class LinearSolver(TangentSolver):
    """Factorises the matrices.

    Parameters
    ----------
    free : see `TangentSolver`.
    symmetric : see `TangentSolver`.
    threads : of PARDISO; None leaves MKL's own choice.
    engine : "pardiso" or "sparsecholesky"; None for `default_engine`. Unsymmetric matrices go to SuperLU where PARDISO
        is not used, since `sparsecholesky` reads one triangle only. A matrix that turns out to be symmetric is
        factorised as such, which takes half the work and gives its inertia.
    all_free : see `TangentSolver`.
    """

    def __init__(
        self,
        free: NDArray[np.bool_],
        symmetric: bool,
        threads: int | None = None,
        engine: str | None = None,
        all_free: NDArray[np.bool_] | None = None,
    ) -> None:
        super().__init__(free, symmetric, all_free)
        self._threads, self._engine_name = threads, engine or default_engine()
        self._triangular = symmetric
        self.engine = self._make_engine()
        self._block: _FreeBlock | None = None
        self._pattern: tuple[Integers, Integers] | None = None
        self._substitute: SuperLU | None = None
        self.latest: Factorisation | None = None

    def factorise(self, data: Array, indices: Integers, indptr: Integers) -> Factorisation:
        """See `TangentSolver`."""
        if not np.all(np.isfinite(data)):
            raise SolverError("the tangent matrix is not finite: the deformation is too large or inside out")
        matrix: Matrix = self._block_of(indices, indptr).extract(data)
        triangular = self.symmetric or _is_symmetric(matrix)
        if triangular and not self.symmetric:
            matrix = sp.triu(matrix, format="csr")
        if triangular != self._triangular:
            self._triangular = triangular
            self.engine = self._make_engine()
        self._substitute = None
        if matrix.shape[0]:
            self.engine.factorise(matrix)
        self.latest = Factorisation(self, matrix, triangular)
        return self.latest

    def _make_engine(self) -> _Engine:
        if self._engine_name == "pardiso":
            return Pardiso(self._triangular, self._threads)
        return _SparseCholesky() if self._triangular else SuperLU(triangular=False)

    def _block_of(self, indices: Integers, indptr: Integers) -> _FreeBlock:
        """The free block's pattern, worked out again only when K's pattern has changed."""
        known = self._pattern
        if (
            self._block is None
            or known is None
            or not (np.array_equal(known[0], indices) and np.array_equal(known[1], indptr))
        ):
            self._block = _FreeBlock.of(indices, indptr, self.free, self.symmetric)
            self._pattern = np.array(indices), np.array(indptr)
        return self._block

    def engines_to_try(self, matrix: Matrix) -> Iterator[_Engine]:
        """The engine, then (lazily, once for each matrix) SuperLU in its place."""
        yield self.engine
        if self._substitute is None:
            self._substitute = SuperLU(triangular=self._triangular)
            self._substitute.factorise(matrix)
        yield self._substitute


class AssembledLinearisation:
    """Residual and tangent in CSR form; factorised when first solved with, and again if need be.

    Parameters
    ----------
    residual : (n,) internal minus external forces at all dofs.
    matrix : K over all dofs, whole or, if symmetric, one triangle; its data must not change afterwards.
    solver : shared by the linearisations of one problem, so that PARDISO's analysis is kept.
    """

    def __init__(self, residual: Array, matrix: Matrix, solver: TangentSolver) -> None:
        self.residual, self._matrix, self._solver = residual, matrix, solver
        self._factorisation: Solved | None = None
        self._triangular = solver.symmetric and solver.is_triangle(matrix)

    def _factorised(self) -> Solved:
        if self._factorisation is None or not self._factorisation.current:
            matrix = self._matrix
            self._factorisation = self._solver.factorise(matrix.data, matrix.indices, matrix.indptr)
        return self._factorisation

    @property
    def negative_pivots(self) -> int | None:
        return self._factorised().negative_pivots

    def solve(self, right: Array) -> Array:
        """K_ff^-1 right_f for (n,) or (k, n), zero at prescribed dofs."""
        return self._factorised().solve(right)

    def apply(self, vectors: Array) -> Array:
        """K times (n,) or (k, n), at all dofs."""
        return multiply(self._matrix, vectors.T, self._triangular).T
