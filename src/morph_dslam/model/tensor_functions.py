"""Functions of several parameters in separated form: CP, Tucker and tensor train, and products of functions.

Each class holds ``n_functions`` functions H_i(mu), one for each spatial mode, made of one-dimensional bases:

- `CPFunctions`: H_i = sum_t C[t, i] prod_k (phi_k(mu_k) . A_k[:, t]), the paper's sum of products;
- `TuckerFunctions`: H_i = sum_abc core[i, a, b, c] u_a(mu_1) v_b(mu_2) w_c(mu_3);
- `TensorTrainFunctions`: H_i = [G_1(mu_1) G_2(mu_2) ... G_d(mu_d)]_i, a product of small matrices.

Values and all first derivatives come from one compiled pass.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.model.basis_functions import KINDS, Basis, fill_basis
from morph_dslam.model.functions import Functions

Array = NDArray[np.float64]


class PackedBases(NamedTuple):
    """The bases of all parameters as plain arrays, for compiled code; ``starts`` delimit their functions."""

    kinds: NDArray[np.int64]
    degrees: NDArray[np.int64]
    starts: NDArray[np.int64]
    lower: Array
    upper: Array
    knots: Array
    knot_starts: NDArray[np.int64]


def pack_bases(bases: tuple[Basis, ...]) -> PackedBases:
    """Arrays of the bases, in order."""
    return PackedBases(
        kinds=np.array([KINDS[b.kind] for b in bases]),
        degrees=np.array([b.degree for b in bases]),
        starts=np.concatenate([[0], np.cumsum([b.size for b in bases])]),
        lower=np.array([b.lower for b in bases]),
        upper=np.array([b.upper for b in bases]),
        knots=np.concatenate([b.knots for b in bases]),
        knot_starts=np.concatenate([[0], np.cumsum([len(b.knots) for b in bases])]),
    )


@njit(cache=True, nogil=True)
def fill_bases(packed, mu):
    """Values and slopes (3, total size) of the functions of all parameters at ``mu`` (d,)."""
    out = np.empty((3, packed.starts[-1]))
    for k in range(len(mu)):
        a, b = packed.starts[k], packed.starts[k + 1]
        knots = packed.knots[packed.knot_starts[k] : packed.knot_starts[k + 1]]
        fill_basis(
            packed.kinds[k], packed.degrees[k], b - a, packed.lower[k], packed.upper[k], knots, mu[k], out[:, a:b]
        )
    return out


@njit(cache=True, nogil=True)
def evaluate_cp(packed, mu, factors, mixing):
    """Values and gradient (1 + d, n); ``factors`` (total size, n_terms), ``mixing`` (n_terms, n)."""
    d, n_terms = len(mu), factors.shape[1]
    table = fill_bases(packed, mu)
    values, slopes = np.zeros((d, n_terms)), np.zeros((d, n_terms))
    for k in range(d):
        for j in range(packed.starts[k], packed.starts[k + 1]):
            phi, dphi = table[0, j], table[1, j]
            if phi != 0.0 or dphi != 0.0:  # most splines vanish here
                for t in range(n_terms):
                    values[k, t] += phi * factors[j, t]
                    slopes[k, t] += dphi * factors[j, t]
    rows = np.ones((1 + d, n_terms))
    for k in range(d):
        for row in range(1 + d):
            for t in range(n_terms):
                rows[row, t] *= slopes[k, t] if row == k + 1 else values[k, t]
    result = np.zeros((1 + d, mixing.shape[1]))
    for row in range(1 + d):
        for t in range(n_terms):
            for i in range(mixing.shape[1]):
                result[row, i] += rows[row, t] * mixing[t, i]
    return result


@njit(cache=True, nogil=True)
def evaluate_tucker(packed, mu, ranks, factors, core, n_functions):
    """Values and gradient (1 + d, n_functions); ``factors`` and ``core`` flattened in C order."""
    d = len(mu)
    table = fill_bases(packed, mu)
    below = core.reshape(1, core.size)
    end = len(factors)
    for k in range(d - 1, -1, -1):
        rank, a, b = ranks[k], packed.starts[k], packed.starts[k + 1]
        factor = factors[end - (b - a) * rank : end].reshape(b - a, rank)
        end -= (b - a) * rank
        value, slope = np.zeros(rank), np.zeros(rank)
        for j in range(b - a):
            if table[0, a + j] != 0.0 or table[1, a + j] != 0.0:
                for q in range(rank):
                    value[q] += table[0, a + j] * factor[j, q]
                    slope[q] += table[1, a + j] * factor[j, q]
        # rows of `next_`: value, derivative by parameter k, derivatives by the parameters after k
        n_rows, length = below.shape[0], below.shape[1] // rank
        next_ = np.zeros((n_rows + 1, length))
        for i in range(length):
            for q in range(rank):
                next_[1, i] += below[0, i * rank + q] * slope[q]
        for row in range(n_rows):
            target = row if row == 0 else row + 1
            for i in range(length):
                for q in range(rank):
                    next_[target, i] += below[row, i * rank + q] * value[q]
        below = next_
    return below.reshape(1 + d, n_functions)


@njit(cache=True, nogil=True)
def evaluate_tensor_train(packed, mu, ranks, cores):
    """Values and gradient (1 + d, n_functions); core k, (ranks[k], size, ranks[k + 1]), flattened."""
    d = len(mu)
    table = fill_bases(packed, mu)
    after = np.ones((1, 1))
    end = len(cores)
    for k in range(d - 1, -1, -1):
        left, right = ranks[k], ranks[k + 1]
        a, size = packed.starts[k], packed.starts[k + 1] - packed.starts[k]
        core = cores[end - left * size * right : end].reshape(left, size, right)
        end -= left * size * right
        value, slope = np.zeros((left, right)), np.zeros((left, right))
        for i in range(left):
            for j in range(size):
                phi, dphi = table[0, a + j], table[1, a + j]
                if phi != 0.0 or dphi != 0.0:
                    for q in range(right):
                        value[i, q] += phi * core[i, j, q]
                        slope[i, q] += dphi * core[i, j, q]
        n_rows = after.shape[0]
        next_ = np.zeros((n_rows + 1, left))
        for i in range(left):
            for q in range(right):
                next_[1, i] += slope[i, q] * after[0, q]
        for row in range(n_rows):
            target = row if row == 0 else row + 1
            for i in range(left):
                for q in range(right):
                    next_[target, i] += value[i, q] * after[row, q]
        after = next_
    return after


@dataclass(frozen=True)
class TensorFunctions(Functions):
    """``n_functions`` functions of ``d`` parameters; the common part of the three formats."""

    bases: tuple[Basis, ...]

    @cached_property
    def _packed(self) -> PackedBases:
        return pack_bases(self.bases)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        lower, upper = np.array([b.bounds for b in self.bases]).T
        return np.ascontiguousarray(lower), np.ascontiguousarray(upper)

    def _check_sizes(self, arrays: tuple[Array, ...], axis: int) -> None:
        sizes, found = [b.size for b in self.bases], [a.shape[axis] for a in arrays]
        if sizes != found:
            raise ValueError(f"the bases have {sizes} functions, the coefficients {found}")


@dataclass(frozen=True)
class CPFunctions(TensorFunctions):
    """Sums of products of one-dimensional functions (canonical polyadic form).

    Attributes
    ----------
    factors : one (size_k, n_terms) per parameter, coefficients in its basis.
    mixing : (n_terms, n_functions); the unit matrix, which files leave out, where each term is one mode.
    """

    factors: tuple[Array, ...]
    mixing: Array

    @property
    def n_functions(self) -> int:
        return self.mixing.shape[1]

    @property
    def n_floats(self) -> int:
        return sum(f.size for f in self.factors) + (0 if self.is_unmixed else self.mixing.size)

    @cached_property
    def is_unmixed(self) -> bool:
        """Whether each term is one function, so that ``mixing`` need not be kept."""
        return np.array_equal(self.mixing, np.eye(*self.mixing.shape))

    @cached_property
    def _stacked(self) -> Array:
        return np.ascontiguousarray(np.concatenate(self.factors))

    def __post_init__(self) -> None:
        self._check_sizes(self.factors, axis=0)
        terms = {f.shape[1] for f in self.factors}
        if terms != {len(self.mixing)}:
            raise ValueError(f"the factors have {terms} terms, the mixing {len(self.mixing)}")

    def _compiled(self, mu: Array) -> Array:
        return evaluate_cp(self._packed, mu, self._stacked, self.mixing)

    def mixed(self, matrix: Array) -> Self:
        mixing = self.mixing @ matrix
        if len(self.factors) == 1:  # a sum of functions of one parameter is such a function
            factor = np.ascontiguousarray(self.factors[0] @ mixing)
            return replace(self, factors=(factor,), mixing=np.eye(mixing.shape[1]))
        return replace(self, mixing=mixing)


@dataclass(frozen=True)
class TuckerFunctions(TensorFunctions):
    """A small core tensor over a few functions of each parameter.

    Attributes
    ----------
    factors : one (size_k, rank_k) per parameter, coefficients in its basis.
    core : (n_functions, rank_1, ..., rank_d).
    """

    factors: tuple[Array, ...]
    core: Array

    @property
    def n_functions(self) -> int:
        return self.core.shape[0]

    @property
    def n_floats(self) -> int:
        return sum(f.size for f in self.factors) + self.core.size

    @cached_property
    def _flat(self) -> tuple[NDArray[np.int64], Array, Array]:
        ranks = np.array(self.core.shape[1:])
        return ranks, np.concatenate([f.ravel() for f in self.factors]), self.core.ravel()

    def __post_init__(self) -> None:
        self._check_sizes(self.factors, axis=0)
        ranks = tuple(f.shape[1] for f in self.factors)
        if self.core.shape[1:] != ranks:
            raise ValueError(f"the factors have ranks {ranks}, the core {self.core.shape[1:]}")

    def _compiled(self, mu: Array) -> Array:
        return evaluate_tucker(self._packed, mu, *self._flat, self.n_functions)

    def mixed(self, matrix: Array) -> Self:
        return replace(self, core=np.ascontiguousarray(np.tensordot(matrix.T, self.core, axes=1)))


@dataclass(frozen=True)
class TensorTrainFunctions(TensorFunctions):
    """A product of small matrices, one for each parameter.

    Attributes
    ----------
    cores : one (rank_k, size_k, rank_k+1) per parameter; the first rank is n_functions, the last is 1.
    """

    cores: tuple[Array, ...]

    @property
    def n_functions(self) -> int:
        return self.cores[0].shape[0]

    @property
    def n_floats(self) -> int:
        return sum(c.size for c in self.cores)

    @cached_property
    def _flat(self) -> tuple[NDArray[np.int64], Array]:
        ranks = np.array([c.shape[0] for c in self.cores] + [1])
        return ranks, np.concatenate([c.ravel() for c in self.cores])

    def __post_init__(self) -> None:
        self._check_sizes(self.cores, axis=1)
        left, right = [c.shape[0] for c in self.cores], [c.shape[2] for c in self.cores]
        if right != [*left[1:], 1]:
            raise ValueError(f"the cores' ranks {left} and {right} do not follow each other")

    def _compiled(self, mu: Array) -> Array:
        return evaluate_tensor_train(self._packed, mu, *self._flat)

    def mixed(self, matrix: Array) -> Self:
        first = np.ascontiguousarray(np.tensordot(matrix.T, self.cores[0], axes=1))
        return replace(self, cores=(first, *self.cores[1:]))


@njit(cache=True, nogil=True)
def product_rows(first, second):
    """Values and derivatives (1 + d + e, m n) of all products of functions of d and of e parameters.

    Parameters
    ----------
    first, second : (1 + d, m) and (1 + e, n), values and derivatives of the functions.
    """
    m, n, d = first.shape[1], second.shape[1], first.shape[0]
    rows = np.empty((d + second.shape[0] - 1, m * n))
    for k in range(len(rows)):
        ours, theirs = first[k if k < d else 0], second[0 if k < d else k - d + 1]
        for i in range(m):
            for j in range(n):
                rows[k, i * n + j] = ours[i] * theirs[j]
    return rows


@dataclass(frozen=True)
class ProductFunctions(Functions):
    """All products H_i(mu) K_j(nu), function i n_second + j, or linear combinations of them.

    Attributes
    ----------
    first : functions of the first parameters.
    second : functions of those that follow.
    mixing : (products, n_functions), or None where they stand as they are.
    """

    first: Functions
    second: Functions
    mixing: Array | None = None

    def __post_init__(self) -> None:
        if self.mixing is not None and len(self.mixing) != self._n_products:
            raise ValueError(f"{self._n_products} products are mixed by a matrix {self.mixing.shape}")

    @property
    def _n_products(self) -> int:
        return self.first.n_functions * self.second.n_functions

    @property
    def n_functions(self) -> int:
        return self._n_products if self.mixing is None else self.mixing.shape[1]

    @property
    def n_floats(self) -> int:
        mixing = 0 if self.mixing is None else self.mixing.size
        return self.first.n_floats + self.second.n_floats + mixing

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        lower, upper = zip(self.first.bounds, self.second.bounds, strict=True)
        return np.concatenate(lower), np.concatenate(upper)

    def _compiled(self, mu: Array) -> Array:
        split = self.first.dimension
        rows = product_rows(self.first.rows(mu[:split]), self.second.rows(mu[split:]))
        return rows if self.mixing is None else rows @ self.mixing

    def mixed(self, matrix: Array) -> Self:
        return replace(self, mixing=matrix if self.mixing is None else self.mixing @ matrix)
