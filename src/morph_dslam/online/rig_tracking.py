"""Tracking one object with several synchronised cameras.

Each camera follows the object by itself, and one state is estimated from what all of them measured. A camera
that has lost the object goes on from what the others know, and finds it again there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import RegistrationError
from morph_dslam.model import ReducedModel
from morph_dslam.online.estimation import Estimate, State
from morph_dslam.online.frame_result import FOLLOWED, STAGES, FrameResult
from morph_dslam.online.measurement_noise import RigMeasured
from morph_dslam.online.pipeline import Tracker
from morph_dslam.online.rig import RigCamera, RigEstimator
from morph_dslam.online.temporal import new_filter
from morph_dslam.online.timing import StageClock
from morph_dslam.online.tracker_options import TrackerOptions

Image = NDArray[np.uint8]

#: A camera of which a smaller share of the points agrees with all cameras together says something else.
LEAST_AGREEING = 0.5


class RigTracker:
    """Follows one object from a registered reference view in each camera.

    Parameters
    ----------
    cameras : of the rig. references : by camera, the reference frame (h, w, 3) uint8, of one instant.
    state : of the object in them, its pose in the rig's frame (the first camera's).

    Raises
    ------
    RegistrationError
        If the object shows too few corners in a reference frame. TrackingError as `Tracker` does.
    """

    def __init__(
        self,
        model: ReducedModel,
        cameras: Sequence[RigCamera],
        references: Sequence[Image],
        state: State,
        options: TrackerOptions | None = None,
        in_sequence: bool = True,
    ) -> None:
        self.model, self.cameras, self.options = model, tuple(cameras), options or TrackerOptions()
        self.trackers = [
            self._new_tracker(number, part, image, part.seen(state), in_sequence)
            for number, (part, image) in enumerate(zip(self.cameras, references, strict=True))
        ]
        self.estimator = RigEstimator(model, self.cameras, self.options.estimation)
        self._filter = new_filter(self.estimator, self.options)

    def process_frame(self, images: Sequence[Image]) -> FrameResult:
        """Find the object in the next frames (h, w, 3) uint8 of all cameras, in their order."""
        results = [tracker.process_frame(image) for tracker, image in zip(self.trackers, images, strict=True)]
        clock = StageClock(STAGES)
        with clock.stage("fuse"):
            estimate, measured, why_not = self._together(results)
        n_points = sum(result.n_points for result in results)
        times = {stage: sum(r.timings_ms[stage] for r in results) for stage in STAGES}
        times["fuse"] += clock.milliseconds["fuse"]
        total = sum(result.total_ms for result in results) + clock.total
        if estimate is None:
            return FrameResult("lost", why_not, None, np.nan, n_points, 0, times, total)
        for tracker, part in zip(self.trackers, self.cameras, strict=True):
            tracker.continue_from(part.seen(estimate.state))
        used = measured.weights > 0.0
        rms = float(np.sqrt(np.mean(np.sum(estimate.residuals[used] ** 2, axis=1))))
        reason = "; ".join(_reasons(results, measured)) or FOLLOWED
        recovered = all(result.recovered or result.estimate is None for result in results)
        return FrameResult(
            "tracked", reason, estimate, rms, n_points, int(used.sum()), times, total, recovered,
            pose_from="points",
        )  # fmt: skip

    def _together(self, results: list[FrameResult]) -> tuple[Estimate | None, RigMeasured, str]:
        """The estimate from all cameras, what it was made from, and why there is none."""
        measured = RigMeasured(tuple(tracker.last_measured for tracker in self.trackers))
        counts = [0 if result.estimate is None else result.n_inliers for result in results]
        best = int(np.argmax(counts))
        seen = results[best].estimate
        if seen is None:
            return None, measured, "; ".join(_reasons(results, measured))
        estimate = self.estimator.fit(measured, self.cameras[best].in_rig(seen.state))
        measured = self._agreeing(measured, estimate)
        if (measured.weights > 0.0).sum() < self.options.least_inliers:
            return None, measured, "lost: the cameras contradict each other: is their calibration right?"
        estimate = self.estimator.fit(measured, estimate.state)
        return self._filter.fuse(measured, estimate), measured, ""

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

    def _new_tracker(
        self, number: int, part: RigCamera, image: Image, state: State, in_sequence: bool
    ) -> Tracker:
        part.camera.check_image(image, f"the reference frame of camera {number}")
        # What is one over the sequence, or walks, is found from all cameras together.
        # The joint estimate ties lasting errors to the points of one view a camera, so these stay the same.
        single = replace(self.options, per_sequence=(), random_walk=(), new_views=False)
        try:
            return Tracker(self.model, part.camera, image, state, single, in_sequence)
        except RegistrationError as error:
            raise RegistrationError(f"camera {number}: {error}") from error


def _reasons(results: list[FrameResult], measured: RigMeasured) -> list[str]:
    """What is to be said of the cameras that do not count."""
    said = []
    for number, (result, view) in enumerate(zip(results, measured.views, strict=True)):
        if result.estimate is None:
            said.append(f"camera {number}: {result.reason}")
        elif not view.weights.any():
            said.append(f"camera {number} contradicts the others and does not count")
    return said
