"""Sparse PGD: sums of products of one-dimensional functions fitted to scattered samples.

u(mu) = sum_m f_m prod_k phi_k(mu_k) . a_{k,m} is found by enrichment and alternating least squares (Ibanez et
al., "A multidimensional data-driven sparse identification technique: the sparse proper generalized
decomposition", Complexity 2018). Roughness is penalised, with a weight chosen by generalised cross-validation
(GCV); after every few enrichments all modes are refitted together; the number of modes is the one that
predicts samples kept aside best. The samples are compressed by POD first, which changes no fit.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.model.basis_functions import Basis
from morph_dslam.model.tensor_functions import CPFunctions
from morph_dslam.reduction.pod import Pod, compute_pod
from morph_dslam.reduction.registry import register_reduction
from morph_dslam.reduction.task import ReductionTask, parameter_bases
from morph_dslam.studies.sections import BasisName

Array = NDArray[np.float64]
#: Candidates of the smoothing weight, relative to the ratio of the data's and the penalty's traces.
SMOOTHING = np.logspace(-14.0, 2.0, 33)
#: The alternating directions of one enrichment end at this relative change, or after so many iterations.
INNER_TOLERANCE, INNER_ITERATIONS = 1e-4, 30
#: All modes are refitted after so many enrichments, by so many sweeps at most, and until a sweep lowers the
#: misfit by less than this, relatively.
REFIT_EVERY, REFIT_SWEEPS, SETTLED = 2, 30, 0.02
#: Share of the samples kept aside to choose the number of modes, and refits without a better prediction.
VALIDATION_SHARE, PATIENCE = 0.15, 3
#: A relative misfit that is rounding: what is left has no direction to be enriched by.
EXACT = 1e-12


class SamplingWarning(UserWarning):
    """There are too few samples for the number of unknowns."""


@dataclass(frozen=True)
class SparsePgd:
    """A fitted sum of products.

    Attributes
    ----------
    pod : the spatial modes (n_modes, n); the functions are their coefficients.
    functions : (n_modes) functions of the parameters in CP form.
    validation_errors : relative error on the samples kept aside, by the number of products at each refit.
    """

    pod: Pod
    functions: CPFunctions
    validation_errors: dict[int, float]


def smoothed_fit(gram: Array, right: Array, square: float, count: int, penalty: Array) -> Array:
    """Coefficients minimising |y - W a|^2 + weight a' P a, with the weight of least GCV score.

    Parameters
    ----------
    gram : W'W (s, s).
    right : W'y (s,).
    square : y'y.
    count : number of data y.
    penalty : P (s, s).
    """
    size = len(gram)
    base = gram + 1e-13 * np.trace(gram) / size * np.eye(size)
    roughness, vectors = scipy.linalg.eigh(penalty, base)
    roughness = np.maximum(roughness, 0.0)
    projected = vectors.T @ right
    weights = SMOOTHING * np.trace(gram) / max(float(np.trace(penalty)), np.finfo(float).tiny)
    shrink = 1.0 / (1.0 + weights[:, None] * roughness)
    residual = np.maximum(square - (2.0 * shrink - shrink**2) @ projected**2, 1e-30 * square)
    freedom = np.maximum(count - shrink.sum(axis=1), 1e-3 * count)
    best = int(np.argmin(residual / freedom**2))
    return vectors @ (shrink[best] * projected)


class _Fit:
    """The sum for one set of samples: data (N, r), mixing (M, r), coefficients [(size_k, M)]."""

    def __init__(self, tables: list[Array], penalties: list[Array], data: Array) -> None:
        self.tables, self.penalties, self.data = tables, penalties, data
        self.mixing: Array = np.zeros((0, data.shape[1]))
        self.coefficients: list[Array] = [np.zeros((t.shape[1], 0)) for t in tables]
        self._random = np.random.default_rng(0)

    def _products(self, skip: int | None = None) -> Array:
        """Products of the modes' functions over all parameters but ``skip`` at the samples (N, M)."""
        parts = [t @ c for k, (t, c) in enumerate(zip(self.tables, self.coefficients, strict=True)) if k != skip]
        return np.prod(parts, axis=0) if parts else np.ones((len(self.data), self.mixing.shape[0]))

    @property
    def is_exact(self) -> bool:
        """Whether the sum goes through all data to rounding, so that nothing is left to enrich it by."""
        missed = np.linalg.norm(self.data - self._products() @ self.mixing)
        return len(self.mixing) > 0 and bool(missed <= EXACT * np.linalg.norm(self.data))

    def enrich(self) -> None:
        """Add the product that alternating least squares settles on for the residual."""
        residual = self.data - self._products() @ self.mixing
        new = [self._start(t) for t in self.tables]
        values = [t @ a for t, a in zip(self.tables, new, strict=True)]
        previous, amplitude = np.inf, np.zeros(self.data.shape[1])
        for _ in range(INNER_ITERATIONS):
            product = np.prod(values, axis=0)
            amplitude = residual.T @ product / (product @ product)
            target = residual @ amplitude / (amplitude @ amplitude)
            for k, table in enumerate(self.tables):
                others = np.prod([v for j, v in enumerate(values) if j != k], axis=0)
                weighted = table * np.broadcast_to(others, len(table))[:, None]
                a = smoothed_fit(
                    weighted.T @ weighted, weighted.T @ target, target @ target, len(target), self.penalties[k]
                )
                scale = max(float(np.sqrt(np.mean((table @ a) ** 2))), np.finfo(float).tiny)
                new[k], values[k] = a / scale, table @ a / scale
            size = float(np.linalg.norm(amplitude))
            if abs(size - previous) <= INNER_TOLERANCE * size:
                break
            previous = size
        product = np.prod(values, axis=0)
        self.mixing = np.vstack([self.mixing, residual.T @ product / (product @ product)])
        self.coefficients = [np.column_stack([c, a]) for c, a in zip(self.coefficients, new, strict=True)]

    def _start(self, table: Array) -> Array:
        """A first guess: the function nearest to one, with a small random part that breaks symmetries."""
        ones = np.linalg.lstsq(table, np.ones(len(table)), rcond=None)[0]
        a = ones + 0.1 * np.abs(ones).max() * self._random.standard_normal(len(ones))
        return a / np.sqrt(np.mean((table @ a) ** 2))

    def refit(self) -> None:
        """All modes together, one parameter after the other, the amplitudes in between, until it settles."""
        previous = np.inf
        for _ in range(REFIT_SWEEPS):
            for k in range(len(self.tables)):
                self._refit_amplitudes()
                self._refit_parameter(k)
            self._refit_amplitudes()
            misfit = float(np.linalg.norm(self.data - self._products() @ self.mixing))
            if previous - misfit < SETTLED * misfit:
                break
            previous = misfit

    def _refit_amplitudes(self) -> None:
        products = self._products()
        gram = products.T @ products
        gram[np.diag_indices_from(gram)] += 1e-12 * np.trace(gram) / len(gram)
        self.mixing = np.asarray(np.linalg.solve(gram, products.T @ self.data), dtype=np.float64)

    def _refit_parameter(self, k: int) -> None:
        table, others, m = self.tables[k], self._products(skip=k), len(self.mixing)
        size, overlap = table.shape[1], self.mixing @ self.mixing.T
        weighted = (table[:, :, None] * others[:, None, :]).reshape(len(table), -1)
        gram = (weighted.T @ weighted) * np.tile(overlap, (size, size))
        image = self.data @ self.mixing.T
        right = (table.T @ (others * image)).ravel()
        penalty = np.kron(self.penalties[k], np.diag(np.diag(overlap))).astype(np.float64)
        count = len(table) * min(m, self.data.shape[1])
        square = float(np.sum(self.data**2))
        found = smoothed_fit(gram, right, square, count, penalty).reshape(size, m)
        scales = np.sqrt(np.mean((table @ found) ** 2, axis=0))
        self.coefficients[k] = found / np.maximum(scales, np.finfo(float).tiny)
        self.mixing = self.mixing * scales[:, None]


def fit_sparse_pgd(
    samples: Array,
    values: Array,
    bases: tuple[Basis, ...],
    max_modes: int = 30,
    pod_tolerance: float = 1e-7,
    labels: NDArray[np.int64] | None = None,
) -> SparsePgd:
    """Fit fields by a sum of products of functions of the parameters.

    Parameters
    ----------
    samples : (N, d) parameters.
    values : (N, n) fields at the samples.
    bases : of the functions of each parameter.
    max_modes : at most this many products.
    pod_tolerance : relative energy (root) that the compression of the values may leave out.
    labels : (N,); samples of one label, mirror images say, are kept aside together. All differ if absent.

    Warns
    -----
    SamplingWarning
        If there are fewer samples than modes times functions of one parameter.
    """
    pod = compute_pod(values, np.ones(values.shape[1]), pod_tolerance, min(values.shape))
    data = pod.project(values)
    tables = [b.evaluate(samples[:, k]) for k, b in enumerate(bases)]
    penalties = [b.penalty() for b in bases]
    labels = np.arange(len(samples)) if labels is None else labels
    order = np.random.default_rng(0).permutation(np.unique(labels))
    n_aside = max(1, round(VALIDATION_SHARE * len(order)))
    kept_aside = np.isin(labels, order[:n_aside])
    aside, used = np.flatnonzero(kept_aside), np.flatnonzero(~kept_aside)
    fit = _Fit([t[used] for t in tables], penalties, data[used])
    errors: dict[int, float] = {}
    best: tuple[Array, list[Array]] = (fit.mixing, fit.coefficients)
    since = 0
    while since < PATIENCE and len(fit.mixing) < max_modes and not fit.is_exact:
        for _ in range(min(REFIT_EVERY, max_modes - len(fit.mixing))):
            if not fit.is_exact:
                fit.enrich()
        fit.refit()
        products = np.prod([t[aside] @ c for t, c in zip(tables, fit.coefficients, strict=True)], axis=0)
        error = float(np.linalg.norm(products @ fit.mixing - data[aside]) / np.linalg.norm(data[aside]))
        since = since + 1
        if error < min(errors.values(), default=np.inf):
            best, since = (fit.mixing, fit.coefficients), 0
        errors[len(fit.mixing)] = error
    final = _Fit(tables, penalties, data)
    final.mixing, final.coefficients = best[0], list(best[1])
    final.refit()
    _warn_if_undersampled(len(samples), len(final.mixing), bases)
    return SparsePgd(pod, CPFunctions(bases, tuple(final.coefficients), final.mixing), errors)


def _warn_if_undersampled(n_samples: int, n_modes: int, bases: tuple[Basis, ...]) -> None:
    unknowns = n_modes * max(b.size for b in bases)
    if n_samples < unknowns:
        warnings.warn(
            f"{n_samples} samples for {n_modes} products of {max(b.size for b in bases)} functions: "
            f"give at least {unknowns} samples, or allow fewer modes or smaller bases",
            SamplingWarning,
            stacklevel=3,
        )


def reduce_by_sparse_pgd(task: ReductionTask) -> ReducedModel:
    """A reduced model of every field that the snapshots hold, each in CP form with one term a mode.

    ``options.basis`` names the functions of the parameters (Chebyshev polynomials if absent), of which there
    are ``max_degree + 1``, and ``options.max_modes`` bounds the products of a field; how many there are,
    samples kept aside decide. Mirror images of one solution are kept aside together. Too few samples are said
    under "warnings" of the certificate's "reduction".
    """
    options, dimension = task.options, len(task.parameters)
    basis = options.basis or "chebyshev"
    bases = parameter_bases(basis, task.parameters, (options.max_degree + 1,) * dimension)
    fields: dict[str, SeparatedField] = {}
    summaries: dict[str, dict[str, Any]] = {}
    notes: list[str] = []
    for name in task.field_names:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", SamplingWarning)
            fields[name], summaries[name] = _fit_field(task, name, bases)
        notes += [f"{name}: {w.message}" for w in caught if issubclass(w.category, SamplingWarning)]
    summary: dict[str, Any] = {"method": "sparse_pgd", "basis": basis, **summaries["displacement"]}
    return task.model(fields, summary | ({"warnings": notes} if notes else {}))


def _fit_field(task: ReductionTask, name: str, bases: tuple[Basis, ...]) -> tuple[SeparatedField, dict[str, Any]]:
    """One field, and its summary."""
    values = task.values(name)
    shape = values.shape[1:]
    root = np.sqrt(np.repeat(task.weights(shape[0]), shape[1]))
    flat = values.reshape(len(values), -1) * root
    fit = fit_sparse_pgd(task.samples, flat, bases, task.options.max_modes, labels=task.labels)
    modes = (fit.functions.mixing @ fit.pod.modes / root).reshape(-1, *shape)
    functions = CPFunctions(bases, fit.functions.factors, np.eye(len(modes)))
    summary = {
        "modes": len(modes),
        "functions_of_a_parameter": max(basis.size for basis in bases),
        "singular_values": fit.pod.singular_values[:60].tolist(),
        "validation_errors": {str(count): error for count, error in fit.validation_errors.items()},
    }
    return SeparatedField(modes, functions), summary


register_reduction("sparse_pgd", reduce_by_sparse_pgd, functions=lambda dimension: (("cp",), get_args(BasisName)))
