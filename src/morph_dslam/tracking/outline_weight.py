"""How much the outline counts beside texture, and which of its points agree.

The errors of either have a variance, and are alike in neighbours. Both are learnt from the frames as components of one
fit (Rao, J. Multivariate Analysis 1, 257, 1971): residuals are larger than they seem by what the estimate has taken
up of them. The ratio of what one independent number of each is worth is the outline's weight. Clutter that it is
mistaken for thus lowers its weight, and texture that agrees badly with the model raises it. What the texture's points
have in common because the reference state is off is no noise of either: `reference_correction` takes it out.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
from numba import njit
from numpy.typing import NDArray

from morph_dslam.even_rows import evenly
from morph_dslam.tracking.covariance import LEAST_SPREAD_PX as LEAST_NOISE_PX
from morph_dslam.tracking.noise import middle
from morph_dslam.tracking.outline import OutlineMeasurement

Array = NDArray[np.float64]
#: Share of the latest frame in what is learnt.
LEARNING_RATE = 0.1
#: Errors of points within so many pixels of each other are compared.
NEAR_PX = 40.0
#: The errors of an outline are alike over this length before any frame has shown it, pixels.
FIRST_LENGTH_PX = 8.0
#: The outline is known no better than by this, pixels: where a rounded edge turns away is no line.
LEAST_SPREAD_PX = 0.1
#: As a whole an outline may be off by this much or more in each direction, and outwards; a standard deviation, pixels.
LEAST_COMMON_PX = 0.1
#: Standard deviations beyond which a point does not agree, and the least such limit, pixels.
AGREEING_SIGMAS, LEAST_LIMIT_PX = 3.0, 0.5
#: The same limit where the outline is alone: as long as the state is wrong all of it is off.
LEAST_ALONE_PX = 1.0
#: How many times its usual spread that of an outline that is alone may be.
MOST_UNUSUAL = 1.5
#: The median of the absolute value of a Gaussian number, in standard deviations.
MEDIAN_OF_NUMBER = 0.6745
#: Fewer points do not tell how exact they are.
LEAST_POINTS = 12
#: Of so many of the texture's points, the nearest to one of the outline, so many must be found, or something covers
#: both. Chosen on rendered sheets; one and three do nearly as well.
NEIGHBOURS, LEAST_NEIGHBOURS = 5, 2
#: Pairs are made of no more points than these.
MOST_COMPARED = 100
#: What an estimate leaves of the numbers is at least this share of them.
LEAST_LEFT = 0.25


class ErrorComponent:
    """How large the errors of one kind of measurement are, and how alike those of neighbours; learnt from frames.

    Attributes
    ----------
    variance : of a number, squared pixels; NaN until something was learnt.
    redundancy : how many points count as one.
    """

    def __init__(self) -> None:
        self.variance, self.redundancy = np.nan, 1.0
        self._alike, self._apart = float(np.exp(-NEAR_PX / FIRST_LENGTH_PX)), NEAR_PX

    def learn(self, pixels: Array, residuals: Array, variance: float) -> None:
        """Take in a frame.

        Parameters
        ----------
        pixels : (p, 2) of the points that agree
        residuals : (p, k) their errors.
        variance : of a number, that they show.
        """
        if len(pixels) < LEAST_POINTS or not np.isfinite(variance):
            return
        compared = evenly(len(pixels), MOST_COMPARED)
        some = pixels[compared]
        alike, apart = near_products(some, residuals[compared])
        alike /= max(float(np.mean(residuals**2)), 1e-300)
        rate = 1.0 if np.isnan(self.variance) else LEARNING_RATE
        self.variance = variance if rate == 1.0 else self.variance + rate * (variance - self.variance)
        self._alike += rate * (alike - self._alike)
        self._apart += rate * (apart - self._apart)
        count = 1.0 + (len(pixels) - 1) * float(mean_correlation(some, self.length))
        self.redundancy += rate * (count - self.redundancy)

    @property
    def independent(self) -> float:
        """Variance of a number times how many points count as one: what one independent number is worth."""
        return self.redundancy * self.variance

    @property
    def length(self) -> float:
        """Over which the errors are alike, pixels, by a factor e: as of a Markov process."""
        return -self._apart / float(np.log(np.clip(self._alike, 1e-9, 0.98)))


class OutlineBalance:
    """What is learnt of texture and outline.

    Attributes
    ----------
    texture, outline : of either.
    """

    def __init__(self) -> None:
        self.texture, self.outline = ErrorComponent(), ErrorComponent()

    @property
    def weight(self) -> float:
        """Of a point of the outline, one of the texture being 1; zero until something was learnt of both."""
        if np.isnan(self.texture.variance) or np.isnan(self.outline.variance):
            return 0.0
        ours = self.outline.redundancy * max(self.outline.variance, LEAST_SPREAD_PX**2)
        return self.texture.independent / ours

    @property
    def common_px(self) -> float:
        """What the outline may be off by as a whole, see `whole_deviation`."""
        return whole_deviation(self.outline.variance)

    def correlation(self, seen: OutlineMeasurement) -> scipy.sparse.csr_array:
        """Of the errors (p, p) of the outline's points; those that do not count have none in common.

        As of `Observations`: beside texture a point's variance is not what its weight says. That is less by as much as
        neighbours err alike, which counts here, and no more than `LEAST_SPREAD_PX` allows.
        """
        count, said = len(seen.pixels), 1.0
        if not (np.isnan(self.texture.variance) or np.isnan(self.outline.variance)):
            weight = float(seen.weights.max(initial=0.0))  # the same for all that count
            said = weight * self.outline.variance / self.texture.variance
        return scipy.sparse.csr_array(_alike(seen.pixels, seen.valid, self.outline.length, said), shape=(count, count))

    def suppose_exact_outline(self, seen: OutlineMeasurement) -> bool:
        """Begin with an outline as exact as one can be, if enough points can tell then how exact it is.

        In the state that a wrong registration gives, residuals tell of that alone.
        """
        pixels = seen.pixels[seen.valid]
        if len(pixels) < LEAST_POINTS:
            return False
        alike = float(mean_correlation(pixels[evenly(len(pixels), MOST_COMPARED)], FIRST_LENGTH_PX))
        self.outline = ErrorComponent()
        self.outline.variance, self.outline.redundancy = LEAST_SPREAD_PX**2, 1.0 + (len(pixels) - 1) * alike
        return True

    def agreeing(self, residuals: Array) -> NDArray[np.bool_]:
        """Which of the outline's points (p,) agree with an estimate that leaves these residuals (p, 2)."""
        spread = LEAST_SPREAD_PX if np.isnan(self.outline.variance) else float(np.sqrt(self.outline.variance))
        limit = max(AGREEING_SIGMAS * spread, LEAST_LIMIT_PX)
        return np.hypot(*residuals.T) < limit

    def agreeing_alone(self, seen: OutlineMeasurement, residuals: Array, near: bool) -> NDArray[np.bool_]:
        """Which of the outline's points (p,) agree with the others, in a frame without texture.

        Parameters
        ----------
        residuals : (p, 2) what an estimate from them leaves.
        near : whether it is nearly right: then they spread as usual, or something else is seen beside the object.
        """
        away = np.hypot(*residuals.T)
        spread = float(np.median(away[seen.valid])) / MEDIAN_OF_NUMBER if seen.valid.any() else 0.0
        if near and not np.isnan(self.outline.variance):
            spread = min(spread, MOST_UNUSUAL * float(np.sqrt(self.outline.variance)))
        return away < max(AGREEING_SIGMAS * spread, LEAST_ALONE_PX)

    def in_common(self, seen: OutlineMeasurement, residuals: Array) -> float:
        """Root mean product of what neighbours on the outline are off by together, pixels."""
        across = np.einsum("pk,pk->p", residuals, seen.normals)[seen.valid]
        return float(np.sqrt(max(near_products(seen.pixels[seen.valid], across[:, None])[0], 0.0)))

    def learn_outline(self, seen: OutlineMeasurement, residuals: Array, taken: float, anew: bool = False) -> None:
        """Take in the residuals (p, 2) of the outline.

        Parameters
        ----------
        taken : how many numbers the estimate takes up.
        anew : whether to forget what was learnt or supposed before.
        """
        if anew:
            self.outline = ErrorComponent()
        used = seen.valid
        across = np.einsum("pk,pk->p", residuals, seen.normals)[used]
        if not len(across):
            return
        left = max(len(across) - self.outline.redundancy * taken, LEAST_LEFT * len(across))
        robust = middle(np.abs(across)) / MEDIAN_OF_NUMBER
        near = np.abs(across) < AGREEING_SIGMAS * max(robust, LEAST_SPREAD_PX)
        variance = robust**2 * len(across) / left
        self.outline.learn(seen.pixels[used][near], across[near, None], float(variance))


def whole_deviation(variance: float) -> float:
    """What an outline may be off by as a whole, a standard deviation, pixels: as much as its single points are.

    Residuals do not tell of it, as the state takes it up. But what displaces single points, such as clutter, an edge
    that is rounded or a model that is off, may displace them together.

    Parameters
    ----------
    variance : of a single point, squared pixels; NaN where it is not known.
    """
    return LEAST_COMMON_PX if np.isnan(variance) else max(LEAST_COMMON_PX, float(np.sqrt(variance)))


def mean_square(residuals: Array, weights: Array, n_unknowns: int) -> float:
    """Variance of a number of weight one, by residuals (p, 2) with weights (p,), a few unknowns being fitted to them.

    Points that are far off count in an estimate by their squares, so that the mean says how exact it is: a median tells
    of the better half. Among few points of a smooth surface some are always worse, such as those near its rim.
    """
    numbers = 2 * len(residuals)
    left = max(numbers - n_unknowns, LEAST_LEFT * numbers, 1)
    return max(float(weights @ np.sum(residuals**2, axis=1)) / left, LEAST_NOISE_PX**2)


@njit(cache=True, nogil=True)
def _alike(pixels, counts, length, variance):
    """Values, columns and beginnings of the rows of variance exp(-d / length) of pairs that count.

    Others have ones on the diagonal.
    """
    rows = np.flatnonzero(counts)
    begins = np.zeros(len(pixels) + 1, np.int32)
    for i in range(len(pixels)):
        begins[i + 1] = begins[i] + (len(rows) if counts[i] else 1)
    values, columns = np.ones(begins[-1]), np.empty(begins[-1], np.int32)
    for i in range(len(pixels)):
        if not counts[i]:
            columns[begins[i]] = i
    for a in range(len(rows)):
        i = rows[a]
        values[begins[i] + a], columns[begins[i] + a] = variance, i
        for b in range(a):
            j = rows[b]
            squared = (pixels[i, 0] - pixels[j, 0]) ** 2 + (pixels[i, 1] - pixels[j, 1]) ** 2
            alike = variance * np.exp(-np.sqrt(squared) / length)
            values[begins[i] + b] = values[begins[j] + a] = alike
            columns[begins[i] + b], columns[begins[j] + a] = j, i
    return values, columns, begins


@njit(cache=True, nogil=True)
def near_products(pixels, residuals):
    """Mean product, by number, of residuals (p, k) of points within `NEAR_PX`, and their mean distance."""
    total, apart, pairs = 0.0, 0.0, 0
    for i in range(len(pixels)):
        for j in range(i):
            squared = (pixels[i, 0] - pixels[j, 0]) ** 2 + (pixels[i, 1] - pixels[j, 1]) ** 2
            if squared < NEAR_PX * NEAR_PX:
                pairs += 1
                apart += np.sqrt(squared)
                for k in range(residuals.shape[1]):
                    total += residuals[i, k] * residuals[j, k]
    if pairs == 0:
        return 0.0, NEAR_PX
    return total / (pairs * residuals.shape[1]), max(apart / pairs, 1.0)


@njit(cache=True, nogil=True)
def beside_found(pixels, texture, found):
    """Which points (p,) have `LEAST_NEIGHBOURS` that were found among the `NEIGHBOURS` nearest of the texture.

    Parameters
    ----------
    pixels : (p, 2) of the points.
    texture : (n, 2) where the texture's points should be seen; NaN for those that should not.
    found : (n,) which of them were found there.
    """
    result = np.ones(len(pixels), np.bool_)
    nearest, is_found = np.empty(NEIGHBOURS), np.empty(NEIGHBOURS, np.bool_)
    for i in range(len(pixels)):
        count, farthest = 0, np.inf
        for j in range(len(texture)):
            squared = (pixels[i, 0] - texture[j, 0]) ** 2 + (pixels[i, 1] - texture[j, 1]) ** 2
            if not squared < farthest:
                continue
            count = min(count + 1, NEIGHBOURS)
            k = count - 1
            while k > 0 and nearest[k - 1] > squared:
                nearest[k], is_found[k] = nearest[k - 1], is_found[k - 1]
                k -= 1
            nearest[k], is_found[k] = squared, found[j]
            if count == NEIGHBOURS:
                farthest = nearest[-1]
        result[i] = is_found[:count].sum() >= min(count, LEAST_NEIGHBOURS)
    return result


@njit(cache=True, nogil=True)
def mean_correlation(pixels, length):
    """Mean of exp(-d / length) over all pairs of different points (p, 2)."""
    total, count = 0.0, len(pixels)
    for i in range(count):
        for j in range(i):
            squared = (pixels[i, 0] - pixels[j, 0]) ** 2 + (pixels[i, 1] - pixels[j, 1]) ** 2
            total += np.exp(-np.sqrt(squared) / length)
    return total / max(0.5 * count * (count - 1), 1.0)
