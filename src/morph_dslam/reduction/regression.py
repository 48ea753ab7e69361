"""Fitting smooth functions of the parameters to values and gradients at scattered samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.model.functions import ParameterFunctions, total_degree_indices
from morph_dslam.reduction.sparse_expansion import weighted_degree_indices

Array = NDArray[np.float64]
#: Tikhonov weight relative to the largest singular value; it only settles directions the data leave open.
RIDGE = 1e-8
#: Parts that the samples are split into for cross-validation.
FOLDS = 5
#: Samples belong to one level of a parameter within this part of its range.
SAME_LEVEL = 0.01
#: A parameter gets a higher degree than the others if the error falls below this part of what it was.
WORTH_RAISING = 0.9
#: Most terms that raised degrees may lead to: the time of a fit grows with their square.
MOST_TERMS = 2000


def design_matrix(samples: Array, lower: Array, upper: Array, indices: NDArray[np.int64]) -> Array:
    """Products of Chebyshev polynomials and their scaled slopes at all samples.

    Returns
    -------
    (1 + d, n_samples, n_terms): values, then derivatives by the scaled coordinate of each parameter.
    """
    d = samples.shape[1]
    xi = 2.0 * (samples - lower) / (upper - lower) - 1.0
    degree = int(indices.max())
    unit = np.eye(degree + 1)
    slope_series = chebyshev.chebder(unit) if degree else np.zeros((1, 1))
    values = [chebyshev.chebval(xi[:, k], unit).T[:, indices[:, k]] for k in range(d)]
    slopes = [chebyshev.chebval(xi[:, k], slope_series).T[:, indices[:, k]] for k in range(d)]
    rows = np.empty((1 + d, len(samples), len(indices)))
    for row, j in zip(rows, (None, *range(d)), strict=True):
        np.copyto(row, slopes[0] if j == 0 else values[0])
        for k in range(1, d):
            row *= slopes[k] if j == k else values[k]
    return rows


def _solve(gram: Array, right: Array) -> Array:
    """Coefficients (n_terms, n_functions)."""
    ridge = RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.asarray(np.linalg.solve(gram + ridge, right), dtype=np.float64)


@dataclass(frozen=True)
class _Trial:
    """Polynomials that were tried.

    Attributes
    ----------
    indices : (n_terms, d) of them.
    missed : relative root-mean-square error of the values of samples that were left out.
    gram, right : normal equations of all samples, (n_terms, n_terms) and (n_terms, n_functions).
    """

    indices: NDArray[np.int64]
    missed: float
    gram: Array
    right: Array


def _levels(samples: Array, lower: Array, upper: Array) -> NDArray[np.int64]:
    """The number of levels (d,) that samples (n, d) have along each parameter, those within `SAME_LEVEL` counted once.

    Levels of a table scatter, as its values were rounded, measured or reached in steps. Values so close tell no more of
    a polynomial than its slope there, and this the less, the closer they are.
    """
    counts = []
    for places in np.sort((samples - lower) / (upper - lower), axis=0).T:
        count, first = 0, -np.inf
        for place in places.tolist():
            if place > first + SAME_LEVEL:
                count, first = count + 1, place
        counts.append(count)
    return np.array(counts, dtype=np.int64)


class _Regression:
    """Samples (n, d) in a box, with targets (1 or 1 + d, n, n_functions) by the scaled parameters, and weights (n,)."""

    def __init__(
        self,
        samples: Array,
        targets: Array,
        box: Array,
        folds: NDArray[np.int64],
        gradient_weight: float,
        weights: Array,
    ) -> None:
        order = np.argsort(folds, kind="stable")
        ends = np.cumsum(np.bincount(folds, minlength=FOLDS))
        self._folds = [slice(end - size, end) for end, size in zip(ends, np.diff(ends, prepend=0), strict=True)]
        self._box, self._samples = box, samples[order]
        of_kinds = np.where(np.arange(len(targets)) == 0, 1.0, gradient_weight)
        self._weights = np.multiply.outer(of_kinds, weights[order])[:, :, None]
        self._targets = targets[:, order] * self._weights
        self._conditions = 1 if len(targets) == 1 else 2
        self._levels = _levels(samples, box[0], box[1])
        #: Each parameter's degree must be below its number (d,) here.
        self.degrees = self._conditions * self._levels

    def determined(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those (m, d) of multi-indices (n_terms, d) that a full grid of the samples' levels determines.

        Let w_k be the polynomial that is zero at the n_k levels of parameter k. Polynomials that are zero at the grid
        form the ideal of all w_k, those whose slopes are zero too its square, with w_i w_j. A term is determined unless
        it is a multiple of the leading term of such a polynomial.
        """
        return indices[(indices // self._levels).sum(axis=1) < self._conditions]

    def suits(self, indices: NDArray[np.int64]) -> bool:
        """Whether there are enough samples for so many terms when a fold is left out."""
        used = len(self._samples) - (self._folds[0].stop - self._folds[0].start)
        return len(indices) <= 0.8 * len(self._targets) * used

    def trial(self, indices: NDArray[np.int64]) -> _Trial:
        """Fit polynomials to all samples but one fold after the other."""
        design = design_matrix(self._samples, self._box[0], self._box[1], indices)[: len(self._targets)]
        design *= self._weights
        parts = [_normal_equations(design[:, fold], self._targets[:, fold]) for fold in self._folds]
        gram, right, missed = np.zeros_like(parts[0][0]), np.zeros_like(parts[0][1]), 0.0
        for part in parts:
            gram += part[0]
            right += part[1]
        for fold, part in zip(self._folds, parts, strict=True):
            coefficients = _solve(gram - part[0], right - part[1])
            missed += float(np.sum((design[0, fold] @ coefficients - self._targets[0, fold]) ** 2))
        return _Trial(indices, float(np.sqrt(missed / np.sum(self._targets[0] ** 2))), gram, right)

    def functions(self, trial: _Trial) -> ParameterFunctions:
        return ParameterFunctions(self._box[0], self._box[1], trial.indices, _solve(trial.gram, trial.right))


def _normal_equations(design: Array, targets: Array) -> tuple[Array, Array]:
    """Matrix (n_terms, n_terms) and right-hand side (n_terms, n_functions) of least squares over all rows."""
    matrix = design.reshape(-1, design.shape[2])
    return matrix.T @ matrix, matrix.T @ targets.reshape(-1, targets.shape[2])


def fit_functions(
    samples: Array,
    values: Array,
    gradients: Array | None,
    lower: Array,
    upper: Array,
    max_degree: int,
    groups: NDArray[np.int64],
    gradient_weight: float = 0.3,
    raise_single: bool = False,
    weights: Array | None = None,
) -> tuple[ParameterFunctions, dict[int, float]]:
    """Polynomials of the total degree that predicts left-out samples best.

    Of samples that have few levels along a parameter, as a table of tests has, no higher degree than these levels
    determine: between them it would be arbitrary, and no left-out sample tells, for all lie on the same levels.

    Parameters
    ----------
    samples : (n, d).
    values : (n, n_functions).
    gradients : (n, d, n_functions), by the parameters; None where they are unknown.
    groups : (n,) label of the fold that each sample is left out with; mirror images share one.
    gradient_weight : weight of gradients (over the half range) relative to values.
    raise_single : whether parameters may have higher degrees than the others where that predicts clearly
        better, up to three times ``max_degree``.
    weights : (n,) of the samples; 1 each if absent.

    Returns
    -------
    The functions and, by total degree, the relative root-mean-square error of cross-validation.
    """
    half = (upper - lower) / 2.0
    targets = values[None]
    if gradients is not None:
        targets = np.concatenate([targets, np.moveaxis(gradients * half[None, :, None], 1, 0)])
    d = samples.shape[1]
    weights = np.ones(len(samples)) if weights is None else weights
    fit = _Regression(samples, targets, np.array([lower, upper]), groups % FOLDS, gradient_weight, weights)
    errors: dict[int, float] = {}
    best: _Trial | None = None
    terms = 0
    for degree in range(min(2, max_degree), max_degree + 1):
        indices = fit.determined(total_degree_indices(d, degree))
        if not fit.suits(indices) or len(indices) == terms:
            break
        terms = len(indices)
        trial = fit.trial(indices)
        errors[degree] = trial.missed
        if best is None or trial.missed < best.missed:
            best = trial
    if best is None:
        raise StudyError(f"{len(samples)} training samples are too few for {d} parameters: solve more")
    if raise_single and d > 1:
        best = _raised(fit, best, 3 * max_degree)
    return fit.functions(best), errors


def _raised(fit: _Regression, best: _Trial, highest: int) -> _Trial:
    """The best with the degrees of single parameters raised by half while that predicts better."""
    most = np.minimum(fit.degrees - 1, highest).tolist()
    degrees = [int(best.indices.sum(axis=1).max())] * len(most)
    for k in range(len(degrees)):
        while degrees[k] < most[k]:
            tried = [*degrees[:k], min(max(3 * degrees[k] // 2, 2), most[k]), *degrees[k + 1 :]]
            indices = fit.determined(weighted_degree_indices(tried))
            if len(indices) > MOST_TERMS or not fit.suits(indices):
                break
            trial = fit.trial(indices)
            if trial.missed > WORTH_RAISING * best.missed:
                break
            best, degrees = trial, tried
    return best
