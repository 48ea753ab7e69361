"""Smooth functions of the parameters: sums of products of Chebyshev polynomials, with their derivatives.

Each function is H_i(mu) = sum_t c[t, i] prod_k T_{m[t, k]}(xi_k), where xi_k in [-1, 1] is mu_k scaled to
its range. Products of one-dimensional functions are what makes the representation separated (the paper's
equation for the parametric solution); polynomials make it smooth to every order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def evaluate_functions(mu, lower, upper, multi_indices, coefficients):
    """Values and gradient of all functions at one point, compiled.

    Parameters
    ----------
    mu, lower, upper : (d,) parameters and their range.
    multi_indices : (n_terms, d) int, polynomial degree of each factor.
    coefficients : (n_terms, n_functions).

    Returns
    -------
    (1 + d, n_functions): the values, then the derivative with respect to each parameter.
    """
    n_terms, d = multi_indices.shape
    n_functions = coefficients.shape[1]
    degree = 0
    for t in range(n_terms):
        for k in range(d):
            degree = max(degree, multi_indices[t, k])
    table = np.empty((d, degree + 1))
    slope = np.empty((d, degree + 1))
    for k in range(d):
        scale = 2.0 / (upper[k] - lower[k])
        xi = (mu[k] - lower[k]) * scale - 1.0
        table[k, 0], slope[k, 0] = 1.0, 0.0
        if degree > 0:
            table[k, 1], slope[k, 1] = xi, scale
        for j in range(2, degree + 1):
            table[k, j] = 2.0 * xi * table[k, j - 1] - table[k, j - 2]
            slope[k, j] = 2.0 * scale * table[k, j - 1] + 2.0 * xi * slope[k, j - 1] - slope[k, j - 2]
    result = np.zeros((1 + d, n_functions))
    factors = np.empty(1 + d)
    for t in range(n_terms):
        factors[:] = 1.0
        for k in range(d):
            value = table[k, multi_indices[t, k]]
            for row in range(1 + d):
                factors[row] *= slope[k, multi_indices[t, k]] if row == k + 1 else value
        for row in range(1 + d):
            for i in range(n_functions):
                result[row, i] += factors[row] * coefficients[t, i]
    return result


def evaluate_functions_numpy(mu, lower, upper, multi_indices, coefficients):
    """The plain twin of `evaluate_functions`, by numpy's Chebyshev series."""
    d = len(mu)
    scale = 2.0 / (upper - lower)
    xi = (mu - lower) * scale - 1.0
    values, slopes = [], []
    for k in range(d):
        unit = np.eye(multi_indices[:, k].max() + 1)
        values.append(chebyshev.chebval(xi[k], unit)[multi_indices[:, k]])
        slopes.append(scale[k] * chebyshev.chebval(xi[k], chebyshev.chebder(unit))[multi_indices[:, k]])
    rows = [np.prod(values, axis=0)]
    rows += [np.prod([slopes[j] if j == k else values[j] for j in range(d)], axis=0) for k in range(d)]
    return np.stack(rows) @ coefficients


@dataclass(frozen=True)
class ParameterFunctions:
    """``n_functions`` smooth functions on a box of ``d`` parameters.

    Attributes
    ----------
    lower, upper : (d,) the box, SI units.
    multi_indices : (n_terms, d) polynomial degrees.
    coefficients : (n_terms, n_functions).
    """

    lower: Array
    upper: Array
    multi_indices: NDArray[np.int64]
    coefficients: Array

    def evaluate(self, mu: Array) -> tuple[Array, Array]:
        """Values (n_functions,) and gradient (d, n_functions) at ``mu`` (d,)."""
        result = evaluate_functions(
            np.asarray(mu, dtype=float), self.lower, self.upper, self.multi_indices, self.coefficients
        )
        return result[0], result[1:]


def total_degree_indices(dimension: int, degree: int) -> NDArray[np.int64]:
    """All multi-indices (n_terms, dimension) whose sum is at most ``degree``, lowest degrees first."""
    grid = np.indices((degree + 1,) * dimension).reshape(dimension, -1).T
    kept = grid[grid.sum(axis=1) <= degree]
    order = np.lexsort((*kept.T[::-1], kept.sum(axis=1)))
    return kept[order].astype(np.int64)
