"""Several synchronised cameras that are fixed to each other: one estimate from what all of them see (`rig`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError, TrackingError
from morph_dslam.model import ReducedModel
from morph_dslam.model.model_errors import ModelErrors
from morph_dslam.registration.registration import PosePrior, Registration
from morph_dslam.sources import Frame
from morph_dslam.sources.frames import MissingFrame
from morph_dslam.threads import one_thread_for_algebra
from morph_dslam.timing import frame_clock, stage
from morph_dslam.tracking.anchoring import FIRST_SIGMA_PX, HELD, LEAST_SIGMA_PX, Anchor, CameraLocalization
from morph_dslam.tracking.depth_scale import CommonDepthScale
from morph_dslam.tracking.estimator import Estimate, Prior, State
from morph_dslam.tracking.flat_sides import FlatSides
from morph_dslam.tracking.frame_results import warnings_of_place, with_flat_sides, with_model_errors, within_ranges
from morph_dslam.tracking.frame_starts import FrameGaps, new_filter, next_start
from morph_dslam.tracking.hypothesis import Image
from morph_dslam.tracking.noise import RigObservations
from morph_dslam.tracking.options import NO_DISCREPANCY, NO_LOADS, TrackerOptions
from morph_dslam.tracking.outcomes import (
    BlurredByMotion,
    CameraIgnored,
    CamerasDisagree,
    DepthNotUsed,
    FewPointsAgree,
    FoundBy,
    KnownRefuted,
    ModelDoesNotExplain,
    ObjectMoved,
    PastForgotten,
    PoseSource,
    ReadoutNotUsed,
    Rejection,
    RejectionReason,
    Status,
    TrackingWarning,
)
from morph_dslam.tracking.reference_factors import error_factors_of
from morph_dslam.tracking.reference_misfit import Unexplained
from morph_dslam.tracking.result import STAGES, FrameResult
from morph_dslam.tracking.rig import RigCamera, RigEstimator
from morph_dslam.tracking.rig_errors import RigErrors
from morph_dslam.tracking.tracker import Tracker
from morph_dslam.tracking.tracker_inputs import check_pose, check_tracker
from morph_dslam.tracking.views import KeyframeViews

Array = NDArray[np.float64]
_Kind = TypeVar("_Kind", bound=TrackingWarning)
#: Why several cameras refuse an object whose outline is all there is.
NO_TEXTURE = "the object shows too few corners, and its outline alone is followed with one camera: leave out --with"
OUTLINE_ALONE = "the outline alone (--no-texture) is followed with one camera: leave it or --with out"
#: A camera of which a smaller share of the points agrees with all cameras together contradicts them.
LEAST_AGREEING = 0.5


class RigTracker:
    """Follows one object through the frames of several cameras.

    Each camera follows it by itself, and one state is estimated from what all of them measured. A camera that
    has lost the object goes on from what the others know. Where a map gives the object's pose in the rig, it
    counts once in the common state, as it does in that of each camera. No camera makes reference views: the
    common estimate ties lasting errors to the points of one view a camera.

    Parameters
    ----------
    model : the object; where the registration leaves the angle about an axis open, ``registration.model``.
    cameras : of the rig.
    registration : pose in the rig's frame (the first camera's) and parameters in the reference frames.
    options : as of `Tracker`.
    references : by camera, the reference frame of one instant, as `Tracker` takes it.
    in_sequence : whether the first frames to track are the reference frames or follow them.
    anchor : the map that the object is anchored in, of the first camera; None for a free object.
    seen : by camera, where (h, w) the reference frame shows the object; None for all that it covers.
    keyframes : by camera, other images of the object as it is in the reference frames, with the errors of the
        registration there.

    Raises
    ------
    RegistrationError
        If the object shows too few corners in a reference frame.
    TrackingError
        As `Tracker` does, or if the discrepancy is asked for, or the model has unknown loads, which both are estimated
        from one camera.
    ArgumentError
        If model, registration or options are not what `Tracker` takes.
    """

    def __init__(
        self,
        model: ReducedModel,
        cameras: Sequence[RigCamera],
        registration: Registration,
        options: TrackerOptions | None = None,
        *,
        references: Sequence[NDArray[np.uint8] | Image],
        in_sequence: bool = True,
        anchor: Anchor | None = None,
        seen: Sequence[NDArray[np.bool_] | None] | None = None,
        keyframes: Sequence[KeyframeViews] | None = None,
    ) -> None:
        check_tracker(model, registration, options)
        self.model = registration.model if registration.per_sequence else model
        self.cameras, self.options = tuple(cameras), options or TrackerOptions()
        check_pose(self.options, registration, in_map=anchor is not None or keyframes is not None)
        if self.options.use_discrepancy:
            raise TrackingError(NO_DISCREPANCY)
        if self.model.n_loads:
            raise TrackingError(NO_LOADS)
        self.estimator = RigEstimator(self.model, self.cameras, self.options.estimation)
        error_factors = error_factors_of(registration.covariance, self.estimator.scale)
        # What earlier frames add is found from all cameras together.
        single = replace(self.options, per_sequence=(), random_walk=(), new_views=False)
        # It is the first camera whose depths a registration knows.
        scales = [registration.depth_scale, *[None] * (len(self.cameras) - 1)]
        self.trackers: list[Tracker] = []
        for number, (part, image) in enumerate(zip(self.cameras, references, strict=True)):
            grey = image.grey if isinstance(image, Image) else image
            part.camera.checked_picture(grey, f"the reference frame of camera {number}")
            in_camera = None if error_factors is None else part.chain(len(self.model.parameters)) @ error_factors
            known = Registration(self.model, part.seen(registration.state), depth_scale=scales[number])
            covered = None if seen is None else seen[number]
            others = KeyframeViews(in_camera) if keyframes is None else keyframes[number]
            try:
                tracker = Tracker(
                    self.model, part.camera, known, single,
                    reference=image, in_sequence=in_sequence, seen=covered, keyframes=others,
                )  # fmt: skip
            except RegistrationError as error:
                why = part.not_seen(registration.state, model) or error
                raise RegistrationError(f"camera {number}: {why}") from error
            if tracker.reference.outline_alone:
                raise RegistrationError(f"camera {number}: {NO_TEXTURE}" if self.options.use_texture else OUTLINE_ALONE)
            self.trackers.append(tracker)
        self.trackers[0].anchor = anchor
        self._filter, self._gaps = new_filter(self.estimator, self.options), FrameGaps()
        common = [CommonDepthScale.of(scale, self.options.depth_scale_std) for scale in scales]
        self._errors = RigErrors(self.trackers, self.cameras, common)
        self._model_errors = ModelErrors.of(self.model, self.options.per_sequence)
        self._flat_sides = FlatSides(self.model, self._model_errors)
        self._sigma_px = FIRST_SIGMA_PX
        self._angles, self._last = registration.per_sequence, registration.state if in_sequence else None

    @property
    def state(self) -> State:
        """Last known of the object, in the rig's frame."""
        return self.trackers[0].state

    @property
    def camera(self) -> Camera:
        """The first one."""
        return self.cameras[0].camera

    def know(self, values: Mapping[str, float | tuple[float, float]]) -> None:
        """Take in what something else measures of parameters, in the next frames; see `Tracker.know`."""
        self.estimator.known.tell(values)

    def locate(self, frame: Frame) -> CameraLocalization:
        """Find the first camera in the map by its frame; see `Tracker.locate`."""
        return self.trackers[0].locate(frame)

    @one_thread_for_algebra
    def track(
        self,
        frames: Sequence[Frame | NDArray[np.uint8] | None],
        localization: CameraLocalization | None = None,
        occluder_depths: Sequence[NDArray[np.float32]] | None = None,
    ) -> FrameResult:
        """Find the object in the frames of one instant.

        Parameters
        ----------
        frames : by camera, or their images alone, as `Tracker.track` takes them; None of a camera that has no picture.
        localization : the pose in the rig's frame by the map; None for a free object.
        occluder_depths : by camera, as in `Tracker.track`.

        Raises
        ------
        CameraError
            If a picture or its depth is not of its camera's size, or of another type.
        """
        where = localization or CameraLocalization()
        number, time = _number_and_time(frames)
        self.estimator.known.begin(number, time)
        self._filter.go_on(self._gaps.n_missing(number))
        known, results = where.pose_prior, self._each(frames, time, where.pose_prior, occluder_depths)
        has_moved = bool(_all_of(results, ObjectMoved))
        prior = None if known is None or has_moved else self._prior(known, results)
        with frame_clock(STAGES) as clock, stage("fuse"):
            estimate, measured, rejection = self._together(results, prior)
            self._go_on_from(estimate, _is_recovery(results))
            left: list[Unexplained] = []
            if estimate is not None:
                estimate, left = self._with_errors(estimate, measured, prior)
        times = {name: sum((result.timings_ms[name] for result in results), 0.0) for name in STAGES}
        times["fuse"] += clock.milliseconds["fuse"]
        times["locate"] = where.milliseconds
        told = (*self.estimator.known.warnings, *_ignored(results, measured), *_all_of(results, ReadoutNotUsed)[:1])
        is_hidden = estimate is None and known is not None and not has_moved
        result = FrameResult(
            self.model,
            Status.HIDDEN if is_hidden else Status.LOST,
            rejection=rejection,
            warnings=(*told, *warnings_of_place(has_moved, (), 0, where.why_lost)),
            pose_from=PoseSource.MAP if is_hidden else PoseSource.NONE,
            pose_prior=known if is_hidden else None,
            n_points=sum(result.n_points for result in results),
            timings_ms=times,
            total_ms=sum(result.total_ms for result in results) + clock.total + where.milliseconds,
            motion=results[0].motion,
            modulus_std=self.options.modulus_std,
        )
        if estimate is None:
            return result
        result = replace(result, pose_from=PoseSource.POINTS if prior is None else PoseSource.POINTS_AND_MAP)
        return self._found(result, estimate, measured, results, left)

    def _each(
        self,
        frames: Sequence[Frame | NDArray[np.uint8] | None],
        time: float | None,
        known: PosePrior | None,
        occluder_depths: Sequence[NDArray[np.float32]] | None,
    ) -> list[FrameResult]:
        """What each camera finds by itself at an instant's time; else as `track`, with the map's pose in the rig."""
        results = []
        for number, (tracker, part, frame) in enumerate(zip(self.trackers, self.cameras, frames, strict=True)):
            tracker.estimator.known.take(self.estimator.known)
            if frame is None or isinstance(frame, MissingFrame):
                results.append(tracker.pass_over(time if frame is None else frame.timestamp))
                continue
            if isinstance(frame, Frame):
                part.camera.checked_picture(frame.image, f"frame {frame.index} of camera {number}")
            seen = CameraLocalization(None if known is None else part.seen_pose(known))
            results.append(tracker.track(frame, seen, None if occluder_depths is None else occluder_depths[number]))
        return results

    def _go_on_from(self, estimate: Estimate | None, recovered: bool) -> None:
        """Tell each camera what all of them found, None if nothing, and what the next frame starts from.

        After a loss, which ``recovered`` says, no frame before tells of a velocity.
        """
        before = None if recovered else self._last
        self._last = None if estimate is None else estimate.state
        if estimate is None:
            self._filter.go_on()
            return
        start = next_start(estimate, before or estimate.state, self.model, self.options, self._angles)
        for tracker, part in zip(self.trackers, self.cameras, strict=True):
            tracker.continue_from(part.seen(estimate.state), part.seen(start))

    def _with_errors(
        self, estimate: Estimate, measured: RigObservations, prior: Prior | None
    ) -> tuple[Estimate, list[Unexplained]]:
        """The common estimate with the errors in its covariance, and what it leaves of each camera's residuals."""
        corrected = [tracker.last_correction for tracker in self.trackers]
        views = self._errors.views(estimate, measured, corrected)
        left = [view.unexplained for view in views]
        blurred = [tracker.last_blurred for tracker in self.trackers]
        common = [
            rest.total_px if paths is not None else max(rest.px, tracker.last_doubt_px)
            for tracker, rest, paths in zip(self.trackers, left, blurred, strict=True)
        ]
        known = self.estimator.known_information(estimate.state.parameters)[0]
        return self._errors.added(estimate, views, prior, common, blurred, known), left

    def _found(
        self,
        lost: FrameResult,
        estimate: Estimate,
        measured: RigObservations,
        results: list[FrameResult],
        left: list[Unexplained],
    ) -> FrameResult:
        """A result of the common estimate, in place of the one that would stand without it."""
        used = measured.weights > 0.0
        refuted = _refuted(results)  # what a wrong sensor leaves is no one else's fault
        found = replace(
            lost,
            warnings=(
                *lost.warnings,
                *([PastForgotten()] if self._filter.forgot else []),
                *refuted,
                *sorted(_all_of(results, BlurredByMotion), key=lambda warning: -warning.path_px)[:1],
                *_few_agree(results, measured),
                *_depth_unused(results),
                *([] if refuted else _not_explained(results, left)),
            ),
            unexplained_px=max(rest.px for rest in left),
            status=Status.TRACKED,
            estimate=estimate,
            found_by=FoundBy.LAST_STATE if _is_recovery(results) else FoundBy.FLOW,
            n_inliers=int(used.sum()),
            residual_rms_px=float(np.sqrt(np.mean(np.sum(estimate.residuals[used] ** 2, axis=1)))),
        )
        errors, known = self._model_errors, self.estimator.known.indices
        if errors is not None:
            errors = errors.where_known(known, found.pose_from.is_of_frame_alone)
        found = with_model_errors(found, errors, self._filter.held)
        return within_ranges(with_flat_sides(found, self._flat_sides))

    def _prior(self, known: PosePrior, results: list[FrameResult]) -> Prior | None:
        """What the map tells of the pose; None if the points of a camera show the object elsewhere."""
        if any(result.pose_from is PoseSource.POINTS for result in results):
            return None
        redundancy = np.mean([tracker.reference.redundancy for tracker in self.trackers])
        squared_px = float(redundancy) * self._sigma_px**2
        return known.prior(len(self.model.parameters), squared_px, HELD if self.options.pose == "fixed" else 1.0)

    def _together(
        self, results: list[FrameResult], prior: Prior | None
    ) -> tuple[Estimate | None, RigObservations, Rejection | None]:
        """The estimate from all cameras, what it was made from, and why there is none."""
        measured = RigObservations(tuple(tracker.last_measured for tracker in self.trackers))
        counts = [0 if result.estimate is None else result.n_inliers for result in results]
        best = int(np.argmax(counts))
        seen = results[best].estimate
        if seen is None:
            return None, measured, Rejection(RejectionReason.NO_CAMERA)
        estimate = self.estimator.fit(measured, self.cameras[best].in_rig(seen.state), prior)
        self.estimator.known.learn(estimate.sigma_px)
        limit_px = float(np.clip(self.options.inlier_sigmas * estimate.sigma_px, *self.options.inlier_px))
        measured = agreeing(measured, estimate.residuals, limit_px)
        needed = self.options.least_inliers if prior is None else self.options.least_anchored
        if (measured.weights > 0.0).sum() < needed:
            return None, measured, Rejection(RejectionReason.CAMERAS_CONTRADICT)
        estimate = self.estimator.fit(measured, estimate.state, prior)
        if np.isfinite(estimate.sigma_px):
            self._sigma_px = max(estimate.sigma_px, LEAST_SIGMA_PX)
        return self._filter.fuse(measured, estimate, prior), measured, None


def agreeing(measured: RigObservations, residuals: Array, limit_px: float) -> RigObservations:
    """What was measured without points that are far from an estimate, and without cameras of which most are.

    Parameters
    ----------
    measured : by the cameras.
    residuals : (p, 2) that the estimate leaves of all points, pixels.
    limit_px : length from which on a residual is too large.
    """
    with np.errstate(invalid="ignore"):
        close = np.linalg.norm(residuals, axis=1) < limit_px
    kept = []
    for view, near in zip(measured.views, measured.split(close), strict=True):
        weights = np.where(near, view.weights, 0.0)
        if (weights > 0.0).sum() < LEAST_AGREEING * (view.weights > 0.0).sum():
            weights = np.zeros_like(weights)
        # The depth beside such a point is that of whatever is there.
        depths = None if view.depths is None or not weights.any() else view.depths.only(weights > 0.0)
        kept.append(replace(view, weights=weights, depths=depths))
    return RigObservations(tuple(kept))


def _ignored(results: list[FrameResult], measured: RigObservations) -> list[CameraIgnored]:
    """The cameras that do not count."""
    found = []
    for number, (result, view) in enumerate(zip(results, measured.views, strict=True)):
        if result.estimate is None:
            found.append(CameraIgnored(number, result.status, result.rejection))
        elif not view.weights.any():
            found.append(CameraIgnored(number, result.status))
    return found


def _is_recovery(results: list[FrameResult]) -> bool:
    """Whether all cameras that found the object had lost it."""
    return all(result.recovered or result.estimate is None for result in results)


def _number_and_time(frames: Sequence[Frame | NDArray[np.uint8] | None]) -> tuple[int | None, float | None]:
    """Of an instant, by the first camera that has a picture, which by number is that of all, or stands for one."""
    first = next((frame for frame in frames if isinstance(frame, Frame)), None)
    return (None, None) if first is None else (first.index, first.timestamp)


def _refuted(results: list[FrameResult]) -> list[KnownRefuted]:
    """The known parameters that the images of a camera alone have elsewhere, by those of the camera that is surest."""
    found: dict[str, KnownRefuted] = {}
    for result in results:
        for warning in result.warnings:
            if isinstance(warning, KnownRefuted):
                before = found.setdefault(warning.parameter, warning)
                found[warning.parameter] = max(before, warning, key=lambda one: one.deviations)
    return list(found.values())


def _all_of(results: list[FrameResult], kind: type[_Kind]) -> list[_Kind]:
    """The warnings of a kind, one of each camera that has it."""
    return [warning for result in results if (warning := result.warning(kind)) is not None]


def _few_agree(results: list[FrameResult], measured: RigObservations) -> list[FewPointsAgree]:
    """The warning that few points agree of the camera whose points agree least, of those that count."""
    counted = [result for result, view in zip(results, measured.views, strict=True) if view.weights.any()]
    return sorted(_all_of(counted, FewPointsAgree), key=lambda warning: -warning.spread_px)[:1]


def _depth_unused(results: list[FrameResult]) -> list[DepthNotUsed]:
    """That depth does not count, which is asked of all cameras: of one it is elsewhere, or none has any."""
    each = [result.warning(DepthNotUsed) for result in results if result.estimate is not None]
    elsewhere = [warning for warning in each if warning is not None and warning.ratio is not None]
    return elsewhere[:1] or [warning for warning in each[:1] if warning is not None and None not in each]


def _not_explained(results: list[FrameResult], left: list[Unexplained]) -> list[TrackingWarning]:
    """What to say where the common estimate leaves much of what a camera saw.

    Where that camera alone is explained, it is the cameras that do not agree.
    """
    worst = int(np.argmax([rest.px for rest in left]))
    if not left[worst].is_failure:
        return []
    alone = results[worst].warning(ModelDoesNotExplain) is not None
    return [ModelDoesNotExplain(left[worst].px) if alone else CamerasDisagree(left[worst].px)]
