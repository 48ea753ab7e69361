"""What the error of a rig's reference state does to the estimates that all its cameras make together.

As for one camera (`systematic_errors`), the points were bound by the reference state, and an error e of it
enters each estimate through them. Each camera sees e as C e, with C its chain from increments in the rig's
frame to those in its own, so that the sum of C' J' W M J0 C over the cameras pushes the estimate. In further
pictures of the undeformed object the same causes make another e each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from morph_dslam.online.estimation.estimator import Estimate, Prior
from morph_dslam.online.pipeline import Tracker
from morph_dslam.online.several.rig import RigCamera
from morph_dslam.online.uncertainty.measurement_noise import RigMeasured
from morph_dslam.online.uncertainty.systematic_errors import SystematicErrors, inverse_of_seen


class RigReference:
    """Adds to covariances what the reference state is off by.

    Parameters
    ----------
    trackers : by camera, each at its one reference view, which knows how its pictures are off by the causes
        that are the same for all. cameras : of the rig.
    """

    def __init__(self, trackers: Sequence[Tracker], cameras: Sequence[RigCamera]) -> None:
        parts = [part for tracker in trackers for part in tracker.reference.parts]
        self._is_known = all(part.causes is not None for part in parts)
        self._cameras, self._scale = cameras, trackers[0].estimator.scale
        self._chains = [part.chain(len(self._scale) - 6) for part in cameras]
        self._systematic = [
            SystematicErrors(
                tracker.estimator,
                tracker.reference.points,
                tracker.reference.parts,
                tracker.options.measurement.window,
            )
            for tracker in trackers
        ]
        self._counts = [len(tracker.reference.points) for tracker in trackers]

    def added(self, estimate: Estimate, measured: RigMeasured, prior: Prior | None) -> Estimate:
        """The estimate, a state in the rig's frame, with a covariance that holds the reference's error."""
        if not self._is_known:
            return estimate
        size = len(self._scale)
        hessian, first = np.zeros((size, size)), 0
        pushes = []
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
            pushes.append(chain.T @ pushed)
        transfer = inverse_of_seen(hessian, self._scale) @ np.sum(pushes, axis=0)
        return replace(estimate, covariance=estimate.covariance + transfer @ transfer.T)
