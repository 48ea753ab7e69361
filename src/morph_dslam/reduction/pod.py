"""Proper orthogonal decomposition: modes of snapshots, and which of them a model keeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Directions of so little of the largest norm are rounding.
RANK = 1e-13


@dataclass(frozen=True)
class Pod:
    """A basis of snapshots, orthonormal with the weights.

    Attributes
    ----------
    modes : (n_modes, n).
    singular_values : decreasing; all of them.
    weights : (n,).
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
    weights : (n,) quadrature weights (the mass matrix, lumped).
    tolerance : modes are kept until the root of the relative energy left out is below it.
    max_modes : at most this many.
    """
    root = np.sqrt(weights)
    factors: Any = scipy.linalg.qr((snapshots * root).T, mode="economic", overwrite_a=True)
    _, values, right = np.linalg.svd(factors[1].T, full_matrices=False)
    kept = min(rank_for(values, tolerance * float(np.linalg.norm(values))), max_modes)
    return Pod(right[:kept] @ (factors[0].T / root), values, weights)


def rank_for(singular_values: Array, allowed: float) -> int:
    """The smallest rank, at least one, whose tail of singular values has norm at most ``allowed``."""
    tails = np.sqrt(np.cumsum(singular_values[::-1] ** 2))[::-1]
    return max(1, int(np.sum(tails > allowed)))


@dataclass(frozen=True)
class Truncation:
    """Modes of a field, most important first.

    Attributes
    ----------
    modes : (m, n_points, n_components).
    rotation : (m, k) from coefficients of the modes given to coefficients of these.
    singular_values : of the fields, decreasing, beyond those kept too.
    """

    modes: Array
    rotation: Array
    singular_values: Array


def truncate(modes: Array, coefficients: Array, weights: Array, tolerance: float, max_modes: int) -> Truncation:
    """The best modes of fields that are given as coefficients of more modes than enough.

    With the Gram matrix G = R'R of the modes given, the singular value decomposition of R times the
    coefficients gives the best ones.

    Parameters
    ----------
    modes : (k, n_points, n_components).
    coefficients : (k, n) of the fields.
    weights : (n_points,).
    tolerance : relative norm of the fields that may be left out.
    max_modes : at most this many.
    """
    flat = (modes * np.sqrt(weights)[:, None]).reshape(len(modes), -1)
    lengths, vectors = np.linalg.eigh(flat @ flat.T)
    kept = lengths > RANK * max(lengths.max(), np.finfo(float).tiny)
    root, vectors = np.sqrt(lengths[kept]), vectors[:, kept]
    left, singular, _ = np.linalg.svd((root[:, None] * vectors.T) @ coefficients, full_matrices=False)
    left = left[:, : min(rank_for(singular, tolerance * float(np.linalg.norm(singular))), max_modes)]
    return Truncation(
        np.tensordot((left / root[:, None]).T @ vectors.T, modes, axes=1),
        left.T @ (root[:, None] * vectors.T),
        singular,
    )
