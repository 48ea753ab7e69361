"""Whether a frame can tell of a parameter at all: whether the parameter's effect is clearly there.

Some parameters act only while others do, as the side from which a lever is turned. While it is not, errors of
the lever's angle turn it, to a side of their own, and the curvature of the cost, which a covariance is made
from, takes this for a measured side. The error of the direction of a vector with independent errors is about
one over its length in standard deviations only where that length is some of them; below, the direction may be
any. So an effect counts only where it is so many times what the other parameters' errors make it differ by.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.online.estimation.estimator import State
from morph_dslam.online.estimation.linear_cost import LinearCost

Array = NDArray[np.float64]

#: Of a plane vector that is at least so many standard deviations long, the direction's error is that of the
#: linear theory but for some per cent: a vector that points the other way is then less likely than 0.001.
CLEARLY = 4.0


def without_clear_effect(
    model: ReducedModel,
    linear: LinearCost,
    linear_at: Callable[[State], LinearCost],
    state: State,
    spread: Array,
    indices: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Which of some parameters (k,) may have no effect on what was measured.

    Parameters
    ----------
    linear : the cost of what was measured, about the ``state`` that was estimated. linear_at : about another.
    spread : (d,) standard deviations of the parameters were those at ``indices`` (k,) known, SI.
    """
    effects = linear.scores[:, :, indices]
    changes = np.zeros(len(indices))
    half_ranges = 0.5 * (model.upper - model.lower)
    for other in np.setdiff1d(np.arange(len(spread)), indices):
        parameters = state.parameters.copy()
        step = min(float(spread[other]), float(half_ranges[other]))
        parameters[other] += step if parameters[other] + step <= model.upper[other] else -step
        there = linear_at(replace(state, parameters=parameters)).scores[:, :, indices]
        changes += np.sum((there - effects) ** 2, axis=(0, 1))
    return np.sum(effects**2, axis=(0, 1)) <= CLEARLY**2 * changes
