"""Where the edge of an object is in a profile of the image across it.

Where a surface ends, or has a sharp edge, that is the steepest place. Where a smooth one turns away it is not: its
brightness changes as its normal does, with the square root of the distance from the contour, fastest right there. On
a ground about as bright as the rim that slope is all that the image shows, and its steepest place lies one or two
pixels inside. Nor is it in something narrow, as the other edge's blur reaches there. In both cases the edge is fitted
with all that is beside it (`blurred_edges`). All edges together tell how blurred the picture is.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.tracking.blurred_edges import (
    N_COLUMNS,
    NARROW,
    NOISE,
    SMOOTH,
    fill_columns,
    fit_edge,
    make_orthonormal,
)

Array = NDArray[np.float64]
#: Pixels averaged on each side of a candidate.
SIDE_PX = 4
#: Grey levels by which the two sides must differ.
LEAST_CONTRAST = 10.0
#: Largest difference of the inner side from its brightness in the first picture, relative to that; shading
#: changes it as the surface bends.
BRIGHTNESS_TOLERANCE = 0.35
#: Grey levels by which a side may differ from it until the candidate's score halves.
LIKELY_LEVELS = 12.0
#: How far from a candidate the steepest place is looked for, pixels.
STEEPEST_PX = 3
#: How far inwards and outwards of a candidate, which shading draws inwards, a surface is expected to turn away, and in
#: which steps, pixels.
FIRST_PX, LAST_PX, STEP_PX = -2, 5, 0.5
N_PLACES = 15
#: Pixels inside and outside of an edge that are compared with the fit.
INSIDE_PX, OUTSIDE_PX = 5, 4
#: An edge whose place the fit knows less well is not used: standard deviation, pixels.
LARGEST_STD_PX = 0.5
#: How far from the start of a fit its edge is looked for, pixels.
FARTHEST_PX = 1.0
#: Blur of an edge by lens and pixels, standard deviation, pixels, before a picture has shown it, and that of this
#: number. Reading between pixels adds this variance on average.
BLUR_PX, BLUR_STD_PX, MEAN_READ = 0.65, 0.3, 1.0 / 6.0
#: It is taken to be between these, pixels, and changes by no more than this at once.
LEAST_BLUR_PX, MOST_BLUR_PX, MOST_CHANGE_PX = 0.25, 2.5, 0.2
#: What is no wider than this is narrow, pixels, and so many pixels beyond either edge are compared with the fit then.
NARROW_PX, BESIDE_PX = 6.5, 4
#: Profiles are read so much farther than candidates are looked for, pixels.
MARGIN_PX = max(INSIDE_PX - FIRST_PX, OUTSIDE_PX + LAST_PX)


@njit(cache=True, nogil=True)
def _read_profile(grey, x, y, nx, ny, first, profile, read):
    """Fill a profile with the image along a normal from ``first`` pixels on; NaN beyond the border.

    ``read`` is filled with the variances by which reading between pixels blurs along the normal, squared pixels.
    """
    height, width = grey.shape
    for k in range(len(profile)):
        u, v = x + (k + first) * nx, y + (k + first) * ny
        profile[k] = np.nan
        if u < 0.0 or v < 0.0 or u >= width - 1 or v >= height - 1:
            continue
        u0, v0 = int(u), int(v)
        a, b = u - u0, v - v0
        read[k] = nx * nx * a * (1.0 - a) + ny * ny * b * (1.0 - b)
        above = (1.0 - a) * grey[v0, u0] + a * grey[v0, u0 + 1]
        below = (1.0 - a) * grey[v0 + 1, u0] + a * grey[v0 + 1, u0 + 1]
        profile[k] = (1.0 - b) * above + b * below


@njit(cache=True, nogil=True)
def _likelihood(profile, middle, brightness):
    """How well both sides (2, n) of a place in a profile look as the object did there; 1 where that is not known."""
    result = 1.0
    for which in range(2):
        differs, count = 0.0, 0
        for i in range(1, brightness.shape[1]):  # what is right at the contour is blurred with the other side
            there = brightness[which, i]
            if np.isfinite(there):
                differs += abs(profile[middle + (2 * which - 1) * (i + 1)] - there)
                count += 1
        if count:
            result /= 1.0 + (differs / count / LIKELY_LEVELS) ** 2
    return result


@njit(cache=True, nogil=True)
def _best_step(profile, brightness, inside, reach, steps):
    """Index of the best of the candidates whose contrasts fill ``steps`` (2 reach + 1,); -1 if there is none."""
    best, highest = -1, 0.0
    for k in range(len(steps)):
        inner, outer = 0.0, 0.0
        for i in range(1, SIDE_PX + 1):
            inner += profile[k + MARGIN_PX - i]
            outer += profile[k + MARGIN_PX + i]
        inner, outer = inner / SIDE_PX, outer / SIDE_PX
        steps[k] = abs(inner - outer)
        if not np.isfinite(steps[k]) or abs(inner - inside) > BRIGHTNESS_TOLERANCE * inside + LEAST_CONTRAST:
            steps[k] = 0.0
        if steps[k] <= LEAST_CONTRAST:
            continue
        away = 2.0 * (k - reach) / reach
        score = steps[k] / (1.0 + away * away) * _likelihood(profile, k + MARGIN_PX, brightness)
        if best < 0 or score > highest:
            best, highest = k, score
    # The nearest one may be on the slope of a step: its top is where the step is.
    while 0 < best < 2 * reach and max(steps[best - 1], steps[best + 1]) > steps[best]:
        best += 1 if steps[best + 1] > steps[best - 1] else -1
    return best if 0 < best < 2 * reach else -1


@njit(cache=True, nogil=True)
def _steepest(profile, middle, slopes):
    """Where a profile is steepest near a place, to a fraction of a pixel by a parabola; NaN if it is not nearby.

    It rises or falls there as it does about ``middle``: nearby something narrow may have its other edge.
    """
    sign = 0.0
    for i in range(1, SIDE_PX + 1):
        sign += profile[middle + i] - profile[middle - i]
    sign = np.sign(sign)
    first, last = max(middle - STEEPEST_PX, 1), min(middle + STEEPEST_PX, len(profile) - 2)
    top = -1
    for k in range(first, last + 1):
        slopes[k] = sign * (profile[k + 1] - profile[k - 1])
        if np.isfinite(slopes[k]) and (top < 0 or slopes[k] > slopes[top]):
            top = k
    if not middle - STEEPEST_PX < top < middle + STEEPEST_PX:
        return np.nan
    bend = slopes[top - 1] - 2.0 * slopes[top] + slopes[top + 1]
    shift = 0.5 * (slopes[top - 1] - slopes[top + 1]) / bend if bend < 0.0 else 0.0
    return top + min(max(shift, -0.5), 0.5)


@njit(cache=True, nogil=True)
def _smooth_bases(blur):
    """Orthonormal profiles (k, b, w) of surfaces that turn away at k places, in the w pixels about a candidate."""
    count, width = N_COLUMNS[SMOOTH], LAST_PX - FIRST_PX + INSIDE_PX + OUTSIDE_PX + 1
    columns, slopes, bends = np.empty((count, width)), np.empty((count, width)), np.empty((count, width))
    bases, taken, unused = np.empty((N_PLACES, count, width)), np.empty((count, count)), np.empty(width)
    blurs = np.full(width, np.sqrt(blur * blur + MEAN_READ))
    for k in range(N_PLACES):
        fill_columns(SMOOTH, INSIDE_PX + STEP_PX * k, 0.0, blurs, columns, slopes, bends, unused)
        make_orthonormal(columns, bases[k], taken)
    return bases


@njit(cache=True, nogil=True)
def _where_it_turns_away(values, bases):
    """About where in grey levels (w,) a surface turns away, counted from the first one; NaN if it is not well known."""
    explained, top = np.zeros(len(bases)), 0  # sums of squares
    for k in range(len(bases)):
        for term in range(bases.shape[1]):
            product = 0.0
            for i in range(len(values)):
                product += bases[k, term, i] * values[i]
            explained[k] += product * product
        if explained[k] > explained[top]:
            top = k
    if not 0 < top < len(bases) - 1:
        return np.nan
    before, after = explained[top - 1], explained[top + 1]
    bend, total = 2.0 * explained[top] - before - after, 0.0
    for i in range(len(values)):
        total += values[i] * values[i]
    # Where the sum of squares that is left is larger by a variance of the noise is one standard deviation off.
    squared = 2.0 * STEP_PX**2 * max((total - explained[top]) / (len(values) - bases.shape[1] - 1), NOISE**2)
    if not bend * LARGEST_STD_PX**2 > squared:
        return np.nan
    return INSIDE_PX + STEP_PX * (top + 0.5 * (after - before) / bend)


@njit(cache=True, nogil=True)
def _fitted(profile, read, middle, steepest, width, bases, blur):
    """The edge near a place in a profile, NaN if it is not well known, and what it says of the blur: see `fit_edge`.

    Parameters
    ----------
    profile, read : see `_read_profile`.
    middle : of the candidate.
    steepest : place nearby, where what is narrow is supposed to end.
    width : of the object, pixels; where it is not narrow it turns away.
    bases : see `_smooth_bases`.
    blur : standard deviation, pixels.
    """
    kind = NARROW if width <= NARROW_PX else SMOOTH
    first, stop = middle + FIRST_PX - INSIDE_PX, middle + LAST_PX + OUTSIDE_PX + 1
    if kind == NARROW and np.isfinite(steepest):
        first = max(int(np.rint(steepest - width)) - BESIDE_PX, 0)
        stop = min(int(np.rint(steepest)) + BESIDE_PX + 1, len(profile))
    values = profile[first:stop]
    if not np.isfinite(np.sum(values)):
        return np.nan, 0.0, 0.0
    # Less their mean, lest what is explained of it hides the rest.
    start = steepest - first if kind == NARROW else _where_it_turns_away(values - np.mean(values), bases)
    if not np.isfinite(start):
        return np.nan, 0.0, 0.0
    place, variance, gradient, curvature = fit_edge(kind, values, start, width, blur, read[first:stop])
    if not (variance < LARGEST_STD_PX**2 and abs(place - start) < FARTHEST_PX):
        return np.nan, 0.0, 0.0
    return first + place, gradient, curvature


@njit(cache=True, nogil=True)
def search_outline(grey, pixels, normals, turns_away, widths, brightness, reach, blur):
    """Where along the normals the edge is that is most likely the outline.

    A candidate's inner side must be as bright as it was within the tolerance, where that is known (not NaN). Its score
    is the contrast of both sides, times how well they look as the object did, and halves at half the reach: what is
    near is more likely the outline. The edge is then placed near the best one.

    Parameters
    ----------
    grey : (h, w) image.
    pixels, normals : (p, 2).
    turns_away : (p,) whether a smooth surface turns away there.
    widths : (p,) how wide the object is against the normal, pixels.
    brightness : (p, 2, `SIDE_PX`) of the object inside and outside, from one pixel off on.
    reach : how far to search, pixels.
    blur : of the image, as far as it is known, standard deviation, pixels.

    Returns
    -------
    offsets : (p,) signed distances, or NaN.
    blur : nearer to that of the image.
    """
    length = 2 * (reach + MARGIN_PX) + 1
    profile, read = np.empty(length), np.zeros(length)
    slopes, steps = np.empty(length), np.empty(2 * reach + 1)
    result, bases = np.full(len(pixels), np.nan), _smooth_bases(blur)
    # Of half the chi-squared by the blur, with what is known of it before.
    downwards, curved = (BLUR_PX - blur) / BLUR_STD_PX**2, 1.0 / BLUR_STD_PX**2
    for j in range(len(pixels)):
        inside, outside = np.mean(brightness[j, 0, 1:]), np.mean(brightness[j, 1, 1:])
        if not np.isfinite(pixels[j, 0]) or abs(inside - outside) < LEAST_CONTRAST:
            continue
        _read_profile(grey, pixels[j, 0], pixels[j, 1], normals[j, 0], normals[j, 1], -reach - MARGIN_PX, profile, read)
        best = _best_step(profile, brightness[j], inside, reach, steps)
        if best < 0:
            continue
        edge = _steepest(profile, best + MARGIN_PX, slopes)
        if turns_away[j] or widths[j] <= NARROW_PX:
            edge, gradient, curvature = _fitted(profile, read, best + MARGIN_PX, edge, widths[j], bases, blur)
            downwards, curved = downwards + gradient, curved + curvature
        result[j] = edge - MARGIN_PX - reach
    change = min(max(downwards / curved, -MOST_CHANGE_PX), MOST_CHANGE_PX)
    return result, min(max(blur + change, LEAST_BLUR_PX), MOST_BLUR_PX)
