"""Looking for a lost object by its features in the whole frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.model import ReducedModel
from morph_dslam.registration.landmarks import shape_starts, solve_pnp
from morph_dslam.timing import stage
from morph_dslam.tracking.frame_estimation import FrameEstimation
from morph_dslam.tracking.hypothesis import MOST_AGREE, Image, PoseHypothesis, agree, reject
from morph_dslam.tracking.measurement import LARGEST_CORRECTION_PX
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outcomes import Rejection, RejectionReason
from morph_dslam.tracking.reference import ReferenceView
from morph_dslam.tracking.state import Prior, State

Array = NDArray[np.float64]
#: An object that is found anew is believed if half of its points agree, or if they agree as closely as this,
#: pixels, or as so many times the usual spread of their residuals: what looks alike by chance does not, nor
#: do windows that see the rim of what is before the object.
CLOSE_PX, CLOSE_TO_USUAL = 0.25, 1.5
#: An object that was followed is lost where fewer of its points agree than `TrackerOptions.least_share`, and these by
#: more than this, pixels, and than so many times the usual spread. Where more agree, the model may be that far off.
LOOSE_PX, LOOSE_TO_USUAL = 1.0, 10.0
#: Something is before the object where less than this share of the points that it does not hide itself agree.
UNHIDDEN = 0.75
#: At most about so many shapes are tried, lest a mirrored one that fits nearly as well is taken.
MOST_SHAPES = 27
#: Share of the latest frame in the usual spread.
LEARNING_RATE = 0.05


class Recovery:
    """Finds the object again by the features of its reference view, unless it could be in two places."""

    def __init__(
        self,
        model: ReducedModel,
        camera: Camera,
        reference: ReferenceView,
        estimation: FrameEstimation,
        options: TrackerOptions,
    ) -> None:
        self._model, self._reference, self._camera = model, reference, camera
        self._estimation, self._options = estimation, options
        self._usual_px, self._n_doubted = np.nan, 0

    def learn(self, attempt: PoseHypothesis) -> None:
        """Take in how closely the points agreed in a frame in which the object was followed."""
        spread = attempt.estimate.sigma_px
        if not np.isfinite(spread):
            return
        if np.isnan(self._usual_px):
            self._usual_px = spread
        if self.partly_hidden(attempt):
            return
        self._usual_px += LEARNING_RATE * (spread - self._usual_px)

    def doubt(self, attempt: PoseHypothesis) -> float:
        """By how much, pixels, the points that agree may be off together; 0 where nothing is doubtful.

        Where something hides part of the object, or less than half of the points agree, and those not as
        closely as usual, something else is in the windows of many: what their residuals have more than usual
        is no noise that averages out.
        """
        if np.isnan(self._usual_px):
            return 0.0
        if self._known_by_map(attempt):  # fewer points tell as much
            if agree(attempt, self._options.least_share):
                return 0.0
        elif agree(attempt, MOST_AGREE) and not self.partly_hidden(attempt):
            return 0.0
        spread = attempt.estimate.sigma_px
        if spread < CLOSE_TO_USUAL * self._usual_px:
            return 0.0
        return float(np.sqrt(spread**2 - self._usual_px**2))

    def reject(self, attempt: PoseHypothesis, followed: bool) -> Rejection | None:
        """Why an object is not accepted; None when it is. One that was not ``followed`` must agree more closely."""
        rejection = reject(attempt, self._options)
        if rejection is not None or attempt.outline_alone or self._known_by_map(attempt):
            return rejection
        if agree(attempt, self._options.least_share if followed else MOST_AGREE):
            return None
        least, to_usual = (LOOSE_PX, LOOSE_TO_USUAL) if followed else (CLOSE_PX, CLOSE_TO_USUAL)
        usual = np.nan_to_num(self._usual_px)  # 0 where it was never followed yet
        if attempt.estimate.sigma_px < max(least, to_usual * usual):
            return None
        visible, count = attempt.counts
        return Rejection(RejectionReason.LOOSE_AGREEMENT, count, visible, spread_px=attempt.estimate.sigma_px)

    def _known_by_map(self, attempt: PoseHypothesis) -> bool:
        """Whether the frame's camera and the map say where it is; a pose that is held says nothing of a frame."""
        return attempt.prior is not None and self._options.pose != "still"

    def partly_hidden(self, attempt: PoseHypothesis) -> bool:
        """Whether something else seems to be before the object."""
        return int(attempt.inliers.sum()) < UNHIDDEN * int(attempt.measurement.visible.sum())

    def recover(
        self, picture: Image, last_shape: Array, rejection: Rejection, held: Prior | None = None
    ) -> tuple[PoseHypothesis | None, Rejection | None]:
        """The object somewhere in the frame, or None and why it is lost.

        Parameters
        ----------
        last_shape : (d,), the parameters known last.
        rejection : why it was not found by its last state.
        held : its pose, where this is one over the sequence; then the object can be nowhere else.
        """
        found, matches = self._find(picture, self._shapes(last_shape), None, held)
        if matches is not None:
            return None, replace(rejection, then=Rejection(RejectionReason.FEW_FEATURES, matches))
        if found is None or held is not None:
            return found, rejection if found is None else None
        other = self.another(picture, found)
        if other is not None:
            counts = int(found.inliers.sum()), int(other.inliers.sum())
            return None, replace(rejection, then=Rejection(RejectionReason.TWO_PLACES, *counts))
        return found, None

    def jumped_to(self, picture: Image, followed: PoseHypothesis, last_shape: Array) -> PoseHypothesis | None:
        """The object where its features are, if most of its points agree there, and more closely than ``followed``.

        It is looked for where fewer than half of the points agree of an object that is followed freely, and in doubt:
        in the first of such frames and now and then. None where there is another one like it in the frame, too.
        """
        free = followed.prior is None and not followed.outline_alone
        doubted = free and not agree(followed, MOST_AGREE) and self.doubt(followed) > 0.0
        self._n_doubted = self._n_doubted + 1 if doubted else 0
        if not doubted or (self._n_doubted - 1) % self._options.look_every:
            return None
        found, _ = self._find(picture, self._shapes(last_shape), None)
        if found is None or not agree(found, MOST_AGREE) or found.estimate.sigma_px >= followed.estimate.sigma_px:
            return None
        return found if self.another(picture, found) is None else None

    def another(self, picture: Image, found: PoseHypothesis) -> PoseHypothesis | None:
        """Another one like the object that was found, elsewhere in the frame; None if there is none."""
        with stage("recover"):
            covered = self._reference.covered(found.estimate.state)
            elsewhere = np.where(covered, 0, 255).astype(np.uint8)
        other, _ = self._find(picture, self._shapes(found.estimate.state.parameters), elsewhere)
        return other if other is not None and self._apart(found, other) else None

    def _find(
        self, picture: Image, shapes: list[Array], mask: NDArray[np.uint8] | None, held: Prior | None = None
    ) -> tuple[PoseHypothesis | None, int | None]:
        """A place where the object is to be believed, or None; and how many features agreed, if too few."""
        with stage("recover"):
            state, matches = self._reference.relocaliser.find(picture.grey, shapes, mask)
        if state is None:
            return None, matches
        state = state if held is None else held.placed(state)
        candidate = self._estimation.correct(picture, state, None, held)
        candidate = self._estimation.correct(picture, candidate.estimate.state, None, held)
        if reject(candidate, self._options) is not None:
            return None, None
        with stage("search"):
            better = self._estimation.best_of(candidate, self._starts(candidate))
        candidate = self._estimation.correct(picture, better.estimate.state, None, held)
        return (candidate if self.reject(candidate, followed=False) is None else None), None

    def _starts(self, candidate: PoseHypothesis) -> list[State]:
        """Shapes spread over the box, each in the held pose, or where it fits the supporting points best."""
        if candidate.prior is not None:
            place = candidate.prior.placed(candidate.estimate.state)
            return [replace(place, parameters=shape) for shape in shape_starts(self._model, MOST_SHAPES)]
        points, rows = self._reference.points, candidate.inliers
        pixels = candidate.measurement.pixels[rows]
        starts = []
        for shape in shape_starts(self._model, MOST_SHAPES):
            positions = (points.rest + points.field.value(shape))[rows]
            starts += [State(shape, pose) for pose in solve_pnp(positions, pixels, self._camera)]
        return starts

    def _apart(self, found: PoseHypothesis, other: PoseHypothesis) -> bool:
        """Whether two attempts are of different places in the image."""
        between = np.linalg.norm(found.measurement.pixels - other.measurement.pixels, axis=1)
        return float(np.nanmedian(between)) > LARGEST_CORRECTION_PX

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
