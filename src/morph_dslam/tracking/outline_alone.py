"""Estimating the object's state in a frame from its outline alone: of an object without texture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from morph_dslam.tracking.covariance import trace_of_share
from morph_dslam.tracking.estimator import Estimator, Prior, State
from morph_dslam.tracking.frame_starts import ShapeSearch
from morph_dslam.tracking.hypothesis import Image, PoseHypothesis, reject
from morph_dslam.tracking.measurement import Measurement
from morph_dslam.tracking.noise import Observations
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outline import n_absent
from morph_dslam.tracking.outline_weight import OutlineBalance
from morph_dslam.tracking.reference import ReferenceView
from morph_dslam.tracking.reference_misfit import Unexplained

#: How far an outline is searched for, pixels: the first after a loss only. That is for an object of this extent in the
#: image, pixels; where it is larger, so are its motion and what the model leaves, up to this factor.
REACHES, USUAL_EXTENT_PX, MOST_LARGER = (28, 14, 7, 4), 250.0, 2.5
_NO_PIXELS, _NO_ROWS = np.zeros((0, 2)), np.zeros(0, dtype=bool)
_NOTHING = Measurement(_NO_PIXELS, _NO_PIXELS, _NO_ROWS, _NO_ROWS, np.zeros(0))


@dataclass(frozen=True)
class OutlineAlone:
    """Makes attempts at one frame after the other by the outline of a view.

    Attributes
    ----------
    scout : an estimator in brief, for as long as the outline is looked for.
    balance : what is learnt of the outline.
    search : other shapes than the last.
    """

    estimator: Estimator
    scout: Estimator
    reference: ReferenceView
    options: TrackerOptions
    balance: OutlineBalance
    search: ShapeSearch

    def estimate(self, picture: Image, start: State, prior: Prior | None, lost: bool) -> PoseHypothesis:
        """The outline is searched for far first, then nearer, from one state to the next.

        After a loss it is searched for farther off, and other shapes than the last are tried in turn.
        """
        best = self._along_contour(picture, start, prior, REACHES if lost else REACHES[1:])
        if lost and reject(best, self.options) is not None:
            others = self.search.spread(best.estimate, self.options.searches)
            for other in [*self.search.off_bound(best.estimate), *others]:
                moved = replace(other, camera_from_object=start.camera_from_object)
                found = self._along_contour(picture, moved, prior, REACHES)
                if found.counts[1] > best.counts[1]:
                    best = found
        if not lost or best.outline is None:
            return best
        return replace(best, n_absent=n_absent(picture.grey, best.outline))

    def _along_contour(
        self, picture: Image, start: State, prior: Prior | None, reaches: Sequence[int]
    ) -> PoseHypothesis:
        """The outline searched for from ``start``, at most so many pixels off one time after the other."""
        outline, attempt = self.reference.outline, None
        assert outline is not None
        if picture.has_grey and not outline.knows_brightness:
            outline.take_brightness(picture.grey, start)
        larger, state = np.clip(np.sqrt(outline.extent(start) / USUAL_EXTENT_PX), 1.0, MOST_LARGER), start
        for reach in reaches:
            last = reach == reaches[-1]
            estimator = self.estimator if last else self.scout
            far, before = int(larger * reach), picture.occluder_depth
            seen = outline.measure(picture.grey, state, far, before, motion=picture.motion)
            for _ in range(2):  # the second time without what does not agree
                together = Observations(seen.points, seen.pixels, seen.weights, seen.normals)
                estimate = estimator.fit(together, state, prior)
                attempt = PoseHypothesis(estimate, _NOTHING.valid, _NOTHING, _NOTHING.spread, prior, seen)
                state = estimate.state
                seen = seen.weighted(1.0, self.balance.agreeing_alone(seen, estimate.residuals, last))
        assert attempt is not None
        return attempt

    def learn(self, attempt: PoseHypothesis, picture: Image) -> None:
        """Take in how well the outline agreed in a frame that is believed, and how bright the object is."""
        seen, outline, estimate = attempt.outline, self.reference.outline, attempt.estimate
        assert seen is not None
        measured = seen.points, seen.pixels, seen.weights, estimate.state, seen.normals
        whole, own = self.estimator.evaluate(*measured, attempt.prior)[1], self.estimator.of_pixels(*measured)[1]
        self.balance.learn_outline(seen, estimate.residuals, trace_of_share(whole, own, self.estimator.scale))
        if picture.has_grey and outline is not None:
            shown = estimate.state if picture.motion is None else picture.motion.as_seen(estimate.state)
            outline.take_brightness(picture.grey, shown)

    def left(self, attempt: PoseHypothesis) -> Unexplained:
        """What the model leaves of the outline."""
        assert attempt.outline is not None
        across = attempt.estimate.residuals[attempt.outline.valid]
        common = self.balance.in_common(attempt.outline, attempt.estimate.residuals)
        return Unexplained(common, float(np.sqrt(np.mean(np.sum(across**2, axis=1)))))
