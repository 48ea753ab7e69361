"""What is known of unknown loads before a frame is seen: their elastic energy, and that they change slowly.

Loads are as likely as exp(-energy / work) (`model.unknown_loads`), with a work scale for each, and from frame to frame
they change by a part of what such loads are. The scales are stated, or found from the frames so far by maximum
evidence: a load's is the mean square that the frames show of it, so that loads that are not there vanish (automatic
relevance determination: MacKay, Neural Computation 4, 1992; Tipping, JMLR 1, 2001). All count as terms of the
estimator's cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.unknown_loads import ElasticEnergy

Array = NDArray[np.float64]
#: Frames that work scales are found from, and the part of their mean that each keeps, lest a load could not come back.
MEMORY, LEAST_SHARE = 5.0, 0.02


@dataclass(frozen=True)
class LoadOptions:
    """How unknown loads are estimated.

    Attributes
    ----------
    work : scale of their elastic energy, J; None to find it from the sequence.
    change : standard deviation of their change from frame to frame over their own.
    """

    work: float | None = None
    change: float = 0.5


class LoadPrior:
    """The terms of the cost from unknown loads, the last m of the parameters.

    Parameters
    ----------
    energy : with the first work scale.
    options : see `LoadOptions`.

    Attributes
    ----------
    work : (m,) scale of the energy for each load, J.
    squared_px : variance of an image coordinate, which turns likelihoods into costs in squared pixels.
    """

    def __init__(self, energy: ElasticEnergy, options: LoadOptions) -> None:
        self._loads, self._options = energy.loads, options
        self.work, self.squared_px = np.full(energy.loads.count, energy.work), 0.25
        self._past: tuple[Array, Array] | None = None

    def terms(self, parameters: Array) -> tuple[float, Array, Array]:
        """Cost, Hessian (n, n) and gradient (n,) by the parameters (n,), in squared pixels."""
        m, scale = self._loads.count, 1.0 / np.sqrt(self.work)
        root, slopes = self._loads.root(parameters[:-m])
        scaled = scale * parameters[-m:]
        value, rows = root @ scaled, np.hstack([(slopes @ scaled).T, root * scale])
        cost, hessian, gradient = 0.5 * float(value @ value), rows.T @ rows, rows.T @ value
        if self._past is not None:
            mean, information = self._past
            away = parameters[-m:] - mean
            push = information @ away
            hessian[-m:, -m:] += information
            gradient[-m:] += push
            cost += 0.5 * float(away @ push)
        return self.squared_px * cost, self.squared_px * hessian, self.squared_px * gradient

    def learn(self, parameters: Array, covariance: Array, sigma_px: float) -> None:
        """Take in an accepted frame's parameters (n,), their covariance (n, n) and the deviation of its pixels."""
        m, n = self._loads.count, len(parameters)
        q, own = parameters[-m:], covariance[n - m : n, n - m : n]
        self.squared_px = sigma_px**2
        if self._options.work is None:
            found = self.work + (q**2 + np.diag(own) - self.work) / MEMORY
            self.work = np.maximum(found, LEAST_SHARE * found.mean())
        root, _ = self._loads.root(parameters[:-m])
        spread = self._options.change * np.sqrt(self.work)[:, None] * np.linalg.inv(root)
        self._past = q, np.asarray(np.linalg.inv(own + spread @ spread.T), dtype=np.float64)

    def forget(self) -> None:
        """The next frame may follow a gap: loads may be any."""
        self._past = None
