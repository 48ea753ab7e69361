"""Fitting smooth functions of the parameters to values and gradients at scattered samples."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.model.functions import ParameterFunctions, total_degree_indices

Array = NDArray[np.float64]

#: Tikhonov weight relative to the largest singular value; it only settles directions the data leave open.
RIDGE = 1e-8


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


def _solve(design: Array, targets: Array, gradient_weight: float) -> Array:
    """Least squares over values and weighted gradients: (n_terms, n_functions)."""
    weights = np.ones(len(design))
    weights[1:] = gradient_weight
    matrix = (design * weights[:, None, None]).reshape(-1, design.shape[2])
    right = (targets * weights[:, None, None]).reshape(-1, targets.shape[2])
    gram = matrix.T @ matrix
    gram[np.diag_indices_from(gram)] += RIDGE * np.trace(gram) / len(gram)
    return np.asarray(np.linalg.solve(gram, matrix.T @ right), dtype=np.float64)


def fit_functions(
    samples: Array,
    values: Array,
    gradients: Array | None,
    lower: Array,
    upper: Array,
    max_degree: int,
    groups: NDArray[np.int64],
    gradient_weight: float = 0.3,
) -> tuple[ParameterFunctions, dict[int, float]]:
    """Polynomials of the total degree that predicts left-out samples best.

    Parameters
    ----------
    samples : (n, d). values : (n, n_functions). gradients : (n, d, n_functions), by the parameters; None
        where they are unknown.
    groups : (n,) label of the fold that each sample is left out with; mirror images share one.
    gradient_weight : weight of gradients (over the half range) relative to values.

    Returns
    -------
    The functions and, by degree, the relative root-mean-square error of cross-validation.

    Raises
    ------
    StudyError
        If there are too few samples for polynomials of degree 2.
    """
    half = (upper - lower) / 2.0
    targets = values[None]
    if gradients is not None:
        targets = np.concatenate([targets, np.moveaxis(gradients * half[None, :, None], 1, 0)])
    d = samples.shape[1]
    errors: dict[int, float] = {}
    folds = groups % 5
    for degree in range(2, max_degree + 1):
        indices = total_degree_indices(d, degree)
        if len(indices) > 0.8 * len(targets) * np.mean(folds != 0) * len(samples):
            break
        design = design_matrix(samples, lower, upper, indices)[: len(targets)]
        missed = 0.0
        for fold in range(5):
            left = folds == fold
            coefficients = _solve(design[:, ~left], targets[:, ~left], gradient_weight)
            missed += float(np.sum((design[0, left] @ coefficients - values[left]) ** 2))
        errors[degree] = float(np.sqrt(missed / np.sum(values**2)))
    if not errors:
        raise StudyError(f"{len(samples)} training samples are too few for {d} parameters: solve more")
    best = min(errors, key=lambda degree: errors[degree])
    indices = total_degree_indices(d, best)
    design = design_matrix(samples, lower, upper, indices)[: len(targets)]
    coefficients = _solve(design, targets, gradient_weight)
    return ParameterFunctions(lower, upper, indices, coefficients), errors
