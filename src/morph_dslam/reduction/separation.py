"""Exact separation of a vector that depends on parameters, V(mu) = sum_q v_q prod_k f_q^k(mu_k), by sampling.

Stiffness matrices, loads and prescribed displacements of linear problems are such sums of few terms. The
functions of each parameter come from fibres: V sampled along that parameter through random points, at
Chebyshev points whose number doubles until the series has converged. A singular value decomposition leaves
the functions that span all of them; the vectors follow by interpolation at as many points of each parameter
as there are functions. Random points decide whether the sum is V indeed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import scipy.linalg
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.model import Parameter

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
