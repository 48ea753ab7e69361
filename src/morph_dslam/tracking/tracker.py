"""Tracking one object: its pose and parameters in every frame.

`Tracker.process_frame` is the method: follow the bound points from the previous frame, estimate, correct
against the rendered reference view so that nothing drifts, and accept the result on evidence; a lost object
is found again from the reference view's features. A free object's pose is estimated with its parameters; an
anchored one's comes from the camera in the map of the scene, as long as its points agree. There is no
temporal prior on what changes: the previous frames only say where to start.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.diagnostics.duplicate_objects import DuplicateObjects
from morph_dslam.diagnostics.statements import FrameStatements, missed
from morph_dslam.model import ReducedModel
from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.registration.registration import PosePrior
from morph_dslam.sources import Frame
from morph_dslam.timing import StageClock
from morph_dslam.tracking.anchoring import Anchor, Anchoring
from morph_dslam.tracking.covariance import error_factors_of
from morph_dslam.tracking.discrepancy import DiscrepancyFit
from morph_dslam.tracking.estimator import Estimator, Prior, State
from morph_dslam.tracking.frame_estimation import at_constant_velocity, new_filter
from morph_dslam.tracking.measurement import Measurement
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.patches import follow, normalize_contrast
from morph_dslam.tracking.reference import PosedImage, ReferenceView
from morph_dslam.tracking.refinement import Keyframe
from morph_dslam.tracking.result import (
    FOLLOWED,
    FOUND_AGAIN,
    HAS_MOVED,
    RECOVERED,
    STAGES,
    FrameResult,
    Image,
    PoseHypothesis,
    refusal,
)
from morph_dslam.tracking.shape_search import with_undetermined_at_default
from morph_dslam.tracking.views import ActiveView, Change, KeyframeViews, ViewSet

Array = NDArray[np.float64]


class Tracker:
    """Follows one object from its registered reference view.

    Parameters
    ----------
    reference : the reference frame (h, w, 3) uint8, as recorded, or made ready already.
    state : the object in it.
    in_sequence : whether the first frame to process is the reference frame or follows it; if not, the object
        is looked for as after a loss.
    reference_covariance : (d + 6, d + 6) of ``state``; it enters that of every frame. None where nothing is
        known of the error of ``state``.
    seen : (h, w) where the object is seen in the reference frame; all that it covers by default.
    discrepancy : what the object's shape has beyond the model's in the reference frame, if it is known.
    further : other pictures of the object as it is there; they bring the error of ``state`` with them.

    Attributes
    ----------
    reference : the reference view that frames are compared with. state : last known of the object.
    last_seen : where the first view's points were in the last frame that was compared with it.
    last_measured : what the last frame's estimate was made from; without weights if the object was lost.

    Raises
    ------
    RegistrationError
        If the object shows too few corners in the reference frame.
    TrackingError
        If a parameter is to be one over the sequence, or to walk, that the model does not have.
    """

    def __init__(
        self,
        model: ReducedModel,
        camera: Camera,
        reference: NDArray[np.uint8] | Image,
        state: State,
        options: TrackerOptions | None = None,
        in_sequence: bool = True,
        reference_covariance: Array | None = None,
        seen: NDArray[np.bool_] | None = None,
        discrepancy: Discrepancy | None = None,
        further: KeyframeViews | None = None,
    ) -> None:
        self.model, self.camera, self.options = model, camera, options or TrackerOptions()
        self.estimator = Estimator(model, camera, self.options.estimation)
        self._undistortion = camera.undistortion_maps()
        picture = reference if isinstance(reference, Image) else self._prepare(reference)
        further = further or KeyframeViews(error_factors_of(reference_covariance, self.estimator.scale))
        first = PosedImage(picture, state, further.error_factors, seen, discrepancy)
        reference_view = ReferenceView(self.estimator, [first, *further.views], self.options)
        sought = self.options.discrepancy
        self._discrepancy = None if sought is None else DiscrepancyFit(model, camera, sought)
        self._views = ViewSet(self.estimator, reference_view, self.options)
        self._anchoring = Anchoring(self.estimator, reference_view, self.options)
        self._filter = new_filter(self.estimator, self.options)
        self._unfiltered = np.zeros((len(model.parameters) + 6,) * 2)
        self.last_seen: Keyframe | None = None
        self.last_measured = self.reference.nothing_measured
        self._picture, self._pixels = picture, self.reference.pixels
        self._supported = np.ones(len(reference_view.points), dtype=bool)
        self._last, self._velocity_base, self._start = state, state, state
        self._beyond = discrepancy
        self._lost, self._n_lost = not in_sequence, 0
        self._statements = FrameStatements(self._filter.constant)
        self._look_alikes = DuplicateObjects(model.nodes)

    def process_frame(
        self,
        image: NDArray[np.uint8],
        known: PosePrior | None = None,
        depth: NDArray[np.float32] | None = None,
        occluder_depth: NDArray[np.float32] | None = None,
    ) -> FrameResult:
        """Find the object in the next frame (h, w, 3) uint8, as recorded.

        Parameters
        ----------
        known : an anchored object's pose by the map; None for a free one, or where the camera is lost.
        depth : (h, w) metres, NaN where unknown, of a depth camera that sees what the image shows.
        occluder_depth : (h, w) depth of other objects, metres, infinite where there are none: points that
            they hide do not count.
        """
        clock = StageClock(STAGES)
        with clock.stage("prepare"):
            picture = replace(self._prepare(image), depth=depth, occluder_depth=occluder_depth)
        attempt = self._attempt_from_last(picture, self._anchoring.prior(known), clock)
        with clock.stage("search"):
            attempt = self._view.estimation.search_other_shapes(attempt)
        if known is not None and attempt.prior is not None:
            attempt = self._without_map_if_moved(picture, attempt, known, clock)
        why_not, how = refusal(attempt, self.options), FOLLOWED
        if self._lost:
            why_not, how = self._view.recovery.refusal(attempt), FOUND_AGAIN
        if why_not and self._is_to_be_looked_for(known):
            found, why_not = self._view.recovery.recover(picture, self._last.parameters, why_not, clock)
            attempt, how = (attempt, how) if found is None else (found, RECOVERED)
        if why_not:
            self._look_alikes.note_lost(why_not)
        else:
            recovery = self._view.recovery
            why_not = self._look_alikes.refusal(picture, attempt, how == RECOVERED, recovery, clock)
        if not why_not:
            with clock.stage("outline"):
                attempt = self._view.estimation.fit_outline(picture, attempt)
            with clock.stage("depth"):
                attempt = self._view.estimation.fit_depths(picture, attempt)
            with clock.stage("fuse"):
                attempt = self._fuse(attempt)
            if self._discrepancy is not None:
                with clock.stage("discrepancy"):
                    attempt = self._with_discrepancy(attempt, self._discrepancy)
            if known is not None:
                self._anchoring.note(self._anchoring.contradicts(known, attempt))
        self._remember(picture, attempt, bool(why_not), known)
        result = self._result(attempt, why_not, how, known, clock)
        change = self._change_of_view(picture, attempt, result, clock)
        return replace(result, made_view=change is not None and change.is_new, total_ms=clock.total)

    @property
    def _view(self) -> ActiveView:
        return self._views.active

    @property
    def reference(self) -> ReferenceView:
        return self._view.reference

    @property
    def state(self) -> State:
        return self._last

    def continue_from(self, state: State) -> None:
        """Go on from a state of the last frame that is known better from elsewhere, also when it is lost."""
        self._last = self._start = state
        projected = self.camera.project(self.reference.points.in_camera(state))
        self._pixels = np.where(self._supported[:, None], self._pixels, projected)

    def _attempt_from_last(self, picture: Image, prior: Prior | None, clock: StageClock) -> PoseHypothesis:
        """Estimate from the last known state; by way of the previous frame if the object was seen there."""
        if self._lost:
            start = self._last if prior is None else prior.placed(self._last)
            attempt = self._view.estimation.correct(picture, start, None, prior, clock)
            if refusal(attempt, self.options):
                return attempt
            # It may have another shape by now: what that hides or shows is only known once it is found.
            return self._view.estimation.correct(picture, attempt.estimate.state, None, prior, clock)
        with clock.stage("flow"):
            followed = self._follow(picture, prior)
        with clock.stage("estimate"):
            start = self._view.estimation.rough(followed, self._start, prior)
        return self._view.estimation.correct(picture, start, followed, prior, clock)

    def _follow(self, picture: Image, prior: Prior | None) -> Measurement:
        """Follow the points that supported the previous frame's estimate from that frame to this one."""
        rows = np.flatnonzero(self._supported)
        guesses = self._pixels + self._expected_motion(prior)
        found, ok = follow(
            self._picture.normalized, picture.normalized, self._pixels[rows], guesses[rows], self.options.flow
        )
        pixels, valid = guesses, np.zeros(len(guesses), dtype=bool)
        pixels[rows], valid[rows] = found, ok
        return Measurement(pixels, valid, self._supported, np.ones(len(pixels)))

    def _expected_motion(self, prior: Prior | None) -> Array:
        """Image motion (p, 2) as the map has it, or at the velocity of two frames; only a first guess."""
        points = self.reference.points
        last = self.camera.project(points.in_camera(self._last))
        if prior is not None:
            there = prior.placed(self._last)
            return np.nan_to_num(self.camera.project(points.in_camera(there)) - last)
        return np.nan_to_num(last - self.camera.project(points.in_camera(self._velocity_base)))

    def _without_map_if_moved(
        self, picture: Image, attempt: PoseHypothesis, known: PosePrior, clock: StageClock
    ) -> PoseHypothesis:
        """The attempt, or one by the points alone where they are not where the map has the object."""
        refused = bool(refusal(attempt, self.options))
        if refused and self._lost:
            return attempt
        if not refused and not self._anchoring.contradicts(known, attempt):
            return attempt
        free = self._attempt_from_last(picture, None, clock)
        return attempt if refusal(free, self.options) else free

    def _is_to_be_looked_for(self, known: PosePrior | None) -> bool:
        """A hidden object, whose place is known from the map, is looked for elsewhere now and then."""
        return known is None or self._anchoring.has_moved or self._n_lost % self.options.look_every == 0

    def _fuse(self, attempt: PoseHypothesis) -> PoseHypothesis:
        """The attempt with what earlier frames tell of the parameters that are one per sequence."""
        self.last_measured = measured = self._view.estimation.measured(attempt)
        estimate = self._filter.fuse(measured, attempt.estimate, attempt.prior)
        return replace(attempt, estimate=replace(estimate, residuals=estimate.residuals[: len(attempt.inliers)]))

    def _with_discrepancy(self, attempt: PoseHypothesis, fit: DiscrepancyFit) -> PoseHypothesis:
        """The attempt with what the object's shape has beyond the model's."""
        last = None if self._lost else self._beyond
        self._beyond = fit.fit(self.last_measured, attempt.estimate.state, last)
        return replace(attempt, discrepancy=self._beyond)

    def _remember(self, picture: Image, attempt: PoseHypothesis, lost: bool, known: PosePrior | None) -> None:
        """Keep what the next frame starts from; a lost frame keeps the last known shape."""
        if not lost:
            estimate, weights = attempt.estimate, attempt.inliers.astype(float)
            self.last_seen = None
            if not self._view.number:
                self.last_seen = Keyframe(
                    attempt.measurement.pixels, weights, estimate.state, estimate.sigma_px, attempt.outline
                )
            self._velocity_base = estimate.state if self._lost else self._last
            self._last = estimate.state
            self._start = with_undetermined_at_default(self.model, estimate)
            if self.options.start == "constant-velocity":
                self._start = at_constant_velocity(self._velocity_base, self._start)
            self._supported = attempt.inliers
            projected = self.camera.project(self.reference.points.in_camera(self._last))
            self._pixels = np.where(attempt.inliers[:, None], attempt.measurement.pixels, projected)
            self._anchoring.learn(estimate, self.last_measured)
            self._view.estimation.learn(attempt)
            if not self._lost:
                self._view.recovery.learn(attempt)
        elif known is not None and not self._anchoring.has_moved:
            self._last = replace(self._last, camera_from_object=known.pose)
        if lost:
            self.last_measured = self.reference.nothing_measured
        self._picture, self._lost = picture, lost
        self._n_lost = self._n_lost + 1 if lost else 0

    def _change_of_view(
        self, picture: Image, attempt: PoseHypothesis, result: FrameResult, clock: StageClock
    ) -> Change | None:
        """Go on with another reference view if it shows more of what is seen, or may show a lost object."""
        if result.estimate is None:
            change = self._views.after_lost(self._n_lost)
        else:
            self._unfiltered = result.estimate.covariance - attempt.estimate.covariance
            if result.recovered:  # what was only just found again is followed for a frame first
                return None
            left = result.unexplained_px
            change = self._views.after_tracked(picture, attempt, result.estimate, left, clock)
        if change is None:
            return None
        self._filter.change_points(self._views.point_change(change.view, self._unfiltered))
        self._unfiltered = np.zeros_like(self._unfiltered)
        self._views.active, self._anchoring.reference = change.view, change.view.reference
        self._supported, self._pixels = change.supported, change.pixels
        return change

    def _result(
        self, attempt: PoseHypothesis, why_not: str, how: str, known: PosePrior | None, clock: StageClock
    ) -> FrameResult:
        has_moved = self._anchoring.has_moved
        aside = f"; {HAS_MOVED}" if has_moved else ""
        if self._view.number:
            aside += f"; by reference view {self._view.number}"
        if why_not:
            return missed(attempt, why_not, aside, None if has_moved else known, clock)
        doubt, unobservable = self._look_alikes.doubt, self._filter.unobservable
        return self._statements.tracked(attempt, unobservable, how, aside, doubt, self._view, clock)

    def _prepare(self, image: NDArray[np.uint8]) -> Image:
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if self._undistortion is not None:
            grey = cv2.remap(grey, *self._undistortion, interpolation=cv2.INTER_LINEAR)
        normalized = normalize_contrast(grey, self.options.flow.contrast_window)  # type: ignore[arg-type]
        return Image(grey, normalized)  # type: ignore[arg-type]


# From a frame to the object in it: the camera in the map of the scene, then the object.
# The two steps can run one after the other or, for different frames, in two threads.


@dataclass(frozen=True)
class CameraLocalization:
    """What the map told of a frame.

    Attributes
    ----------
    known : the object's pose by the map, None where the camera is lost. why_lost : the camera; empty if not.
    milliseconds : that it took.
    """

    known: PosePrior | None = None
    why_lost: str = ""
    milliseconds: float = 0.0

    def told_of(self, result: FrameResult) -> FrameResult:
        """The result of an anchored object, with the time that finding the camera took, or why it failed."""
        reason = result.reason
        if self.known is None:
            reason = f"{reason}; the camera is lost in the map: {self.why_lost}"
        return replace(
            result,
            reason=reason,
            timings_ms=result.timings_ms | {"locate": self.milliseconds},
            total_ms=result.total_ms + self.milliseconds,
        )


class AnchoredTracker:
    """Both steps; without an anchor the object is free and the first one does nothing.

    ``anchor`` is of this object alone.
    """

    def __init__(self, camera: Camera, tracker: Tracker, anchor: Anchor | None = None) -> None:
        self._camera, self.tracker, self.anchor = camera, tracker, anchor

    def with_tracker(self, tracker: Tracker) -> AnchoredTracker:
        """The same with another tracker; the camera stays where it was found."""
        return AnchoredTracker(self._camera, tracker, self.anchor)

    def process(self, frame: Frame) -> FrameResult:
        """Both steps for the next frame; raises CameraError if it has not the camera's size."""
        return self.track(frame, self.locate(frame))

    def locate(self, frame: Frame) -> CameraLocalization:
        """Find the camera of the next frame in the map."""
        self._camera.check_image(frame.image, f"frame {frame.index}")
        if self.anchor is None:
            return CameraLocalization()
        known, camera = self.anchor.locate(frame.image, frame.index, frame.timestamp)
        return CameraLocalization(next(iter(known.values()), None), camera.reason, camera.total_ms)

    def track(self, frame: Frame, located: CameraLocalization) -> FrameResult:
        """Find the object in a frame that `locate` has seen."""
        depth = frame.depth if self.tracker.options.use_depth else None
        result = self.tracker.process_frame(frame.image, located.known, depth)
        return result if self.anchor is None else located.told_of(result)
