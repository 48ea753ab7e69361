"""What the ranges of parameters say of their errors: a deviation by derivatives has no end, a parameter has.

Nothing shows the side from which a lever is turned before it is, and its deviation by derivatives may then be many
turns. Let a parameter's error have the variance v about the estimate by the derivatives. Cut off at the ends of its
range, a Gaussian's mean square is never above v, nor above that of values that are all alike from end to end. So what
exceeds the latter is cut down to it. All other unknowns follow by their regression on the parameter, and what the
parameter does not tell of them stays as it is: the update of a Kalman filter by one measurement.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel

Array = NDArray[np.float64]


def mean_squares_in_ranges(model: ReducedModel, mu: Array) -> Array:
    """Mean square distances from ``mu`` of values that are all alike in a range.

    Parameters
    ----------
    model : with the ranges.
    mu : (d,) parameters in them, SI.

    Returns
    -------
    (d,), SI squared; infinite for unknown loads, whose ranges are no more than what the model was built for.
    """
    found = (model.upper - model.lower) ** 2 / 12.0 + (mu - 0.5 * (model.lower + model.upper)) ** 2
    found[len(mu) - model.n_loads :] = np.inf
    return found


def cut_down(covariance: Array, limits: Array) -> Array:
    """A covariance in which no parameter's variance is above its limit.

    Parameters
    ----------
    covariance : (n, n), of the d parameters first.
    limits : (d,) largest variances of these; 0 for no limit.

    Returns
    -------
    (n, n); ``covariance`` itself where no variance that is finite is above its limit.
    """
    if not np.isfinite(covariance).all():
        return covariance
    found, d = covariance, len(limits)
    for _ in range(d):
        excess = np.divide(np.diag(found)[:d], limits, out=np.zeros(d), where=limits > 0.0)
        # The least known first: others may be far off only with it.
        k = int(excess.argmax())
        if not excess[k] > 1.0:
            break
        found = found - np.outer(found[k], found[k]) * (1.0 - 1.0 / excess[k]) / found[k, k]
        found[k, k] = limits[k]
    return found
