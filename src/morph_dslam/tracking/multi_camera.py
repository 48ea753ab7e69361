"""Several synchronised cameras that are fixed to each other: one estimate from what all of them see.

The pose that is estimated is that of the object in the rig's frame, which is the first camera's. Each camera
sees the object at camera_from_object = camera_from_rig rig_from_object, so an increment (w, v) of the rig's
pose is (R w, R v) of the camera's, with R the rotation of camera_from_rig, and the costs of all are summed.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import ReducedModel
from morph_dslam.registration.registration import PosePrior, Registration
from morph_dslam.slam.frame_images import FrameImages
from morph_dslam.sources import open_source
from morph_dslam.timing import frame_clock, stage
from morph_dslam.tracking.anchoring import FIRST_SIGMA_PX, HELD, LEAST_SIGMA_PX
from morph_dslam.tracking.covariance import error_factors_of
from morph_dslam.tracking.estimator import Estimate, EstimationOptions, Estimator, LinearCost, Prior, State
from morph_dslam.tracking.frame_estimation import new_filter
from morph_dslam.tracking.hypothesis import Image
from morph_dslam.tracking.levenberg_marquardt import minimise
from morph_dslam.tracking.measurement import PATCH_WINDOW
from morph_dslam.tracking.noise import RigObservations
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outcomes import (
    CameraIgnored,
    CameraLost,
    FoundBy,
    ObjectMoved,
    PoseSource,
    Rejection,
    RejectionReason,
    Status,
    TrackingWarning,
)
from morph_dslam.tracking.reference import PosedImage
from morph_dslam.tracking.result import STAGES, FrameResult
from morph_dslam.tracking.setup import Setup, views_of
from morph_dslam.tracking.systematic_errors import SystematicErrors, inverse_of_seen
from morph_dslam.tracking.tracker import CameraLocalization, Tracker
from morph_dslam.tracking.views import KeyframeViews, choose_keyframe_views

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RigCamera:
    """A camera and where it is: ``camera_from_rig``, metres; the first camera's is the identity."""

    camera: Camera
    camera_from_rig: RigidTransform

    def seen(self, state: State) -> State:
        """The state in this camera's frame of a state in the rig's."""
        return replace(state, camera_from_object=self.camera_from_rig @ state.camera_from_object)

    def seen_pose(self, known: PosePrior) -> PosePrior:
        """The pose in this camera of what the map tells of that in the rig's; the rig itself is exact."""
        rotation = self.camera_from_rig.rotation
        turn = np.asarray(scipy.linalg.block_diag(rotation, rotation))
        return PosePrior(self.camera_from_rig @ known.pose, turn @ known.from_camera @ turn.T, turn @ known.lasting)

    def in_rig(self, state: State) -> State:
        """The inverse of `seen`."""
        return replace(state, camera_from_object=self.camera_from_rig.inverse @ state.camera_from_object)

    def chain(self, n_parameters: int) -> Array:
        """(d + 6, d + 6) from increments in the rig's frame to those in the camera's."""
        rotation = self.camera_from_rig.rotation
        return np.asarray(scipy.linalg.block_diag(np.eye(n_parameters), rotation, rotation))


class RigEstimator:
    """Finds states from what several cameras measured at the same time; as `Estimator` for one.

    Parameters
    ----------
    cameras : of the rig. What they measured comes in the same order.
    """

    def __init__(
        self, model: ReducedModel, cameras: Sequence[RigCamera], options: EstimationOptions | None = None
    ) -> None:
        self.model, self.cameras = model, tuple(cameras)
        self.options = options or EstimationOptions()
        self._single = [Estimator(model, part.camera, self.options) for part in self.cameras]
        self._chains = [part.chain(len(model.parameters)) for part in self.cameras]

    @property
    def scale(self) -> Array:
        """Of the unknowns (d + 6,), as `Estimator` has it."""
        return self._single[0].scale

    def evaluate(
        self, measured: RigObservations, state: State, prior: Prior | None = None
    ) -> tuple[float, Array, Array, Array]:
        """Cost, Hessian, gradient, and residuals (p, 2) of all points at a state in the rig's frame."""
        size = len(state.parameters) + 6
        cost, hessian, gradient, residuals = 0.0, np.zeros((size, size)), np.zeros(size), []
        for single, part, chain, view in zip(self._single, self.cameras, self._chains, measured.views, strict=True):
            found = single.evaluate(
                view.points, view.pixels, view.weights, part.seen(state), view.normals, depths=view.depths
            )
            cost += found[0]
            hessian += chain.T @ found[1] @ chain
            gradient += chain.T @ found[2]
            residuals.append(found[3])
        if prior is not None:
            terms = prior.terms(state)
            cost, hessian, gradient = cost + terms[0], hessian + terms[1], gradient + terms[2]
        return cost, hessian, gradient, np.concatenate(residuals)

    def fit(self, measured: RigObservations, start: State, prior: Prior | None = None) -> Estimate:
        """Minimise the sum of all cameras' costs from ``start``, a state in the rig's frame."""
        options, first = self.options, self._single[0]
        found = minimise(
            lambda state: self.evaluate(measured, state, prior),
            start,
            first.box,
            options.max_iterations,
            options.tolerance,
        )
        return first.finished(found, measured.weights, measured.numbers)

    def linear(self, measured: RigObservations, estimate: Estimate) -> LinearCost:
        """The cost of what was measured, about an estimate made from it."""
        costs, first = [], 0
        for single, part, chain, view in zip(self._single, self.cameras, self._chains, measured.views, strict=True):
            last = first + len(view.points)
            seen = replace(estimate, state=part.seen(estimate.state), residuals=estimate.residuals[first:last])
            costs.append(single.linear(view, seen).in_unknowns(chain))
            first = last
        return LinearCost.joined(costs)


# What the error of a rig's reference state does to the estimates that all its cameras make together.
# As for one camera (`systematic_errors`), the points were bound by the reference state, and an error e of it
# enters each estimate through them. Each camera sees e as C e, with C its chain from increments in the rig's
# frame to those in its own, so that the sum of C' J' W M J0 C over the cameras pushes the estimate. In
# further pictures of the undeformed object the same error factors make another e each.


class RigReference:
    """Adds to covariances what the reference state is off by.

    Parameters
    ----------
    trackers : by camera, each at its one reference view, which knows how its pictures are off by the error
        factors that are the same for all. cameras : of the rig.
    """

    def __init__(self, trackers: Sequence[Tracker], cameras: Sequence[RigCamera]) -> None:
        parts = [part for tracker in trackers for part in tracker.reference.parts]
        self._is_known = all(part.error_factors is not None for part in parts)
        self._cameras, self._scale = cameras, trackers[0].estimator.scale
        self._chains = [part.chain(len(self._scale) - 6) for part in cameras]
        self._systematic = [
            SystematicErrors(tracker.estimator, tracker.reference.points, tracker.reference.parts, PATCH_WINDOW)
            for tracker in trackers
        ]
        self._counts = [len(tracker.reference.points) for tracker in trackers]

    def added(self, estimate: Estimate, measured: RigObservations, prior: Prior | None) -> Estimate:
        """The estimate, a state in the rig's frame, with a covariance that holds the reference's error."""
        if not self._is_known:
            return estimate
        size = len(self._scale)
        hessian, first = np.zeros((size, size)), 0
        pushes = []
        if prior is not None:
            hessian += prior.terms(estimate.state)[1]
        for part, chain, systematic, count, view in zip(
            self._cameras, self._chains, self._systematic, self._counts, measured.views, strict=True
        ):
            rows = estimate.residuals[first : first + count]
            first += len(view.weights)
            seen = replace(estimate, state=part.seen(estimate.state), residuals=rows)
            own, pushed = systematic.pushed(seen, view.weights[:count])
            hessian += chain.T @ own @ chain
            pushes.append(chain.T @ pushed)
        transfer = inverse_of_seen(hessian, self._scale) @ np.sum(pushes, axis=0)
        return replace(estimate, covariance=estimate.covariance + transfer @ transfer.T)


# In which pictures of a scan each camera of a rig has the undeformed object, if the rig filmed the scan.
# The registration has the object in the first camera's keyframes. What the other cameras filmed in the same
# instants shows it too, from where the rig has them; each camera chooses among its own pictures.


def keyframe_views_of_rig(
    setup: Setup, cameras: Sequence[RigCamera], others: Sequence[Path]
) -> list[KeyframeViews] | None:
    """What each camera has beside the keyframe that the object is placed in; None where nothing is known.

    Parameters
    ----------
    setup : of the first camera, whose recording shows the map's keyframes. others : the other recordings.
    """
    if setup.further is None or setup.registration is None:
        return None
    model, views = setup.registration.model, views_of(setup.registration, setup.keyframes, setup.seen)
    options, found = setup.tracker_options(setup.registration), [setup.further]
    for part, path in zip(cameras[1:], others, strict=True):
        pictures = pictures_from(path, part.camera, [view.frame for view in views if view.frame is not None])
        own = [
            _seen_by(part, view, pictures[view.frame], len(model.parameters))
            for view in views
            if view.frame in pictures
        ]
        found.append(choose_keyframe_views(Estimator(model, part.camera), own[0], own[1:], options))
    return found


def pictures_from(path: Path, camera: Camera, numbers: Collection[int]) -> dict[int, Image]:
    """Frames of a recording by number, made ready; those that it does not hold are left out.

    Raises
    ------
    SourceError
        If it cannot be read. CameraError if a frame has not the camera's size.
    """
    images, pictures = FrameImages(camera), {}
    for frame in open_source(path):
        if frame.index in numbers:
            view = images.prepare(frame.image, frame.index, frame.timestamp)
            pictures[frame.index] = Image(view.grey, view.normalized)
        if frame.index >= max(numbers):
            break
    return pictures


def _seen_by(part: RigCamera, view: PosedImage, picture: Image, n_parameters: int) -> PosedImage:
    """The first camera's view as another camera has it, in its own picture."""
    error_factors = None if view.error_factors is None else part.chain(n_parameters) @ view.error_factors
    return replace(view, picture=picture, state=part.seen(view.state), error_factors=error_factors)


# Tracking one object with several synchronised cameras.
# Each camera follows the object by itself, and one state is estimated from what all of them measured. A
# camera that has lost the object goes on from what the others know, and finds it again there. Where a map
# tells the object's pose in the rig, it counts once in the state of all, as it does in each camera's own.


#: A camera of which a smaller share of the points agrees with all cameras together says something else.
LEAST_AGREEING = 0.5


class RigTracker:
    """Follows one object from a registered reference view in each camera.

    Parameters
    ----------
    cameras : of the rig. references : by camera, the reference frame, of one instant; see `Tracker`.
    state : of the object in them, its pose in the rig's frame (the first camera's).
    reference_covariance : (d + 6, d + 6) of ``state``; None where nothing is known of its error.
    further : by camera, other pictures of the object as it is there, and how it is off in all of them by the
        same error_factors; these count in place of ``reference_covariance``.

    Raises
    ------
    RegistrationError
        If the object shows too few corners in a reference frame. TrackingError as `Tracker` does.
    """

    def __init__(
        self,
        model: ReducedModel,
        cameras: Sequence[RigCamera],
        references: Sequence[NDArray[np.uint8] | Image],
        state: State,
        options: TrackerOptions | None = None,
        in_sequence: bool = True,
        reference_covariance: NDArray[np.float64] | None = None,
        further: Sequence[KeyframeViews] | None = None,
    ) -> None:
        self.model, self.cameras, self.options = model, tuple(cameras), options or TrackerOptions()
        self.estimator = RigEstimator(model, self.cameras, self.options.estimation)
        further = further or self._without_further(reference_covariance)
        self.trackers = [
            self._new_tracker(number, image, self.cameras[number].seen(state), in_sequence, others)
            for number, (image, others) in enumerate(zip(references, further, strict=True))
        ]
        self._filter = new_filter(self.estimator, self.options)
        self._reference = RigReference(self.trackers, self.cameras)
        self._sigma_px = FIRST_SIGMA_PX

    def track(self, images: Sequence[NDArray[np.uint8]], localization: CameraLocalization | None = None) -> FrameResult:
        """Find the object in the next frames (h, w, 3) uint8 of all cameras, in their order.

        Parameters
        ----------
        images : one of each camera.
        localization : an anchored object's pose in the rig's frame by the map; None for a free object.
        """
        where = localization or CameraLocalization()
        known = where.pose_prior
        results = [
            tracker.track(image, CameraLocalization(None if known is None else part.seen_pose(known)))
            for tracker, part, image in zip(self.trackers, self.cameras, images, strict=True)
        ]
        has_moved = any(result.warning(ObjectMoved) is not None for result in results)
        prior = None if known is None or has_moved else self._prior(known, results)
        with frame_clock(STAGES) as clock, stage("fuse"):
            estimate, measured, rejection = self._together(results, prior)
        times = {name: sum(result.timings_ms[name] for result in results) for name in STAGES}
        times["fuse"] += clock.milliseconds["fuse"]
        times["locate"] = where.milliseconds
        common = FrameResult(
            self.model,
            Status.LOST,
            n_points=sum(result.n_points for result in results),
            timings_ms=times,
            total_ms=sum(result.total_ms for result in results) + clock.total + where.milliseconds,
        )
        warnings: list[TrackingWarning] = [*_ignored(results, measured), *([ObjectMoved()] if has_moved else [])]
        if where.why_lost:
            warnings.append(CameraLost(where.why_lost))
        if estimate is None:
            is_hidden = known is not None and not has_moved
            status, pose_from = (Status.HIDDEN, PoseSource.MAP) if is_hidden else (Status.LOST, PoseSource.NONE)
            pose_prior = known if is_hidden else None
            return replace(
                common,
                status=status,
                rejection=rejection,
                warnings=tuple(warnings),
                pose_from=pose_from,
                pose_prior=pose_prior,
            )
        for tracker, part in zip(self.trackers, self.cameras, strict=True):
            tracker.continue_from(part.seen(estimate.state))
        used = measured.weights > 0.0
        recovered = all(result.recovered or result.estimate is None for result in results)
        return replace(
            common,
            status=Status.TRACKED,
            estimate=estimate,
            found_by=FoundBy.LAST_STATE if recovered else FoundBy.FLOW,
            warnings=tuple(warnings),
            pose_from=PoseSource.POINTS if prior is None else PoseSource.POINTS_AND_MAP,
            n_inliers=int(used.sum()),
            residual_rms_px=float(np.sqrt(np.mean(np.sum(estimate.residuals[used] ** 2, axis=1)))),
        )

    def _prior(self, known: PosePrior, results: list[FrameResult]) -> Prior | None:
        """What the map tells of the pose; None if the points of a camera show the object elsewhere."""
        if any(result.pose_from is PoseSource.POINTS for result in results):
            return None
        redundancy = np.mean([tracker.reference.redundancy for tracker in self.trackers])
        squared_px = float(redundancy) * self._sigma_px**2
        return known.prior(len(self.model.parameters), squared_px, HELD if self.options.hold_pose else 1.0)

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
        measured = self._agreeing(measured, estimate)
        needed = self.options.least_inliers if prior is None else self.options.least_anchored
        if (measured.weights > 0.0).sum() < needed:
            return None, measured, Rejection(RejectionReason.CAMERAS_CONTRADICT)
        estimate = self.estimator.fit(measured, estimate.state, prior)
        if np.isfinite(estimate.sigma_px):
            self._sigma_px = max(estimate.sigma_px, LEAST_SIGMA_PX)
        estimate = self._filter.fuse(measured, estimate, prior)
        return self._reference.added(estimate, measured, prior), measured, None

    def _agreeing(self, measured: RigObservations, estimate: Estimate) -> RigObservations:
        """Without points that are far from the estimate, and without cameras of which most are."""
        limit = np.clip(self.options.inlier_sigmas * estimate.sigma_px, *self.options.inlier_px)
        with np.errstate(invalid="ignore"):
            close = np.linalg.norm(estimate.residuals, axis=1) < limit
        kept, first = [], 0
        for view in measured.views:
            weights = np.where(close[first : first + len(view.weights)], view.weights, 0.0)
            first += len(view.weights)
            if (weights > 0.0).sum() < LEAST_AGREEING * (view.weights > 0.0).sum():
                weights = np.zeros_like(weights)
            kept.append(replace(view, weights=weights))
        return RigObservations(tuple(kept))

    def _without_further(self, covariance: NDArray[np.float64] | None) -> list[KeyframeViews]:
        """Of each camera no other pictures, but how the reference state is off there."""
        error_factors = error_factors_of(covariance, self.estimator.scale)
        chains = [part.chain(len(self.model.parameters)) for part in self.cameras]
        return [KeyframeViews(None if error_factors is None else chain @ error_factors) for chain in chains]

    def _new_tracker(
        self, number: int, image: NDArray[np.uint8] | Image, state: State, in_sequence: bool, further: KeyframeViews
    ) -> Tracker:
        part = self.cameras[number]
        picture = image.grey if isinstance(image, Image) else image
        part.camera.check_image(picture, f"the reference frame of camera {number}")
        # What is one over the sequence, or walks, is found from all cameras together.
        # The joint estimate ties lasting errors to the points of one view a camera, so that none is made.
        single = replace(self.options, per_sequence=(), random_walk=(), new_views=False)
        try:
            registration = Registration(self.model, state)
            return Tracker(
                self.model,
                part.camera,
                registration,
                single,
                reference=image,
                in_sequence=in_sequence,
                keyframes=further,
            )
        except RegistrationError as error:
            raise RegistrationError(f"camera {number}: {error}") from error


def _ignored(results: list[FrameResult], measured: RigObservations) -> list[CameraIgnored]:
    """The cameras that do not count."""
    found = []
    for number, (result, view) in enumerate(zip(results, measured.views, strict=True)):
        if result.estimate is None:
            found.append(CameraIgnored(number, result.status, result.rejection))
        elif not view.weights.any():
            found.append(CameraIgnored(number, result.status))
    return found
