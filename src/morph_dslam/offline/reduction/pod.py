"""Proper orthogonal decomposition of snapshots, by a thin singular value decomposition."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pod:
    """An orthonormal basis of snapshots.

    Attributes
    ----------
    modes : (n_modes, n) orthonormal in the given weights.
    singular_values : all of them, decreasing.
    """

    modes: Array
    singular_values: Array
    weights: Array

    def project(self, fields: Array) -> Array:
        """Coefficients (..., n_modes) of fields (..., n)."""
        return (fields * self.weights) @ self.modes.T


def compute_pod(snapshots: Array, weights: Array, tolerance: float, max_modes: int) -> Pod:
    """Leading modes of ``snapshots`` (n_snapshots, n).

    A QR factorisation in place comes first, so that little more memory is needed than the snapshots take.

    Parameters
    ----------
    weights : (n,) quadrature weights of the inner product (the mass matrix, lumped).
    tolerance : modes are kept until the root of the relative energy left out is below it.
    max_modes : at most this many.
    """
    root = np.sqrt(weights)
    factors: Any = scipy.linalg.qr((snapshots * root).T, mode="economic", overwrite_a=True)
    basis, triangle = factors
    _, singular_values, right = np.linalg.svd(triangle.T, full_matrices=False)
    energy = np.cumsum(singular_values[::-1] ** 2)[::-1]
    left_out = np.sqrt(np.append(energy[1:], 0.0) / energy[0])
    count = min(int(np.argmax(left_out <= tolerance)) + 1, max_modes)
    return Pod(right[:count] @ basis.T / root, singular_values, weights)
