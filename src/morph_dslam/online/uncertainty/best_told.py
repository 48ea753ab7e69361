"""How well parameters that are one over the sequence are known in frames that tell little of them.

A frame's systematic errors are carried to its estimate by what the frame itself determines. Where it tells
little of a parameter, such as a stiffness while hardly anything is bent, that would state any error, though
the estimate stands as earlier frames have left it. Its error has changed since by no more than the estimate.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.estimation.estimator import Estimate

Array = NDArray[np.float64]


class BestTold:
    """Remembers the frame that told each of some parameters best.

    Parameters
    ----------
    indices : (k,) of the parameters that are one over the sequence.
    """

    def __init__(self, indices: NDArray[np.int64]) -> None:
        self._indices = indices
        self._values, self._deviations = np.zeros(len(indices)), np.full(len(indices), np.inf)

    def stated(self, estimate: Estimate, untold: NDArray[np.bool_]) -> Estimate:
        """The estimate with deviations no larger than the best so far, plus the change since that frame.

        Parameters
        ----------
        untold : (k,) of which the estimate's frame tells nothing, so that its deviations are not to be kept.
        """
        rows, share = self._indices, np.ones(len(estimate.covariance))
        if not len(rows):
            return estimate
        values = estimate.state.parameters[rows]
        own = np.sqrt(np.maximum(np.diag(estimate.covariance)[rows], 1e-300))
        since = self._deviations + np.abs(values - self._values)
        share[rows] = np.minimum(since / own, 1.0)
        kept = ~untold & (own <= since)
        self._values = np.where(kept, values, self._values)
        self._deviations = np.where(kept, own, self._deviations)
        return replace(estimate, covariance=estimate.covariance * np.outer(share, share))
