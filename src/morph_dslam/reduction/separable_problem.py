"""Sums of products of splines: how PGD's fields are multiplied, added and compressed.

A sum of T terms is vectors (N, T) times products over the parameters of functions with coefficients
[(size_k, T)] in common bases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solvers.linear_solver import Factorisation, LinearSolver
from morph_dslam.model import SeparatedField
from morph_dslam.model.basis_functions import Basis, hat_basis
from morph_dslam.model.tensor_functions import CPFunctions
from morph_dslam.reduction.separation import SeparatedVector

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Terms:
    """A sum of products.

    Attributes
    ----------
    vectors : (N, T). coefficients : per basis (size_k, T). bases : one for each parameter.
    """

    vectors: Array
    coefficients: tuple[Array, ...]
    bases: tuple[Basis, ...]

    def __add__(self, other: Terms) -> Terms:
        joined = (np.hstack(pair) for pair in zip(self.coefficients, other.coefficients, strict=True))
        return Terms(np.hstack([self.vectors, other.vectors]), tuple(joined), self.bases)

    def field(self, weights: Array, n_components: int, tolerance: float) -> tuple[SeparatedField, Array]:
        """The field with as few modes as the tolerance allows, orthonormal over space, and singular values.

        The singular value decomposition of the sum itself, over space and the parameters' box: no other
        modes in space lose less.

        Parameters
        ----------
        weights : (n_points,) of the points; each has ``n_components`` of the vectors' N numbers in a row.
        tolerance : relative norm that may be left out.
        """
        gram = np.ones((self.vectors.shape[1],) * 2)
        for basis, c in zip(self.bases, self.coefficients, strict=True):
            gram = gram * (c.T @ basis.gram() @ c) / (basis.upper - basis.lower)
        sizes, directions = np.linalg.eigh(gram)
        functions = directions * np.sqrt(np.maximum(sizes, 0.0))
        root = np.sqrt(np.repeat(weights, n_components))[:, None]
        left, values, _ = np.linalg.svd(self.vectors * root @ functions, full_matrices=False)
        tails = np.sqrt(np.cumsum(values[::-1] ** 2))[::-1]
        left = left[:, : max(1, int(np.sum(tails > tolerance * tails[0])))]
        mixing = np.ascontiguousarray((self.vectors * root).T @ left)
        modes = (left / root).T.reshape(-1, len(weights), n_components)
        return SeparatedField(modes, CPFunctions(self.bases, self.coefficients, mixing)), values


def spline_terms(vector: SeparatedVector, bases: tuple[Basis, ...]) -> Terms:
    """A separated vector with its functions in ``bases``."""
    return Terms(vector.vectors, tuple(_in_basis(vector, k, b) for k, b in enumerate(bases)), bases)


def _in_basis(vector: SeparatedVector, k: int, basis: Basis) -> Array:
    points, _ = basis.quadrature()
    return basis.interpolate(points, vector.functions(k, points).T)


def multiplied(terms: Terms, factor: SeparatedVector) -> Terms:
    """Products of scalar ``terms`` functions and those of ``factor``, whose vectors (N T, Q) hold N a term.

    The result is sum_t sum_q factor.vectors[t N : (t + 1) N, q] h_t(mu) f_q(mu).
    """
    count, n_terms = factor.n_terms, terms.coefficients[0].shape[1]
    vectors = factor.vectors.reshape(n_terms, -1, count)
    coefficients = []
    for k, (basis, c) in enumerate(zip(terms.bases, terms.coefficients, strict=True)):
        points, _ = basis.quadrature()
        products = (basis.evaluate(points) @ c)[:, :, None] * factor.functions(k, points).T[:, None, :]
        coefficients.append(basis.interpolate(points, products.reshape(len(points), -1)))
    stacked = np.moveaxis(vectors, 0, 1).reshape(-1, n_terms * count)
    return Terms(stacked, tuple(coefficients), terms.bases)


# Linear problems with separated parameters: [sum_q A_q (x) theta_q] U = sum_j h_j (x) g_j.
# Every theta_q and g_j is a product over the parameters. A parameter is discretised by a `ParameterAxis`: a
# basis and the quadrature of the integral over it. On an axis theta_q is multiplication with a function (a
# stiffness, a position) or, for time, the derivative; both are given as what they make of the basis
# functions.
# `galerkin_system` and `minimal_residual_system` turn a problem into the symmetric algebraic form that the
# alternating directions of `pgd` work on.


@dataclass(frozen=True)
class ParameterAxis:
    """One parameter: its basis, and the points (p,) and weights (p,) of the integral over it.

    ``fixed`` functions of the basis are left out: their coefficients are zero, as an initial condition asks.
    """

    basis: Basis
    points: Array
    weights: Array
    fixed: tuple[int, ...] = ()

    @cached_property
    def free(self) -> NDArray[np.int64]:
        """Indices of the functions in use (n_free,)."""
        return np.setdiff1d(np.arange(self.basis.size), self.fixed)

    @cached_property
    def values(self) -> Array:
        """The functions in use at the points (p, n_free)."""
        return self.basis.evaluate(self.points)[:, self.free]

    def multiplied_by(self, theta: ArrayLike) -> Array:
        """Images (..., p, n_free) of the functions, multiplied with ``theta`` (..., p) at the points."""
        return np.asarray(theta, dtype=float)[..., None] * self.values

    def differentiated(self) -> Array:
        """Images (p, n_free) of the functions under differentiation."""
        return self.basis.evaluate(self.points, order=1)[:, self.free]

    def integrate(self, tests: Array, images: Array) -> Array:
        """Weighted products of ``tests`` (p, a) and ``images`` (p, b): (a, b)."""
        return (tests * self.weights[:, None]).T @ images

    def all_coefficients(self, free: Array) -> Array:
        """Coefficients (size, m) of the whole basis from those in use (n_free, m)."""
        result = np.zeros((self.basis.size, free.shape[1]))
        result[self.free] = free
        return result


def galerkin_axis(basis: Basis, fixed: tuple[int, ...] = ()) -> ParameterAxis:
    """An axis on which the problem holds in the mean, weighted with the basis functions."""
    return ParameterAxis(basis, *basis.quadrature(), fixed)


def collocation_axis(nodes: ArrayLike) -> ParameterAxis:
    """An axis of hats on which the problem holds at the ``nodes`` (n,) themselves, all of equal weight."""
    nodes = np.asarray(nodes, dtype=float)
    return ParameterAxis(hat_basis(nodes), nodes, np.full(len(nodes), 1.0 / len(nodes)))


@dataclass(frozen=True)
class SeparableProblem:
    """[sum_q A_q (x) theta_q] U = sum_j h_j (x) g_j.

    Attributes
    ----------
    axes : the d parameters.
    matrices : the Q sparse matrices A_q (n, n), on the free degrees of freedom.
    images : per axis (Q, p_k, n_free), what the factor of theta_q makes of the axis' functions.
    loads : (n, J), the vectors h_j.
    load_functions : per axis (J, p_k), the factors of g_j at the axis' points.
    metric : K0 (n, n), symmetric positive definite: residuals are measured in the norm of its inverse. The
        operator in the middle of the box is the natural choice, its symmetric part if it is not symmetric.
    """

    axes: tuple[ParameterAxis, ...]
    matrices: tuple[sp.csc_array, ...]
    images: tuple[Array, ...]
    loads: Array
    load_functions: tuple[Array, ...]
    metric: sp.csc_array

    def __post_init__(self) -> None:
        n, n_loads = self.loads.shape
        for k, axis in enumerate(self.axes):
            expected = (len(self.matrices), *axis.values.shape)
            if self.images[k].shape != expected:
                raise ValueError(f"images of axis {k} must be {expected}, not {self.images[k].shape}")
            if self.load_functions[k].shape != (n_loads, len(axis.points)):
                raise ValueError(f"load functions of axis {k} must be ({n_loads}, {len(axis.points)})")
        if any(matrix.shape != (n, n) for matrix in (*self.matrices, self.metric)):
            raise ValueError(f"all matrices must be ({n}, {n}), as the loads have {n} rows")


class SpaceOperators(Protocol):
    """Sums over terms of c_t L_t, symmetric and positive definite for the weights c that occur."""

    n_terms: int

    def apply(self, term: int, vectors: Array) -> Array:
        """L_t times ``vectors`` (n, ...)."""
        ...

    def solve(self, weights: Array, right: Array) -> Array:
        """Solve [sum_t weights_t L_t] x = right (n,)."""
        ...


@dataclass(frozen=True)
class SeparatedSystem:
    """sum_t L_t (x) Theta_t^1 (x) ... U = sum_j h_j (x) l_j^1 (x) ..., symmetric as a whole.

    Attributes
    ----------
    operators : the L_t. grams : per axis (T, n_free, n_free). masses : per axis (n_free, n_free), the norm.
    loads : (n, J). load_vectors : per axis (J, n_free).
    """

    operators: SpaceOperators
    grams: tuple[Array, ...]
    masses: tuple[Array, ...]
    loads: Array
    load_vectors: tuple[Array, ...]


def weighted_sum(weights: ArrayLike, matrices: Sequence[sp.csc_array]) -> sp.csc_array:
    """sum_q weights_q A_q."""
    scaled = [w * m for w, m in zip(np.asarray(weights), matrices, strict=True)]
    return sp.csc_array(reduce(lambda a, b: a + b, scaled))


def factorise(matrix: sp.csc_array, symmetric: bool) -> SuperLU:
    """Sparse LU factors; without pivoting where the matrix is symmetric and positive definite."""
    if symmetric:
        return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return splu(matrix)


class GalerkinOperators:
    """L_q = A_q themselves: the energy is minimised; sums must be symmetric and positive definite.

    All sums have one pattern, so that the linear solver analyses it once.
    """

    def __init__(self, problem: SeparableProblem) -> None:
        self.matrices = problem.matrices
        self.n_terms = len(problem.matrices)
        pattern: Any = sp.csr_array(reduce(lambda a, b: a + b, [abs(m) for m in problem.matrices]))
        pattern.sort_indices()
        self._indices, self._indptr = pattern.indices, pattern.indptr
        self._data = np.stack([_data_in(pattern, m) for m in problem.matrices])
        self._solver = LinearSolver(np.ones(pattern.shape[0], dtype=bool), symmetric=True)
        self._single = self._factorise(np.ones(1)) if self.n_terms == 1 else None

    def _factorise(self, weights: Array) -> Factorisation:
        return self._solver.factorise(weights @ self._data, self._indices, self._indptr)

    def apply(self, term: int, vectors: Array) -> Array:
        return self.matrices[term] @ vectors

    def solve(self, weights: Array, right: Array) -> Array:
        if self._single is not None:
            return self._single.solve(right) / weights[0]
        return self._factorise(weights).solve(right)


def _data_in(pattern: Any, matrix: sp.csc_array) -> Array:
    """The entries of a matrix in the order of a pattern (CSR, sorted) that holds them all."""
    entries: Any = sp.coo_array(matrix)
    size = pattern.shape[1]
    rows = np.repeat(np.arange(pattern.shape[0], dtype=np.int64), np.diff(pattern.indptr))
    places = np.searchsorted(rows * size + pattern.indices, entries.row.astype(np.int64) * size + entries.col)
    data = np.zeros(pattern.nnz)
    np.add.at(data, places, entries.data)
    return data


class MinimalResidualOperators:
    """L_pq = A_p^T K0^-1 A_q: the residual is minimised in K0^-1, for operators that are not symmetric."""

    def __init__(self, problem: SeparableProblem) -> None:
        self.matrices = problem.matrices
        self.metric = problem.metric
        self.inverse_metric = factorise(problem.metric, True)
        count = len(problem.matrices)
        self.pairs = [(p, q) for p in range(count) for q in range(count)]
        self.n_terms = len(self.pairs)

    def apply(self, term: int, vectors: Array) -> Array:
        p, q = self.pairs[term]
        return self.matrices[p].T @ self.inverse_metric.solve(self.matrices[q] @ vectors)

    def solve(self, weights: Array, right: Array) -> Array:
        """Conjugate gradients, preconditioned by B^T K0^-1 B with B the leading combination of the A_q."""
        table = weights.reshape(len(self.matrices), len(self.matrices))
        table = (table + table.T) / 2.0
        values, vectors = np.linalg.eigh(table)
        lead = factorise(weighted_sum(np.sqrt(values[-1]) * vectors[:, -1], self.matrices), False)

        def operator(x: Array) -> Array:
            images = np.column_stack([m @ x for m in self.matrices])
            mixed = self.inverse_metric.solve(images @ table)
            return np.sum([m.T @ mixed[:, q] for q, m in enumerate(self.matrices)], axis=0)

        def precondition(x: Array) -> Array:
            return lead.solve(self.metric @ lead.solve(x, trans="T"))

        shape = (len(right), len(right))
        solution, failed = cg(
            LinearOperator(shape, matvec=operator, dtype=float),  # pyright: ignore[reportCallIssue]
            right,
            rtol=1e-8,
            maxiter=200,
            M=LinearOperator(shape, matvec=precondition, dtype=float),  # pyright: ignore[reportCallIssue]
        )
        if failed:
            raise SolverError(
                "the minimal-residual step of PGD did not converge in 200 iterations: "
                "narrow the range of the parameters, or scale the operators alike"
            )
        return solution


def galerkin_system(problem: SeparableProblem) -> SeparatedSystem:
    """The problem tested with its own functions: for symmetric positive definite operators."""
    axes = problem.axes
    return SeparatedSystem(
        GalerkinOperators(problem),
        tuple(
            np.stack([a.integrate(a.values, image) for image in images])
            for a, images in zip(axes, problem.images, strict=True)
        ),
        tuple(a.integrate(a.values, a.values) for a in axes),
        problem.loads,
        tuple((g * a.weights) @ a.values for a, g in zip(axes, problem.load_functions, strict=True)),
    )


def minimal_residual_system(problem: SeparableProblem) -> SeparatedSystem:
    """The normal equations of |f - A U| in K0^-1: for any operator that is not singular."""
    axes, operators = problem.axes, MinimalResidualOperators(problem)
    lifted = operators.inverse_metric.solve(problem.loads)
    return SeparatedSystem(
        operators,
        tuple(
            np.stack([a.integrate(images[p], images[q]) for p, q in operators.pairs])
            for a, images in zip(axes, problem.images, strict=True)
        ),
        tuple(a.integrate(a.values, a.values) for a in axes),
        np.concatenate([m.T @ lifted for m in problem.matrices], axis=1),
        tuple(
            np.concatenate([(g * a.weights) @ image for image in images])
            for a, g, images in zip(axes, problem.load_functions, problem.images, strict=True)
        ),
    )


class DualResidual:
    """sqrt(int r(mu)^T K0^-1 r(mu) dmu), K0 the problem's metric.

    It equals the energy norm of the error where the operator is K0 for all parameters, and is equivalent to
    it otherwise. As the residual is a sum of products, its norm needs only the Gram matrices of its space
    vectors and of its functions of each parameter. These cancel, so relative values below about 1e-7 mean no
    more than "small".
    """

    def __init__(self, problem: SeparableProblem) -> None:
        self._problem = problem
        self._inverse = factorise(problem.metric, True)
        self._lifted = self._inverse.solve(problem.loads)
        self.load_norm = self._norm(problem.loads, self._lifted, list(problem.load_functions))

    def _norm(self, vectors: Array, lifted: Array, functions: list[Array]) -> float:
        """Of sum_s vectors[:, s] prod_k functions[k][s], with ``lifted`` = K0^-1 vectors."""
        product = vectors.T @ lifted
        for axis, values in zip(self._problem.axes, functions, strict=True):
            product = product * ((values * axis.weights) @ values.T)
        return float(np.sqrt(max(np.sum(product), 0.0)))

    def relative(self, modes: Array, coefficients: list[Array]) -> float:
        """Residual of the sum with ``modes`` (n, m) and ``coefficients`` [(n_free, m)], over that of zero."""
        problem = self._problem
        images = np.concatenate([matrix @ modes for matrix in problem.matrices], axis=1)
        functions = [
            np.concatenate([g, np.swapaxes(image @ c, 1, 2).reshape(images.shape[1], -1)])
            for g, image, c in zip(problem.load_functions, problem.images, coefficients, strict=True)
        ]
        vectors = np.concatenate([problem.loads, -images], axis=1)
        lifted = np.concatenate([self._lifted, -self._inverse.solve(images)], axis=1)
        return self._norm(vectors, lifted, functions) / self.load_norm
