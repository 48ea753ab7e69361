"""Minimiser of a quadratic model inside a box, by an active set (Nocedal & Wright, ch. 16.7)."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def bounded_step(hessian, gradient, lower, upper):
    """Minimiser of the quadratic model, with unknowns that would leave [lower, upper] held at the bound.

    Starts with all unknowns free and holds those that violate a bound until none does; unknowns already at a
    bound (zero distance) that the gradient pushes outwards are thereby held from the start.

    Parameters
    ----------
    hessian, gradient : (n, n), positive definite, and (n,). lower, upper : (n,) of the step.

    Returns
    -------
    The step (n,).
    """
    n = len(gradient)
    step = np.zeros(n)
    free = np.ones(n, dtype=np.bool_)
    for k in range(n):
        free[k] = not ((lower[k] == 0.0 and gradient[k] > 0.0) or (upper[k] == 0.0 and gradient[k] < 0.0))
    while free.any():
        rows = np.flatnonzero(free)
        matrix, right = np.empty((len(rows), len(rows))), np.empty(len(rows))
        for a in range(len(rows)):
            right[a] = -gradient[rows[a]]
            for k in range(n):
                if not free[k]:
                    right[a] -= hessian[rows[a], k] * step[k]
            for b in range(len(rows)):
                matrix[a, b] = hessian[rows[a], rows[b]]
        found = np.linalg.solve(matrix, right)
        kept = True
        for a in range(len(rows)):
            k = rows[a]
            step[k] = min(max(found[a], lower[k]), upper[k])
            if step[k] != found[a]:
                free[k], kept = False, False
        if kept:
            break
    return step


def bounded_step_numpy(hessian: Array, gradient: Array, lower: Array, upper: Array) -> Array:
    """The plain twin of `bounded_step`."""
    step = np.zeros_like(gradient)
    free = ~(((lower == 0.0) & (gradient > 0.0)) | ((upper == 0.0) & (gradient < 0.0)))
    while free.any():
        held = ~free
        right = -gradient[free] - hessian[np.ix_(free, held)] @ step[held]
        step[free] = np.linalg.solve(hessian[np.ix_(free, free)], right)
        outside = free & ((step < lower) | (step > upper))
        if not outside.any():
            break
        step[outside] = np.clip(step[outside], lower[outside], upper[outside])
        free &= ~outside
    return step
