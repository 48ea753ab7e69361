"""Fitting smooth functions of the parameters to values and gradients at scattered samples."""

from __future__ import annotations

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
    values = [chebyshev.chebval(xi[:, k], unit)[indices[:, k]].T for k in range(d)]
    slopes = [chebyshev.chebval(xi[:, k], slope_series)[indices[:, k]].T for k in range(d)]
    rows = [np.prod(values, axis=0)]
    rows += [np.prod([slopes[j] if j == k else values[j] for j in range(d)], axis=0) for k in range(d)]
    return np.array(rows, dtype=np.float64)


def _normal_equations(design: Array, targets: Array, gradient_weight: float) -> tuple[Array, Array]:
    """Matrix (n_terms, n_terms) and right-hand side of least squares over values and weighted gradients."""
    weights = np.ones(len(design))
    weights[1:] = gradient_weight
    matrix = (design * weights[:, None, None]).reshape(-1, design.shape[2])
    right = (targets * weights[:, None, None]).reshape(-1, targets.shape[2])
    return matrix.T @ matrix, matrix.T @ right


def _solve(gram: Array, right: Array) -> Array:
    """Coefficients (n_terms, n_functions)."""
    ridge = RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.asarray(np.linalg.solve(gram + ridge, right), dtype=np.float64)


class _Regression:
    """Samples (n, d) in a box, with targets (1 or 1 + d, n, n_functions) by the scaled parameters."""

    def __init__(
        self, samples: Array, targets: Array, box: Array, folds: NDArray[np.int64], gradient_weight: float
    ) -> None:
        self._samples, self._targets, self._box = samples, targets, box
        self._folds, self._gradient_weight = folds, gradient_weight

    def suits(self, indices: NDArray[np.int64]) -> bool:
        """Whether there are enough samples for so many terms when a fold is left out."""
        equations = len(self._targets) * np.mean(self._folds != 0) * len(self._samples)
        return len(indices) <= 0.8 * equations

    def missed(self, indices: NDArray[np.int64]) -> float:
        """Relative root-mean-square error of the values of samples that were left out."""
        design, missed = self._design(indices), 0.0
        folds = [self._folds == fold for fold in range(FOLDS)]
        parts = [self._equations(design, fold) for fold in folds]
        gram, right = sum(part[0] for part in parts), sum(part[1] for part in parts)
        for fold, part in zip(folds, parts, strict=True):
            coefficients = _solve(gram - part[0], right - part[1])
            missed += float(np.sum((design[0, fold] @ coefficients - self._targets[0, fold]) ** 2))
        return float(np.sqrt(missed / np.sum(self._targets[0] ** 2)))

    def functions(self, indices: NDArray[np.int64]) -> ParameterFunctions:
        everything = np.ones(len(self._samples), dtype=bool)
        coefficients = _solve(*self._equations(self._design(indices), everything))
        return ParameterFunctions(self._box[0], self._box[1], indices, coefficients)

    def _equations(self, design: Array, which: NDArray[np.bool_]) -> tuple[Array, Array]:
        return _normal_equations(design[:, which], self._targets[:, which], self._gradient_weight)

    def _design(self, indices: NDArray[np.int64]) -> Array:
        return design_matrix(self._samples, self._box[0], self._box[1], indices)[: len(self._targets)]


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
) -> tuple[ParameterFunctions, dict[int, float]]:
    """Polynomials of the total degree that predicts left-out samples best.

    Parameters
    ----------
    samples : (n, d).
    values : (n, n_functions).
    gradients : (n, d, n_functions), by the parameters; None where they are unknown.
    groups : (n,) label of the fold that each sample is left out with; mirror images share one.
    gradient_weight : weight of gradients (over the half range) relative to values.
    raise_single : whether parameters may have higher degrees than the others where that predicts clearly
        better, up to three times ``max_degree``.

    Returns
    -------
    The functions and, by total degree, the relative root-mean-square error of cross-validation.
    """
    half = (upper - lower) / 2.0
    targets = values[None]
    if gradients is not None:
        targets = np.concatenate([targets, np.moveaxis(gradients * half[None, :, None], 1, 0)])
    d = samples.shape[1]
    fit = _Regression(samples, targets, np.array([lower, upper]), groups % FOLDS, gradient_weight)
    errors: dict[int, float] = {}
    for degree in range(2, max_degree + 1):
        indices = total_degree_indices(d, degree)
        if not fit.suits(indices):
            break
        errors[degree] = fit.missed(indices)
    if not errors:
        raise StudyError(f"{len(samples)} training samples are too few for {d} parameters: solve more")
    best = min(errors, key=lambda degree: errors[degree])
    indices = total_degree_indices(d, best)
    if raise_single and d > 1:
        indices = _raised(fit, [best] * d, errors[best], 3 * max_degree)
    return fit.functions(indices), errors


def _raised(fit: _Regression, degrees: list[int], error: float, highest: int) -> NDArray[np.int64]:
    """Multi-indices with the degrees of single parameters raised by half while that predicts better."""
    best = weighted_degree_indices(degrees)
    for k in range(len(degrees)):
        while degrees[k] < highest:
            tried = [*degrees[:k], min(3 * degrees[k] // 2, highest), *degrees[k + 1 :]]
            indices = weighted_degree_indices(tried)
            if len(indices) > MOST_TERMS or not fit.suits(indices):
                break
            if (missed := fit.missed(indices)) > WORTH_RAISING * error:
                break
            best, degrees, error = indices, tried, missed
    return best
