"""Proper orthogonal decomposition of snapshots, in any inner product and for more data than memory holds."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Weights (n,) of the unknowns (a lumped mass matrix), or a sparse symmetric positive definite matrix (n, n).
InnerProduct = Array | scipy.sparse.sparray | scipy.sparse.spmatrix
#: Bytes that a decomposition may take before it is done in blocks.
DEFAULT_MEMORY = 4e9
#: Arrays of the snapshots' size, in double precision, that a decomposition at once needs.
COPIES = 3
#: Part of the tolerance that truncation before the last decomposition may use.
BLOCK_SHARE = 0.1


@dataclass(frozen=True)
class Pod:
    """A basis of snapshots, orthonormal in an inner product.

    Attributes
    ----------
    modes : (n_modes, n). singular_values : decreasing; all that are known.
    weights : the inner product.
    error_bound : of the root of the relative energy left out by truncation in blocks, beside that of the
        singular values left out; 0 for a decomposition at once.
    """

    modes: Array
    singular_values: Array
    weights: InnerProduct
    error_bound: float = 0.0

    def project(self, fields: Array) -> Array:
        """Coefficients (..., n_modes) of fields (..., n)."""
        return weighted(fields, self.weights) @ self.modes.T


def weighted(fields: Array, inner_product: InnerProduct) -> Array:
    """Fields (..., n) times the weights or the matrix of an inner product."""
    if isinstance(inner_product, np.ndarray):
        return fields * inner_product
    matrix: Any = inner_product
    return np.asarray(fields @ matrix)


class Rows(Protocol):
    """Snapshots (n_snapshots, n) that are gathered when sliced: an array, or one that is on disk."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def __getitem__(self, rows: slice, /) -> NDArray[Any]: ...


def compute_pod(
    snapshots: Rows, weights: InnerProduct, tolerance: float, max_modes: int, memory: float = DEFAULT_MEMORY
) -> Pod:
    """Leading modes of ``snapshots`` (n_snapshots, n).

    Parameters
    ----------
    weights : (n,) quadrature weights (the mass matrix, lumped), or a sparse symmetric positive definite
        matrix (n, n), a stiffness at rest for instance, in whose norm errors then count.
    tolerance : modes are kept until the root of the relative energy left out is below it.
    max_modes : at most this many.
    memory : bytes; if more were needed, blocks of snapshots are decomposed one after the other
        (`hierarchical_pod`). Snapshots may then be of single precision, or on disk (`numpy.memmap`).

    Raises
    ------
    ValueError
        If the matrix is not positive definite.
    """
    count, n = snapshots.shape
    if COPIES * 8 * count * n <= memory:
        found = _decompose(np.asarray(snapshots[:], dtype=np.float64), weights)
        kept = min(_rank(found.values, tolerance**2 * float(np.sum(found.values**2))), max_modes)
        return Pod(found.modes(kept), found.values, weights)
    # Two blocks and what is kept of others must fit.
    size = max(1, int(memory / (4 * COPIES * 8 * n)))
    blocks = (snapshots[start : start + size] for start in range(0, count, size))
    return hierarchical_pod(blocks, -(-count // size), weights, tolerance, max_modes)


def hierarchical_pod(
    blocks: Iterable[Array], n_blocks: int, weights: InnerProduct, tolerance: float, max_modes: int
) -> Pod:
    """Leading modes of snapshots that come in blocks (n_i, n), of which few are in memory at a time.

    Each block is replaced by its modes times their singular values, and pairs of equally many blocks are
    merged and truncated again. The squares of what all truncations leave out add up to a bound of the error
    (Himpel, Leibner, Rave, "Hierarchical approximate proper orthogonal decomposition", SIAM J. Sci. Comput.
    40, 2018, theorem 3.3); the last decomposition keeps so many modes that the sum stays below the tolerance.

    Parameters
    ----------
    n_blocks : how many come, from which follows what each truncation may leave out.
    weights, tolerance, max_modes : as of `compute_pod`.
    """
    levels = int(np.ceil(np.log2(max(n_blocks, 2)))) + 1
    share = (BLOCK_SHARE * tolerance) ** 2 / levels
    merged = _Merged(weights, share)
    for block in blocks:
        merged.add(np.asarray(block, dtype=np.float64))
    rows, energy, lost = merged.rest()
    found = _decompose(rows, weights)
    kept = min(_rank(found.values, tolerance**2 * energy - lost), max_modes)
    bound = float(np.sqrt(lost / energy)) if energy else 0.0
    return Pod(found.modes(kept), found.values, weights, bound)


class _Merged:
    """Blocks merged in pairs of one size, as in a binary counter, so that few are held at a time."""

    def __init__(self, weights: InnerProduct, share: float) -> None:
        self._weights, self._share = weights, share
        # Level, modes times singular values, energy of the snapshots that they stand for.
        self._held: list[tuple[int, Array, float]] = []
        self._lost = 0.0

    def add(self, block: Array) -> None:
        energy = float(np.sum(block * weighted(block, self._weights)))
        self._held.append((0, self._truncated(block, energy), energy))
        while len(self._held) > 1 and self._held[-1][0] == self._held[-2][0]:
            (level, second, more), (_, first, energy) = self._held.pop(), self._held.pop()
            both = np.vstack([first, second])
            del first, second
            self._held.append((level + 1, self._truncated(both, energy + more), energy + more))

    def _truncated(self, rows: Array, energy: float) -> Array:
        found = _decompose(rows, self._weights)
        kept = _rank(found.values, self._share * energy)
        self._lost += float(np.sum(found.values[kept:] ** 2))
        return found.values[:kept, None] * found.modes(kept)

    def rest(self) -> tuple[Array, float, float]:
        """Rows left, energy of all snapshots, and the part of it that truncation has left out."""
        return (np.vstack([rows for _, rows, _ in self._held]), sum(energy for *_, energy in self._held), self._lost)


def _rank(values: Array, allowed: float) -> int:
    """How many singular values to keep for the squares of the others to add up to at most ``allowed``."""
    left_out = np.append(np.cumsum(values[::-1] ** 2)[::-1][1:], 0.0)
    return int(np.argmax(left_out <= max(allowed, 0.0))) + 1


@dataclass(frozen=True)
class _Decomposition:
    """Singular values (k,) of snapshots, and modes as ``combinations`` (k, k) of ``basis`` (k, n)."""

    values: Array
    combinations: Array
    basis: Array

    def modes(self, count: int) -> Array:
        """The first modes (count, n), orthonormal in the inner product."""
        return self.combinations[:count] @ self.basis


def _decompose(snapshots: Array, weights: InnerProduct) -> _Decomposition:
    """The singular value decomposition of snapshots (s, n) in an inner product.

    A QR factorisation in place comes first, so that little more memory is needed than the snapshots take. In
    the inner product of a matrix K, snapshots are R'Q' with Q'Q = 1, and with Q'KQ = CC' the modes follow
    from the singular value decomposition of R'C: nothing is squared but the condition of K.
    """
    lumped = isinstance(weights, np.ndarray)
    root = np.sqrt(weights) if lumped else np.ones(1)
    factors: Any = scipy.linalg.qr((snapshots * root).T, mode="economic", overwrite_a=True)
    basis, triangle = factors[0].T, factors[1].T
    if lumped:
        _, values, right = np.linalg.svd(triangle, full_matrices=False)
        basis /= root
        return _Decomposition(values, right, basis)
    try:
        factor = np.linalg.cholesky(weighted(basis, weights) @ basis.T)
    except np.linalg.LinAlgError as error:
        raise ValueError("the matrix of the inner product is not positive definite") from error
    _, values, right = np.linalg.svd(triangle @ factor, full_matrices=False)
    return _Decomposition(values, scipy.linalg.solve_triangular(factor, right.T, lower=True, trans=1).T, basis)
