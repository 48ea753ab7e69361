"""What an estimate was made from, and how large and how alike the errors of its measurements are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse
from numba import njit
from numpy.typing import NDArray

from morph_dslam.tracking.covariance import LEAST_SPREAD_PX
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.state import BoundPoints

Array = NDArray[np.float64]
#: Of errors: whole, or, of those that few others share, sparse.
Correlation = Array | scipy.sparse.csr_array


@dataclass(frozen=True)
class Observations:
    """What an estimate was made from, in one frame.

    Attributes
    ----------
    points : p of them
    pixels : (p, 2) as measured
    weights : (p,), inverse variances up to a factor, but for what ``correlation`` says.
    normals : (p, 2), zero for points that count in both directions; see `reprojection.linearise`.
    correlation : (p, p) of the errors of the points' measurements; empty where nobody asks for it. On its diagonal is
        how many times as large as its weight says a point's variance is.
    depths : where a depth camera saw them.
    common_px : what the points with normals may be off by together, a standard deviation, pixels: by a shift in either
        direction, and by one outwards; the same in all frames.
    """

    points: BoundPoints
    pixels: Array
    weights: Array
    normals: Array
    correlation: Correlation = field(default_factory=lambda: np.zeros((0, 0)))
    depths: PointDepths | None = None
    common_px: float = 0.0

    @property
    def numbers(self) -> NDArray[np.int64]:
        """How many numbers each point (p,) gives: one on an outline, two otherwise."""
        return np.where((self.normals != 0.0).any(axis=1), 1, 2)

    @property
    def redundancy(self) -> float:
        """How many of the points count as one, because their windows overlap."""
        exactness = np.sqrt(self.weights)
        return float(exactness @ (self.correlation @ exactness)) / max(float(self.weights.sum()), 1e-300)


@dataclass(frozen=True)
class RigObservations:
    """What several cameras measured at the same time, by camera; their points come one after the other."""

    views: tuple[Observations, ...]

    @cached_property
    def weights(self) -> Array:
        """(p,) of all points."""
        return np.concatenate([view.weights for view in self.views])

    @cached_property
    def numbers(self) -> NDArray[np.int64]:
        """(p,) as in `Observations`."""
        return np.concatenate([view.numbers for view in self.views])

    def split(self, values: Array) -> list[Array]:
        """By camera what (p, ...) is of all points."""
        return np.split(values, np.cumsum([len(view.weights) for view in self.views])[:-1])

    @cached_property
    def correlation(self) -> Correlation:
        """(p, p); the errors of different cameras have nothing in common."""
        return block_diagonal([scipy.sparse.csr_array(view.correlation) for view in self.views])


def block_diagonal(blocks: Sequence[scipy.sparse.csr_array]) -> scipy.sparse.csr_array:
    """Square matrices along the diagonal of a larger one; scipy's own takes ten times as long for small ones."""
    rows = np.cumsum([0, *(len(block.indptr) - 1 for block in blocks)])
    entries = np.cumsum([0, *(block.nnz for block in blocks)])
    values = np.concatenate([block.data for block in blocks])
    columns = np.concatenate([block.indices + first for block, first in zip(blocks, rows, strict=False)])
    begins = np.concatenate([[0], *(block.indptr[1:] + first for block, first in zip(blocks, entries, strict=False))])
    indices = columns.astype(np.int32), begins.astype(np.int32)  # as those of one block, for `_sparse_quadratic`
    return scipy.sparse.csr_array((values, *indices), shape=(rows[-1], rows[-1]))


def window_correlation(pixels: Array, window: int) -> scipy.sparse.csr_array:
    """Correlation (p, p) of measurements at ``pixels`` (p, 2): the share of their windows that is the same.

    ``window`` is the side of the square that is compared, in pixels. Points at NaN have no window.
    """
    if not len(pixels):
        return scipy.sparse.csr_array((0, 0))
    from_left = np.argsort(np.where(np.isfinite(pixels[:, 0]), pixels[:, 0], np.inf), kind="stable")
    overlaps = _overlaps(pixels[from_left], from_left, float(window))
    return scipy.sparse.csr_array(overlaps, shape=(len(pixels), len(pixels)))


@njit(cache=True, nogil=True)
def _overlaps(ordered, from_left, window):
    """Values, columns and beginnings of the rows of the sparse matrix of shared windows.

    Parameters
    ----------
    ordered, from_left : the pixels (p, 2) in order of their columns, and which (p,) these are.
    window : side of the square that is compared around each, pixels.
    """
    count = len(ordered)
    x, y, found = ordered[:, 0], ordered[:, 1], np.ones(count, np.int32)
    for a in range(count):
        b = a + 1
        while b < count and x[b] < x[a] + window:
            if abs(y[b] - y[a]) < window:
                found[from_left[a]] += 1
                found[from_left[b]] += 1
            b += 1
    begins = np.zeros(count + 1, np.int32)
    for i in range(count):
        begins[i + 1] = begins[i] + found[i]
    values, columns, ends = np.ones(begins[-1]), np.empty(begins[-1], np.int32), np.empty(count, np.int32)
    for i in range(count):
        columns[begins[i]], ends[i] = i, begins[i] + 1
    for a in range(count):
        i, b = from_left[a], a + 1
        while b < count and x[b] < x[a] + window:
            down = abs(y[b] - y[a])
            if down < window:
                j, share = from_left[b], (1.0 - (x[b] - x[a]) / window) * (1.0 - down / window)
                values[ends[i]], columns[ends[i]] = share, j
                values[ends[j]], columns[ends[j]] = share, i
                ends[i] += 1
                ends[j] += 1
            b += 1
    return values, columns, begins


def quadratic(rows: Array, correlation: Correlation, others: Array | None = None) -> Array:
    """sum_ij K_ij W_i' V_j (n, n) of W and V (p, 2, n), W itself by default, with correlation K (p, p)."""
    others = rows if others is None else others
    if isinstance(correlation, scipy.sparse.csr_array):
        return _sparse_quadratic(correlation.data, correlation.indices, correlation.indptr, rows, others)
    spread = np.asarray(correlation @ others.reshape(len(others), -1)).reshape(others.shape)
    return np.tensordot(rows, spread, axes=([0, 1], [0, 1]))


@njit(cache=True, nogil=True)
def _sparse_quadratic(values, columns, begins, rows, others):
    """`quadratic` with K as the arrays of a sparse matrix by rows; points whose row of W is zero cost nothing."""
    count, size = rows.shape[2], others.shape[2]
    found, spread = np.zeros((count, size)), np.empty((2, size))
    for i in range(len(rows)):
        if not rows[i].any():
            continue
        spread[:] = 0.0
        for e in range(begins[i], begins[i + 1]):
            value, other = values[e], others[columns[e]]
            for c in range(2):
                for b in range(size):
                    spread[c, b] += value * other[c, b]
        for c in range(2):
            for a in range(count):
                entry, line = rows[i, c, a], found[a]
                for b in range(size):
                    line[b] += entry * spread[c, b]
    return found


#: An estimate that takes up more of the variance leaves too little, as a share, to tell how large it is.
LEAST_LEFT = 0.25


class PixelNoise:
    """The variance of a coordinate of a point of weight 1: what stays with the point, and what is new."""

    def __init__(self, memory: float) -> None:
        self._fade, self._count, self._product = np.exp(-1.0 / memory), 0.0, 0.0
        self._before: Array | None = None
        self.common, self.frame = 0.0, 0.0

    def change_points(self) -> None:
        """The next frame's residuals are of other points: they cannot be compared with the last ones."""
        self._before = None

    def add(self, residuals: Array, measured: Observations | RigObservations, taken: float) -> None:
        """Learn from the residuals (p, 2) of a frame; those of the frame before tell what stays.

        ``taken`` is how many numbers' worth of variance the estimate has taken up.
        """
        used = (measured.weights > 0.0) & np.isfinite(residuals).all(axis=1)
        # How many numbers each point gives, by the variance that they have at weight 1.
        worth = measured.numbers * measured.correlation.diagonal()
        numbers = worth[used].sum()
        # In what a point of weight 1 is off by.
        residuals = np.where(used[:, None], np.sqrt(measured.weights)[:, None] * residuals, np.nan)
        total = max(np.nansum(residuals**2) / max(numbers - taken, LEAST_LEFT * numbers, 1), LEAST_SPREAD_PX**2)
        if self._before is not None:
            products = residuals * self._before
            pairs = np.isfinite(products).all(axis=1)
            # A point of an outline is off across it alone: its pair of products is that of one number.
            self._count = self._fade * self._count + worth[pairs].sum()
            self._product = self._fade * self._product + np.nansum(products)
        self._before = residuals
        # As long as there is nothing to compare with, all of it is taken to stay.
        stays = self._product / self._count if self._count else np.inf
        self.common = float(np.clip(stays, 0.0, total))
        self.frame = float(total - self.common)


#: With differences that are independent from pixel to pixel f is 1; blur makes neighbours alike, so that they
#: count as fewer. A larger f is no noise of the patches but what the model leaves, where it moves them most.
LARGEST_FACTOR = 4.0
#: Larger powers of what the patches tell would leave few points to decide.
LARGEST_POWER = 1.5
#: Share of the latest frame in what is learnt, and points that it must have to tell.
LEARNING_RATE, LEAST_POINTS = 0.05, 20
#: The length of a Gaussian pair has this median, in standard deviations of a coordinate (Rayleigh).
MEDIAN_OF_PAIR = 1.1774


class PointNoise:
    """Weights of points; all the same until frames were learnt from.

    What the patches of a point differ by says how exactly it was found, s; a model that is a little off
    leaves residuals that all points have alike. A residual's variance is f s² + t, and where the model leaves
    nothing f s^2p, because a part of a window that is covered moves what is found as a whole; f, t and the
    power p are learnt from the residuals of the frames.

    Attributes
    ----------
    common : t / f in squared pixels; infinite where the patches do not tell how exact a point is.
    power : p; 1 where the patches tell too little, or the model leaves something.
    """

    def __init__(self) -> None:
        self._moments: Array | None = None
        self.common, self.power = np.inf, 1.0

    def weights(self, spread: Array, used: NDArray[np.bool_]) -> Array:
        """Inverse variances (p,), in that of a typical point; zero for points that are not ``used`` (p,).

        ``spread`` (p,) is what the patches tell, see `compare_patches`.
        """
        if np.isinf(self.common) or not used.any():
            return used.astype(float)
        variance = spread**2 + self.common
        if self.power != 1.0:
            variance = variance**self.power
        return np.where(used, middle(variance[used]) / variance, 0.0)

    def learn(self, spread: Array, residuals: Array, used: NDArray[np.bool_]) -> None:
        """Take in the residuals (p, 2) of a frame: of the better half of the points and of the other."""
        used = used & np.isfinite(spread) & np.isfinite(residuals).all(axis=1)
        if used.sum() < LEAST_POINTS:
            return
        spread, length = spread[used], np.linalg.norm(residuals[used], axis=1)
        better = spread <= middle(spread)
        if better.all():
            return
        moments = np.array(
            [[middle(spread[half]) ** 2, (middle(length[half]) / MEDIAN_OF_PAIR) ** 2] for half in (better, ~better)]
        )
        if moments[:, 1].max() < LEAST_SPREAD_PX**2:
            return  # the reference picture itself, which tells nothing of noise
        before = moments if self._moments is None else self._moments
        self._moments = before + LEARNING_RATE * (moments - before)
        self.common = _common_variance(self._moments)
        self.power = 1.0
        if self.common <= LEAST_SPREAD_PX**2:
            expected, squared = np.log(np.maximum(self._moments.T, 1e-300))
            self.power = float(np.clip((squared[1] - squared[0]) / (expected[1] - expected[0]), 1.0, LARGEST_POWER))


def _common_variance(moments: Array) -> float:
    """`PointNoise.common` of the moments (2, 2), expected and shown, of the better half and the other."""
    expected, squared = moments.T
    factor = min((squared[1] - squared[0]) / max(expected[1] - expected[0], 1e-300), LARGEST_FACTOR)
    return max(float(squared.mean() / factor - expected.mean()), LEAST_SPREAD_PX**2) if factor > 0.0 else np.inf


def middle(values: Array) -> float:
    """The upper median of numbers (n,); numpy's own takes five times as long for some hundred."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])
