"""Looking for a lost object by its features in the whole frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import ReducedModel
from morph_dslam.registration.starts import shape_starts, solve_pnp
from morph_dslam.timing import stage
from morph_dslam.tracking.covariance import LEAST_SPREAD_PX
from morph_dslam.tracking.frame_estimation import FrameEstimation
from morph_dslam.tracking.hypothesis import MOST_AGREE, Image, PoseHypothesis, agree, reject
from morph_dslam.tracking.measurement import LARGEST_CORRECTION_PX
from morph_dslam.tracking.noise import middle
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outcomes import Rejection, RejectionReason
from morph_dslam.tracking.patches import zero_where_unknown
from morph_dslam.tracking.reference import ReferenceView
from morph_dslam.tracking.relocalization import matching_shifts
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
#: Where other places look alike, it is not believed if its points spread more than so many times the usual; where fewer
#: than `UNHIDDEN` of all agree, `CLOSE_TO_USUAL`.
ALIKE_TO_USUAL = 5.0
#: So many times a better place is looked for from a better one.
MOST_ROUNDS = 3
#: In so many places where other objects stand it is found before it counts as lost.
MOST_TAKEN = 4
#: So many standard deviations tell two places apart.
SIGNIFICANT = 3.0
#: Share of the latest frame in the usual spread. One that agrees far less closely counts as twice as loose as usual, or
#: by that much more, pixels.
LEARNING_RATE, LEAST_RISE_PX = 0.05, 0.1


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
        """Take in how closely the points agreed in a frame in which the object was followed.

        The reference picture itself, which is often the first frame, agrees with itself, and tells nothing of others.
        """
        spread = attempt.estimate.sigma_px
        if not LEAST_SPREAD_PX < spread < np.inf:
            return
        if np.isnan(self._usual_px):
            self._usual_px = spread
        if self.partly_hidden(attempt):
            return
        rise = spread - self._usual_px
        if self.is_loose(attempt):
            rise = min(rise, max(self._usual_px, LEAST_RISE_PX))
        self._usual_px += LEARNING_RATE * rise

    def doubt(self, attempt: PoseHypothesis) -> float:
        """By how much, pixels, the points that agree may be off together; 0 where nothing is doubtful.

        Where something hides part of the object, and the points that agree do so less closely than usual, something
        else is in the windows of many: what their residuals have more than usual is no noise that averages out. Of an
        object that leaves the picture, or turns away, most points that are to be seen agree. Only where they do so no
        more closely than what looks alike does, the state that has the others out of sight may itself be mistaken.
        """
        spread = attempt.estimate.sigma_px
        if np.isnan(self._usual_px) or not np.isfinite(spread):  # so few points that nothing is left of them
            return 0.0
        if self.is_loose(attempt):
            return float(np.sqrt(spread**2 - self._usual_px**2))
        is_known, to_usual = self._known_by_map(attempt), CLOSE_TO_USUAL
        if is_known and _agree_of_visible(attempt, self._options.least_share):  # fewer points tell as much
            return 0.0
        if not is_known and not self.partly_hidden(attempt):
            if agree(attempt, MOST_AGREE):
                return 0.0
            to_usual = ALIKE_TO_USUAL
        if spread < to_usual * self._usual_px:
            return 0.0
        return float(np.sqrt(spread**2 - self._usual_px**2))

    def reject(self, attempt: PoseHypothesis, followed: bool, alike: bool = False) -> Rejection | None:
        """Why an object is not accepted; None when it is.

        One that was not ``followed`` must agree more closely, and about as closely as usual where others are ``alike``.
        """
        rejection = reject(attempt, self._options)
        if rejection is not None or attempt.outline_alone or self._known_by_map(attempt):
            return rejection
        spread = attempt.estimate.sigma_px
        to_usual = ALIKE_TO_USUAL if agree(attempt, UNHIDDEN) else CLOSE_TO_USUAL
        mistakable = alike and spread > to_usual * self._usual_px
        if not mistakable and spread < self._loosest_px(attempt, followed):
            return None
        visible, count = attempt.counts
        return Rejection(RejectionReason.LOOSE_AGREEMENT, count, visible, spread_px=attempt.estimate.sigma_px)

    def _loosest_px(self, attempt: PoseHypothesis, followed: bool) -> float:
        """The spread from which on the points that agree do so by chance, pixels; infinite where none is too large."""
        usual = np.nan_to_num(self._usual_px)  # 0 where it was never followed yet
        most, loosest = agree(attempt, MOST_AGREE), max(LOOSE_PX, LOOSE_TO_USUAL * usual)
        if followed:
            return np.inf if agree(attempt, self._options.least_share) else loosest
        if not most:
            return max(CLOSE_PX, CLOSE_TO_USUAL * usual)
        return loosest if usual else np.inf

    def is_loose(self, attempt: PoseHypothesis) -> bool:
        """Whether points agree far less closely than usual: as where those of a regular print are taken for others."""
        if attempt.outline_alone or np.isnan(self._usual_px):
            return False
        return max(LOOSE_PX, LOOSE_TO_USUAL * self._usual_px) < attempt.estimate.sigma_px < np.inf

    def _known_by_map(self, attempt: PoseHypothesis) -> bool:
        """Whether the frame's camera and the map say where it is; a pose that is held says nothing of a frame."""
        return attempt.prior is not None and self._options.pose != "still"

    def partly_hidden(self, attempt: PoseHypothesis) -> bool:
        """Whether something else seems to be before the object."""
        return not _agree_of_visible(attempt, UNHIDDEN)

    def brought_in_reach(self, picture: Image, attempt: PoseHypothesis) -> PoseHypothesis:
        """Compare once more in the state that was found, where few points agree and some were out of reach before."""
        few = not agree(attempt, MOST_AGREE) or self.partly_hidden(attempt)
        found, drawing = attempt.measurement, attempt.measurement.drawing
        if not few or drawing is None or reject(attempt, self._options) is not None:
            return attempt
        state, missed = attempt.estimate.state, found.visible & ~attempt.inliers
        moved = zero_where_unknown(self._reference.projected(state) - self._reference.projected(drawing.state))
        if np.linalg.norm(moved[missed], axis=1).max(initial=0.0) < LARGEST_CORRECTION_PX:
            return attempt
        return self._estimation.correct(picture, state, None, attempt.prior)

    def unmistaken(self, picture: Image, attempt: PoseHypothesis) -> tuple[PoseHypothesis, Rejection | None]:
        """The attempt after a loss, or what explains the frame better in a place that looks alike; or why neither.

        A regular print that is shifted by a period agrees nearly everywhere.
        """
        if attempt.prior is not None or reject(attempt, self._options) is not None or attempt.outline_alone:
            rejection = self.reject(attempt, followed=False)
            if rejection is None and attempt.prior is None and _is_taken(picture, attempt):
                rejection = _taken(attempt)
            return attempt, rejection
        best, rejection = attempt, None
        # A better place comes with a better shape, from which the right one may be in reach.
        for _ in range(MOST_ROUNDS):
            attempt = best
            shifts = self._shifts(picture, attempt.estimate.state)
            shifts = shifts[np.linalg.norm(shifts, axis=1) >= LARGEST_CORRECTION_PX]
            places = [attempt, *self._shifted(picture, attempt.estimate.state, shifts)]
            free = [place for place in places if not _is_taken(picture, place)]
            if not free:
                return attempt, _taken(attempt)
            best, rejection = self._chosen(free, alike=len(shifts) > 0)
            if best is attempt:
                break
        return best, rejection

    def _chosen(self, places: list[PoseHypothesis], alike: bool) -> tuple[PoseHypothesis, Rejection | None]:
        """The place that explains a frame best, and why it is not to be believed, if it is not."""
        best, *others = sorted(places, key=lambda place: -int(place.inliers.sum()))
        rival = next((other for other in others if self._apart(best, other) and self._about_as_good(other, best)), None)
        if rival is None:
            return best, self.reject(best, followed=False, alike=alike)
        counts = int(best.inliers.sum()), int(rival.inliers.sum())
        return best, Rejection(RejectionReason.TWO_PLACES, *counts)

    def _shifts(self, picture: Image, state: State) -> Array:
        """By how much (k, 2), pixels, the object in ``state`` has to be moved to where a frame looks like it."""
        with stage("recover"):
            return matching_shifts(picture.normalized, self._reference.rendered(state))

    def _shifted(self, picture: Image, state: State, shifts: Array) -> list[PoseHypothesis]:
        """The object moved from ``state`` in the image, where its points agree somehow."""
        pose, places = state.camera_from_object, list[PoseHypothesis]()
        depth = middle(self._reference.points.in_camera(state)[:, 2])
        for shift in shifts / [self._camera.fx, self._camera.fy] * depth:
            moved = RigidTransform(pose.rotation, pose.translation + np.append(shift, 0.0))
            place = self._estimation.correct(picture, replace(state, camera_from_object=moved), None, None)
            if reject(place, self._options) is not None:
                continue
            # Compared again in the shape that was found, hardly a point may agree any more.
            place = self._estimation.correct(picture, place.estimate.state, None, None)
            if reject(place, self._options) is None:
                places.append(place)
        return places

    def _about_as_good(self, other: PoseHypothesis, best: PoseHypothesis) -> bool:
        """Whether chance may have made more points agree with the best place than with another one.

        Points that agree with one of both alone tell them apart; were both places right, they would fall to either
        as a coin does. Points whose windows overlap count as one.
        """
        limit = np.linalg.norm(best.estimate.residuals[: len(best.inliers)][best.inliers], axis=1).max()
        with np.errstate(invalid="ignore"):
            close = np.linalg.norm(other.estimate.residuals[: len(other.inliers)], axis=1) <= limit
        agreeing = other.inliers & close
        for_best, for_other = int((best.inliers & ~agreeing).sum()), int((agreeing & ~best.inliers).sum())
        return for_best - for_other < SIGNIFICANT * np.sqrt((for_best + for_other) * self._reference.redundancy)

    def recover(
        self, picture: Image, last: State, rejection: Rejection, held: Prior | None = None
    ) -> tuple[PoseHypothesis | None, Rejection | None]:
        """The object somewhere in the frame, or None and why it is lost.

        Parameters
        ----------
        last : its state known last.
        rejection : why it was not found by its last state.
        held : its pose, where this is one over the sequence; then the object can be nowhere else.
        """
        found = None if held is not None else self._by_appearance(picture, last)
        if found is None:
            found, why = self._find_free(picture, self._shapes(last.parameters), held)
            if why is not None:
                return None, replace(rejection, then=why)
            if found is not None and held is None:
                found, mistaken = self.unmistaken(picture, found)
                if mistaken is not None:
                    return None, replace(rejection, then=mistaken)
        if found is None or held is not None:
            return found, rejection if found is None else None
        other = self.another(picture, found)
        if other is not None:
            counts = int(found.inliers.sum()), int(other.inliers.sum())
            return None, replace(rejection, then=Rejection(RejectionReason.TWO_PLACES, *counts))
        return found, None

    def jumped_to(self, picture: Image, followed: PoseHypothesis, last_shape: Array) -> PoseHypothesis | None:
        """The object where its features are, if most of its points agree there, and more closely than ``followed``.

        It is looked for where fewer than half of the points agree of an object that is followed freely, and in doubt,
        or all far less closely than usual: in the first of such frames and now and then. None where there is another
        one like it in the frame, too.
        """
        free = followed.prior is None and not followed.outline_alone
        few = not agree(followed, MOST_AGREE)
        doubted = free and self.doubt(followed) > 0.0 and (few or self.is_loose(followed))
        self._n_doubted = self._n_doubted + 1 if doubted else 0
        if not doubted or (self._n_doubted - 1) % self._options.look_every:
            return None
        found, _ = self._find_free(picture, self._shapes(last_shape), None)
        if found is None:
            return None
        found, mistaken = self.unmistaken(picture, found)
        agrees = agree(found, MOST_AGREE) and found.estimate.sigma_px < followed.estimate.sigma_px
        if mistaken is not None or not agrees:
            return None
        return found if self.another(picture, found) is None else None

    def another(self, picture: Image, found: PoseHypothesis) -> PoseHypothesis | None:
        """Another one like the object that was found, elsewhere in the frame; None if there is none."""
        shapes = [found.estimate.state.parameters, self._model.default]  # it may rest
        other, _ = self._find_free(picture, shapes, None, self._elsewhere(found, None))
        return other if other is not None and self._apart(found, other) else None

    def _elsewhere(self, found: PoseHypothesis, mask: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
        """Where (h, w) to look, 255, but for the place that was found; 0 where ``mask`` is."""
        with stage("recover"):
            elsewhere = np.where(self._reference.covered(found.estimate.state), 0, 255).astype(np.uint8)
        return elsewhere if mask is None else np.minimum(elsewhere, mask)

    def _find_free(
        self, picture: Image, shapes: list[Array], held: Prior | None, mask: NDArray[np.uint8] | None = None
    ) -> tuple[PoseHypothesis | None, Rejection | None]:
        """A place where the object is to be believed and no other one stands; or None, and why, if it is known."""
        taken: Rejection | None = None
        for _ in range(MOST_TAKEN):
            found, matches = self._find(picture, shapes, mask, held)
            if found is None:
                return None, taken if matches is None or taken else Rejection(RejectionReason.FEW_FEATURES, matches)
            if held is not None or not _is_taken(picture, found):
                return found, None
            taken, mask = _taken(found), self._elsewhere(found, mask)
        return None, taken

    def _find(
        self, picture: Image, shapes: list[Array], mask: NDArray[np.uint8] | None, held: Prior | None = None
    ) -> tuple[PoseHypothesis | None, int | None]:
        """A place where the object is to be believed, or None; and how many features agreed, if too few."""
        with stage("recover"):
            state, matches = self._reference.relocaliser.find(picture.grey, shapes, mask)
        if state is None:
            return None, matches
        return self._settled(picture, state if held is None else held.placed(state), held), None

    def _by_appearance(self, picture: Image, last: State) -> PoseHypothesis | None:
        """The object in the place that looks most like it in its last state; None if it is not to be believed."""
        places = self._shifted(picture, last, self._shifts(picture, last))
        places = [place for place in places if not _is_taken(picture, place)]
        best, rejection = self._chosen(places, alike=True) if places else (None, None)
        if best is None or rejection is not None:
            return None
        found = self._settled(picture, best.estimate.state, None)
        return None if found is None or _is_taken(picture, found) else found

    def _settled(self, picture: Image, state: State, held: Prior | None) -> PoseHypothesis | None:
        """The object near ``state``, in the shape that explains the frame best; None if it is not to be believed."""
        candidate = self._estimation.correct(picture, state, None, held)
        candidate = self._estimation.correct(picture, candidate.estimate.state, None, held)
        if reject(candidate, self._options) is not None:
            return None
        with stage("search"):
            better = self._estimation.best_of(candidate, self._starts(candidate))
        candidate = self._estimation.correct(picture, better.estimate.state, None, held)
        return candidate if self.reject(candidate, followed=False) is None else None

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


def _agree_of_visible(attempt: PoseHypothesis, share: float) -> bool:
    """Whether this share of the points that an attempt has in sight support it."""
    return int(attempt.inliers.sum()) >= share * int(attempt.measurement.visible.sum())


def _is_taken(picture: Image, place: PoseHypothesis) -> bool:
    """Whether another object stands there."""
    return picture.is_taken is not None and picture.is_taken(place.estimate.state)


def _taken(place: PoseHypothesis) -> Rejection:
    """Why a place where another object stands is not accepted."""
    points, agreeing = place.counts
    return Rejection(RejectionReason.PLACE_TAKEN, agreeing, points)
