"""What the seen half tells of the hidden one without physics: polynomials of degree 1 to 3, fitted in each frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
NAMES = {1: "affine", 2: "quadratic", 3: "cubic"}


def polynomial_errors(seen: Array, hidden: Array, px_per_mm: float) -> dict[str, float]:
    """Mean distances of predicted from measured hidden points, mm, by the polynomial's name.

    Parameters
    ----------
    seen : (f, n, 2) speckles followed in the seen half, pixels; NaN where lost.
    hidden : (f, k, 2) points of the hidden half, pixels.
    px_per_mm : of the pictures.
    """
    return {name: _error(seen, hidden, degree) / px_per_mm for degree, name in NAMES.items()}


def _error(seen: Array, hidden: Array, degree: int) -> float:
    centre, size = seen[0].mean(axis=0), float(np.ptp(seen[0], axis=0).max())
    before, there = (_powers((points[0] - centre) / size, degree) for points in (seen, hidden))
    errors = []
    for now, truth in zip(seen[1:], hidden[1:], strict=True):
        known = np.isfinite(now[:, 0])
        coefficients = np.linalg.lstsq(before[known], now[known], rcond=None)[0]
        errors.append(np.linalg.norm(there @ coefficients - truth, axis=1))
    return float(np.nanmean(errors))


def _powers(points: Array, degree: int) -> Array:
    """Monomials (n, m) of points (n, 2) up to a degree."""
    x, y = points.T
    return np.column_stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)])
