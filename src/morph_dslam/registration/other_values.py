"""Whether other values of parameters, far from those that were found, have nearly the same shape.

Fibres that run the other way make the same shape, and so may a stiff body under a large load and a soft one under a
small load. No image of the shape tells which it is: both values must be named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.registration.messages import OtherValues
from morph_dslam.registration.outline_snap import DISTINCT_SHARE, EXCLUDED, shape_distance
from morph_dslam.tracking.estimator import Estimate
from morph_dslam.tracking.observability import UNOBSERVABLE_SHARE

Array = NDArray[np.float64]
#: Values so many standard deviations of both apart are different ones, as minima so many apart are excluded.
APART = 3.0
#: Mean distance, as a share of the object's size, up to which depth and outline do not tell shapes apart either.
SAME_SHARE = 1e-3


@dataclass(frozen=True)
class FoundValues:
    """Parameters (d,) of a minimum, SI, and their standard deviations (d,)."""

    values: Array
    deviations: Array

    def apart(self, other: FoundValues, turns: Array) -> NDArray[np.bool_]:
        """Which parameters (d,) differ from another minimum's.

        ``turns`` (d,) are the periods of those after which all is the same, infinite for others.
        """
        away = np.abs(self.values - other.values)
        nearest = np.minimum(away, np.abs(turns - away))
        return np.asarray(nearest > APART * np.hypot(self.deviations, other.deviations))


def other_values(model: ReducedModel, best: FoundValues, others: Sequence[FoundValues]) -> tuple[OtherValues, ...]:
    """A warning with all values of parameters that differ from the best minimum's; empty if there are none.

    Parameters
    ----------
    model : of the object. What it tells nothing of may have any value anyway, and is left out.
    best : what was found.
    others : other minima that cannot be excluded, of nearly the same shape.
    """
    count = len(model.study_parameters)
    ranges = np.array([parameter.upper - parameter.lower for parameter in model.parameters])
    endless = np.isinf(model.displacement.functions.bounds[0])
    turns = np.where(endless, ranges, np.inf)
    told = (best.deviations < UNOBSERVABLE_SHARE * ranges) & (np.arange(len(ranges)) < count)
    named = []
    for k in np.flatnonzero(told):
        kept = [best]
        for other in others:
            if other.deviations[k] < UNOBSERVABLE_SHARE * ranges[k] and all(other.apart(one, turns)[k] for one in kept):
                kept.append(other)
        if len(kept) > 1:
            parameter = model.parameters[k]
            *first, last = [f"{parameter.display(one.values[k]):.4g}" for one in kept]
            unit = "" if parameter.unit == "1" else f" {parameter.unit}"
            named.append(f"{parameter.name} = {', '.join(first)} or {last}{unit}")
    return (OtherValues("; ".join(named)),) if named else ()


def plausible_minima(found: list[Estimate], click_px: float, n_unknowns: int) -> list[Estimate]:
    """The best minimum, and others that landmarks of the stated accuracy cannot exclude.

    Parameters
    ----------
    found : the minima, the best first.
    click_px : standard deviation of a carefully set landmark.
    n_unknowns : that were estimated; parameters whose values are known are none.
    """
    best = found[0]
    freedom = max(2 * len(best.residuals) - n_unknowns, 1)
    variance = max(click_px**2, 2.0 * best.cost / freedom)
    # Twice the log-likelihood ratio of two minima.
    return [best, *(e for e in found[1:] if 2.0 * (e.cost - best.cost) < EXCLUDED * variance)]


def as_set(estimate: Estimate, click_px: float) -> float:
    """Factor of an estimate's covariance, so that landmarks are no more exact than they were set."""
    return max(1.0, (click_px / max(estimate.sigma_px, 1e-12)) ** 2)


def values_of_same_shape(
    model: ReducedModel, minima: Sequence[Estimate], covariance: Array, click_px: float, is_corrected: bool
) -> tuple[OtherValues, ...]:
    """What is to be said of other values of parameters that have the shape of the best of these minima.

    Parameters
    ----------
    minima : that landmarks cannot exclude, the best first.
    covariance : (d + 6, d + 6) of the registration.
    click_px : standard deviation of a carefully set landmark.
    is_corrected : whether depth or the outline tell shapes apart that landmarks do not.
    """
    d, best, share = len(model.parameters), minima[0], SAME_SHARE if is_corrected else DISTINCT_SHARE
    others = [
        FoundValues(one.state.parameters, np.sqrt(as_set(one, click_px)) * one.parameter_std)
        for one in minima[1:]
        if shape_distance(model, best.state, one.state) <= share
    ]
    return other_values(model, FoundValues(best.state.parameters, np.sqrt(np.diag(covariance)[:d])), others)
