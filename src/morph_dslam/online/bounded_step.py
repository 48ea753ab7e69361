"""Minimiser of a quadratic model inside a box, by an active set (Nocedal & Wright, ch. 16.7)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def bounded_step(hessian: Array, gradient: Array, lower: Array, upper: Array) -> Array:
    """Minimiser of the quadratic model, with unknowns that would leave [lower, upper] held at the bound.

    Starts with all unknowns free and holds those that violate a bound until none does; unknowns already at a
    bound (zero distance) that the gradient pushes outwards are thereby held from the start.
    """
    step = np.zeros_like(gradient)
    free = ~(((lower == 0.0) & (gradient > 0.0)) | ((upper == 0.0) & (gradient < 0.0)))
    if free.all():
        # The usual case, without the cost of selecting rows.
        step[:] = np.linalg.solve(hessian, -gradient)
        if ((step >= lower) & (step <= upper)).all():
            return step
        step[:] = 0.0
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
