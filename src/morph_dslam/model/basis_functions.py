"""One-dimensional function bases of a parameter: values, first and second derivatives, compiled.

========== =========================================================== ===================================
kind       functions                                                   use
========== =========================================================== ===================================
chebyshev  T_0 ... T_p on the scaled range                             smooth dependence, few samples
spline     B-splines of degree 3 (C2, or C1) or 1 (hats), any knots    values on grids; P-splines
fourier    1, cos j x, sin j x with the range as the period            angles
kriging    Matern-5/2 kernels at centres                               scattered samples of one parameter
========== =========================================================== ===================================

Outside the range every basis but the periodic one goes on as its tangent (C1): nothing is extrapolated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

CHEBYSHEV, SPLINE, FOURIER, KRIGING = range(4)
KINDS = {"chebyshev": CHEBYSHEV, "spline": SPLINE, "fourier": FOURIER, "kriging": KRIGING}


@njit(cache=True, nogil=True)
def _continue(n, beyond, out):
    """Go on from the end of the range, where ``out`` is known, along the tangent."""
    if beyond != 0.0:
        for j in range(n):
            out[0, j] += beyond * out[1, j]
            out[2, j] = 0.0


@njit(cache=True, nogil=True)
def fill_chebyshev(n, lower, upper, x, out):
    """`fill_basis` of Chebyshev polynomials."""
    at = min(max(x, lower), upper)
    scale = 2.0 / (upper - lower)
    xi = (at - lower) * scale - 1.0
    out[:, 0] = 0.0
    out[0, 0] = 1.0
    if n > 1:
        out[0, 1], out[1, 1], out[2, 1] = xi, scale, 0.0
    for j in range(2, n):
        out[0, j] = 2.0 * xi * out[0, j - 1] - out[0, j - 2]
        out[1, j] = 2.0 * scale * out[0, j - 1] + 2.0 * xi * out[1, j - 1] - out[1, j - 2]
        out[2, j] = 4.0 * scale * out[1, j - 1] + 2.0 * xi * out[2, j - 1] - out[2, j - 2]
    _continue(n, x - at, out)


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
            for j in range(p):
                table[degree - p + 1, j] = row[j]
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
    if kind == CHEBYSHEV:
        fill_chebyshev(n, lower, upper, x, out)
        return
    at = min(max(x, lower), upper)
    if kind == SPLINE:
        _fill_spline(n, degree, knots, at, out)
    else:
        _fill_kriging(n, knots, at, out)
    _continue(n, x - at, out)


@njit(cache=True, nogil=True)
def fill_many(kind, degree, n, lower, upper, knots, points, out):
    for i in range(len(points)):
        fill_basis(kind, degree, n, lower, upper, knots, points[i], out[i][:, :n])


Array = NDArray[np.float64]


@dataclass(frozen=True)
class Basis:
    """``size`` functions phi_j of one parameter on [lower, upper]; made by the functions below.

    Attributes
    ----------
    kind : "chebyshev", "spline", "fourier" or "kriging".
    lower : lower end of the range, in the parameter's SI unit.
    upper : its upper end.
    size : number of functions.
    degree : of a spline, 0 for the other kinds.
    knots : of a spline (size + degree + 1,); of kriging the correlation length and then the centres.
    """

    kind: str
    lower: float
    upper: float
    size: int
    degree: int = 0
    knots: Array = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"a basis is one of {', '.join(KINDS)}, not '{self.kind}'")
        if not self.lower < self.upper:
            raise ValueError(f"the range of a basis must grow, not go from {self.lower} to {self.upper}")
        self._check_knots()

    def _check_knots(self) -> None:
        """Compiled code reads the arrays unchecked."""
        n = {"spline": self.size + self.degree + 1, "kriging": self.size + 1}.get(self.kind, 0)
        if self.size < 1 or (self.kind == "fourier" and self.size % 2 == 0):
            raise ValueError(f"a {self.kind} basis cannot have {self.size} functions")
        if self.kind == "spline" and not (1 <= self.degree <= 3 and self.size > self.degree):
            raise ValueError(f"{self.size} splines cannot be of degree {self.degree}")
        if self.knots.shape != (n,) or not np.isfinite(self.knots).all():
            raise ValueError(f"{self.size} functions of a {self.kind} basis need {n} finite knots")
        if self.kind == "spline" and not self._knots_grow():
            raise ValueError("the knots of a spline must grow from its lower to its upper end")
        if self.kind == "kriging" and self.knots[0] <= 0.0:
            raise ValueError(f"a correlation length must be positive, not {self.knots[0]}")

    def _knots_grow(self) -> bool:
        """Each function has a support, and the spans inside the range cover it; cubic ones are at least C1."""
        p, t = self.degree, self.knots
        inside, repeated = t[p : self.size + 1], max(p - 1, 1)
        ordered = (
            (np.diff(t) >= 0.0).all()
            and (t[p + 1 :] > t[: -p - 1]).all()
            and (inside[repeated:] > inside[:-repeated]).all()
        )
        return bool(ordered and t[p] == self.lower and t[self.size] == self.upper)

    @property
    def bounds(self) -> tuple[float, float]:
        """The ends of the range; infinite for the periodic basis, which has no outside."""
        return (-np.inf, np.inf) if self.kind == "fourier" else (self.lower, self.upper)

    def inside(self, x: ArrayLike) -> NDArray[np.bool_]:
        """Where ``x`` lies in the range (always for the periodic basis)."""
        x = np.asarray(x, dtype=float)
        lower, upper = self.bounds
        return (x >= lower) & (x <= upper)

    def table(self, x: ArrayLike) -> Array:
        """Values and two derivatives (n, 3, size) at points ``x`` (n,), compiled."""
        points = np.ascontiguousarray(np.atleast_1d(x), dtype=float)
        out = np.empty((len(points), 3, self.size))
        fill_many(KINDS[self.kind], self.degree, self.size, self.lower, self.upper, self.knots, points, out)
        return out

    def evaluate(self, x: ArrayLike, order: int = 0) -> Array:
        """The functions (n, size), or their derivative of ``order`` 1 or 2, at points ``x`` (n,)."""
        return np.ascontiguousarray(self.table(x)[:, order])

    def quadrature(self) -> tuple[Array, Array]:
        """Gauss points and weights that integrate products of two functions (n,), (n,).

        Exact for splines and Chebyshev polynomials and Fourier functions; to 1e-8 or so for kriging.
        """
        if self.kind == "fourier":
            n = 2 * self.size
            length = self.upper - self.lower
            return self.lower + length * np.arange(n) / n, np.full(n, length / n)
        breaks = np.array([self.lower, self.upper])
        if self.kind == "spline":
            breaks = np.unique(np.clip(self.knots, self.lower, self.upper))
        elif self.kind == "kriging":
            breaks = np.unique(np.concatenate([breaks, self.knots[1:]]))
        count = {"chebyshev": self.size, "spline": self.degree + 1, "kriging": 6}[self.kind]
        nodes, weights = np.polynomial.legendre.leggauss(count)
        half = np.diff(breaks)[:, None] / 2.0
        points = breaks[:-1, None] + half * (1.0 + nodes)
        return points.ravel(), (half * weights).ravel()

    def gram(self, order: int = 0) -> Array:
        """Integrals (size, size) of products of the derivatives of ``order`` over the range."""
        points, weights = self.quadrature()
        values = self.evaluate(points, order)
        return (values * weights[:, None]).T @ values

    def penalty(self) -> Array:
        """Roughness a' P a (size, size) of a function with coefficients a, for regularised fits.

        The integral of the squared second derivative; for hats, which have none, its difference
        quotient at the knots; for kriging the norm of the kernel's own space.
        """
        if self.kind == "kriging":
            return self.evaluate(self.knots[1:])
        if self.kind == "spline" and self.degree == 1:
            nodes = self.knots[1:-1]
            h = np.diff(nodes)
            rows = np.zeros((max(self.size - 2, 0), self.size))
            for i in range(len(rows)):
                mean = (h[i] + h[i + 1]) / 2.0
                rows[i, i : i + 3] = np.array([1.0 / h[i], -1.0 / h[i] - 1.0 / h[i + 1], 1.0 / h[i + 1]])
                rows[i] /= np.sqrt(mean)
            return rows.T @ rows
        return self.gram(order=2)

    def interpolate(self, points: Array, values: Array) -> Array:
        """Coefficients (size, ...) of the functions through ``values`` (n, ...) at ``points`` (n,).

        Least squares where there are more points than functions.
        """
        matrix = self.evaluate(points)
        flat = np.asarray(values, dtype=float).reshape(len(points), -1)
        coefficients = np.asarray(np.linalg.lstsq(matrix, flat, rcond=None)[0], dtype=np.float64)
        return coefficients.reshape(self.size, *np.shape(values)[1:])


def chebyshev_basis(lower: float, upper: float, degree: int) -> Basis:
    """Chebyshev polynomials up to ``degree``."""
    return Basis("chebyshev", lower, upper, degree + 1)


def fourier_basis(lower: float, upper: float, harmonics: int) -> Basis:
    """Periodic functions with period ``upper - lower``: 1 and ``harmonics`` cosines and sines."""
    return Basis("fourier", lower, upper, 2 * harmonics + 1)


def _growing(nodes: ArrayLike, least: int) -> Array:
    nodes = np.asarray(nodes, dtype=np.float64)
    if len(nodes) < least or not (np.diff(nodes) > 0.0).all():
        raise ValueError(f"splines need at least {least} growing nodes, not {nodes}")
    return nodes


def hat_basis(nodes: ArrayLike) -> Basis:
    """Piecewise linear functions on ``nodes`` (n >= 2,), growing: one-dimensional finite elements."""
    nodes = _growing(nodes, 2)
    knots = np.concatenate([nodes[:1], nodes, nodes[-1:]])
    return Basis("spline", float(nodes[0]), float(nodes[-1]), len(nodes), 1, knots)


def cubic_spline_basis(nodes: ArrayLike) -> Basis:
    """C2 cubic splines with as many functions as ``nodes`` (n >= 4,), fit to interpolate at them.

    "Not a knot": the second and the last but one node are no knots, so that no end condition is imposed.
    """
    nodes = _growing(nodes, 4)
    knots = np.concatenate([np.repeat(nodes[:1], 4), nodes[2:-2], np.repeat(nodes[-1:], 4)])
    return Basis("spline", float(nodes[0]), float(nodes[-1]), len(nodes), 3, knots)


def hermite_basis(nodes: ArrayLike) -> Basis:
    """C1 piecewise cubics with two functions for each of ``nodes`` (n >= 2,): through values and slopes there."""
    nodes = _growing(nodes, 2)
    knots = np.concatenate([np.repeat(nodes[:1], 4), np.repeat(nodes[1:-1], 2), np.repeat(nodes[-1:], 4)])
    return Basis("spline", float(nodes[0]), float(nodes[-1]), 2 * len(nodes), 3, knots)


def p_spline_basis(lower: float, upper: float, size: int) -> Basis:
    """Cubic B-splines on uniform knots that run past the ends (Eilers and Marx 1996): fit with `penalty`."""
    if size < 4:
        raise ValueError(f"cubic splines need at least 4 functions, not {size}")
    step = (upper - lower) / (size - 3)
    knots = np.asarray(lower + step * np.arange(-3, size + 1), dtype=np.float64)
    knots[3], knots[size] = lower, upper
    return Basis("spline", float(lower), float(upper), size, 3, knots)


def kriging_basis(lower: float, upper: float, centres: ArrayLike, length: float) -> Basis:
    """Matern-5/2 kernels (C2) of correlation ``length`` at ``centres`` (n,)."""
    knots = np.append(np.float64(length), np.asarray(centres, dtype=np.float64))
    return Basis("kriging", lower, upper, len(knots) - 1, 0, knots)
