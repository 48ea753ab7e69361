"""Functions of many parameters from scattered values: sparse Chebyshev expansions, kept as tensor trains.

A full grid of d parameters is out of reach beyond four. A Chebyshev expansion over the lower set

    { m : sum_k m_k / degree_k <= 1 },

with the degree that each parameter needs along lines, has far fewer terms than the grid has nodes. It is found
by least squares at a few times as many samples as terms, and turned into a tensor train by singular value
decompositions of matrices no wider than the number of terms, so that no full tensor is ever formed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.stats import qmc
from tqdm import tqdm

from morph_dslam.model.basis_functions import Basis, chebyshev_basis
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.tensor_functions import TensorTrainFunctions
from morph_dslam.reduction.pod import rank_for

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Samples for each term of an expansion, and the part of the samples that only chooses its size.
OVERSAMPLING, KEPT_ASIDE = 2.0, 0.1
#: Most terms of an expansion.
MOST_TERMS = 2500
#: The set of degrees grows by this factor until the expansion is good enough.
GROWTH = 1.2


def weighted_degree_indices(degrees: Sequence[int], bound: float = 1.0) -> Indices:
    """All multi-indices m (n_terms, d) with sum_k m_k / degrees_k <= bound."""
    indices, used = np.zeros((1, 0), dtype=np.int64), np.zeros(1)
    for degree in degrees:
        steps = np.arange(int(np.floor(degree * bound + 1e-9)) + 1)
        total = used[:, None] + steps / degree
        row, step = np.nonzero(total <= bound + 1e-9)
        indices = np.column_stack([indices[row], step])
        used = total[row, step]
    return indices[np.argsort(used, kind="stable")]


def expansion_rows(samples: Array, box: Array, indices: Indices) -> Array:
    """Products of Chebyshev polynomials (n_samples, n_terms) at samples (n, d)."""
    rows = np.ones((len(samples), len(indices)))
    for k, (lower, upper) in enumerate(box):
        table = chebyshev_basis(lower, upper, int(indices[:, k].max())).evaluate(samples[:, k])
        rows *= table[:, indices[:, k]]
    return rows


class ScatteredValues:
    """Values at more and more Sobol samples of a box, denser towards its edges.

    Parameters
    ----------
    evaluate : values (n,) at parameters (d,).
    """

    def __init__(self, evaluate: Callable[[Array], Array], box: Array) -> None:
        self._evaluate, self._box = evaluate, box
        self.samples: Array = np.zeros((0, len(box)))
        self.values: list[Array] = []

    def extend_to(self, count: int) -> None:
        """Have at least ``count`` samples."""
        # of two lengths, the shorter Sobol sequence is the beginning of the longer
        sobol = qmc.Sobol(len(self._box), rng=0).random_base2(int(np.ceil(np.log2(count))))
        unit = sobol[len(self.samples) : count]
        middle, half = self._box.mean(axis=1), np.diff(self._box, axis=1)[:, 0] / 2.0
        new = middle - half * np.cos(np.pi * unit)
        bar = tqdm(new, desc="sampling the reduced solver", unit="sample")
        self.values += [self._evaluate(sample) for sample in bar]
        self.samples = np.concatenate([self.samples, new])


def fit_expansion(
    scattered: ScatteredValues, box: Array, degrees: Sequence[int], tolerance: float, leading: slice
) -> tuple[Indices, Array, float]:
    """Indices (n_terms, d), coefficients (n_terms, n) of an expansion, and its error on samples kept aside.

    Parameters
    ----------
    tolerance : relative error (root mean squares) at which the expansion is good enough.
    leading : the values that the error is measured on.
    """
    bound = 1.0
    while True:
        indices = weighted_degree_indices(degrees, bound)
        scattered.extend_to(int(np.ceil(OVERSAMPLING * len(indices) / (1.0 - KEPT_ASIDE))))
        values, samples = np.array(scattered.values), scattered.samples
        aside = np.arange(len(samples)) % round(1.0 / KEPT_ASIDE) == 0
        rows = expansion_rows(samples, box, indices)
        coefficients = _least_squares(rows[~aside], values[~aside])
        missed = (rows[aside] @ coefficients - values[aside])[:, leading]
        error = float(np.linalg.norm(missed) / np.linalg.norm(values[aside][:, leading]))
        larger = weighted_degree_indices(degrees, bound * GROWTH)
        if error <= tolerance or len(larger) > MOST_TERMS:
            return indices, _least_squares(rows, values), error
        bound *= GROWTH


def _least_squares(rows: Array, values: Array) -> Array:
    solution = scipy.linalg.lstsq(rows, values, lapack_driver="gelsy", check_finite=False)
    assert solution is not None
    return np.asarray(solution[0], dtype=np.float64)


def polynomial_functions(box: Array, indices: Indices, coefficients: Array) -> ParameterFunctions:
    """The expansion as it is: coefficients (n_terms, n_functions)."""
    return ParameterFunctions(box[:, 0].copy(), box[:, 1].copy(), indices, np.ascontiguousarray(coefficients))


def chebyshev_train(
    lower: Array, upper: Array, indices: Indices, coefficients: Array, tolerance: float
) -> TensorTrainFunctions:
    """`expansion_train` of Chebyshev polynomials between ``lower`` and ``upper`` (d,)."""
    degrees = indices.max(axis=0).tolist()
    bases = tuple(chebyshev_basis(*each) for each in zip(lower, upper, degrees, strict=True))
    return expansion_train(indices, coefficients, bases, tolerance)


def expansion_train(
    indices: Indices, coefficients: Array, bases: tuple[Basis, ...], tolerance: float
) -> TensorTrainFunctions:
    """The tensor train of sum_t c_t prod_k phi_{k, m_tk}, truncated to a relative tolerance (TT-SVD).

    At each cut the columns are the distinct remainders of the multi-indices, so the matrices stay as small as
    the expansion. Chebyshev polynomials count by their norms in the Chebyshev weight.

    Parameters
    ----------
    indices : (n_terms, d), distinct.
    coefficients : (n_terms, n_functions).
    """
    norms = [np.where((np.arange(b.size) > 0) & (b.kind == "chebyshev"), np.sqrt(0.5), 1.0) for b in bases]
    scale = np.prod([n[indices[:, k]] for k, n in enumerate(norms)], axis=0)
    rest, remaining = coefficients.T * scale, indices
    allowed = tolerance * float(np.linalg.norm(rest)) / np.sqrt(len(bases))
    cores = []
    for k, basis in enumerate(bases):
        tails, column = np.unique(remaining[:, 1:], axis=0, return_inverse=True)
        block = np.zeros((len(rest), basis.size, max(len(tails), 1)))
        block[:, remaining[:, 0], column.ravel()] = rest
        if k == len(bases) - 1:
            cores.append(block)
            break
        left, values, right = np.linalg.svd(block.reshape(-1, block.shape[2]), full_matrices=False)
        rank = rank_for(values, allowed)
        cores.append(left[:, :rank].reshape(len(rest), basis.size, rank))
        rest, remaining = values[:rank, None] * right[:rank], tails
    cores = [np.ascontiguousarray(core / n[None, :, None]) for core, n in zip(cores, norms, strict=True)]
    return TensorTrainFunctions(bases, tuple(cores))
