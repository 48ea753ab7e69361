"""How well parameters that are one over the sequence are known in frames that tell little of them.

A frame's systematic errors are carried to its estimate by what the frame itself determines. Where it tells
little of a parameter, such as a stiffness while hardly anything is bent, that would state any error, though
the estimate stands as earlier frames have left it. Its error has changed since by no more than the estimate.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.diagnostics.dimensions import StretchEvidence
from morph_dslam.diagnostics.reference_misfit import CLEARLY_WORSE
from morph_dslam.registration.registration import PosePrior
from morph_dslam.timing import StageClock
from morph_dslam.tracking.estimator import Estimate
from morph_dslam.tracking.result import (
    DIMENSIONS_OFF,
    FEW_AGREE,
    FOLLOWED,
    REFERENCE_WORSE,
    UNCHECKED,
    UNEXPLAINED,
    FrameResult,
    PoseHypothesis,
)
from morph_dslam.tracking.views import ActiveView

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

    def stated(self, estimate: Estimate, unobservable: NDArray[np.bool_]) -> Estimate:
        """The estimate with deviations no larger than the best so far, plus the change since that frame.

        Parameters
        ----------
        unobservable : (k,) of which the estimate's frame tells nothing, so that its deviations are not to be
            kept.
        """
        rows, share = self._indices, np.ones(len(estimate.covariance))
        if not len(rows):
            return estimate
        values = estimate.state.parameters[rows]
        own = np.sqrt(np.maximum(np.diag(estimate.covariance)[rows], 1e-300))
        since = self._deviations + np.abs(values - self._values)
        share[rows] = np.minimum(since / own, 1.0)
        kept = ~unobservable & (own <= since)
        self._values = np.where(kept, values, self._values)
        self._deviations = np.where(kept, own, self._deviations)
        return replace(estimate, covariance=estimate.covariance * np.outer(share, share))


# What is said of a frame: its status and reason, and the estimate with all errors that are known of.


def _counts(attempt: PoseHypothesis) -> tuple[int, int]:
    return int(attempt.measurement.visible.sum()), int(attempt.inliers.sum())


def missed(
    attempt: PoseHypothesis, why_not: str, aside: str, known: PosePrior | None, clock: StageClock
) -> FrameResult:
    """Of a frame in which the object was not found: hidden where the map tells its place, else lost.

    Parameters
    ----------
    why_not : the attempt is not believed. aside : follows the reason of a lost frame.
    known : its pose by the map, None where that does not tell it.
    """
    visible, count = _counts(attempt)
    if known is not None:
        return FrameResult.hidden(why_not, known, visible, count, clock.milliseconds, clock.total)
    reason = f"lost: {why_not}{aside}"
    return FrameResult("lost", reason, None, np.nan, visible, count, clock.milliseconds, clock.total)


class FrameStatements:
    """Of the frames in which one object was found, one after the other.

    Parameters
    ----------
    constant : (k,) indices of the parameters that are one over the sequence.
    """

    def __init__(self, constant: NDArray[np.int64]) -> None:
        self._best_told = BestTold(constant)
        # What the frames that were compared with each view tell of the object's dimensions.
        self._stretch: dict[int, StretchEvidence] = {}

    def tracked(
        self,
        attempt: PoseHypothesis,
        unobservable: NDArray[np.bool_],
        how: str,
        aside: str,
        another: str,
        view: ActiveView,
        clock: StageClock,
    ) -> FrameResult:
        """What is said of a frame.

        Parameters
        ----------
        unobservable : (k,) parameters that are one over the sequence, of which the frame tells nothing.
        how : the object was found. aside : follows that. another : what speaks for another object like it.
        view : that the attempt was made against.
        """
        residuals = attempt.estimate.residuals[attempt.inliers]
        rms = float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))
        systematic, recovery = view.systematic, view.recovery
        left = systematic.unexplained(attempt.estimate, attempt.inliers)
        doubt, whole = recovery.doubt(attempt), not recovery.partly_hidden(attempt)
        alike_px = max(left.px, doubt)
        elsewhere = [told for number, told in self._stretch.items() if number != view.number]
        estimate = systematic.added(attempt.estimate, attempt.weights, alike_px, attempt.prior, whole, elsewhere)
        estimate = self._best_told.stated(estimate, unobservable)
        if doubt:
            aside += f"; {FEW_AGREE}: by {attempt.estimate.sigma_px:.1f} px"
        if another:
            aside += f"; {another}"
        if left.is_failure:
            aside += f"; {UNEXPLAINED}: {left.px:.1f} px are left"
        if systematic.worse > CLEARLY_WORSE:
            aside += f"; {REFERENCE_WORSE}: {systematic.worse:.1f} times what it was taken to be known to"
        off, on_dimensions = self._on_dimensions(view, elsewhere, attempt.prior is None)
        aside += on_dimensions
        return FrameResult(
            "tracked",
            how + aside,
            estimate,
            rms,
            *_counts(attempt),
            clock.milliseconds,
            clock.total,
            recovered=how != FOLLOWED,
            unexplained_px=left.px,
            reference_worse=systematic.worse,
            dimensions_off=off,
            pose_from="points" if attempt.prior is None else "points and map",
            view=view.number,
            discrepancy=attempt.discrepancy,
        )

    def _on_dimensions(self, view: ActiveView, elsewhere: list[StretchEvidence], is_free: bool) -> tuple[str, str]:
        """How an object is shown to be off the model's dimensions, "" if it is not, and what is said of that.

        A free one may be off as long as the frames do not exclude it; one in a map has been found there.
        """
        told = view.systematic.stretch
        if told is None:
            return "", ""
        self._stretch[view.number] = told
        told = told.joined(elsewhere)
        if told.is_shown:
            return told.in_words, f"; {DIMENSIONS_OFF}: {told.in_words}"
        return "", f"; {UNCHECKED}" if is_free and not told.is_excluded else ""
