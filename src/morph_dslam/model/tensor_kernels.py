"""Compiled evaluation of CP, Tucker and tensor-train functions: values and first derivatives in one pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.model.basis_functions import Basis
from morph_dslam.model.basis_kernels import KINDS, fill_basis

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
            packed.kinds[k],
            packed.degrees[k],
            b - a,
            packed.lower[k],
            packed.upper[k],
            knots,
            mu[k],
            out[:, a:b],
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
