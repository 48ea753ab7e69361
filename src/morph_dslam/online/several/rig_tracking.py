"""Tracking one object with several synchronised cameras.

Each camera follows the object by itself, and one state is estimated from what all of them measured. A camera
that has lost the object goes on from what the others know, and finds it again there. Where a map tells the
object's pose in the rig, it counts once in the state of all, as it does in each camera's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import RegistrationError
from morph_dslam.model import ReducedModel
from morph_dslam.online.anchored.anchoring import FIRST_SIGMA_PX, HELD, LEAST_SIGMA_PX
from morph_dslam.online.anchored.known_pose import KnownPose
from morph_dslam.online.attempt import Picture
from morph_dslam.online.estimation.estimator import Estimate, Prior, State
from morph_dslam.online.estimation.temporal import new_filter
from morph_dslam.online.frame_result import FOLLOWED, HAS_MOVED, STAGES, FrameResult
from morph_dslam.online.pipeline import Tracker
from morph_dslam.online.reference.further_views import FurtherViews
from morph_dslam.online.several.rig import RigCamera, RigEstimator
from morph_dslam.online.several.rig_reference import RigReference
from morph_dslam.online.timing import StageClock
from morph_dslam.online.tracker_options import TrackerOptions
from morph_dslam.online.uncertainty.bound_part import causes_of
from morph_dslam.online.uncertainty.measurement_noise import RigMeasured

Image = NDArray[np.uint8]

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
        same causes; these count in place of ``reference_covariance``.

    Raises
    ------
    RegistrationError
        If the object shows too few corners in a reference frame. TrackingError as `Tracker` does.
    """

    def __init__(
        self,
        model: ReducedModel,
        cameras: Sequence[RigCamera],
        references: Sequence[Image | Picture],
        state: State,
        options: TrackerOptions | None = None,
        in_sequence: bool = True,
        reference_covariance: NDArray[np.float64] | None = None,
        further: Sequence[FurtherViews] | None = None,
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

    def process_frame(self, images: Sequence[Image], known: KnownPose | None = None) -> FrameResult:
        """Find the object in the next frames (h, w, 3) uint8 of all cameras, in their order.

        ``known`` is an anchored object's pose in the rig's frame by the map; see `Tracker.process_frame`.
        """
        results = [
            tracker.process_frame(image, None if known is None else part.seen_pose(known))
            for tracker, part, image in zip(self.trackers, self.cameras, images, strict=True)
        ]
        clock, has_moved = StageClock(STAGES), any(HAS_MOVED in result.reason for result in results)
        prior = None if known is None or has_moved else self._prior(known, results)
        with clock.stage("fuse"):
            estimate, measured, why_not = self._together(results, prior)
        n_points = sum(result.n_points for result in results)
        times = {stage: sum(r.timings_ms[stage] for r in results) for stage in STAGES}
        times["fuse"] += clock.milliseconds["fuse"]
        total = sum(result.total_ms for result in results) + clock.total
        if estimate is None and known is not None and not has_moved:
            why = why_not.removeprefix("lost: ")
            return FrameResult.hidden(why, known, n_points, 0, times, total)
        if estimate is None:
            return FrameResult("lost", why_not, None, np.nan, n_points, 0, times, total)
        for tracker, part in zip(self.trackers, self.cameras, strict=True):
            tracker.continue_from(part.seen(estimate.state))
        used = measured.weights > 0.0
        rms = float(np.sqrt(np.mean(np.sum(estimate.residuals[used] ** 2, axis=1))))
        aside = [HAS_MOVED] if has_moved else []
        reason = "; ".join([*_reasons(results, measured), *aside]) or FOLLOWED
        recovered = all(result.recovered or result.estimate is None for result in results)
        return FrameResult(
            "tracked", reason, estimate, rms, n_points, int(used.sum()), times, total, recovered,
            pose_from="points" if prior is None else "points and map",
        )  # fmt: skip

    def _prior(self, known: KnownPose, results: list[FrameResult]) -> Prior | None:
        """What the map tells of the pose; None if the points of a camera show the object elsewhere."""
        if any(result.pose_from == "points" for result in results):
            return None
        redundancy = np.mean([tracker.reference.redundancy for tracker in self.trackers])
        squared_px = float(redundancy) * self._sigma_px**2
        return known.prior(len(self.model.parameters), squared_px, HELD if self.options.hold_pose else 1.0)

    def _together(
        self, results: list[FrameResult], prior: Prior | None
    ) -> tuple[Estimate | None, RigMeasured, str]:
        """The estimate from all cameras, what it was made from, and why there is none."""
        measured = RigMeasured(tuple(tracker.last_measured for tracker in self.trackers))
        counts = [0 if result.estimate is None else result.n_inliers for result in results]
        best = int(np.argmax(counts))
        seen = results[best].estimate
        if seen is None:
            return None, measured, "; ".join(_reasons(results, measured))
        estimate = self.estimator.fit(measured, self.cameras[best].in_rig(seen.state), prior)
        measured = self._agreeing(measured, estimate)
        needed = self.options.least_inliers if prior is None else self.options.least_anchored
        if (measured.weights > 0.0).sum() < needed:
            return None, measured, "lost: the cameras contradict each other: is their calibration right?"
        estimate = self.estimator.fit(measured, estimate.state, prior)
        if np.isfinite(estimate.sigma_px):
            self._sigma_px = max(estimate.sigma_px, LEAST_SIGMA_PX)
        estimate = self._filter.fuse(measured, estimate, prior)
        return self._reference.added(estimate, measured, prior), measured, ""

    def _agreeing(self, measured: RigMeasured, estimate: Estimate) -> RigMeasured:
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
        return RigMeasured(tuple(kept))

    def _without_further(self, covariance: NDArray[np.float64] | None) -> list[FurtherViews]:
        """Of each camera no other pictures, but how the reference state is off there."""
        causes = causes_of(covariance, self.estimator.scale)
        chains = [part.chain(len(self.model.parameters)) for part in self.cameras]
        return [FurtherViews(None if causes is None else chain @ causes) for chain in chains]

    def _new_tracker(
        self, number: int, image: Image | Picture, state: State, in_sequence: bool, further: FurtherViews
    ) -> Tracker:
        part = self.cameras[number]
        picture = image.grey if isinstance(image, Picture) else image
        part.camera.check_image(picture, f"the reference frame of camera {number}")
        # What is one over the sequence, or walks, is found from all cameras together.
        # The joint estimate ties lasting errors to the points of one view a camera, so that none is made.
        single = replace(self.options, per_sequence=(), random_walk=(), new_views=False)
        try:
            return Tracker(self.model, part.camera, image, state, single, in_sequence, further=further)
        except RegistrationError as error:
            raise RegistrationError(f"camera {number}: {error}") from error


def _reasons(results: list[FrameResult], measured: RigMeasured) -> list[str]:
    """What is to be said of the cameras that do not count."""
    said = []
    for number, (result, view) in enumerate(zip(results, measured.views, strict=True)):
        if result.status == "hidden":  # what the map knows then is said once, of all cameras
            said.append(f"camera {number}: {result.reason.split(';')[0]}")
        elif result.estimate is None:
            said.append(f"camera {number}: {result.reason}")
        elif not view.weights.any():
            said.append(f"camera {number} contradicts the others and does not count")
    return said
