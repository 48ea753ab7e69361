"""A frame's points about its estimate, to first order: what more of their residuals, or of unknowns, would do to it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.tracking.covariance import EIGENVALUE_FLOOR

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Linearization:
    """A frame's points about its estimate; all is zero for those that do not count.

    Attributes
    ----------
    usable : (p,) those that count
    residuals : (p, 2), pixels
    jacobian : (p, 2, d + 6) of the pixels
    weighted_jacobian : (p, 2, d + 6), that times the weights
    weights : (p,) with Huber's factor
    """

    usable: NDArray[np.bool_]
    residuals: Array
    jacobian: Array
    weighted_jacobian: Array
    weights: Array

    @classmethod
    def of(cls, jacobian: Array, residuals: Array, weights: Array, huber_px: float) -> Linearization:
        """Of the Jacobian (p, 2, d + 6) of all points, their residuals (p, 2), pixels, and their weights (p,)."""
        numbers = np.asarray(weights, dtype=np.float64)
        return cls(*_counting(jacobian, np.ascontiguousarray(residuals), numbers, huber_px))

    @property
    def hessian(self) -> Array:
        """J' W J (d + 6, d + 6)."""
        return self.products(self.jacobian)

    def products(self, rows: Array) -> Array:
        """J' W times ``rows`` (p, 2, m): (d + 6, m)."""
        weighted = self.weighted_jacobian
        return weighted.reshape(-1, weighted.shape[2]).T @ rows.reshape(-1, rows.shape[2])

    def left(self, moved: Array, transfer: Array) -> Array:
        """What an estimate that moves by ``transfer`` (d + 6, m) leaves of motions (p, 2, m) of the pixels."""
        taken = self.jacobian.reshape(-1, len(transfer)) @ transfer
        return np.where(self.usable[:, None, None], moved - taken.reshape(moved.shape), 0.0)

    def with_unknowns(self, moved: Array) -> Linearization:
        """As if there were more unknowns, by which the pixels move by ``moved`` (p, 2, c)."""
        weighted = self.weights[:, None, None] * moved
        return replace(
            self,
            jacobian=np.concatenate([self.jacobian, moved], axis=2),
            weighted_jacobian=np.concatenate([self.weighted_jacobian, weighted], axis=2),
        )


@njit(cache=True, nogil=True)
def _counting(jacobian, residuals, weights, huber):
    """What `Linearization` holds, of all points' Jacobian (p, 2, n), residuals (p, 2) and weights (p,)."""
    usable = np.zeros(len(weights), np.bool_)
    seen, left, weighted = np.zeros_like(jacobian), np.zeros_like(residuals), np.zeros_like(jacobian)
    counted = np.zeros(len(weights))
    for j in range(len(weights)):
        length = np.sqrt(residuals[j, 0] ** 2 + residuals[j, 1] ** 2)
        if weights[j] > 0.0 and np.isfinite(length + np.sum(jacobian[j])):
            usable[j] = True
            weight = weights[j] * min(1.0, huber / max(length, 1e-300))
            counted[j] = weight
            # Entry by entry: numba takes seconds to compile the assignment of one array to a part of another.
            for c in range(2):
                left[j, c] = residuals[j, c]
                for k in range(jacobian.shape[2]):
                    seen[j, c, k], weighted[j, c, k] = jacobian[j, c, k], weight * jacobian[j, c, k]
    return usable, left, seen, weighted, counted


def inverse_of_seen(hessian: Array, scale: Array) -> Array:
    """H^-1 (n, n); nothing moves along what neither the images nor a prior determine."""
    values, vectors = np.linalg.eigh(hessian * np.outer(scale, scale))
    seen = values > max(values[-1], 1e-30) * EIGENVALUE_FLOOR
    inverse = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T
    return np.asarray(inverse * np.outer(scale, scale), dtype=np.float64)
