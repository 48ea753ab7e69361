"""What the error of a rig's reference state does to the estimates that all its cameras make together.

As for one camera (`systematic_errors`), the points were bound by the reference state, and an error e of it
enters each estimate through them. Each camera sees e as C e, with C its chain from increments in the rig's
frame to those in its own, so that the sum of C' J' W M J0 C over the cameras pushes the estimate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.estimation.estimator import Estimate, Prior
from morph_dslam.online.pipeline import Tracker
from morph_dslam.online.several.rig import RigCamera
from morph_dslam.online.uncertainty.bound_part import BoundPart
from morph_dslam.online.uncertainty.measurement_noise import RigMeasured
from morph_dslam.online.uncertainty.systematic_errors import SystematicErrors, inverse_of_seen

Array = NDArray[np.float64]


class RigReference:
    """Adds to covariances what the reference state is off by.

    Parameters
    ----------
    trackers : by camera, each at its one reference view. cameras : of the rig.
    covariance : (d + 6, d + 6) of the reference state, its pose in the rig's frame; None where nobody knows.
    """

    def __init__(
        self, trackers: Sequence[Tracker], cameras: Sequence[RigCamera], covariance: Array | None
    ) -> None:
        known = covariance is not None and bool(np.isfinite(covariance).all())
        self._covariance = covariance if known else None
        self._cameras, self._scale = cameras, trackers[0].estimator.scale
        self._chains = [part.chain(len(self._scale) - 6) for part in cameras]
        self._systematic = [
            SystematicErrors(
                tracker.estimator,
                tracker.reference.points,
                [BoundPart(slice(None), tracker.reference.state, None)],
                tracker.options.measurement.window,
            )
            for tracker in trackers
        ]
        self._counts = [len(tracker.reference.points) for tracker in trackers]

    def added(self, estimate: Estimate, measured: RigMeasured, prior: Prior | None) -> Estimate:
        """The estimate, a state in the rig's frame, with a covariance that holds the reference's error."""
        if self._covariance is None:
            return estimate
        size = len(self._scale)
        hessian, push, first = np.zeros((size, size)), np.zeros((size, size)), 0
        if prior is not None:
            hessian += prior.terms(estimate.state)[1]
        for part, chain, systematic, count, view in zip(
            self._cameras, self._chains, self._systematic, self._counts, measured.views, strict=True
        ):
            rows = estimate.residuals[first : first + count]
            first += len(view.weights)
            seen = replace(estimate, state=part.seen(estimate.state), residuals=rows)
            own, pushed = systematic.pushed(seen, view.weights[:count])
            hessian += chain.T @ own @ chain
            push += chain.T @ pushed @ chain
        transfer = inverse_of_seen(hessian, self._scale) @ push
        covariance = estimate.covariance + transfer @ self._covariance @ transfer.T
        return replace(estimate, covariance=covariance)
