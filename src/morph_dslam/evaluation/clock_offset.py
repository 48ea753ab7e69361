"""A constant offset of the clocks of two camera paths, where that explains why they differ."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from morph_dslam.geometry import fit_similarity
from morph_dslam.io.trajectory import Trajectory

Array = NDArray[np.float64]
#: Looked for where positions differ by more than this part of the true path's spread about its middle.
LARGE_SHARE = 0.25
#: An offset must leave less than this part of the error.
LEAST_LEFT = 0.1
#: Paths overlap by this part of the shorter one at least.
LEAST_OVERLAP = 0.5
#: Longer paths are compared at so many instants.
MOST_INSTANTS = 20000


def clock_offset(estimate: Trajectory, truth: Trajectory) -> tuple[float, float, float] | None:
    """How much to add to the times of an estimate, and what that does, where one offset explains most of the error.

    Speeds do not depend on the world's axes, nor their course on the scale. So the offset at which their normalized
    correlation is largest is a candidate, which the positions then make exact.

    Parameters
    ----------
    estimate, truth : whole, each on its own clock.

    Returns
    -------
    The offset, seconds, and the root mean square errors of the positions without and with it, metres, after the best
    similarity. None where the errors are small, or no offset explains them, or less than half of the paths overlap.
    """
    if truth.is_numbered or estimate.is_numbered or min(len(estimate), len(truth)) < 4:
        return None
    before = _error(estimate, truth, 0.0)
    spread = float(np.sqrt(np.sum(np.var(truth.positions, axis=0))))
    if not LARGE_SHARE * spread < before < np.inf:
        return None
    step = max(float(np.median(np.diff(path.timestamps))) for path in (estimate, truth))
    step = max(step, max(np.ptp(estimate.timestamps), np.ptp(truth.timestamps)) / MOST_INSTANTS)
    rough = _by_speeds(estimate, truth, step)
    if rough is None:
        return None
    bounds = (rough - 2.0 * step, rough + 2.0 * step)
    exact: Any = scipy.optimize.minimize_scalar(lambda s: _error(estimate, truth, s), bounds=bounds, method="bounded")
    offset, after = float(exact.x), float(exact.fun)
    return (offset, before, after) if after < LEAST_LEFT * before else None


def _error(estimate: Trajectory, truth: Trajectory, offset: float) -> float:
    """Root mean square distance of the centres at an offset of the clocks, metres; infinite without an overlap."""
    times = estimate.timestamps + offset
    shared = (times >= truth.timestamps[0]) & (times <= truth.timestamps[-1])
    if shared.sum() < max(3.0, LEAST_OVERLAP * min(len(times), len(truth))):
        return np.inf
    return aligned_error(estimate.positions[shared], _positions_at(truth, times[shared]))


def aligned_error(own: Array, true: Array, with_scale: bool = True) -> float:
    """Root mean square distance of points (n, 3) after the best similarity or motion; infinite where there is none."""
    try:
        motion = fit_similarity(own, true, with_scale)
    except ValueError:
        return np.inf
    return float(np.sqrt(np.mean(np.sum((motion.apply(own) - true) ** 2, axis=1))))


def _positions_at(path: Trajectory, times: Array) -> Array:
    """Centres (n, 3) at times (n,), on straight lines between those of a path."""
    return np.column_stack([np.interp(times, path.timestamps, column) for column in path.positions.T])


def _by_speeds(estimate: Trajectory, truth: Trajectory, step: float) -> float | None:
    """The offset, to a ``step``, at which the speeds of both paths are most alike; None where they tell nothing."""
    import scipy.signal  # half a second, which commands that compare no clocks do without

    own, true = (_speeds(path, step) for path in (estimate, truth))
    ones = [np.ones(len(speeds)) for speeds in (true, own)]

    def sums(first: Array, second: Array) -> Array:
        return np.asarray(scipy.signal.correlate(first, second, mode="full", method="fft"))

    count = np.maximum(np.rint(sums(*ones)), 1.0)
    first, second = sums(true, ones[1]) / count, sums(ones[0], own) / count
    variances = (sums(true**2, ones[1]) / count - first**2) * (sums(ones[0], own**2) / count - second**2)
    enough = count >= LEAST_OVERLAP * min(len(own), len(true))
    told = enough & (variances > 1e-6 * float(np.var(true) * np.var(own)))
    if not told.any():
        return None
    alike = np.full(len(count), -np.inf)
    alike[told] = (sums(true, own) / count - first * second)[told] / np.sqrt(variances[told])
    lags = scipy.signal.correlation_lags(len(true), len(own))
    return float(truth.timestamps[0] - estimate.timestamps[0] + step * lags[int(np.argmax(alike))])


def _speeds(path: Trajectory, step: float) -> Array:
    """Speeds (n,) of a path over every ``step`` from its beginning, metres a second."""
    times = np.arange(path.timestamps[0], path.timestamps[-1], step)
    return np.linalg.norm(np.diff(_positions_at(path, times), axis=0), axis=1) / step
