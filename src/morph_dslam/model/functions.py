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

from morph_dslam.model.basis_functions import fill_chebyshev
from morph_dslam.row_products import row_products

Array = NDArray[np.float64]
#: So many states' values and derivatives are kept at most: about half of those that a tracked frame asks for.
KEPT = 16


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

        The last ones are kept: fields of the same functions, and steps of a frame, ask for the same state again.

        Raises
        ------
        ValueError
            If ``mu`` has another shape: compiled code would read beyond the arrays.
        """
        mu = np.ascontiguousarray(mu, dtype=np.float64)
        last, key = self._last, (mu.shape, mu.tobytes())
        known = last.get(key)
        if known is None:
            if mu.shape != (self.dimension,):
                raise ValueError(f"{self.dimension} parameters are needed, not an array of shape {mu.shape}")
            known = self._compiled(mu)
            if len(last) >= KEPT:
                last.clear()
            last[key] = known
        return known.copy()

    @cached_property
    def _last(self) -> dict[tuple[tuple[int, ...], bytes], Array]:
        """The rows of the last parameters, by shape and bytes; emptied at once, so that threads need not take turns."""
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
def _fill_products(tables, degrees, first, end, products, chosen):
    """Fill products of Chebyshev polynomials and their derivatives (1 + d, n), of the terms of a group.

    Parameters
    ----------
    tables : (d, 3, p) values and derivatives of each parameter's polynomials.
    degrees : (d, n_terms) of all terms' factors.
    first, end : where the group's terms begin and end.
    products, chosen : (1 + d, n), to be filled as far as there are terms, and (n,) for work.
    """
    # After k factors there are the first 1 + k rows.
    products[0, : end - first] = 1.0
    for k in range(len(degrees)):
        values, slopes, of_k = tables[k, 0], tables[k, 1], degrees[k, first:end]
        whole, line = products[0], products[k + 1]
        for t in range(end - first):
            chosen[t] = values[of_k[t]]
            line[t] = whole[t] * slopes[of_k[t]]
        for row in range(k + 1):
            line = products[row]
            for t in range(end - first):
                line[t] *= chosen[t]


@njit(cache=True, nogil=True)
def evaluate_polynomials(mu, lower, upper, degrees, first_term, first_function, functions, coefficients):
    """Values and gradient (1 + d, n) of sums of products of Chebyshev polynomials, compiled.

    Parameters
    ----------
    mu : (d,) parameters.
    lower : (d,) lower ends of their ranges.
    upper : (d,) upper ends.
    degrees : (d, n_terms) uint16, polynomial degree of each factor; the terms of one group after those of the other.
    first_term, first_function : (g + 1,) where the terms and functions of each of g groups begin.
    functions : (n,) which function each is, group by group.
    coefficients : those of all functions, one function after the other, as many as its group has terms.
    """
    d, highest, most, begin = len(mu), np.uint16(0), 0, 0
    for k in range(d):
        for t in range(degrees.shape[1]):
            highest = max(highest, degrees[k, t])
    for group in range(len(first_term) - 1):
        most = max(most, first_term[group + 1] - first_term[group])
    size = np.int64(highest) + 1
    tables, result = np.empty((d, 3, size)), np.empty((1 + d, len(functions)))
    products, chosen = np.empty((1 + d, most)), np.empty(most)
    for k in range(d):
        fill_chebyshev(size, lower[k], upper[k], mu[k], tables[k])
    for group in range(len(first_term) - 1):
        first, end, last = first_term[group], first_term[group + 1], first_function[group + 1] - 1
        count = end - first
        _fill_products(tables, degrees, first, end, products, chosen)
        for i in range(first_function[group], last + 1, 2):
            # Three rows times two functions at a pass; those that are not there are taken to be the last ones.
            other = min(i + 1, last)
            of_one, begin = coefficients[begin : begin + count], begin + (other - i) * count
            of_other, begin = coefficients[begin : begin + count], begin + count
            one, two = functions[i], functions[other]
            for row in range(0, 1 + d, 3):
                r, s = min(row + 1, d), min(row + 2, d)
                (result[row, one], result[row, two], result[r, one], result[r, two], result[s, one], result[s, two]) = (
                    row_products(products[row], products[r], products[s], of_one, of_other)
                )
    return result


#: A coefficient smaller than this share of its function's largest one is rounding.
ROUNDING = 1e-12


def _grouped(degrees: NDArray[np.int64], coefficients: Array) -> tuple[NDArray, ...]:
    """The last five arguments of `evaluate_polynomials`: functions of the same terms together.

    Functions that are even or odd in a parameter, as those of a symmetric object, have half of the terms only.
    """
    sizes = np.abs(coefficients)
    counts = sizes > ROUNDING * sizes.max(axis=0, initial=0.0)
    of_group: dict[bytes, list[int]] = {}
    for i, column in enumerate(counts.T):
        of_group.setdefault(column.tobytes(), []).append(i)
    groups = [np.array(group) for group in of_group.values()] or [np.empty(0, dtype=np.int64)]
    terms = [np.flatnonzero(counts[:, group].any(axis=1)) for group in groups]
    return (
        np.ascontiguousarray(degrees[np.concatenate(terms)].T, dtype=np.uint16),
        np.cumsum([0, *map(len, terms)]),
        np.cumsum([0, *map(len, groups)]),
        np.concatenate(groups),
        np.concatenate(
            [coefficients[np.ix_(rows, group)].T.ravel() for rows, group in zip(terms, groups, strict=True)]
        ),
    )


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
        return evaluate_polynomials(mu, self.lower, self.upper, *self._groups)

    @cached_property
    def _groups(self) -> tuple[NDArray, ...]:
        """What is evaluated; see `_grouped`."""
        return _grouped(self.multi_indices, np.asarray(self.coefficients, dtype=np.float64))

    def mixed(self, matrix: Array) -> Self:
        return replace(self, coefficients=self.coefficients @ matrix)


def total_degree_indices(dimension: int, degree: int) -> NDArray[np.int64]:
    """All multi-indices (n_terms, dimension) whose sum is at most ``degree``, lowest degrees first."""
    grid = np.indices((degree + 1,) * dimension).reshape(dimension, -1).T
    kept = grid[grid.sum(axis=1) <= degree]
    order = np.lexsort((*kept.T[::-1], kept.sum(axis=1)))
    return kept[order].astype(np.int64)
