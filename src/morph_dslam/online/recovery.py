"""Looking for a lost object by its features in the whole frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.online.attempt import Attempt, Picture, refusal
from morph_dslam.online.frame_estimation import FrameEstimation
from morph_dslam.online.reference_view import ReferenceView
from morph_dslam.online.timing import StageClock
from morph_dslam.online.tracker_options import TrackerOptions

Array = NDArray[np.float64]


class Recovery:
    """Finds the object again by the features of its reference view, unless it could be in two places."""

    def __init__(
        self,
        model: ReducedModel,
        reference: ReferenceView,
        estimation: FrameEstimation,
        options: TrackerOptions,
    ) -> None:
        self._model, self._reference = model, reference
        self._estimation, self._options = estimation, options

    def recover(
        self, picture: Picture, last_shape: Array, why_lost: str, clock: StageClock
    ) -> tuple[Attempt | None, str]:
        """The object somewhere in the frame, or None and why it is lost.

        Parameters
        ----------
        last_shape : (d,) the parameters known last. why_lost : what is to be said before anything else.
        """
        shapes = self._shapes(last_shape)
        found, matches = self._find(picture, shapes, None, clock)
        if matches is not None:
            return None, f"{why_lost}; only {matches} features of the reference view were found again"
        if found is None:
            return None, why_lost
        with clock.stage("recover"):
            covered = self._reference.covered(found.estimate.state)
            elsewhere = np.where(covered, 0, 255).astype(np.uint8)
        other, _ = self._find(picture, shapes, elsewhere, clock)
        if other is not None and self._apart(found, other):
            counts = f"{int(found.inliers.sum())} and {int(other.inliers.sum())} points agree"
            return None, f"{why_lost}; it could be in two places, where {counts}"
        return found, ""

    def _find(
        self, picture: Picture, shapes: list[Array], mask: NDArray[np.uint8] | None, clock: StageClock
    ) -> tuple[Attempt | None, int | None]:
        """A place where the object is to be believed, or None; and how many features agreed, if too few."""
        with clock.stage("recover"):
            state, matches = self._reference.relocaliser.find(picture.grey, shapes, mask)
        if state is None:
            return None, matches
        candidate = self._estimation.correct(picture, state, None, None, clock)
        candidate = self._estimation.correct(picture, candidate.estimate.state, None, None, clock)
        return (None if refusal(candidate, self._options) else candidate), None

    def _apart(self, found: Attempt, other: Attempt) -> bool:
        """Whether two attempts are of different places in the image."""
        between = np.linalg.norm(found.measurement.pixels - other.measurement.pixels, axis=1)
        return float(np.nanmedian(between)) > self._options.measurement.largest_correction_px

    def _shapes(self, last: Array) -> list[Array]:
        """Parameters to look with: the last known, the default, each parameter near both ends."""
        lower, upper, default = self._model.lower, self._model.upper, self._model.default
        shapes = [last, default]
        for k in range(len(default)):
            for share in (1 / 6, 5 / 6):
                shape = default.copy()
                shape[k] = lower[k] + share * (upper[k] - lower[k])
                shapes.append(shape)
        return shapes
