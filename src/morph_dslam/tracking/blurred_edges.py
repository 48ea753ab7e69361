"""The place of a blurred edge in a profile of grey levels across it, by least squares.

Either side is a sum of powers of the distance from the edge, and a Gaussian blurs both: that of the lens, the pixels
and the reading between them. Where the brightness of a side changes, a blurred edge is not symmetric, and a fit with
another blur has it at another place: what blur is left over passes for a change of brightness. The levels are
eliminated, so that the place, and the width of something narrow, follow by Gauss-Newton steps (variable projection;
Golub and Pereyra, SIAM J. Numer. Anal. 10, 413, 1973). What the residuals say of the blur is summed over edges.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import ndtr

from morph_dslam.row_products import FAST

Array = NDArray[np.float64]
#: Kinds of edges. A smooth surface turns away, where its brightness changes with the square root of the distance too;
#: something narrow ends, which is alike throughout, and so is what is to either side of it. Compiled loops take a plain
#: integer as a type of its own.
SMOOTH, NARROW = np.int64(0), np.int64(1)
#: How many columns each kind has.
N_COLUMNS = (5, 3)
#: Noise of a grey level, at least.
NOISE = 1.0
#: Gauss-Newton steps for each kind, of which the width of something narrow needs the second, and the longest, pixels.
N_STEPS, LONGEST_PX = (1, 2), 0.5
#: A column counts as a sum of others if they leave less than this share of its square.
LEAST_LEFT = 1e-10
#: Ends of the table, and rows for each standard deviation.
FIRST, LAST, PER_UNIT = -6.0, 10.0, 64


def _blurred_steps_and_roots() -> Array:
    """What a unit Gaussian makes of a step and of a square root that begins at 0, by the distance z inside of them.

    Rows of (n, 5) are the step and its derivative, then the root and two derivatives. With x = s² the midpoint rule
    converges fast for the root, too.
    """
    z, step = np.linspace(FIRST, LAST, round((LAST - FIRST) * PER_UNIT) + 1), 2e-3
    root = np.arange(0.5 * step, np.sqrt(LAST - FIRST), step)
    away = z[:, None] - root**2
    weighted = np.exp(-0.5 * away**2) / np.sqrt(2.0 * np.pi) * (2.0 * root**2 * step)
    roots = [weighted, -away * weighted, (away**2 - 1.0) * weighted]
    density = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    return np.column_stack([ndtr(z), density, *(values.sum(axis=1) for values in roots)])


TABLE = _blurred_steps_and_roots()


@njit(cache=True, nogil=True, fastmath=FAST)
def _look_up(z, values):
    """Fill (5,) with the `TABLE` at z."""
    if z >= LAST:
        root = np.sqrt(z)  # the root itself and half its second derivative, as a Gaussian's variance is one
        values[0], values[1] = 1.0, 0.0
        values[2] = root - 0.125 / (z * root)
        values[3], values[4] = 0.5 / root + 0.1875 / (z * z * root), -0.25 / (z * root)
        return
    place = max(z - FIRST, 0.0) * PER_UNIT
    row = min(int(place), len(TABLE) - 2)
    share = place - row
    for k in range(5):
        values[k] = (1.0 - share) * TABLE[row, k] + share * TABLE[row + 1, k]


@njit(cache=True, nogil=True, fastmath=FAST)
def fill_columns(kind, place, width, blurs, columns, slopes, bends, by_width):
    """What the brightness of an edge is a sum of, pixel by pixel, and derivatives by the distance.

    Parameters
    ----------
    kind : `SMOOTH` or `NARROW`.
    place : of the edge, pixels from the first one; what is smaller is inside.
    width : of what is narrow, pixels.
    blurs : (n,) standard deviation at each pixel, pixels.
    columns, slopes, bends : (b, n), filled; constant outside and inside, then a ramp outside and inside and the root
        inside, or constant beyond something narrow.
    by_width : (n,), filled; the derivative of the second column by the width, minus that of the third, if narrow.
    """
    near, far = np.empty(5), np.empty(5)
    for i in range(columns.shape[1]):
        away, blur, root = place - i, blurs[i], np.sqrt(blurs[i])
        z = away / blur
        _look_up(z, near)
        share, density = near[0], near[1] / blur
        bend = -z * density / blur
        columns[0, i], slopes[0, i], bends[0, i] = 1.0 - share, -density, -bend
        columns[1, i], slopes[1, i], bends[1, i] = share, density, bend
        if kind == NARROW:
            z = (away - width) / blur
            _look_up(z, far)
            by_width[i] = far[1] / blur
            bend = -z * by_width[i] / blur
            columns[2, i], slopes[2, i], bends[2, i] = far[0], by_width[i], bend
            columns[1, i] -= far[0]
            slopes[1, i] -= by_width[i]
            bends[1, i] -= bend
            continue
        ramp = away * share + blur * near[1]
        columns[2, i], slopes[2, i], bends[2, i] = away - ramp, 1.0 - share, -density
        columns[3, i], slopes[3, i], bends[3, i] = ramp, share, density
        columns[4, i] = root * near[2]
        slopes[4, i], bends[4, i] = near[3] / root, near[4] / (root * blur)


@njit(cache=True, nogil=True, fastmath=FAST)
def _leave(basis, count, values, products):
    """Take from values (n,), in place, what ``count`` orthonormal rows of a basis explain; the length of what is left.

    ``products`` (b,) are filled with how much of each that was.
    """
    n = len(values)
    for k in range(count):
        product = 0.0
        for i in range(n):
            product += basis[k, i] * values[i]
        for i in range(n):
            values[i] -= product * basis[k, i]
        products[k] = product
    total = 0.0
    for i in range(n):
        total += values[i] * values[i]
    return np.sqrt(total)


@njit(cache=True, nogil=True, fastmath=FAST)
def make_orthonormal(columns, basis, taken):
    """Fill rows of a basis (b, n) with columns (k, n) made orthonormal, one after the other; False if that is not so.

    ``taken`` (k, b) is filled: each column is the sum of the rows up to its own, times these.
    """
    for k in range(len(columns)):
        before = 0.0
        for i in range(columns.shape[1]):
            basis[k, i] = columns[k, i]
            before += columns[k, i] ** 2
        length = _leave(basis, k, basis[k], taken[k])
        if not length * length > LEAST_LEFT * before:
            return False
        taken[k, k] = length
        for i in range(columns.shape[1]):
            basis[k, i] /= length
    return True


@njit(cache=True, nogil=True, fastmath=FAST)
def _factors(taken, products):
    """Turn products (b,) with the rows of a basis into factors of the columns that it was made from, in place."""
    for k in range(len(taken) - 1, -1, -1):
        for m in range(k + 1, len(taken)):
            products[k] -= taken[m, k] * products[m]
        products[k] /= taken[k, k]


@njit(cache=True, nogil=True, fastmath=FAST)
def _linearized(kind, place, width, blur, blurs, basis, left, of_blur):
    """What grey levels are a sum of to first order about an edge.

    Parameters
    ----------
    kind, place, width, blur : see `fit_edge`; blurs : (n,) with what reading adds.
    basis : (b + 1 or 2, n), filled with orthonormal rows: the levels of both sides, the width if narrow, the place.
    left : (n,) the grey levels; what the sides leave of them.
    of_blur : (n,), filled with the derivative by the blur.

    Returns
    -------
    lengths of what the derivatives by width and place have in their own rows, 0 where they have none; and what that by
    the place has in the row of the width.
    """
    n, count = len(left), N_COLUMNS[kind]
    columns, slopes, bends = np.empty((count, n)), np.empty((count, n)), np.empty((count, n))
    taken, products, last = np.empty((count, count)), np.zeros(len(basis)), len(basis) - 1
    of_width = np.zeros(n)
    fill_columns(kind, place, width, blurs, columns, slopes, bends, of_width)
    if not make_orthonormal(columns, basis, taken):
        return 0.0, 0.0, 0.0
    _leave(basis, count, left, products)
    _factors(taken, products)
    for i in range(n):
        basis[last, i] = of_blur[i] = 0.0
        for k in range(count):
            basis[last, i] += products[k] * slopes[k, i]
            of_blur[i] += products[k] * bends[k, i] * blur  # a Gaussian spreads as heat does
    wide = 0.0
    if kind == NARROW:
        for i in range(n):
            basis[count, i] = (products[1] - products[2]) * of_width[i]
        wide = _normalized(basis, count, products)
    size = _normalized(basis, last, products)
    return wide, size, products[count]


@njit(cache=True, nogil=True, fastmath=FAST)
def _normalized(basis, row, products):
    """Make a row of a basis orthonormal to those before it; its length before, or 0 where nothing is left of it."""
    length = _leave(basis, row, basis[row], products)
    if not length > 0.0:
        return 0.0
    for i in range(basis.shape[1]):
        basis[row, i] /= length
    return length


@njit(cache=True, nogil=True, fastmath=FAST)
def fit_edge(kind, values, place, width, blur, read):
    """The place of an edge in grey levels (n,), from near there on.

    Parameters
    ----------
    kind : `SMOOTH` or `NARROW`.
    place : where it is supposed, counted from the first grey level, pixels.
    width : supposed, of what is narrow, pixels.
    blur : of the image, standard deviation, pixels; read : (n,) variances that reading adds.

    Returns
    -------
    place : pixels; NaN where it does not follow.
    variance : of it, squared pixels.
    gradient, curvature : of half of the chi-squared by the blur, 1 / px and 1 / px², the first one downwards.
    """
    n, rows = len(values), N_COLUMNS[kind] + (2 if kind == NARROW else 1)
    basis, left, of_blur, products = np.empty((rows, n)), np.empty(n), np.empty(n), np.empty(rows)
    gradient, size, rest, blurs = 0.0, 0.0, 0.0, np.sqrt(blur * blur + read)
    for _ in range(N_STEPS[kind] if n > rows else 0):
        for i in range(n):
            left[i] = values[i]
        wide, size, shared = _linearized(kind, place, width, blur, blurs, basis, left, of_blur)
        if not size > 0.0 or (kind == NARROW and not wide > 0.0):
            return np.nan, np.nan, 0.0, 0.0
        rest = _leave(basis, rows, left, products)  # products with what the sides leave are those of place and width
        shift = min(max(products[rows - 1] / size, -LONGEST_PX), LONGEST_PX)
        place += shift
        if kind == NARROW:
            wider = (products[rows - 2] - shared * shift) / wide
            width += min(max(wider, -LONGEST_PX), LONGEST_PX)
    if not size > 0.0:
        return np.nan, np.nan, 0.0, 0.0
    noise = max(rest**2 / (n - rows), NOISE**2)
    change = _leave(basis, rows, of_blur, products)
    for i in range(n):
        gradient += of_blur[i] * left[i]
    return place, noise / size**2, gradient / noise, change**2 / noise
