"""Functions of the parameters: what every format offers, and the smooth polynomials of a total degree.

A field is modes in space times functions H_i(mu) of the parameters (the paper's equation for the parametric
solution). The formats differ in how H_i is made of one-dimensional functions: `ParameterFunctions` here,
`CPFunctions`, `TuckerFunctions` and `TensorTrainFunctions` in `tensor_functions`.

No format extrapolates: beyond its range each one-dimensional function goes on as its tangent (C1), and
`Functions.inside` says which parameters are in their range.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from morph_dslam.model.basis_functions import CHEBYSHEV, fill_basis

Array = NDArray[np.float64]


class Functions(ABC):
    """``n_functions`` functions H_i of ``dimension`` = d parameters, in any format."""

    @property
    @abstractmethod
    def n_functions(self) -> int:
        """Number of functions H_i."""

    @property
    @abstractmethod
    def n_floats(self) -> int:
        """Numbers stored, for the compression factor."""

    @property
    @abstractmethod
    def bounds(self) -> tuple[Array, Array]:
        """Ends of the ranges (d,), (d,) in SI units; infinite for a periodic parameter, which has none."""

    @abstractmethod
    def _compiled(self, mu: Array) -> Array:
        """`rows` without the check."""

    @abstractmethod
    def mixed(self, matrix: Array) -> Self:
        """The functions sum_i ``matrix[i, j]`` H_i for a matrix (n_functions, n), in the same format."""

    @property
    def dimension(self) -> int:
        """Number of parameters d."""
        return len(self.bounds[0])

    def rows(self, mu: ArrayLike) -> Array:
        """Values, then the derivative by each parameter (1 + d, n_functions) at ``mu`` (d,), compiled.

        The last ones are kept: fields of the same functions are mostly asked for one after the other.

        Raises
        ------
        ValueError
            If ``mu`` has another shape: compiled code would read beyond the arrays.
        """
        mu = np.ascontiguousarray(mu, dtype=np.float64)
        if mu.shape != (self.dimension,):
            raise ValueError(f"{self.dimension} parameters are needed, not an array of shape {mu.shape}")
        last, key = self._last, mu.tobytes()
        known = last.get(key)
        if known is None:
            known = self._compiled(mu)
            last.clear()
            last[key] = known
        return known.copy()

    @cached_property
    def _last(self) -> dict[bytes, Array]:
        """The rows of the last parameters, by their bytes."""
        return {}

    def evaluate(self, mu: ArrayLike) -> tuple[Array, Array]:
        """Values (n_functions,) and gradient (d, n_functions) at ``mu`` (d,)."""
        rows = self.rows(mu)
        return rows[0], rows[1:]

    def inside(self, mu: ArrayLike) -> NDArray[np.bool_]:
        """Which parameters (d,) lie in their range: where one does not, the answer is extrapolated."""
        mu = np.asarray(mu, dtype=np.float64)
        lower, upper = self.bounds
        return (mu >= lower) & (mu <= upper)

    def nearest_inside(self, mu: ArrayLike) -> Array:
        """``mu`` (d,) with every parameter brought to the nearer end of its range if it lies outside."""
        lower, upper = self.bounds
        return np.minimum(np.maximum(np.asarray(mu, dtype=np.float64), lower), upper)


@njit(cache=True, nogil=True)
def evaluate_polynomials(mu, lower, upper, multi_indices, coefficients):
    """Values and gradient (1 + d, n) of sums of products of Chebyshev polynomials, compiled.

    Parameters
    ----------
    mu : (d,) parameters.
    lower : (d,) lower ends of their ranges.
    upper : (d,) upper ends.
    multi_indices : (n_terms, d) int, polynomial degree of each factor.
    coefficients : (n_terms, n).
    """
    n_terms, d = multi_indices.shape
    n_functions = coefficients.shape[1]
    degree = 0
    for t in range(n_terms):
        for k in range(d):
            degree = max(degree, multi_indices[t, k])
    table, knots = np.empty((d, 3, degree + 1)), np.empty(0)
    for k in range(d):
        fill_basis(CHEBYSHEV, 0, degree + 1, lower[k], upper[k], knots, mu[k], table[k])
    factors = np.ones((1 + d, n_terms))
    for t in range(n_terms):
        for k in range(d):
            value, slope = table[k, 0, multi_indices[t, k]], table[k, 1, multi_indices[t, k]]
            for row in range(1 + d):
                factors[row, t] *= slope if row == k + 1 else value
    result = np.zeros((1 + d, n_functions))
    whole = n_terms - n_terms % 4
    for row in range(1 + d):
        sums, of_row = result[row], factors[row]
        # Four terms at a pass spare traffic to the result.
        for t in range(0, whole, 4):
            p, q, r, s = coefficients[t], coefficients[t + 1], coefficients[t + 2], coefficients[t + 3]
            for i in range(n_functions):
                sums[i] += of_row[t] * p[i] + of_row[t + 1] * q[i] + of_row[t + 2] * r[i] + of_row[t + 3] * s[i]
        for t in range(whole, n_terms):
            for i in range(n_functions):
                sums[i] += of_row[t] * coefficients[t, i]
    return result


@dataclass(frozen=True)
class ParameterFunctions(Functions):
    """Polynomials of several parameters: H_i(mu) = sum_t c[t, i] prod_k T_{m[t, k]}(xi_k).

    T are Chebyshev polynomials and xi_k in [-1, 1] is mu_k scaled to its range.

    Attributes
    ----------
    lower : (d,) lower ends of the ranges, SI.
    upper : (d,) upper ends.
    multi_indices : (n_terms, d) polynomial degrees.
    coefficients : (n_terms, n_functions).
    """

    lower: Array
    upper: Array
    multi_indices: NDArray[np.int64]
    coefficients: Array

    def __post_init__(self) -> None:
        shapes = [np.shape(a) for a in (self.lower, self.upper, self.multi_indices, self.coefficients)]
        (d,), (terms, _) = shapes[0], shapes[3]
        if shapes[:3] != [(d,), (d,), (terms, d)] or terms < 1:
            raise ValueError(f"ranges, degrees and coefficients of shapes {shapes} do not fit together")
        if not (np.asarray(self.lower) < self.upper).all():
            raise ValueError(f"the ranges must grow, not go from {self.lower} to {self.upper}")
        if np.min(self.multi_indices, initial=0) < 0:
            raise ValueError("a polynomial cannot be of negative degree")

    @property
    def n_functions(self) -> int:
        return self.coefficients.shape[1]

    @property
    def n_floats(self) -> int:
        """Coefficients, and the degrees: each is one byte of a number's four."""
        return self.coefficients.size + -(-self.multi_indices.size // 4)

    @property
    def bounds(self) -> tuple[Array, Array]:
        return self.lower, self.upper

    def _compiled(self, mu: Array) -> Array:
        return evaluate_polynomials(mu, self.lower, self.upper, self.multi_indices, self.coefficients)

    def mixed(self, matrix: Array) -> Self:
        return replace(self, coefficients=self.coefficients @ matrix)


def total_degree_indices(dimension: int, degree: int) -> NDArray[np.int64]:
    """All multi-indices (n_terms, dimension) whose sum is at most ``degree``, lowest degrees first."""
    grid = np.indices((degree + 1,) * dimension).reshape(dimension, -1).T
    kept = grid[grid.sum(axis=1) <= degree]
    order = np.lexsort((*kept.T[::-1], kept.sum(axis=1)))
    return kept[order].astype(np.int64)
