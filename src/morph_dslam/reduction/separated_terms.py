"""Sums of products of splines: how PGD's fields are multiplied, added and compressed.

A sum of T terms is vectors (N, T) times products over the parameters of functions with coefficients
[(size_k, T)] in common bases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import SeparatedField
from morph_dslam.model.basis_functions import Basis
from morph_dslam.model.tensor_functions import CPFunctions
from morph_dslam.reduction.separation import SeparatedVector

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Terms:
    """A sum of products.

    Attributes
    ----------
    vectors : (N, T).
    coefficients : per basis (size_k, T).
    bases : one for each parameter.
    """

    vectors: Array
    coefficients: tuple[Array, ...]
    bases: tuple[Basis, ...]

    def __add__(self, other: Terms) -> Terms:
        joined = (np.hstack(pair) for pair in zip(self.coefficients, other.coefficients, strict=True))
        return Terms(np.hstack([self.vectors, other.vectors]), tuple(joined), self.bases)

    def field(self, weights: Array, n_components: int, tolerance: float) -> tuple[SeparatedField, Array]:
        """The field with as few modes as the tolerance allows, orthonormal over space, and singular values.

        The singular value decomposition of the sum itself, over space and the parameters' box: no other
        modes in space lose less.

        Parameters
        ----------
        weights : (n_points,) of the points; each has ``n_components`` of the vectors' N numbers in a row.
        tolerance : relative norm that may be left out.
        """
        gram = np.ones((self.vectors.shape[1],) * 2)
        for basis, c in zip(self.bases, self.coefficients, strict=True):
            gram = gram * (c.T @ basis.gram() @ c) / (basis.upper - basis.lower)
        sizes, directions = np.linalg.eigh(gram)
        functions = directions * np.sqrt(np.maximum(sizes, 0.0))
        root = np.sqrt(np.repeat(weights, n_components))[:, None]
        left, values, _ = np.linalg.svd(self.vectors * root @ functions, full_matrices=False)
        tails = np.sqrt(np.cumsum(values[::-1] ** 2))[::-1]
        left = left[:, : max(1, int(np.sum(tails > tolerance * tails[0])))]
        mixing = np.ascontiguousarray((self.vectors * root).T @ left)
        modes = (left / root).T.reshape(-1, len(weights), n_components)
        return SeparatedField(modes, CPFunctions(self.bases, self.coefficients, mixing)), values


def spline_terms(vector: SeparatedVector, bases: tuple[Basis, ...]) -> Terms:
    """A separated vector with its functions in ``bases``."""
    return Terms(vector.vectors, tuple(_in_basis(vector, k, b) for k, b in enumerate(bases)), bases)


def _in_basis(vector: SeparatedVector, k: int, basis: Basis) -> Array:
    points, _ = basis.quadrature()
    return basis.interpolate(points, vector.functions(k, points).T)


def multiplied(terms: Terms, factor: SeparatedVector) -> Terms:
    """Products of scalar ``terms`` functions and those of ``factor``, whose vectors (N T, Q) hold N a term.

    The result is sum_t sum_q factor.vectors[t N : (t + 1) N, q] h_t(mu) f_q(mu).
    """
    count, n_terms = factor.n_terms, terms.coefficients[0].shape[1]
    vectors = factor.vectors.reshape(n_terms, -1, count)
    coefficients = []
    for k, (basis, c) in enumerate(zip(terms.bases, terms.coefficients, strict=True)):
        points, _ = basis.quadrature()
        products = (basis.evaluate(points) @ c)[:, :, None] * factor.functions(k, points).T[:, None, :]
        coefficients.append(basis.interpolate(points, products.reshape(len(points), -1)))
    stacked = np.moveaxis(vectors, 0, 1).reshape(-1, n_terms * count)
    return Terms(stacked, tuple(coefficients), terms.bases)
