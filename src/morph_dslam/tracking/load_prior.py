"""What is known of unknown loads before a frame is seen: their elastic energy, and that few of them act.

Loads are as likely as exp(-energy / work) (`model.unknown_loads`). Where the work scale is not stated, it is found from
the last frames, together with compact loads that explain them better (`compact_loads`). Both count as a term of the
estimator's cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.unknown_loads import ElasticEnergy
from morph_dslam.tracking.compact_loads import LoadCovariance, SeenLoads, best_work, spot_displacements, spot_variances

Array = NDArray[np.float64]
#: Frames that the prior is found from.
MEMORY = 5


@dataclass(frozen=True)
class LoadOptions:
    """How unknown loads are estimated.

    Attributes
    ----------
    work : scale of their elastic energy, J; None to find it, and where loads act, from the sequence.
    """

    work: float | None = None


class LoadPrior:
    """The term of the cost from unknown loads, the last m of the parameters.

    Parameters
    ----------
    energy : with the first work scale.
    options : see `LoadOptions`.

    Attributes
    ----------
    covariance : of the loads.
    squared_px : variance of an image coordinate, which turns likelihoods into costs in squared pixels.
    """

    def __init__(self, energy: ElasticEnergy, options: LoadOptions) -> None:
        self._energy, self._loads, self.squared_px = energy, energy.loads, 0.25
        self._is_stated = options.work is not None
        self.forget()

    @cached_property
    def _displacements(self) -> Array:
        """Of the spots (m, s); only the prior that learns needs them."""
        return spot_displacements(self._energy.model, self._loads)

    def terms(self, parameters: Array) -> tuple[float, Array, Array]:
        """Cost, Hessian (n, n) and gradient (n,) by the parameters (n,), in squared pixels."""
        n, m = len(parameters), self._loads.count
        push = self.covariance.inverse @ parameters[-m:]
        hessian, gradient = np.zeros((n, n)), np.zeros(n)
        hessian[-m:, -m:], gradient[-m:] = self.covariance.inverse, push
        cost = 0.5 * float(push @ parameters[-m:])
        return self.squared_px * cost, self.squared_px * hessian, self.squared_px * gradient

    def learn(self, parameters: Array, covariance: Array, sigma_px: float) -> None:
        """Take in an accepted frame's parameters (n,), their covariance (n, n) and the deviation of its pixels."""
        m, n = self._loads.count, len(parameters)
        work, spots, compliance = self.covariance.work, self.covariance.spots, self._loads.compliance(parameters[:-m])
        if not self._is_stated and np.isfinite(covariance).all():
            information = np.asarray(np.linalg.inv(covariance[n - m : n, n - m : n]), dtype=np.float64)
            seen = SeenLoads.of(information, parameters[-m:], self.covariance, self._displacements)
            self._frames = [*self._frames, *([] if seen is None else [seen])][-MEMORY:]
            if self._frames:
                variances = spot_variances(self._frames, work)
                work = best_work(self._frames, variances, work)
                spots = self._displacements[:, variances > 0.0] * np.sqrt(variances[variances > 0.0])
        self.covariance, self.squared_px = LoadCovariance(compliance, work, spots), sigma_px**2

    def forget(self) -> None:
        """The next frame is the first, or may follow a gap: loads may be any."""
        compliance = self._loads.compliance(self._energy.model.default)
        self._frames: list[SeenLoads] = []
        self.covariance = LoadCovariance(compliance, self._energy.work, np.empty((self._loads.count, 0)))
