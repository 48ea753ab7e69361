"""Decompositions of coefficient tensors on full parameter grids: CP, Tucker and tensor train, to a tolerance.

A coefficient tensor is (n_functions, n_1, ..., n_d): the coefficients of every spatial mode at all nodes of a
grid of the d parameters. With orthonormal modes its norm is that of the fields, so the tolerance bounds the
error of the fields at the nodes. All tolerances are relative, in the Frobenius norm.

References: Kolda and Bader, "Tensor decompositions and applications", SIAM Review 2009 (CP, Tucker); De
Lathauwer, De Moor and Vandewalle, SIAM J. Matrix Anal. 2000 (HOSVD, HOOI); Oseledets, "Tensor-train
decomposition", SIAM J. Sci. Comput. 2011.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.basis_functions import Basis
from morph_dslam.model.tensor_functions import CPFunctions, TensorTrainFunctions, TuckerFunctions
from morph_dslam.reduction.pod import rank_for

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CP:
    """tensor ~ sum_t factors[0][:, t] x factors[1][:, t] x ...; the first factor carries the scale."""

    factors: tuple[Array, ...]

    def full(self) -> Array:
        """The whole tensor."""
        rest = khatri_rao(self.factors[1:])
        return (self.factors[0] @ rest.T).reshape([len(f) for f in self.factors])


@dataclass(frozen=True)
class Tucker:
    """tensor ~ core times one factor (n_k, rank_k) with orthonormal columns along every axis."""

    core: Array
    factors: tuple[Array, ...]

    def full(self) -> Array:
        """The whole tensor."""
        return multiply_axes(self.core, self.factors)


@dataclass(frozen=True)
class TensorTrain:
    """tensor[i, j, ...] ~ cores[0][:, i] cores[1][:, j] ...; core k is (rank_k, n_k, rank_k+1)."""

    cores: tuple[Array, ...]

    def full(self) -> Array:
        """The whole tensor."""
        result = self.cores[0]
        for core in self.cores[1:]:
            result = np.tensordot(result, core, axes=1)
        return result[0, ..., 0]


def unfold(tensor: Array, axis: int) -> Array:
    """The tensor as a matrix (n_axis, everything else in order)."""
    return np.moveaxis(tensor, axis, 0).reshape(tensor.shape[axis], -1)


def multiply_axes(tensor: Array, matrices: tuple[Array, ...], skip: int | None = None) -> Array:
    """Multiply every axis k but ``skip`` by ``matrices[k]`` (m_k, n_k)."""
    for axis, matrix in enumerate(matrices):
        if axis != skip:
            tensor = np.moveaxis(np.tensordot(matrix, tensor, axes=(1, axis)), 0, axis)
    return tensor


def khatri_rao(factors: tuple[Array, ...]) -> Array:
    """Column-wise Kronecker product (prod n_k, n_terms), the last index fastest."""
    result = factors[0]
    for factor in factors[1:]:
        result = (result[:, None, :] * factor[None, :, :]).reshape(-1, factor.shape[1])
    return result


def tensor_train(tensor: Array, tolerance: float) -> TensorTrain:
    """TT-SVD: one truncated SVD per cut, each with its share tolerance / sqrt(d) of the error."""
    shape, cores, rank = tensor.shape, [], 1
    allowed = tolerance * float(np.linalg.norm(tensor)) / np.sqrt(max(tensor.ndim - 1, 1))
    rest = tensor
    for size in shape[:-1]:
        left, values, right = np.linalg.svd(rest.reshape(rank * size, -1), full_matrices=False)
        new = rank_for(values, allowed)
        cores.append(left[:, :new].reshape(rank, size, new))
        rest, rank = values[:new, None] * right[:new], new
    cores.append(rest.reshape(rank, shape[-1], 1))
    return TensorTrain(tuple(cores))


def _leading_vectors(matrix: Array) -> tuple[Array, Array]:
    """Left singular vectors and values; of a wide matrix through QR of its transpose, for full accuracy."""
    if matrix.shape[1] > matrix.shape[0]:
        matrix = np.asarray(np.linalg.qr(matrix.T, mode="r")).T
    left, values, _ = np.linalg.svd(matrix, full_matrices=False)
    return left, values


def tucker(tensor: Array, tolerance: float, sweeps: int = 2) -> Tucker:
    """HOSVD to the tolerance, then higher-order orthogonal iteration (HOOI) at the ranks found.

    Each axis may use tolerance / sqrt(number of axes) of the error, so the sum stays below the tolerance;
    the ``sweeps`` of HOOI lower the error further.
    """
    allowed = tolerance * float(np.linalg.norm(tensor)) / np.sqrt(tensor.ndim)
    factors = []
    for axis in range(tensor.ndim):
        left, values = _leading_vectors(unfold(tensor, axis))
        factors.append(left[:, : rank_for(values, allowed)])
    for _ in range(sweeps):
        for axis in range(tensor.ndim):
            others = multiply_axes(tensor, tuple(f.T for f in factors), skip=axis)
            left, _ = _leading_vectors(unfold(others, axis))
            factors[axis] = left[:, : factors[axis].shape[1]]
    return Tucker(multiply_axes(tensor, tuple(f.T for f in factors)), tuple(factors))


def cp(tensor: Array, tolerance: float, max_terms: int, sweeps: int = 60) -> CP:
    """CP by alternating least squares, with terms added until the tolerance or ``max_terms`` is reached.

    The tensor is first compressed by HOSVD, which leaves ALS a small core. Each new term starts as the best
    rank-one part of the residual; then all terms are refitted by up to ``sweeps`` sweeps. The normal
    equations of ALS limit the accuracy to about 1e-6.
    """
    compressed = tucker(tensor, 0.1 * tolerance, sweeps=0)
    core, total = compressed.core, float(np.linalg.norm(tensor))
    allowed = tolerance * total
    factors = tuple(np.zeros((n, 0)) for n in core.shape)
    residual = core
    while factors[0].shape[1] < max_terms:
        term = _rank_one(residual)
        factors = tuple(np.column_stack([f, t]) for f, t in zip(factors, term, strict=True))
        factors = _als(core, factors, sweeps, allowed)
        residual = core - CP(factors).full()
        if np.linalg.norm(residual) <= allowed:
            break
    return CP(tuple(u @ f for u, f in zip(compressed.factors, factors, strict=True)))


def _rank_one(tensor: Array, sweeps: int = 20) -> list[Array]:
    """The best rank-one tensor by the higher-order power method, from the leading HOSVD vectors."""
    vectors = [_leading_vectors(unfold(tensor, axis))[0][:, :1] for axis in range(tensor.ndim)]
    for _ in range(sweeps):
        for axis in range(tensor.ndim):
            image = multiply_axes(tensor, tuple(v.T for v in vectors), skip=axis).reshape(-1, 1)
            vectors[axis] = image / max(float(np.linalg.norm(image)), np.finfo(float).tiny)
    scale = multiply_axes(tensor, tuple(v.T for v in vectors)).item()
    vectors[0] = vectors[0] * scale
    return vectors


def _als(tensor: Array, factors: tuple[Array, ...], sweeps: int, allowed: float) -> tuple[Array, ...]:
    """Sweeps of alternating least squares over all terms, until below ``allowed`` or no longer falling."""
    current = list(factors)
    square, previous = float(np.sum(tensor**2)), np.inf
    for _ in range(sweeps):
        for axis in range(tensor.ndim - 1, -1, -1):
            others = [f for k, f in enumerate(current) if k != axis]
            gram = np.prod([f.T @ f for f in others], axis=0)
            image = unfold(tensor, axis) @ khatri_rao(tuple(others))
            # nearly parallel terms make the Gram matrix singular; the ridge keeps them from growing
            gram[np.diag_indices_from(gram)] += 1e-12 * np.trace(gram) / len(gram)
            current[axis] = np.linalg.solve(gram, image.T).T
            if axis > 0:
                lengths = np.maximum(np.linalg.norm(current[axis], axis=0), np.finfo(float).tiny)
                current[axis] /= lengths
        fit = np.sum((current[0].T @ current[0]) * gram) - 2.0 * np.sum(image * current[0])
        error = np.sqrt(max(square + fit, 0.0))
        if error <= 0.5 * allowed or previous - error < 1e-4 * error:
            break
        previous = error
    return tuple(current)


def cp_functions(decomposition: CP, grids: tuple[Array, ...], bases: tuple[Basis, ...]) -> CPFunctions:
    """Functions of the parameters from a CP of a tensor (n_functions, n_1, ...) on ``grids`` [(n_k,)]."""
    factors = tuple(b.interpolate(grid, f) for b, grid, f in zip(bases, grids, decomposition.factors[1:], strict=True))
    return CPFunctions(bases, factors, np.ascontiguousarray(decomposition.factors[0].T))


def tucker_functions(decomposition: Tucker, grids: tuple[Array, ...], bases: tuple[Basis, ...]) -> TuckerFunctions:
    """Functions of the parameters from a Tucker form of a tensor (n_functions, n_1, ...) on ``grids``."""
    factors = tuple(b.interpolate(grid, f) for b, grid, f in zip(bases, grids, decomposition.factors[1:], strict=True))
    core = np.tensordot(decomposition.factors[0], decomposition.core, axes=1)
    return TuckerFunctions(bases, factors, np.ascontiguousarray(core))


def tensor_train_functions(
    decomposition: TensorTrain, grids: tuple[Array, ...], bases: tuple[Basis, ...]
) -> TensorTrainFunctions:
    """Functions of the parameters from a train of a tensor (n_functions, n_1, ...) on ``grids``."""
    first, *rest = decomposition.cores
    cores = [
        np.moveaxis(b.interpolate(g, np.moveaxis(c, 1, 0)), 0, 1) for b, g, c in zip(bases, grids, rest, strict=True)
    ]
    start = np.tensordot(first[0], cores[0], axes=1)
    return TensorTrainFunctions(bases, tuple(np.ascontiguousarray(c, dtype=float) for c in (start, *cores[1:])))
