"""Compiled values and derivatives of the one-dimensional bases of `basis_functions`, one point at a time."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

CHEBYSHEV, SPLINE, FOURIER, KRIGING = range(4)
KINDS = {"chebyshev": CHEBYSHEV, "spline": SPLINE, "fourier": FOURIER, "kriging": KRIGING}


@njit(cache=True, nogil=True)
def _fill_chebyshev(n, lower, upper, x, out):
    scale = 2.0 / (upper - lower)
    xi = (x - lower) * scale - 1.0
    out[:, 0] = 0.0
    out[0, 0] = 1.0
    if n > 1:
        out[0, 1], out[1, 1], out[2, 1] = xi, scale, 0.0
    for j in range(2, n):
        out[0, j] = 2.0 * xi * out[0, j - 1] - out[0, j - 2]
        out[1, j] = 2.0 * scale * out[0, j - 1] + 2.0 * xi * out[1, j - 1] - out[1, j - 2]
        out[2, j] = 4.0 * scale * out[1, j - 1] + 2.0 * xi * out[2, j - 1] - out[2, j - 2]


@njit(cache=True, nogil=True)
def _fill_fourier(n, lower, upper, x, out):
    omega = 2.0 * math.pi / (upper - lower)
    out[:, 0] = 0.0
    out[0, 0] = 1.0
    for j in range(1, (n - 1) // 2 + 1):
        w = j * omega
        c, s = math.cos(w * (x - lower)), math.sin(w * (x - lower))
        out[0, 2 * j - 1], out[1, 2 * j - 1], out[2, 2 * j - 1] = c, -w * s, -w * w * c
        out[0, 2 * j], out[1, 2 * j], out[2, 2 * j] = s, w * c, -w * w * s


@njit(cache=True, nogil=True)
def _fill_kriging(n, knots, x, out):
    """Matern-5/2: (1 + a r + a^2 r^2 / 3) exp(-a r), a = sqrt(5) / length; knots = [length, centres]."""
    a = math.sqrt(5.0) / knots[0]
    for j in range(n):
        difference = x - knots[1 + j]
        ar = a * abs(difference)
        decay = math.exp(-ar)
        out[0, j] = (1.0 + ar + ar * ar / 3.0) * decay
        out[1, j] = -a * a / 3.0 * difference * (1.0 + ar) * decay
        out[2, j] = -a * a / 3.0 * (1.0 + ar - ar * ar) * decay


@njit(cache=True, nogil=True)
def _fill_spline(n, degree, knots, x, out):
    """Cox-de Boor on the knot span of x; the two derivatives come from the lower degrees met on the way."""
    out[:, :] = 0.0
    span = degree
    while span < n - 1 and x >= knots[span + 1]:
        span += 1
    table = np.zeros((3, degree + 1))  # the last row after the loop is of full degree
    row = np.zeros(degree + 1)
    row[0] = 1.0
    for p in range(1, degree + 1):
        if degree - p < 2:  # degree - 2 and degree - 1 are kept for the derivatives
            table[degree - p + 1, :p] = row[:p]
        carried = 0.0
        for j in range(p):
            left, right = knots[span + 1 - p + j], knots[span + 1 + j]
            part = row[j] / (right - left)
            row[j] = carried + (right - x) * part
            carried = (x - left) * part
        row[p] = carried
    first = span - degree
    for j in range(degree + 1):
        out[0, first + j] = row[j]
    for j in range(degree):  # d B_p = p (B_{p-1,j} / h_j - B_{p-1,j+1} / h_{j+1})
        part = degree * table[1, j] / (knots[first + 1 + j + degree] - knots[first + 1 + j])
        out[1, first + 1 + j] += part
        out[1, first + j] -= part
    for j in range(degree - 1):
        part = (degree - 1) * table[2, j] / (knots[first + 1 + j + degree] - knots[first + 2 + j])
        upper = degree * part / (knots[first + 2 + j + degree] - knots[first + 2 + j])
        lower = degree * part / (knots[first + 1 + j + degree] - knots[first + 1 + j])
        out[2, first + 2 + j] += upper
        out[2, first + 1 + j] -= upper + lower
        out[2, first + j] += lower


@njit(cache=True, nogil=True)
def fill_basis(kind, degree, n, lower, upper, knots, x, out):
    """Write values, first and second derivatives of all functions at ``x`` into ``out`` (3, n).

    Outside [lower, upper] the tangent at the nearer end is continued (the periodic basis needs none).
    """
    if kind == FOURIER:
        _fill_fourier(n, lower, upper, x, out)
        return
    at = min(max(x, lower), upper)
    if kind == CHEBYSHEV:
        _fill_chebyshev(n, lower, upper, at, out)
    elif kind == SPLINE:
        _fill_spline(n, degree, knots, at, out)
    else:
        _fill_kriging(n, knots, at, out)
    if at != x:
        for j in range(n):
            out[0, j] += (x - at) * out[1, j]
            out[2, j] = 0.0


@njit(cache=True, nogil=True)
def fill_many(kind, degree, n, lower, upper, knots, points, out):
    for i in range(len(points)):
        fill_basis(kind, degree, n, lower, upper, knots, points[i], out[i][:, :n])
