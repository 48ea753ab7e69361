"""Runs in which camera and object stand still: the pose over a recording, and live one that sharpens."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from morph_dslam.io.landmarks import Landmarks
from morph_dslam.registration.landmarks import bind_landmarks
from morph_dslam.sources import Frame
from morph_dslam.tracking.multi_camera import RigCamera, RigTracker
from morph_dslam.tracking.options import PoseFrom
from morph_dslam.tracking.placement import PlacedObject
from morph_dslam.tracking.refinement import LANDMARK_PX, Keyframe, choose_keyframes
from morph_dslam.tracking.reregistration import Reregistration
from morph_dslam.tracking.still import CameraTerm, LandmarkTerm, StateTerm, StillProblem, fit_still
from morph_dslam.tracking.tracker import Tracker

#: Live, the pose is estimated anew after so many frames, and whenever there are twice as many.
FIRST_TIME = 10
#: The least standard deviation of a landmark that is believed, pixels.
LEAST_LANDMARK_PX = 0.1


def with_pose(part: PlacedObject, pose: PoseFrom) -> PlacedObject:
    """The object, its pose found in another way."""
    return replace(part, object=replace(part.object, options=replace(part.object.options, pose=pose)))


def with_still_pose(part: PlacedObject, keyframes: Sequence[Keyframe], terms: Sequence[CameraTerm]) -> PlacedObject:
    """The object in the one pose that all frames have together, and its camera with the terms asked for.

    Parameters
    ----------
    part : the object in its reference frame.
    keyframes : where its points were seen.
    terms : of the camera to estimate.
    """
    registration, tracker = part.registration, part.new_tracker()
    assert isinstance(tracker, Tracker)
    names = [parameter.name for parameter in part.model.parameters]
    constant = [names.index(name) for name in part.options.per_sequence]
    problem = StillProblem(
        part.model,
        part.camera,
        registration.state,
        tracker.reference.pixels,
        choose_keyframes(keyframes),
        _known(part, tracker),
        constant,
        [n for n in range(len(names)) if part.object.at_rest and n not in constant],
        terms,
    )
    found = fit_still(problem)
    facts = registration.facts | {"pose": f"one over the sequence, from {len(keyframes)} frames"}
    if found.terms:
        facts["camera"] = {term: {"value": value, "std": std} for term, (value, std) in found.terms.items()}
    registration = replace(registration, state=found.state, covariance=found.covariance, facts=facts)
    first, *others = part.cameras
    cameras = (RigCamera(found.camera, first.camera_from_rig), *others)
    return with_pose(replace(part, registration=registration, cameras=cameras), "still")


def _known(part: PlacedObject, tracker: Tracker) -> LandmarkTerm | StateTerm:
    """What the registration rests on."""
    landmarks, registration, d = part.object.start, part.registration, len(part.model.parameters)
    if isinstance(landmarks, Landmarks):
        sigma = float(registration.facts["sigma_px"])
        sigma = max(sigma, LEAST_LANDMARK_PX) if np.isfinite(sigma) else LANDMARK_PX
        return LandmarkTerm(bind_landmarks(part.model, landmarks.points), landmarks.pixels, sigma)
    scale, covariance = tracker.estimator.scale, registration.covariance
    if covariance is None or not np.isfinite(covariance).all():
        covariance = np.diag(scale**2)
    assert covariance.shape == (d + 6, d + 6)
    return StateTerm(registration.state, covariance, scale)


class Sharpening(Reregistration):
    """Estimates the one pose anew while frames come, in a thread of its own.

    Parameters
    ----------
    placed : the object as the run began with it.
    """

    def __init__(self, placed: PlacedObject) -> None:
        super().__init__(placed)
        self._start, self._seen, self._due_at = placed, list[Keyframe](), FIRST_TIME
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="still pose")
        self._running: Future[Tracker | RigTracker] | None = None

    def tracker(self, frames: Sequence[Frame], current: Tracker | RigTracker) -> Tracker | RigTracker:
        """The tracker for the next frames: the current one, or one with a pose from more frames."""
        if not isinstance(current, Tracker):
            return current
        if current.last_seen is not None and (not self._seen or current.last_seen is not self._seen[-1]):
            self._seen.append(current.last_seen)
        if self._running is not None and self._running.done():
            done, self._running = self._running, None
            new = done.result()
            assert isinstance(new, Tracker)
            new.continue_from(replace(current.state, camera_from_object=new.state.camera_from_object))
            return new
        if self._running is None and len(self._seen) >= self._due_at:
            self._due_at = 2 * len(self._seen)
            self._running = self._executor.submit(self._sharpened, tuple(self._seen))
        return current

    def _sharpened(self, keyframes: Sequence[Keyframe]) -> Tracker | RigTracker:
        return with_still_pose(self._start, keyframes, ()).new_tracker()
