"""Proper orthogonal decomposition by the method of snapshots (Sirovich, Q. Appl. Math. 45, 1987)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
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

    From the eigenvectors of the snapshots' Gram matrix, which takes no more memory than they do. Singular
    values below 1e-7 of the largest are lost in rounding; snapshots are kept in single precision anyway.

    Parameters
    ----------
    weights : (n,) quadrature weights of the inner product (the mass matrix, lumped).
    tolerance : modes are kept until the root of the relative energy left out is below it.
    max_modes : at most this many.
    """
    root = np.sqrt(weights)
    scaled = snapshots * root
    eigenvalues, vectors = np.linalg.eigh(scaled @ scaled.T)
    singular_values = np.sqrt(np.maximum(eigenvalues[::-1], 0.0))[: snapshots.shape[1]]
    energy = np.cumsum(singular_values[::-1] ** 2)[::-1]
    left_out = np.sqrt(np.append(energy[1:], 0.0) / energy[0])
    count = min(int(np.argmax(left_out <= tolerance)) + 1, max_modes)
    # Products of rounded eigenvectors are orthogonal only roughly where singular values are small.
    modes, triangle = np.linalg.qr((vectors[:, ::-1][:, :count].T @ scaled).T)
    modes = modes.T * np.sign(np.diag(triangle))[:, None]
    return Pod(modes / root, singular_values, weights)
