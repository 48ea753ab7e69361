"""Tracking one object: its pose and parameters in every frame.

`Tracker.track` is the method. A free object's pose is estimated with its parameters; that of an anchored one
comes from the camera in the map of the scene, as long as its points agree. There is no temporal prior on what
changes: the previous frames only say where to start.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.even_rows import evenly
from morph_dslam.model import ReducedModel
from morph_dslam.model.model_errors import ModelErrors
from morph_dslam.registration.registration import PosePrior, Registration
from morph_dslam.slam.self_calibration import OffByFactors
from morph_dslam.sources import Frame
from morph_dslam.threads import one_thread_for_algebra
from morph_dslam.timing import frame_clock, stage
from morph_dslam.tracking.anchoring import Anchor, Anchoring, CameraLocalization
from morph_dslam.tracking.compilation import announce_compilation
from morph_dslam.tracking.covariance import symmetric_root
from morph_dslam.tracking.depth_scale import CommonDepthScale, DepthScale
from morph_dslam.tracking.discrepancy import DiscrepancyFit
from morph_dslam.tracking.displacement_jumps import DisplacementJump, JumpDetector
from morph_dslam.tracking.estimator import Estimator, Prior, State
from morph_dslam.tracking.flat_sides import FlatSides
from morph_dslam.tracking.frame_results import (
    lost_result,
    pose_source,
    tracked_result,
    warnings_of_place,
    with_flat_sides,
    with_model_errors,
    within_ranges,
)
from morph_dslam.tracking.frame_starts import FrameGaps, new_filter, next_start
from morph_dslam.tracking.hypothesis import Image, PoseHypothesis, reject
from morph_dslam.tracking.measurement import FOLLOWED_A_UNKNOWN, LEAST_FOLLOWED, MOST_FOLLOWED, Followed
from morph_dslam.tracking.noise import middle
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outcomes import FoundBy, PoseSource, Rejection, RejectionReason, Status
from morph_dslam.tracking.patches import LEVELS, follow, zero_where_unknown
from morph_dslam.tracking.reference import PosedImage, ReferenceView, first_view
from morph_dslam.tracking.reference_correction import ReferenceCorrection
from morph_dslam.tracking.reference_factors import error_factors_of
from morph_dslam.tracking.refinement import Keyframe
from morph_dslam.tracking.result import STAGES, FrameResult
from morph_dslam.tracking.row_motion import StateHistory
from morph_dslam.tracking.still import held
from morph_dslam.tracking.tracker_inputs import (
    Picture,
    check_camera,
    check_look,
    check_pose,
    check_tracker,
    occluders_of,
)
from morph_dslam.tracking.views import (
    ActiveView,
    Change,
    KeyframeViews,
    ViewSet,
    choose_keyframe_views,
    image_of,
    registered_images,
    registered_keyframes,
)

Array = NDArray[np.float64]


class Tracker:
    """Follows one object through the frames of one camera.

    To begin anew, from another registration say, make another one. With the pose "still" it holds the registration's,
    which `track` estimates from all frames of a recording.

    Parameters
    ----------
    model : the object; where the registration leaves the angle about an axis open, ``registration.model``.
    camera : its intrinsics and lens.
    registration : pose and parameters in the reference frame, and how well they are known.
    options : what is measured and what is demanded; defaults if None.
    reference : (h, w, 3) or (h, w) uint8, the reference frame as recorded, or made ready; by default the keyframes of
        the scene that the object is registered in or, without one, the first frame that is tracked.
    in_sequence : whether the first frame to track is the reference frame or follows it; if not, as always after
        keyframes, the object is looked for as after a loss.
    anchor : the map that the object is anchored in; by default that of the keyframes, unless the options' pose is
        free.
    seen : (h, w), where the reference frame shows the object; all that it covers by default.
    keyframes : other images of the object as it is in the reference frame; they bring the error of the
        registration with them.

    Attributes
    ----------
    reference : the reference view that frames are compared with.
    state : last known of the object.
    last_seen : where the first view's points were in the last frame that was compared with it.
    last_measured : what the last frame's estimate was made from; without weights if the object was lost.
    last_blurred : (p, 2), the paths over which motion smeared the points in it; None where it did no harm.
    last_correction : what of the reference's error its points were corrected by; None where they were not.
    last_doubt_px : what the points that agreed in it may have in common, as of `Recovery.doubt`.
    is_taken : whether another object stands where this one would stand in a state, in the frame of the camera: there it
        is not found again after a loss. A `Session` of several objects sets it; None where no other is known.

    Raises
    ------
    RegistrationError
        If a free object shows too few corners in the reference frame, its place in the scene has no covariance, or it
        was registered in a map and neither its scene nor ``reference``, ``keyframes`` or ``anchor`` is given.
    TrackingError
        If a per-sequence parameter, or one that walks, is not in the model, or the pose is to be fixed without a map.
    ArgumentError
        If model, camera, registration or options are of another kind (files are read before), or the registration is of
        another mesh than the model, or of other parameters.
    """

    def __init__(
        self,
        model: ReducedModel,
        camera: Camera,
        registration: Registration,
        options: TrackerOptions | None = None,
        *,
        reference: NDArray[np.uint8] | Image | None = None,
        in_sequence: bool = True,
        anchor: Anchor | None = None,
        seen: NDArray[np.bool_] | None = None,
        keyframes: KeyframeViews | None = None,
    ) -> None:
        check_tracker(model, registration, options)
        check_camera(camera)
        in_map = anchor is not None or keyframes is not None
        check_look(registration, is_given=in_map or reference is not None)
        announce_compilation()
        self.model = registration.model if registration.per_sequence else model
        self.camera, self.options, self.anchor = camera, options or TrackerOptions(), anchor
        check_pose(self.options, registration, in_map)
        self.estimator = Estimator(self.model, camera, self.options.estimation)
        self._model_errors = ModelErrors.of(self.model, self.options.per_sequence)
        self._flat_sides = FlatSides(self.model, self._model_errors)
        self._undistortion = camera.undistortion_maps()
        self._registration, self._seen, self._keyframes = registration, seen, keyframes
        self._depth_scale = registration.depth_scale or DepthScale()
        use, sought = self.options.use_discrepancy, self.options.discrepancy
        self._discrepancy = DiscrepancyFit(self.model, camera, sought) if use else None
        self._filter = new_filter(self.estimator, self.options)
        self._unfiltered = np.zeros((len(self.model.parameters) + 6,) * 2)
        self._still: Prior | None = None
        if registration.scene is not None and reference is None:
            reference, in_sequence = self._from_scene(), False
        self.is_taken: Callable[[State], bool] | None = None
        self._lost, self._n_lost, self._gaps = not in_sequence, 0, FrameGaps()
        self._in_sequence = in_sequence
        self._history = StateHistory(camera, self.model.nodes.mean(axis=0))
        self.last_seen: Keyframe | None = None
        self.last_blurred: Array | None = None
        self.last_correction: ReferenceCorrection | None = None
        self.last_doubt_px = 0.0
        self._views: ViewSet | None = None
        self._last = self._last_by_points = self._velocity_base = self._start = registration.state
        self._jumps_before: tuple[DisplacementJump, ...] = ()
        if reference is not None and not isinstance(reference, Image):
            reference = Picture.of(reference, camera).made_ready(self._undistortion)
        if reference is not None:
            self._begin(reference)

    @one_thread_for_algebra
    def track(
        self,
        frame: Frame | NDArray[np.uint8],
        localization: CameraLocalization | None = None,
        occluder_depth: NDArray | None = None,
    ) -> FrameResult:
        """Find the object in the next frame.

        Parameters
        ----------
        frame : as recorded, with depth where a depth camera saw it too; or its image alone, (h, w, 3) or (h, w) uint8.
        localization : what `locate` found in the frame; None to find it here.
        occluder_depth : (h, w), what hides the object, whose points do not count there: a mask of bool, True where
            something is before it in the frame as recorded; or depth of other objects in the undistorted image, metres,
            infinite, NaN or 0 where there are none.

        Raises
        ------
        CameraError
            If image, depth or mask is not of the camera's size, or of another type.
        """
        camera = localization or self.locate(frame)
        numbered = (frame.index, frame.timestamp) if isinstance(frame, Frame) else (None, None)
        self.estimator.known.begin(*numbered)
        self._filter.go_on(self._gaps.n_missing(numbered[0]))
        with frame_clock(STAGES) as clock:
            image = self._prepare(frame, occluder_depth, camera.image)
            prior = self._predict(camera)
            followed = self._follow(image, prior)
            hypothesis = self._match(image, followed, prior)
            hypothesis = self._view.recovery.brought_in_reach(image, self._search(hypothesis))
            hypothesis = self._check_map(image, hypothesis, camera)
            hypothesis, found_by, rejection = self._gate(image, hypothesis)
            if rejection is not None:
                hypothesis, found_by, rejection = self._relocalize(image, hypothesis, rejection, camera)
            elif found_by is FoundBy.FLOW:
                hypothesis, found_by = self._reconsider(image, hypothesis)
            if rejection is None:
                hypothesis = self._refine(image, hypothesis, camera)
            self._update(image, hypothesis, rejection, camera)
            result = self._result(hypothesis, found_by, rejection, camera)
            if rejection is None and self.estimator.loads is not None:
                # Now only: the result is what the frame tells beside the prior that it had.
                found = hypothesis.estimate
                self.estimator.loads.learn(found.state.parameters, found.covariance, found.sigma_px)
            change = self._choose_view(image, hypothesis, result)
            result = with_model_errors(result, self._errors_now(result.pose_from), self._filter.held)
            result = within_ranges(with_flat_sides(result, self._flat_sides))
        times = clock.milliseconds | {"locate": camera.milliseconds}
        made_view = change is not None and change.is_new
        return replace(result, made_view=made_view, timings_ms=times, total_ms=clock.total + camera.milliseconds)

    def know(self, values: Mapping[str, float | tuple[float, float]]) -> None:
        """Take in what something else measures of parameters, in the next frames, such as a pressure.

        Parameters
        ----------
        values : by the parameter's name its value, SI, or that with its standard deviation; by default this is a
            two-hundredth of the range. An empty mapping ends it.

        Raises
        ------
        TrackingError
            If the model has no such parameter, or a value is not in its range.
        ArgumentError
            If a value is no finite number, or that with its deviation.
        """
        self.estimator.known.tell(values)

    @one_thread_for_algebra
    def locate(self, frame: Frame | NDArray[np.uint8]) -> CameraLocalization:
        """Find the camera of the next frame in the map, and with it the object's pose there.

        It may run in another thread than `track`, one frame ahead.
        """
        if not isinstance(frame, Frame) or self.anchor is None:
            return CameraLocalization()
        return next(iter(self.anchor.localized(frame, self.camera).values()))

    def _from_scene(self) -> Image:
        """Take what the scene shows of the object, and its map, and return the reference image."""
        known, options = self._registration, self.options
        keyframes = {frame: image_of(view) for frame, view in registered_keyframes(known).items()}
        if self._keyframes is None and options.further_views and len(known.views) > 1:
            first, *others = registered_images(known, keyframes)
            self._keyframes = choose_keyframe_views(self.estimator, first, others, options)
        if self.anchor is None and options.pose != "free":
            self.anchor = Anchor.of({self.model.name: known}, self.camera)
        assert known.frame is not None
        return keyframes[known.frame]

    # -- the steps of a frame -----------------------------------------------------------------------------

    def _prepare(self, frame: Frame | NDArray[np.uint8], occluder_depth: NDArray | None, ready: Image | None) -> Image:
        """Undistort and normalize contrast; the first frame is the reference if none was given, a gap is a loss."""
        with stage("prepare"):
            picture = Picture.of(frame, self.camera, self.options.use_depth)
            motion = self._history.motion(frame.timestamp if isinstance(frame, Frame) else None)
            image = ready or picture.made_ready(self._undistortion)
            occluders = occluders_of(occluder_depth, self.camera)
            depth = None if picture.depth is None else self._depth_scale.corrected(picture.depth)
            image = replace(image, depth=depth, occluder_depth=occluders, motion=motion, is_taken=self.is_taken)
            if self._views is None:
                self._begin(image)
            if isinstance(frame, Frame) and self._gaps.after_gap(frame.timestamp):
                self._lost = True
                self._see_nothing()
            return image

    def _predict(self, camera: CameraLocalization) -> Prior | None:
        """What is known of the object's pose, by the map or for the whole sequence, as a term of the cost."""
        if self.options.pose == "still":
            return self._still
        return self._anchoring.prior(camera.pose_prior)

    def _follow(self, image: Image, prior: Prior | None) -> Followed | None:
        """Follow some of the points that supported the previous frame's estimate from there; None after a loss."""
        if self._lost or self.reference.outline_alone:
            return None
        with stage("flow"):
            rows = np.flatnonzero(self._supported)
            count = min(max(FOLLOWED_A_UNKNOWN * len(self.estimator.scale), LEAST_FOLLOWED), MOST_FOLLOWED, len(rows))
            rows = rows[evenly(len(rows), count)]
            last = self.reference.projected(self._last)
            guesses = self._pixels + self._expected_motion(last, prior)
            # Half of the size is exact enough for a start.
            found, ok = follow(self._image.half, image.half, 0.5 * self._pixels[rows], 0.5 * guesses[rows], LEVELS - 1)
            pixels, valid = guesses, np.zeros(len(guesses), dtype=bool)
            # By the points, not as outline and depths correct the state: offsets are added to what `rough` has.
            by_points, found = self.reference.projected(self._last_by_points), 2.0 * found
            if image.motion is not None:
                found = image.motion.since_last(by_points[rows], found)
            pixels[rows], valid[rows] = found, ok
            return Followed(pixels, valid, zero_where_unknown(self._pixels - by_points))

    def _match(self, image: Image, followed: Followed | None, prior: Prior | None) -> PoseHypothesis:
        """Compare with the rendered reference view and solve for pose and parameters."""
        estimation = self._view.estimation
        if self.reference.outline_alone:
            start = self._last if self._lost else self._start
            start = start if prior is None else prior.placed(start)
            return estimation.alone.estimate(image, start, prior, self._lost)
        if followed is None:
            start = self._last if prior is None else prior.placed(self._last)
            hypothesis = estimation.correct(image, start, None, prior)
            if reject(hypothesis, self.options) is None:
                # It may have another shape by now: what that occludes or shows is only known once it is found.
                hypothesis = estimation.correct(image, hypothesis.estimate.state, None, prior)
        else:
            with stage("estimate"):
                start = estimation.rough(followed, self._start, prior)
            hypothesis = estimation.correct(image, start, followed.offsets, prior)
        return estimation.correct_shape(image, hypothesis)

    def _search(self, hypothesis: PoseHypothesis) -> PoseHypothesis:
        """Try other shapes where the residuals are large, and the mirrored tilt, lest it stay in a local minimum."""
        with stage("search"):
            estimation = self._view.estimation
            return estimation.in_likelier_tilt(estimation.search_other_shapes(hypothesis))

    def _check_map(self, image: Image, hypothesis: PoseHypothesis, camera: CameraLocalization) -> PoseHypothesis:
        """Go by the points alone where they are not where the map has the object."""
        if camera.pose_prior is None or hypothesis.prior is None or hypothesis.outline_alone:
            return hypothesis
        rejected = reject(hypothesis, self.options) is not None
        if rejected and self._lost:
            return hypothesis
        if not rejected and not self._anchoring.contradicts(camera.pose_prior, hypothesis):
            return hypothesis
        free = self._match(image, self._follow(image, None), None)
        free = self._view.recovery.brought_in_reach(image, free)
        return hypothesis if reject(free, self.options) is not None else free

    def _gate(self, image: Image, hypothesis: PoseHypothesis) -> tuple[PoseHypothesis, FoundBy, Rejection | None]:
        """Whether to accept the hypothesis; after a loss more is demanded, and other places may be better."""
        recovery = self._view.recovery
        if not self._lost:
            return hypothesis, FoundBy.FLOW, recovery.reject(hypothesis, followed=True)
        hypothesis, rejection = recovery.unmistaken(image, hypothesis)
        return hypothesis, FoundBy.LAST_STATE, rejection

    def _relocalize(
        self, image: Image, hypothesis: PoseHypothesis, rejection: Rejection, camera: CameraLocalization
    ) -> tuple[PoseHypothesis, FoundBy, Rejection | None]:
        """Look for the object by its features; a hidden one, whose place is known, only now and then."""
        if hypothesis.outline_alone:
            return hypothesis, FoundBy.LAST_STATE, rejection
        if self._placed_by_map(camera) is not None and self._n_lost % self.options.look_every:
            return hypothesis, FoundBy.FEATURES, rejection
        found, why = self._view.recovery.recover(image, self._last, rejection, self._still)
        return hypothesis if found is None else found, FoundBy.FEATURES, why

    def _reconsider(self, image: Image, hypothesis: PoseHypothesis) -> tuple[PoseHypothesis, FoundBy]:
        """Where few of the points that were followed agree, look for features, too: the object may have jumped."""
        found = self._view.recovery.jumped_to(image, hypothesis, self._last.parameters)
        return (hypothesis, FoundBy.FLOW) if found is None else (found, FoundBy.FEATURES)

    def _refine(self, image: Image, hypothesis: PoseHypothesis, camera: CameraLocalization) -> PoseHypothesis:
        """Add outline, depth, what earlier frames tell of per-sequence parameters, and the discrepancy."""
        estimation, systematic = self._view.estimation, self._view.systematic
        hypothesis = estimation.with_all(image, hypothesis, systematic)
        with stage("fuse"):
            self.last_measured = measured = estimation.beside.measured(hypothesis, correlated=True)
            estimate = self._filter.fuse(measured, hypothesis.estimate, hypothesis.prior)
            if not hypothesis.outline_alone:
                estimate = replace(estimate, residuals=estimate.residuals[: len(hypothesis.inliers)])
            hypothesis = replace(hypothesis, estimate=estimate)
        if self._discrepancy is not None:
            with stage("discrepancy"):
                last = None if self._lost else self._beyond
                self._beyond = self._discrepancy.fit(self.last_measured, hypothesis.estimate.state, last)
                hypothesis = replace(hypothesis, discrepancy=self._beyond)
        if not self._lost:
            with stage("correct"):
                is_later = self._view.number or not self._in_sequence
                warped = None if is_later or systematic is None else systematic.warped
                hypothesis = estimation.with_blur(image, hypothesis, self._last_by_points, warped)
        self.last_blurred, self.last_correction = hypothesis.blurred, hypothesis.correction
        if camera.pose_prior is not None and not hypothesis.outline_alone:
            self._anchoring.note(self._anchoring.contradicts(camera.pose_prior, hypothesis))
        return hypothesis

    def _update(
        self, image: Image, hypothesis: PoseHypothesis, rejection: Rejection | None, camera: CameraLocalization
    ) -> None:
        """Keep what the next frame starts from; a lost frame keeps the last known shape."""
        if rejection is None:
            self._learn(image, hypothesis)
        else:
            self._filter.go_on()
            self._see_nothing()
            placed = self._placed_by_map(camera)
            if placed is not None:
                self._last = self._last_by_points = replace(self._last, camera_from_object=placed.pose)
            self._history.add(None if placed is None else self._last)
        self._image, self._lost = image, rejection is not None
        self._n_lost = self._n_lost + 1 if self._lost else 0

    def _see_nothing(self) -> None:
        """Nothing is measured, and any loads may act by the next frame."""
        self.last_measured, self.last_blurred, self.last_correction = self.reference.nothing_measured, None, None
        self.last_doubt_px = 0.0
        if self.estimator.loads is not None:
            self.estimator.loads.forget()

    # -- results ------------------------------------------------------------------------------------------

    def _result(
        self, hypothesis: PoseHypothesis, found_by: FoundBy, rejection: Rejection | None, camera: CameraLocalization
    ) -> FrameResult:
        """Status, estimate with all known errors in its covariance, and warnings."""
        number, has_moved = self._view.number, self._anchoring.has_moved
        told = (*self._history.warnings, *self.estimator.known.warnings)
        warnings = (*told, *warnings_of_place(has_moved, self.jumps, number, camera.why_lost))
        self.last_doubt_px = 0.0 if rejection is not None else self._view.recovery.doubt(hypothesis)
        if rejection is not None:
            placed = self._placed_by_map(camera)
            # Of a hidden object, whose place is known, only what its frame's time says.
            told = warnings if placed is None else self.estimator.known.warnings
            result = lost_result(self.model, hypothesis, rejection, placed, told)
        else:
            result = tracked_result(self.model, hypothesis, self._view, self._filter, warnings, self._model_errors)
            is_still = self.options.pose == "still"
            result = replace(result, found_by=found_by, pose_from=pose_source(hypothesis, is_still), jumps=self.jumps)
        return replace(result, view=number, motion=self._image.motion, modulus_std=self.options.modulus_std)

    def _placed_by_map(self, camera: CameraLocalization) -> PosePrior | None:
        """The object's pose by the map; None for a free or moved object, or where the camera is lost."""
        return None if self._anchoring.has_moved else camera.pose_prior

    # -- reference views and state ------------------------------------------------------------------------

    @property
    def _view(self) -> ActiveView:
        assert self._views is not None
        return self._views.active

    @property
    def reference(self) -> ReferenceView:
        return self._view.reference

    @property
    def state(self) -> State:
        return self._last

    def deformation_errors(self) -> OffByFactors | None:
        """By how much what the deformation moves points by may be off in the last frame; None where that is unknown."""
        systematic, errors = self._view.systematic, self._errors_now()
        if systematic is None:
            return None
        of_model = None if errors is None else errors.in_common
        return systematic.deformation_errors(self._last, self._filter.by_known, of_model)

    def _errors_now(self, pose_from: PoseSource | None = None) -> ModelErrors | None:
        """Those of the model, by what is known in this frame; where its pose is from counts if it is given."""
        errors, free = self._model_errors, pose_from is not None and pose_from.is_of_frame_alone
        return None if errors is None else errors.where_known(self.estimator.known.indices, free)

    @property
    def jumps(self) -> tuple[DisplacementJump, ...]:
        """Where the surface was found to open or slip along a line so far."""
        return (*self._jumps_before, *self._jumps.jumps)

    def know_jumps(self, jumps: Sequence[DisplacementJump]) -> None:
        """Take in where another tracker found the surface open up to this frame."""
        self._jumps_before = tuple(jumps)

    def continue_from(self, state: State, start: State | None = None) -> None:
        """Go on from a state of the last frame that is known better from elsewhere, also when it is lost.

        Parameters
        ----------
        state : in the last frame.
        start : where the next frame's estimate starts; by default there.
        """
        self._last, self._start = state, start or state
        if self._lost:
            self._last_by_points = state
        self._history.replace_last(state)
        if self._views is not None:
            self._pixels = np.where(
                self._supported[:, None], self._pixels, self.reference.projected(self._last_by_points)
            )

    def take_over(self, other: Tracker) -> None:
        """Go on after the last frame of another tracker of the object, with what that knows but for the pose."""
        pose = self.state.camera_from_object
        self.continue_from(replace(other.state, camera_from_object=pose))
        self._last_by_points, self._velocity_base = self._last, replace(other._velocity_base, camera_from_object=pose)
        # From that frame, not the reference picture: the object may have another shape since.
        self._image, self._pixels = other._image, self.reference.projected(self._last)
        self._lost, self._n_lost = other._lost, other._n_lost
        self.know_jumps(other.jumps)
        self.estimator.known.take(other.estimator.known)
        if self.estimator.loads is not None and other.estimator.loads is not None:
            self.estimator.loads.take(other.estimator.loads)
        self._gaps = other._gaps

    def pass_over(self, timestamp: float | None) -> FrameResult:
        """Take in that the camera has no picture of an instant; the next frame is as after a loss.

        Parameters
        ----------
        timestamp : of the instant, seconds; None if nobody tells it.
        """
        self._history.motion(timestamp)
        self._history.add(None)
        self._filter.go_on()
        self._gaps.pass_over()
        if timestamp is not None:
            self._gaps.after_gap(timestamp)
        if self._views is not None:  # before the first frame nothing is followed that could be lost
            self._lost, self._n_lost = True, self._n_lost + 1
            self._see_nothing()
        rejection = Rejection(RejectionReason.NO_PICTURE)
        return FrameResult(self.model, Status.LOST, rejection=rejection, timings_ms=dict.fromkeys(STAGES, 0.0))

    def _begin(self, image: Image) -> None:
        """Make the reference view."""
        known = self._registration
        keyframes = self._keyframes or KeyframeViews(error_factors_of(known.covariance, self.estimator.scale))
        first = PosedImage(image, known.state, keyframes.error_factors, self._seen, known.discrepancy)
        # An object that the map has, but that shows no texture, is followed by its outline unasked.
        in_map = known.map_registration is not None and self.options.pose != "free"
        view, self.options = first_view(self.estimator, [first, *keyframes.views], self.options, in_map)
        options = self.options
        if options.pose == "still":
            # Where there are points, their places on the mesh have this error too: `SystematicErrors` adds both.
            factors = keyframes.error_factors if view.outline_alone else None
            lasting = None if factors is None else factors[len(self.model.parameters) :]
            self._still = replace(held(known.state, self.estimator), lasting=lasting)
        scale = CommonDepthScale.of(known.depth_scale, options.depth_scale_std) if options.use_depth else None
        self._views = ViewSet(self.estimator, view, options, scale)
        self._jumps = JumpDetector(view.points.rest, float(np.linalg.norm(np.ptp(self.model.nodes, axis=0))))
        self._anchoring = Anchoring(self.estimator, view, options)
        self.last_measured = view.nothing_measured
        self._image, self._pixels = image, view.pixels
        self._supported = np.ones(len(view.points), dtype=bool)
        self._beyond = known.discrepancy

    def _expected_motion(self, last: Array, prior: Prior | None) -> Array:
        """Image motion (p, 2) by the map, or at the velocity of two frames; only a first guess.

        ``last`` (p, 2) is where the points were in the last state.
        """
        if prior is not None and prior is not self._still:
            return zero_where_unknown(self.reference.projected(prior.placed(self._last)) - last)
        return zero_where_unknown(last - self.reference.projected(self._velocity_base))

    def _learn(self, image: Image, hypothesis: PoseHypothesis) -> None:
        """Take in an accepted frame."""
        estimate, inliers, found = hypothesis.estimate, hypothesis.inliers, hypothesis.measurement
        self.last_seen = None
        if not self._view.number:
            weights = inliers.astype(float)
            known = (estimate.state, estimate.sigma_px, hypothesis.outline)
            self.last_seen = Keyframe(found.pixels, weights, *known, found.recorded, hypothesis.point_depths)
            # What is before the object, or beside its place, is no part of its surface.
            if not hypothesis.outline_alone and not self._view.recovery.doubt(hypothesis):
                shape = self.reference.points.field.value(estimate.state.parameters)
                depth = middle(self.reference.points.in_camera(estimate.state)[:, 2])
                residuals = estimate.residuals[: len(inliers)]
                self._jumps.learn(residuals, found.valid, inliers, shape, depth / self.camera.fx)
        self._velocity_base = estimate.state if self._lost else self._last
        self._last, self._last_by_points = estimate.state, hypothesis.points_state
        self._history.add(self._last, self._last_by_points)
        angles = self._registration.per_sequence
        self._start = next_start(estimate, self._velocity_base, self.model, self.options, angles)
        self._supported = inliers
        self._pixels = np.where(inliers[:, None], found.recorded, self.reference.projected(self._last_by_points))
        self._anchoring.learn(estimate.sigma_px, self.last_measured.redundancy)
        self._view.estimation.learn(hypothesis, image)
        if not self._lost:
            self._view.recovery.learn(hypothesis)

    def _choose_view(self, image: Image, hypothesis: PoseHypothesis, result: FrameResult) -> Change | None:
        """Go on with another reference view if it shows more of what is seen, or may show a lost object."""
        assert self._views is not None
        if result.estimate is None:
            change = self._views.after_lost(self._n_lost)
        else:
            self._unfiltered = result.estimate.covariance - hypothesis.estimate.covariance
            if result.recovered:  # what was only just found again is followed for a frame first
                self._views.after_recovered()
                return None
            change = self._views.after_tracked(image, hypothesis, result.estimate, result.unexplained_px)
        if change is None:
            return None
        # What the filter knows and what it does not may partly cancel out: it goes on with what is added alone.
        scale = self.estimator.scale
        besides = scale[:, None] * symmetric_root(self._unfiltered / np.outer(scale, scale))
        self._filter.change_points(self._views.point_change(change.view, besides @ besides.T))
        self._unfiltered = np.zeros_like(self._unfiltered)
        if change.view.systematic is not None:
            change.view.systematic.forget_frames()
        self._views.active, self._anchoring.reference = change.view, change.view.reference
        self._supported, self._pixels = change.supported, change.pixels
        self._last_by_points = change.by_points or self._last
        self._history.change_points(change.by_points)
        return change
