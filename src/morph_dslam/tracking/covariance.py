"""Covariances: from a Huber cost, and of errors that the points of one reference image share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numba import njit
from numpy.typing import NDArray

from morph_dslam.even_rows import evenly
from morph_dslam.row_products import FAST
from morph_dslam.small_arrays import median, scaled
from morph_dslam.tracking.state import State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BoundPart:
    """Points that were bound in one reference picture.

    Attributes
    ----------
    rows : of the points
    state : of the object in the picture.
    error_factors : (d + 6, c) how ``state`` is off by c error factors, the same for all parts, in their
        standard deviations; None where nothing is known of its error.
    """

    rows: slice
    state: State
    error_factors: Array | None


#: Over these shares of the points' spread a model's errors are taken to be alike, and are pairs compared.
ALIKE_SHARE, PAIR_SHARE = 0.75, 0.5
#: The factor leaves no more than this of any point's variance.
FACTOR_TOLERANCE = 0.01
#: Pairs are made of no more points than these.
MOST_COMPARED = 256
#: An estimate that takes up more of the model's error leaves too little to tell how large it is.
LEAST_LEFT = 0.02


class SharedErrors:
    """How alike errors are in points at these places, and what the same points' residuals show of them.

    Parameters
    ----------
    places : (p, 3) of the points, pixels
    window : side of the square that is compared around each, pixels.
    """

    def __init__(self, places: Array, window: int) -> None:
        spread = float(np.sqrt(np.mean(np.sum((places - places.mean(axis=0)) ** 2, axis=1))))
        self.factor = gaussian_factor(places, max(ALIKE_SHARE * spread, 1e-300))
        self._compared = evenly(len(places), MOST_COMPARED)
        # Coordinate by coordinate: sums over a short axis cost numpy most of the time that a view takes.
        apart = [np.abs(column[:, None] - column[None]) for column in places[self._compared].T]
        near = apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2 < (PAIR_SHARE * spread) ** 2
        beside = np.maximum(np.maximum(apart[0], apart[1]), apart[2]) >= window
        self._redundancy = _redundancy(apart, window)
        # As numbers, to be multiplied by in every frame; points that do not count are zero in what it is. Sparse: about
        # one pair in ten is compared.
        pairs, factor = (near & beside).astype(np.float64), self.factor[self._compared]
        self._pairs = scipy.sparse.csr_array(pairs)
        self._alike_pairs = scipy.sparse.csr_array((factor @ factor.T) * pairs)

    def n_pairs(self, used: NDArray[np.bool_]) -> float:
        """How many pairs of the points ``used`` (p,) are compared, counted from both sides."""
        some = used[self._compared].astype(np.float64)
        return float(some @ (self._pairs @ some))

    def in_common(self, rows: Array, n_pairs: float) -> Array:
        """Mean products (k, k), a coordinate, of what pairs of points have in (p, 2, k), zero if unused."""
        return self._products(rows[self._compared])[0] / max(2.0 * n_pairs, 1.0)

    def _products(self, rows: Array) -> tuple[Array, Array]:
        """Sums of products (k, k) over the pairs of what the points that are compared have in ``rows`` (q, 2, k).

        With it, of each such point, the sum (q, 2 k) of what those that it is compared with have.
        """
        beside = self._pairs @ rows.reshape(len(rows), -1)
        k = rows.shape[2]
        return rows.reshape(-1, k).T @ beside.reshape(-1, k), beside

    def chance(self, variance: float, n_pairs: float) -> float:
        """Standard deviation of what `in_common` shows where only points whose windows overlap err alike.

        Parameters
        ----------
        variance : of each coordinate
        n_pairs : as of `n_pairs`
        """
        return self._redundancy * variance / float(np.sqrt(max(n_pairs, 1.0)))

    def gradients(self, weighted_jacobian: Array) -> Array:
        """Gradients (2 r, n) by each direction of an error of one pixel, by J' W (p, 2, n).

        Their products are the gradient's covariance, each coordinate for itself.
        """
        n = weighted_jacobian.shape[2]
        found = self.factor.T @ weighted_jacobian.reshape(len(weighted_jacobian), -1)
        return np.asarray(found.reshape(-1, n), dtype=np.float64)

    def share_left(
        self, used: NDArray[np.bool_], jacobian: Array, gradients: Array, gain: Array, n_pairs: float
    ) -> float:
        """How much of such an error's variance an estimate leaves in the residuals that show it.

        With G = J gain J' W what the estimate takes up, it leaves (I - G) K (I - G)' of a covariance K; this
        is summed over the pairs of points that `in_common` sums over.

        Parameters
        ----------
        used : (p,)
        jacobian : (p, 2, n), zero if unused
        gradients : (2 r, n) as of `gradients`.
        gain : (n, n) H^-1, or how else the unknowns follow from J' W r.
        n_pairs : as of `n_pairs`, of the same points.
        """
        some = used[self._compared].astype(np.float64)
        taken_up, (products, beside) = gradients @ gain.T, self._products(jacobian[self._compared])
        whole = 2.0 * float(some @ (self._alike_pairs @ some))
        # Over the points, what is beside them times what is taken up there, by directions of the factor.
        along = (some[:, None] * self.factor[self._compared]).T @ beside
        taken = 2.0 * float(along.ravel() @ taken_up.ravel())
        twice = float(np.sum(products * (taken_up.T @ taken_up)))
        return max((whole - taken + twice) / max(2.0 * n_pairs, 1.0), LEAST_LEFT)


def _redundancy(apart: list[Array], window: int) -> float:
    """How many points (p,) err as one, by how much their windows overlap; ``apart`` (p, p) by coordinate."""
    shared = np.prod([np.maximum(1.0 - distance / window, 0.0) for distance in apart], axis=0)
    return float(shared.sum()) / max(len(shared), 1)


def gaussian_factor(places: Array, length: float) -> Array:
    """A factor F (p, r) with F F' = exp(-d^2 / (2 length^2)) of the distances d of places (p, k), nearly.

    By pivoted Cholesky decomposition, until `FACTOR_TOLERANCE` of the largest diagonal is left.
    """
    left, columns = np.ones(len(places)), np.empty((0, len(places)))
    while left.max(initial=0.0) > FACTOR_TOLERANCE:
        pivot = int(left.argmax())
        squared = sum((column - column[pivot]) ** 2 for column in places.T)
        rest = np.exp(-0.5 * squared / length**2) - columns[:, pivot] @ columns
        column = rest / np.sqrt(left[pivot])
        columns = np.vstack([columns, column])
        left = left - column**2
    return np.ascontiguousarray(columns.T)


#: Eigenvalue floor, relative to the best-seen direction.
EIGENVALUE_FLOOR = 1e-12
#: An unknown of which the others leave less than this share of its information may not be seen at all.
LEAST_PIVOT = 1e-8


#: Nothing is known better than by this, pixels, whatever residuals and patches say: a frame that is the reference
#: picture itself agrees with it exactly, with the same noise in both.
LEAST_SPREAD_PX = 0.01


@njit(cache=True, nogil=True)
def huber_covariance(hessian, residuals, weights, numbers, huber_px, scale):
    """Standard deviation of a pixel coordinate and covariance of an M-estimator.

    (sum psi² / (N - k)) / mean(psi')² (J'J)^-1; J'J is the Huber-weighted Hessian over its mean weight
    (Huber & Ronchetti, Robust Statistics, 7.6).

    Parameters
    ----------
    hessian : (k, k) of the Huber cost
    residuals : (p, 2), pixels
    weights : (p,), positive, inverse variances up to a factor.
    numbers : (p,) how many numbers each point gives: 1 along an outline's normal, else 2.
    huber_px : residual length where the cost turns linear.
    scale : (k,) of the unknowns: directions are compared in unknowns divided by it.

    Returns
    -------
    sigma_px : robust standard deviation of a coordinate of a point of weight 1
    covariance : (k, k); infinite where there are no more numbers than unknowns, very large in directions that
        the residuals do not see.
    """
    size, count = len(hessian), numbers.sum()
    freedom = count - size
    if freedom <= 0:
        return np.inf, np.full((size, size), np.inf)
    lengths, pairs, n_pairs = np.empty(len(numbers)), np.empty(len(numbers)), 0
    psi_squared, slopes, factors = 0.0, 0.0, 0.0
    for j in range(len(numbers)):
        length = np.hypot(residuals[j, 0], residuals[j, 1])
        factor = min(1.0, huber_px / max(length, 1e-300))
        psi_squared += weights[j] * (factor * length) ** 2
        slopes += 0.5 * (factor + (1.0 if length <= huber_px else 0.0))
        factors += factor
        lengths[j] = np.sqrt(weights[j]) * length
        if numbers[j] == 2:
            pairs[n_pairs] = lengths[j]
            n_pairs += 1
    # The length of a Gaussian pair has the median 1.1774 sigma (Rayleigh), that of a number 0.6745 sigma.
    sigma = median(pairs[:n_pairs]) / 1.1774 if n_pairs else median(lengths) / 0.6745
    sigma *= np.sqrt(count / freedom)
    mean_slope = max(slopes / len(numbers), 1e-3)
    variance = max(psi_squared / freedom * (factors / len(numbers)) / mean_slope**2, LEAST_SPREAD_PX**2)
    inverse = floored_inverse(scaled(hessian, scale))
    for a in range(size):
        for b in range(size):
            inverse[a, b] *= variance
    return max(sigma, LEAST_SPREAD_PX), scaled(inverse, scale)


def symmetric_root(covariance: Array) -> Array:
    """The symmetric root (n, n) of a covariance; of what is none, that of the part whose eigenvalues are positive."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T, dtype=np.float64)


@njit(cache=True, nogil=True)
def floored_inverse(hessian):
    """Inverse of a Hessian (k, k), no eigenvalue of which counts as less than `EIGENVALUE_FLOOR` of the largest."""
    inverse, n, of_hessian, of_inverse = _definite_inverse(hessian), len(hessian), 0.0, 0.0
    for k in range(len(inverse)):
        of_hessian, of_inverse = of_hessian + hessian[k, k], of_inverse + inverse[k, k]
    # The traces are no less than the largest eigenvalue, and one over the least.
    if len(inverse) == n and of_hessian * of_inverse * EIGENVALUE_FLOOR < 1.0:
        return inverse
    values, vectors = np.linalg.eigh(hessian)
    inverse, floor = np.zeros((n, n)), max(values[-1], 1e-30) * EIGENVALUE_FLOOR
    for a in range(n):
        for b in range(n):
            for k in range(n):
                inverse[a, b] += vectors[a, k] / max(values[k], floor) * vectors[b, k]
    return inverse


@njit(cache=True, nogil=True, fastmath=FAST)
def _definite_inverse(matrix):
    """Inverse of a matrix (k, k) that is clearly positive definite, by its Cholesky factor; else empty, (0, 0)."""
    n, factor = len(matrix), matrix.copy()
    for i in range(n):
        for j in range(i + 1):
            first, second = factor[i], factor[j]
            total = first[j]
            for k in range(j):
                total -= first[k] * second[k]
            if j < i:
                factor[i, j] = total / second[j]
            elif total > LEAST_PIVOT * matrix[i, i]:
                factor[i, i] = np.sqrt(total)
            else:
                return np.empty((0, 0))
    columns, inverse = np.zeros((n, n)), np.empty((n, n))  # columns of the factor's inverse, as rows
    for j in range(n):
        column = columns[j]
        column[j] = 1.0 / factor[j, j]
        for i in range(j + 1, n):
            row, total = factor[i], 0.0
            for k in range(j, i):
                total += row[k] * column[k]
            column[i] = -total / row[i]
    for i in range(n):
        for j in range(i + 1):
            first, second, total = columns[i], columns[j], 0.0
            for k in range(i, n):
                total += first[k] * second[k]
            inverse[i, j] = inverse[j, i] = total
    return inverse


@njit(cache=True, nogil=True)
def trace_of_share(whole, part, scale):
    """tr(H^+ P) of a Hessian H (n, n), on what it sees, and a part P of it.

    Parameters
    ----------
    whole, part : (n, n), H and P.
    scale : (n,) of the unknowns, which makes them comparable.
    """
    values, vectors = np.linalg.eigh(scaled(whole, scale))
    part, trace = scaled(part, scale), 0.0
    for k in range(len(values)):
        if values[k] > EIGENVALUE_FLOOR * values[-1]:
            for a in range(len(values)):
                for b in range(len(values)):
                    trace += vectors[a, k] * part[a, b] * vectors[b, k] / values[k]
    return trace
