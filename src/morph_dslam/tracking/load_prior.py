"""What is known of unknown loads before a frame: their elastic energy, that few act, and that they change slowly.

Loads are as likely as exp(-energy / work) (`model.unknown_loads`). Where the work scale is not stated, it is found
from the last frames, together with compact loads that explain them better (`compact_loads`). What a frame found then
counts for the next one, too: loads are a stationary process of first order, q' = a q + sqrt(1 - a^2) w, with w of the
covariance that was found. All that is a term of the estimator's cost.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.unknown_loads import ElasticEnergy
from morph_dslam.tracking.compact_loads import (
    LoadCovariance,
    LoadPrediction,
    SeenLoads,
    best_work,
    spot_displacements,
    spot_variances,
)
from morph_dslam.tracking.option_values import CheckedOptions, Positive

Array = NDArray[np.float64]
#: Frames that the prior is found from.
MEMORY = 5
#: The share of loads that a frame has in common with the one before.
KEPT = 0.8


@dataclass(frozen=True)
class LoadOptions(CheckedOptions):
    """How unknown loads are estimated.

    Attributes
    ----------
    work : scale of their elastic energy, J; None to find it, and where loads act, from the sequence.
    """

    work: Positive | None = None


class LoadPrior:
    """The term of the cost from unknown loads, the last m of the parameters.

    Parameters
    ----------
    energy : with the first work scale.
    options : see `LoadOptions`.

    Attributes
    ----------
    known : of the loads before the next frame.
    squared_px : variance of an image coordinate, which turns likelihoods into costs in squared pixels.
    """

    def __init__(self, energy: ElasticEnergy, options: LoadOptions) -> None:
        self._energy, self._loads, self.squared_px = energy, energy.loads, 0.25
        self._is_stated, self._is_aside = options.work is not None, False
        self.forget()

    @cached_property
    def _displacements(self) -> Array:
        """Of the spots (m, s); only the prior that learns needs them."""
        return spot_displacements(self._energy.model, self._loads)

    @contextmanager
    def set_aside(self) -> Iterator[None]:
        """Meanwhile any loads are as likely as others: what do the images tell of a parameter beside these?"""
        self._is_aside = True
        try:
            yield
        finally:
            self._is_aside = False

    def terms(self, parameters: Array) -> tuple[float, Array, Array]:
        """Cost, and its Hessian (m, m) and gradient (m,) by the loads, at parameters (n,); in squared pixels."""
        if self._is_aside:
            m = self._loads.count
            return 0.0, np.zeros((m, m)), np.zeros(m)
        away = parameters[-self._loads.count :] - self.known.mean
        push = self.known.inverse @ away
        cost = 0.5 * float(push @ away)
        return self.squared_px * cost, self.squared_px * self.known.inverse, self.squared_px * push

    def learn(self, parameters: Array, covariance: Array, sigma_px: float) -> None:
        """Take in an accepted frame's parameters (n,), their covariance (n, n) and the deviation of its pixels.

        The latter is infinite where the points are too few to tell it: what was known of it goes on then.
        """
        m, n = self._loads.count, len(parameters)
        loads, own = parameters[-m:], covariance[n - m : n, n - m : n]
        is_determined, is_settled = bool(np.isfinite(covariance).all()), len(self._frames) == MEMORY
        self._covariance = replace(self._covariance, compliance=self._loads.compliance(parameters[:-m]))
        if is_determined and not self._is_stated:
            self._find_scales(np.asarray(np.linalg.inv(own), dtype=np.float64), loads)
        if np.isfinite(sigma_px):
            self.squared_px = sigma_px**2
        # The first work scale is a guess. Until a better one is found, so are loads that the frames hardly see.
        kept = KEPT if is_determined and is_settled else 0.0
        new = (1.0 - kept**2) * self._covariance.value
        self.known = LoadPrediction(kept * loads, kept**2 * own + new if kept else new)

    def _find_scales(self, information: Array, loads: Array) -> None:
        """Find work scale and variances of spots that explain the last frames best.

        ``information`` (m, m) is the inverse of the covariance of this frame's ``loads`` (m,).
        """
        compliance, work = self._covariance.compliance, self._covariance.work
        seen = SeenLoads.of(information, loads, self.known, compliance, self._displacements)
        self._frames = [*self._frames, *([] if seen is None else [seen])][-MEMORY:]
        if not self._frames:
            return
        variances = spot_variances(self._frames, work)
        work = best_work(self._frames, variances, work)
        spots = self._displacements[:, variances > 0.0] * np.sqrt(variances[variances > 0.0])
        self._covariance = LoadCovariance(compliance, work, spots)

    def take(self, other: LoadPrior) -> None:
        """Know what another one does, of the same loads."""
        self._frames, self._covariance = other._frames, other._covariance
        self.known, self.squared_px = other.known, other.squared_px

    def forget(self) -> None:
        """The next frame is the first, or may follow a gap: loads may be any."""
        m, compliance = self._loads.count, self._loads.compliance(self._energy.model.default)
        self._frames: list[SeenLoads] = []
        self._covariance = LoadCovariance(compliance, self._energy.work, np.empty((m, 0)))
        self.known = LoadPrediction(np.zeros(m), self._covariance.value)
