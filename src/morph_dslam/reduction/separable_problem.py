"""Linear problems with separated parameters: [sum_q A_q (x) theta_q] U = sum_j h_j (x) g_j.

Every theta_q and g_j is a product over the parameters. A parameter is discretised by a `ParameterAxis`: a
basis and the quadrature of the integral over it. Operators are symmetric and positive definite.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import SuperLU, splu

from morph_dslam.model.basis_functions import Basis, hat_basis

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ParameterAxis:
    """One parameter: its basis, and the quadrature of the integral over it.

    Attributes
    ----------
    basis : of the functions of the parameter.
    points : (p,) of the quadrature.
    weights : (p,) of the points.
    """

    basis: Basis
    points: Array
    weights: Array

    @cached_property
    def values(self) -> Array:
        """The functions of the basis at the points (p, size)."""
        return self.basis.evaluate(self.points)

    def multiplied_by(self, theta: ArrayLike) -> Array:
        """Images (..., p, size) of the functions, multiplied with ``theta`` (..., p) at the points."""
        return np.asarray(theta, dtype=float)[..., None] * self.values

    def integrate(self, images: Array) -> Array:
        """Integrals (size, b) of the functions times ``images`` (p, b)."""
        return (self.values * self.weights[:, None]).T @ images


def galerkin_axis(basis: Basis) -> ParameterAxis:
    """An axis on which the problem holds in the mean, weighted with the basis functions."""
    return ParameterAxis(basis, *basis.quadrature())


def collocation_axis(nodes: ArrayLike) -> ParameterAxis:
    """An axis of hats on which the problem holds at the ``nodes`` (n,) themselves, all of equal weight."""
    nodes = np.asarray(nodes, dtype=float)
    return ParameterAxis(hat_basis(nodes), nodes, np.full(len(nodes), 1.0 / len(nodes)))


@dataclass(frozen=True)
class SeparableProblem:
    """[sum_q A_q (x) theta_q] U = sum_j h_j (x) g_j.

    Attributes
    ----------
    axes : the d parameters.
    matrices : the Q sparse matrices A_q (n, n), on the free degrees of freedom.
    images : per axis (Q, p_k, n_free), what the factor of theta_q makes of the axis' functions.
    loads : (n, J), the vectors h_j.
    load_functions : per axis (J, p_k), the factors of g_j at the axis' points.
    metric : K0 (n, n), symmetric positive definite: residuals are measured in the norm of its inverse. The
        operator in the middle of the box is the natural choice, its symmetric part if it is not symmetric.
    """

    axes: tuple[ParameterAxis, ...]
    matrices: tuple[sp.csc_array, ...]
    images: tuple[Array, ...]
    loads: Array
    load_functions: tuple[Array, ...]
    metric: sp.csc_array

    def __post_init__(self) -> None:
        n, n_loads = self.loads.shape
        for k, axis in enumerate(self.axes):
            expected = (len(self.matrices), *axis.values.shape)
            if self.images[k].shape != expected:
                raise ValueError(f"images of axis {k} must be {expected}, not {self.images[k].shape}")
            if self.load_functions[k].shape != (n_loads, len(axis.points)):
                raise ValueError(f"load functions of axis {k} must be ({n_loads}, {len(axis.points)})")
        if any(matrix.shape != (n, n) for matrix in (*self.matrices, self.metric)):
            raise ValueError(f"all matrices must be ({n}, {n}), as the loads have {n} rows")


def factorise(matrix: sp.csc_array) -> SuperLU:
    """Sparse LU factors of a symmetric positive definite matrix, without pivoting."""
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


class _SpaceOperators:
    """Weighted sums of the matrices A_q, symmetric positive definite."""

    def __init__(self, matrices: tuple[sp.csc_array, ...]) -> None:
        self.matrices, self.n_terms = matrices, len(matrices)
        self._single = factorise(matrices[0]) if self.n_terms == 1 else None

    def apply(self, term: int, vectors: Array) -> Array:
        """A_q of a term times ``vectors`` (n, ...)."""
        return self.matrices[term] @ vectors

    def solve(self, weights: Array, right: Array) -> Array:
        """Solve [sum_q weights_q A_q] x = right (n,)."""
        if self._single is not None:
            return self._single.solve(right) / weights[0]
        total: Any = sum(weight * matrix for weight, matrix in zip(weights, self.matrices, strict=True))
        return factorise(total).solve(right)


@dataclass(frozen=True)
class SeparatedSystem:
    """The problem tested with its own functions, as the alternating directions of `pgd` work on it.

    Attributes
    ----------
    operators : the A_q.
    grams : per axis (Q, size, size), integrals of theta_q times two functions.
    masses : per axis (size, size), the norm of its functions.
    loads : (n, J), the h_j.
    load_vectors : per axis (J, size), integrals of g_j times its functions.
    """

    operators: _SpaceOperators
    grams: tuple[Array, ...]
    masses: tuple[Array, ...]
    loads: Array
    load_vectors: tuple[Array, ...]

    @classmethod
    def of(cls, problem: SeparableProblem) -> SeparatedSystem:
        """The system of a problem."""
        axes = problem.axes
        return cls(
            _SpaceOperators(problem.matrices),
            tuple(
                np.stack([a.integrate(image) for image in images])
                for a, images in zip(axes, problem.images, strict=True)
            ),
            tuple(a.integrate(a.values) for a in axes),
            problem.loads,
            tuple((g * a.weights) @ a.values for a, g in zip(axes, problem.load_functions, strict=True)),
        )


class DualResidual:
    """The stopping measure of PGD: sqrt(int r(mu)^T K0^-1 r(mu) dmu), K0 the problem's metric.

    It equals the energy norm of the error where the operator is K0 for all parameters, and is equivalent to
    it otherwise. As the residual is a sum of products, its norm needs only the Gram matrices of its space
    vectors and of its functions of each parameter. These cancel, so relative values below about 1e-7 mean no
    more than "small".
    """

    def __init__(self, problem: SeparableProblem) -> None:
        self._problem = problem
        self._inverse = factorise(problem.metric)
        self._lifted = self._inverse.solve(problem.loads)
        self.load_norm = self._norm(problem.loads, self._lifted, list(problem.load_functions))

    def _norm(self, vectors: Array, lifted: Array, functions: list[Array]) -> float:
        """Of sum_s vectors[:, s] prod_k functions[k][s], with ``lifted`` = K0^-1 vectors."""
        product = vectors.T @ lifted
        for axis, values in zip(self._problem.axes, functions, strict=True):
            product = product * ((values * axis.weights) @ values.T)
        return float(np.sqrt(max(np.sum(product), 0.0)))

    def relative(self, modes: Array, coefficients: list[Array]) -> float:
        """Residual of the sum with ``modes`` (n, m) and ``coefficients`` [(n_free, m)], over that of zero."""
        problem = self._problem
        images = np.concatenate([matrix @ modes for matrix in problem.matrices], axis=1)
        functions = [
            np.concatenate([g, np.swapaxes(image @ c, 1, 2).reshape(images.shape[1], -1)])
            for g, image, c in zip(problem.load_functions, problem.images, coefficients, strict=True)
        ]
        vectors = np.concatenate([problem.loads, -images], axis=1)
        lifted = np.concatenate([self._lifted, -self._inverse.solve(images)], axis=1)
        return self._norm(vectors, lifted, functions) / self.load_norm
