"""Weak greedy choice of samples, as reduced-basis methods make it.

The next full solution is taken where the reduced model is estimated to err most among candidates. An estimate
hardly ever grows as the basis does, so one from an earlier round bounds the present one (the saturation
assumption: Hesthaven, Stamm and Zhang, ESAIM: M2AN 48, 2014): candidates are estimated anew from the largest
down, until those on top are all up to date. Most keep their old estimate, and cost nothing.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def worst_candidates(
    estimate: Callable[[int], float], earlier: Array, count: int
) -> tuple[NDArray[np.int64], Array]:
    """The candidates with the largest estimated errors.

    Parameters
    ----------
    estimate : present estimate at a candidate, by its index.
    earlier : (n,) last estimate of each; infinite where there is none, minus infinity for candidates that are
        out of the choice.
    count : how many to choose.

    Returns
    -------
    chosen : (count,) indices, the largest estimate first; fewer where no more are in the choice.
    estimates : (n,) with those made anew.
    """
    estimates, current = earlier.copy(), np.isneginf(earlier)
    while True:
        chosen = np.argsort(-estimates, kind="stable")[: min(count, int(np.sum(~np.isneginf(estimates))))]
        stale = chosen[~current[chosen]]
        if not len(stale):
            return chosen, estimates
        estimates[stale[0]] = estimate(int(stale[0]))
        current[stale[0]] = True
