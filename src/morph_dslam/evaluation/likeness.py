"""Whether neighbouring residuals of a curve are alike, as where its law is another one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc

Array = NDArray[np.float64]
#: Singular values and residuals below this share of the largest, or of all, are rounding.
ROUNDING = 1e-9


def root_mean_square(values: Array) -> float:
    """Of any values, at least one."""
    return float(np.sqrt(np.mean(values**2)))


@dataclass(frozen=True)
class Likeness:
    """Whether neighbouring residuals are alike.

    Attributes
    ----------
    durbin_watson : 2 if they are independent, less if they are alike.
    probability : of so small a value if they are independent.
    rms : of what no change of the unknowns takes from the residuals.
    """

    durbin_watson: float
    probability: float
    rms: float


def likeness(residuals: Array, slopes: Array) -> Likeness | None:
    """Whether neighbours are alike among what a curve alone cannot fit, in the order of the curve.

    Its distribution is nearly a beta distribution with the mean and variance that Durbin and Watson (1951) derived.

    Parameters
    ----------
    residuals : (n,).
    slopes : (n, f) derivatives by the unknowns, among them a constant if an offset is.

    Returns
    -------
    None of too few values, and of those that are fitted to rounding.
    """
    left, singular, _ = np.linalg.svd(slopes, full_matrices=False)
    basis = left[:, singular > ROUNDING * singular.max(initial=0.0)]
    own, free = residuals - basis @ (basis.T @ residuals), len(residuals) - basis.shape[1]
    if free < 3 or not np.linalg.norm(own) > ROUNDING * np.linalg.norm(residuals):
        return None
    # The quadratic form is that of A = D'D, D first differences.
    steps = np.diff(basis, axis=0)
    first, second = steps.T @ steps, np.diff(steps, axis=0, prepend=0.0, append=0.0)
    trace = 2.0 * (len(own) - 1) - float(np.trace(first))
    squares = 2.0 * (3.0 * len(own) - 4.0) - 2.0 * float(np.sum(second**2)) + float(np.sum(first**2))
    mean = trace / free
    variance = 2.0 * (squares - trace * mean) / (free * (free + 2.0))
    total = mean / 4.0 * (1.0 - mean / 4.0) / (variance / 16.0) - 1.0
    value = float(np.sum(np.diff(own) ** 2) / np.sum(own**2))
    probability = float(betainc(total * mean / 4.0, total * (1.0 - mean / 4.0), value / 4.0))
    return Likeness(value, probability, root_mean_square(own))
