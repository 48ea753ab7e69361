"""Where the edge of an object is in a profile of the image across it.

Where a surface ends, or has a sharp edge, that is the steepest place. Where a smooth one turns away it is not: its
brightness changes as its normal does, with the square root of the distance from the contour, fastest right there. On
a ground about as bright as the rim that slope is all that the image shows, and its steepest place lies one or two
pixels inside. So both sides are fitted by least squares, for all places of the edge in turn, and the best one counts.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

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
#: Pixels inside and outside of an edge that are compared with the fit.
INSIDE_PX, OUTSIDE_PX = 5, 4
#: An edge whose place the fit knows less well is not used: standard deviation, pixels.
LARGEST_STD_PX = 0.5
#: Noise of a grey level, at least.
NOISE = 1.0
#: Blur of an edge by lens, pixels and smoothing, standard deviation, pixels.
BLUR_PX = 0.7
#: How a profile may vary with the distance from the edge: powers of it, inside and outside.
INSIDE_POWERS, OUTSIDE_POWERS = (0.0, 0.5, 1.0), (0.0, 1.0)


def _edge_bases() -> Array:
    """Orthonormal profiles (k, w, b) of blurred edges at k places, in the w pixels about a candidate."""
    places = np.arange(FIRST_PX, LAST_PX + STEP_PX / 2.0, STEP_PX)
    pixels = np.arange(FIRST_PX - INSIDE_PX, LAST_PX + OUTSIDE_PX + 1)
    blur = np.linspace(-4.0 * BLUR_PX, 4.0 * BLUR_PX, 81)
    weights = np.exp(-0.5 * (blur / BLUR_PX) ** 2)
    away = pixels[None, :, None] - places[:, None, None] + blur  # (k, w, 81)
    inside = [np.where(away < 0.0, np.abs(away) ** power, 0.0) @ weights for power in INSIDE_POWERS]
    outside = [np.where(away >= 0.0, np.abs(away) ** power, 0.0) @ weights for power in OUTSIDE_POWERS]
    return np.ascontiguousarray(np.linalg.qr(np.stack([*inside, *outside], axis=2))[0])


EDGE_BASES = _edge_bases()
#: Profiles are read so much farther than candidates are looked for, pixels.
MARGIN_PX = max(INSIDE_PX - FIRST_PX, OUTSIDE_PX + LAST_PX)


@njit(cache=True, nogil=True)
def _read_profile(grey, x, y, nx, ny, first, profile):
    """Fill a profile with the image along a normal from ``first`` pixels on; NaN beyond the border."""
    height, width = grey.shape
    for k in range(len(profile)):
        u, v = x + (k + first) * nx, y + (k + first) * ny
        profile[k] = np.nan
        if u < 0.0 or v < 0.0 or u >= width - 1 or v >= height - 1:
            continue
        u0, v0 = int(u), int(v)
        a, b = u - u0, v - v0
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
    """Where a profile is steepest near a place, to a fraction of a pixel by a parabola; NaN if it is not nearby."""
    first, last = max(middle - STEEPEST_PX, 1), min(middle + STEEPEST_PX, len(profile) - 2)
    top = -1
    for k in range(first, last + 1):
        slopes[k] = abs(profile[k + 1] - profile[k - 1])
        if np.isfinite(slopes[k]) and (top < 0 or slopes[k] > slopes[top]):
            top = k
    if not middle - STEEPEST_PX < top < middle + STEEPEST_PX:
        return np.nan
    bend = slopes[top - 1] - 2.0 * slopes[top] + slopes[top + 1]
    shift = 0.5 * (slopes[top - 1] - slopes[top + 1]) / bend if bend < 0.0 else 0.0
    return top + min(max(shift, -0.5), 0.5)


@njit(cache=True, nogil=True)
def _where_it_turns_away(profile, middle):
    """Where the edge of a surface that turns away is near a place in a profile; NaN if it is not well known there."""
    n_places, width, n_terms = EDGE_BASES.shape
    first = middle + FIRST_PX - INSIDE_PX
    values = profile[first : first + width] - np.mean(profile[first : first + width])
    total = np.sum(values**2)
    if not np.isfinite(total):
        return np.nan
    explained, top = np.zeros(n_places), 0  # sums of squares
    for k in range(n_places):
        for term in range(n_terms):
            product = 0.0
            for i in range(width):
                product += EDGE_BASES[k, i, term] * values[i]
            explained[k] += product * product
        if explained[k] > explained[top]:
            top = k
    if not 0 < top < n_places - 1:
        return np.nan
    before, after = explained[top - 1], explained[top + 1]
    bend = 2.0 * explained[top] - before - after
    # Where the sum of squares that is left is larger by a variance of the noise is one standard deviation off.
    squared = 2.0 * STEP_PX**2 * max((total - explained[top]) / (width - n_terms - 1), NOISE**2)
    if not bend * LARGEST_STD_PX**2 > squared:
        return np.nan
    return middle + FIRST_PX + STEP_PX * (top + 0.5 * (after - before) / bend)


@njit(cache=True, nogil=True)
def search_outline(grey, pixels, normals, turns_away, brightness, reach):
    """Signed distances (p,) along the normals to the edge that is most likely the outline, or NaN.

    A candidate's inner side must be as bright as it was within the tolerance, where that is known (not NaN). Its score
    is the contrast of both sides, times how well they look as the object did, and halves at half the reach: what is
    near is more likely the outline. The edge is then placed near the best one.

    Parameters
    ----------
    grey : (h, w) image.
    pixels, normals : (p, 2).
    turns_away : (p,) whether a smooth surface turns away there.
    brightness : (p, 2, `SIDE_PX`) of the object inside and outside, from one pixel off on.
    reach : how far to search, pixels.
    """
    length = 2 * (reach + MARGIN_PX) + 1
    profile, slopes, steps = np.empty(length), np.empty(length), np.empty(2 * reach + 1)
    result = np.full(len(pixels), np.nan)
    for j in range(len(pixels)):
        inside, outside = np.mean(brightness[j, 0, 1:]), np.mean(brightness[j, 1, 1:])
        if not np.isfinite(pixels[j, 0]) or abs(inside - outside) < LEAST_CONTRAST:
            continue
        _read_profile(grey, pixels[j, 0], pixels[j, 1], normals[j, 0], normals[j, 1], -reach - MARGIN_PX, profile)
        best = _best_step(profile, brightness[j], inside, reach, steps)
        if best < 0:
            continue
        middle = best + MARGIN_PX
        edge = _where_it_turns_away(profile, middle) if turns_away[j] else _steepest(profile, middle, slopes)
        result[j] = edge - MARGIN_PX - reach
    return result
