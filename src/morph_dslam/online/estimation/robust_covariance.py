"""Covariance of an estimate with Huber weights."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Eigenvalue floor, relative to the best-seen direction.
EIGENVALUE_FLOOR = 1e-12


@njit(cache=True, nogil=True)
def huber_covariance(hessian, residuals, weights, numbers, huber_px, scale):
    """Standard deviation of a pixel coordinate and covariance of an M-estimator.

    (sum psi² / (N - k)) / mean(psi')² (J'J)^-1; J'J is the Huber-weighted Hessian over its mean weight
    (Huber & Ronchetti, Robust Statistics, 7.6).

    Parameters
    ----------
    hessian : (k, k) of the Huber cost. residuals : (p, 2), pixels. weights : (p,), positive,
        inverse variances up to a factor.
    numbers : (p,) how many numbers each point gives: 1 along an outline's normal, else 2.
    huber_px : residual length where the cost turns linear.
    scale : (k,) of the unknowns: directions are compared in unknowns divided by it.

    Returns
    -------
    sigma_px : robust standard deviation of a coordinate of a point of weight 1. covariance : (k, k); infinite
        where there are no more numbers than unknowns, very large in directions that the residuals do not see.
    """
    size, count = len(hessian), numbers.sum()
    freedom = count - size
    if freedom <= 0:
        return np.inf, np.full((size, size), np.inf)
    length, is_pair = np.empty(len(numbers)), numbers == 2
    psi_squared, slopes, factors = 0.0, 0.0, 0.0
    for j in range(len(numbers)):
        length[j] = np.hypot(residuals[j, 0], residuals[j, 1])
        factor = min(1.0, huber_px / max(length[j], 1e-300))
        psi_squared += weights[j] * (factor * length[j]) ** 2
        slopes += 0.5 * (factor + (1.0 if length[j] <= huber_px else 0.0))
        factors += factor
    # The length of a Gaussian pair has the median 1.1774 sigma (Rayleigh).
    sigma = np.inf
    if is_pair.any():
        sigma = np.median((np.sqrt(weights) * length)[is_pair]) / 1.1774 * np.sqrt(count / freedom)
    mean_slope = max(slopes / len(numbers), 1e-3)
    variance = psi_squared / freedom * (factors / len(numbers)) / mean_slope**2
    values, vectors = np.linalg.eigh(hessian * np.outer(scale, scale))
    floored = np.maximum(values, max(values[-1], 1e-30) * EIGENVALUE_FLOOR)
    return sigma, variance * ((vectors / floored) @ vectors.T) * np.outer(scale, scale)


def huber_covariance_numpy(
    hessian: Array,
    residuals: Array,
    weights: Array,
    numbers: NDArray[np.integer],
    huber_px: float,
    scale: Array,
) -> tuple[float, Array]:
    """The plain twin of `huber_covariance`."""
    size = len(hessian)
    count = int(numbers.sum())
    freedom = count - size
    if freedom <= 0:
        return float("inf"), np.full((size, size), np.inf)
    length = np.linalg.norm(residuals, axis=1)
    # The length of a Gaussian pair has the median 1.1774 sigma (Rayleigh).
    pairs = (np.sqrt(weights) * length)[numbers == 2]
    sigma = float(np.median(pairs) / 1.1774 * np.sqrt(count / freedom)) if len(pairs) else float("inf")
    factor = np.minimum(1.0, huber_px / np.maximum(length, 1e-300))
    psi_squared = float(np.sum(weights * (factor * length) ** 2)) / freedom
    mean_slope = max(float(np.mean(0.5 * (factor + (length <= huber_px)))), 1e-3)
    eigenvalues, vectors = np.linalg.eigh(hessian * np.outer(scale, scale))
    floored = np.maximum(eigenvalues, max(eigenvalues[-1], 1e-30) * EIGENVALUE_FLOOR)
    inverse = (vectors / floored) @ vectors.T
    variance = psi_squared * float(factor.mean()) / mean_slope**2
    return sigma, variance * inverse * np.outer(scale, scale)
