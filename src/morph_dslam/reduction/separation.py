"""Exact separation of a vector that depends on parameters, V(mu) = sum_q v_q prod_k f_q^k(mu_k), by sampling.

Stiffness matrices, loads and prescribed displacements of linear problems are such sums of few terms. The
functions of each parameter come from fibres: V sampled along that parameter through random points, at
Chebyshev points whose number doubles until the series has converged. A singular value decomposition leaves
the functions that span all of them; the vectors follow by interpolation at as many points of each parameter
as there are functions. Random points decide whether the sum is V indeed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import scipy.linalg
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.stats import qmc
from tqdm import tqdm

from morph_dslam.errors import StudyError
from morph_dslam.model import Parameter
from morph_dslam.model.basis_functions import Basis, chebyshev_basis
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.tensor_functions import TensorTrainFunctions

Array = NDArray[np.float64]

#: V: a vector (N,) for parameters (d,).
VectorFunction = Callable[[Array], Array]

#: What is left out of the functions and of the sum, relative to the largest.
TOLERANCE = 1e-11

#: Relative error at random points up to which the sum is V.
EXACT = 1e-10

#: Highest degree along one parameter, most terms, and most points at which V is sampled for its vectors.
HIGHEST_DEGREE, MOST_SEPARATED_TERMS, MOST_POINTS = 256, 400, 4000

N_FIBRES, N_CHECKS = 2, 10


@dataclass(frozen=True)
class SeparatedVector:
    """V(mu) = sum_q vectors[:, q] prod_k T(xi_k) . series[k][:, q] with Chebyshev polynomials T.

    Attributes
    ----------
    vectors : (N, Q). series : per parameter (degree_k + 1, Q).
    box : (d, 2) ends of the parameters, which xi_k in [-1, 1] scales.
    """

    vectors: Array
    series: tuple[Array, ...]
    box: Array

    @property
    def n_terms(self) -> int:
        return self.vectors.shape[1]

    def functions(self, k: int, points: Array) -> Array:
        """The functions (Q, p) of parameter k at ``points`` (p,)."""
        return np.asarray(chebyshev.chebval(_scaled(points, self.box[k]), self.series[k]), dtype=np.float64)

    def value(self, mu: Array) -> Array:
        """V (N,) at ``mu`` (d,)."""
        factors = [self.functions(k, mu[k : k + 1])[:, 0] for k in range(len(mu))]
        return self.vectors @ np.prod(factors, axis=0)


def separate(
    function: VectorFunction, parameters: tuple[Parameter, ...], what: str, probe: VectorFunction | None = None
) -> SeparatedVector:
    """Separate ``function`` over the box of the parameters.

    Parameters
    ----------
    what : name of the vector in messages, "the stiffness" say.
    probe : a shorter vector with the same functions of the parameters, to find them from; ``function`` itself
        if absent.

    Raises
    ------
    StudyError
        Where V is not smooth in a parameter, or is no short sum of products.
    """
    box = np.array([[p.lower, p.upper] for p in parameters])
    fibres = [_fibre_functions(probe or function, box, k, parameters[k].name, what) for k in range(len(box))]
    coupled = [p for p, f in zip(parameters, fibres, strict=True) if f.shape[1] > 1]
    if np.prod([float(f.shape[1]) for f in fibres]) > MOST_POINTS:
        raise StudyError(_no_sum(what, coupled))
    vectors = _vectors(function, box, fibres)
    series = _products(fibres)
    sizes = np.linalg.norm(vectors, axis=0)
    kept = sizes > TOLERANCE * sizes.max() if sizes.max() > 0.0 else np.zeros(len(sizes), dtype=bool)
    found = SeparatedVector(vectors[:, kept], tuple(s[:, kept] for s in series), box)
    if found.n_terms > MOST_SEPARATED_TERMS or not _reproduces(found, function):
        raise StudyError(_no_sum(what, coupled))
    return found


def _no_sum(what: str, coupled: list[Parameter]) -> str:
    names = " and ".join(p.name for p in coupled)
    return (
        f'reduction.method = "pgd": {what} is no short sum of products of functions of {names}: '
        'use method = "galerkin" for this study, or keep one of them fixed'
    )


def generic_points(box: Array, count: int, seed: int) -> Array:
    """Points (count, d) anywhere in a ``box`` (d, 2): where nothing vanishes by chance."""
    return box[:, 0] + np.random.default_rng(seed).random((count, len(box))) * (box[:, 1] - box[:, 0])


def _scaled(points: Array, ends: Array) -> Array:
    return 2.0 * (points - ends[0]) / (ends[1] - ends[0]) - 1.0


def _chebyshev_points(degree: int, ends: Array) -> Array:
    return ends.mean() + (ends[1] - ends[0]) / 2.0 * np.cos(np.pi * np.arange(degree, -1, -1) / degree)


def fibre_series(function: VectorFunction, box: Array, k: int, bases: Array, tolerance: float) -> Array | None:
    """Chebyshev series (degree + 1, N) of V along parameter k through each of ``bases`` (f, d), side by side.

    The degree doubles until the last two coefficients are below ``tolerance`` of the largest; None where they
    are not at `HIGHEST_DEGREE`.
    """
    known: dict[float, Array] = {}

    def sample(cosine: float) -> Array:
        if cosine not in known:
            x = box[k].mean() + cosine * (box[k, 1] - box[k, 0]) / 2.0
            known[cosine] = np.concatenate([function(np.insert(np.delete(b, k), k, x)) for b in bases])
        return known[cosine]

    degree = 2
    while degree <= HIGHEST_DEGREE:
        cosines = np.round(np.cos(np.pi * np.arange(degree + 1) / degree), 14)  # equal at every degree
        series = np.linalg.solve(chebyshev.chebvander(cosines, degree), np.stack([sample(float(c)) for c in cosines]))
        sizes = np.linalg.norm(series, axis=1)
        if sizes[-2:].max() <= tolerance * max(sizes.max(), np.finfo(float).tiny):
            return np.asarray(series, dtype=np.float64)
        degree *= 2
    return None


def _fibre_functions(function: VectorFunction, box: Array, k: int, name: str, what: str) -> Array:
    """Chebyshev series (degree + 1, r) of the r functions of parameter k, first the constant if it is one."""
    series = fibre_series(function, box, k, generic_points(box, N_FIBRES, k), TOLERANCE)
    if series is None:
        raise StudyError(
            f'reduction.method = "pgd": {what} does not depend smoothly enough on {name}: a moving load '
            'may be too narrow for its path; make it wider, or use method = "galerkin"'
        )
    return _spanning(series)


def _spanning(series: Array) -> Array:
    """Orthonormal combinations (n, r) that span the columns of ``series`` (n, N)."""
    _, sizes, right = np.linalg.svd(np.asarray(np.linalg.qr(series.T, mode="r")))
    rank = max(1, int(np.sum(sizes > TOLERANCE * max(sizes[0], np.finfo(float).tiny))))
    span = right[:rank].T
    constant = np.eye(len(series))[:, 0]
    if rank > 1 and np.linalg.norm(constant - span @ span[0]) <= TOLERANCE:
        rest = span - np.outer(constant, span[0])
        left, _, _ = np.linalg.svd(rest, full_matrices=False)
        span = np.column_stack([constant, left[:, : rank - 1]])
    return span


def _interpolation_points(series: Array, ends: Array) -> Array:
    """As many points as functions, well conditioned: QR with pivoting (Drmac and Gugercin 2016)."""
    candidates = _chebyshev_points(max(4 * len(series), 8), ends)
    table = chebyshev.chebvander(_scaled(candidates, ends), len(series) - 1) @ series
    pivots: Any = scipy.linalg.qr(table.T, mode="r", pivoting=True)
    return np.sort(candidates[pivots[1][: series.shape[1]]])


def _vectors(function: VectorFunction, box: Array, fibres: list[Array]) -> Array:
    """The vectors (N, prod r_k) of all products of functions, by interpolation on a grid."""
    points = [_interpolation_points(f, ends) for f, ends in zip(fibres, box, strict=True)]
    grid = np.stack(np.meshgrid(*points, indexing="ij"), axis=-1).reshape(-1, len(box))
    tensor = np.stack([function(mu) for mu in grid]).reshape(*(len(p) for p in points), -1)
    for k, (p, f, ends) in enumerate(zip(points, fibres, box, strict=True)):
        table = chebyshev.chebvander(_scaled(p, ends), len(f) - 1) @ f
        tensor = np.moveaxis(np.tensordot(np.linalg.inv(table), tensor, axes=(1, k)), 0, k)
    return np.ascontiguousarray(tensor.reshape(len(grid), -1).T)


def _products(fibres: list[Array]) -> tuple[Array, ...]:
    """Per parameter the series of its factor in every product, in the order of the grid."""
    ranks = [f.shape[1] for f in fibres]
    indices = np.indices(ranks).reshape(len(ranks), -1)
    return tuple(f[:, index] for f, index in zip(fibres, indices, strict=True))


def _reproduces(found: SeparatedVector, function: VectorFunction) -> bool:
    box = found.box
    checks = generic_points(box, N_CHECKS, len(box))
    truth = np.stack([function(mu) for mu in checks])
    missed = np.stack([found.value(mu) for mu in checks]) - truth
    size = reduce(max, (float(np.linalg.norm(t)) for t in truth), 0.0)
    return bool(np.linalg.norm(missed, axis=1).max() <= EXACT * size)


# Functions of many parameters from scattered values: sparse Chebyshev expansions, kept as tensor trains.
# A full grid of d parameters is out of reach beyond four. A Chebyshev expansion over the lower set
#     { m : sum_k m_k / degree_k <= 1 },
# with the degree that each parameter needs along lines, has far fewer terms than the grid has nodes. It is
# found by least squares at a few times as many samples as terms, and turned into a tensor train by singular
# value decompositions of matrices no wider than the number of terms, so that no full tensor is ever formed.


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


def expansion_train(
    indices: Indices, coefficients: Array, bases: tuple[Basis, ...], tolerance: float
) -> TensorTrainFunctions:
    """The tensor train of sum_t c_t prod_k phi_{k, m_tk}, truncated to a relative tolerance (TT-SVD).

    At each cut the columns are the distinct remainders of the multi-indices, so the matrices stay as small as
    the expansion. Chebyshev polynomials count by their norms in the Chebyshev weight.

    Parameters
    ----------
    indices : (n_terms, d), distinct. coefficients : (n_terms, n_functions).
    """
    norms = [_norms(basis) for basis in bases]
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
        left_out = np.sqrt(np.cumsum(values[::-1] ** 2))[::-1]
        rank = max(1, int(np.sum(left_out > allowed)))
        cores.append(left[:, :rank].reshape(len(rest), basis.size, rank))
        rest, remaining = values[:rank, None] * right[:rank], tails
    cores = [np.ascontiguousarray(core / n[None, :, None]) for core, n in zip(cores, norms, strict=True)]
    return TensorTrainFunctions(bases, tuple(cores))


def _norms(basis: Basis) -> Array:
    norms = np.ones(basis.size)
    if basis.kind == "chebyshev":
        norms[1:] = np.sqrt(0.5)
    return norms
