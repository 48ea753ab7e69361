"""Runs in which camera and object stand still: the pose over a recording, and live one that sharpens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.io.landmarks import Landmarks
from morph_dslam.model.model_errors import ModelErrors
from morph_dslam.registration.landmark_binding import bind_landmarks
from morph_dslam.registration.messages import Ambiguity, Ambiguous
from morph_dslam.sources import Frame
from morph_dslam.tracking.depth_registration import depth_term
from morph_dslam.tracking.displacement_jumps import DisplacementJump
from morph_dslam.tracking.estimator import Estimator
from morph_dslam.tracking.known_state import LandmarkDepthTerm, LandmarkTerm, StateTerm
from morph_dslam.tracking.levenberg_marquardt import Box
from morph_dslam.tracking.multi_camera import RigTracker
from morph_dslam.tracking.options import PoseFrom
from morph_dslam.tracking.placement import PlacedObject
from morph_dslam.tracking.refinement import N_KEYFRAMES, Keyframe, choose_keyframes, landmark_deviation
from morph_dslam.tracking.reregistration import Reregistration
from morph_dslam.tracking.rig import RigCamera
from morph_dslam.tracking.still import CameraTerm, StillProblem, fit_still
from morph_dslam.tracking.still_notices import STILL_NOTICES, LandmarksAlone, still_notices
from morph_dslam.tracking.tracker import Tracker

Array = NDArray[np.float64]
#: Live, the pose is estimated anew after so many frames, and whenever there are twice as many.
FIRST_TIME = 10
#: Frames that are kept for it; then every second one is dropped.
MOST_KEPT = 4 * N_KEYFRAMES


def with_pose(part: PlacedObject, pose: PoseFrom) -> PlacedObject:
    """The object, its pose found in another way."""
    return replace(part, object=replace(part.object, options=replace(part.object.options, pose=pose)))


def with_still_pose(
    part: PlacedObject, keyframes: Sequence[Keyframe], terms: Sequence[CameraTerm] = (), estimated: int = 0
) -> PlacedObject:
    """The object in the one pose that all frames have together, and its camera with the terms asked for.

    Parameters
    ----------
    part : the object in its reference frame.
    keyframes : where its points were seen.
    terms : of the camera to estimate.
    estimated : from how many earlier frames, beside the landmarks, the object's registration is such an estimate; zero
        where it is none.
    """
    registration, tracker = part.registration, part.new_tracker()
    assert isinstance(tracker, Tracker)
    names = [parameter.name for parameter in part.model.parameters]
    constant = [names.index(name) for name in part.options.per_sequence]
    known = _state_term(part, _covariance_of(part)) if estimated else known_state(part)
    problem = StillProblem(
        part.model,
        part.camera,
        registration.state,
        tracker.reference.pixels,
        choose_keyframes(keyframes),
        known,
        constant,
        [n for n in range(len(names)) if part.object.at_rest and n not in constant],
        terms,
        part.depth_scale_std,
    )
    found = fit_still(problem, registration.alternatives)
    facts = registration.facts | {"pose": f"one for the whole sequence, from {estimated + len(keyframes)} frames"}
    if found.terms:
        facts["camera"] = {term: {"value": value, "std": std} for term, (value, std) in found.terms.items()}
    warnings = tuple(w for w in registration.warnings if not isinstance(w, STILL_NOTICES))  # of the estimate before
    if found.decided:
        warnings = tuple(
            w for w in warnings if not (isinstance(w, Ambiguous) and w.why in (Ambiguity.SHAPES, Ambiguity.TILT))
        )
    warnings += tuple(still_notices(found, _landmarks_alone(part), part.camera))
    registration = replace(
        registration, state=found.state, covariance=found.covariance, facts=facts, warnings=warnings, alternatives=()
    )
    first, *others = part.cameras
    cameras = (RigCamera(found.camera, first.camera_from_rig), *others)
    return with_pose(replace(part, registration=registration, cameras=cameras), "still")


def known_state(part: PlacedObject) -> LandmarkTerm | StateTerm:
    """What an object's registration rests on: landmarks, depth, or what these and other measurements gave together."""
    registration, term = part.registration, _landmark_term(part)
    if term is None or registration.facts.get("corrected_by_outline", False):
        return _state_term(part, _covariance_of_first_frame(part))
    if part.depth is None:
        return term
    depth = depth_term(Estimator(part.model, part.camera), registration.state, part.depth, part.options.depth_sigma)
    return LandmarkDepthTerm(term.points, term.recorded, term.sigma_px, depth)


def _landmark_term(part: PlacedObject) -> LandmarkTerm | None:
    """What landmarks say of the reference state; None for an object that was registered otherwise."""
    landmarks = part.object.start
    if not isinstance(landmarks, Landmarks):
        return None
    # As in the registration: a few that happen to fit well, or that a wrong mesh fits, are not exact for that.
    sigma = max(landmark_deviation(part.registration.facts["sigma_px"]), part.object.click_px)
    return LandmarkTerm(bind_landmarks(part.model, landmarks.points), landmarks.pixels, sigma)


def _landmarks_alone(part: PlacedObject) -> LandmarksAlone | None:
    """Landmarks as they fitted alone, whether or not something else has corrected the registration by them."""
    term = _landmark_term(part)
    if term is None:
        return None
    n_unknowns = 6 if part.object.at_rest else Box.of(part.model).n_unknowns
    return LandmarksAlone(term, part.registration.facts["residual_rms_px"], n_unknowns, part.object.click_px)


def _state_term(part: PlacedObject, covariance: Array) -> StateTerm:
    """The registration's state, as well as it is known."""
    return StateTerm(part.registration.state, covariance, Box.of(part.model).scale)


def _covariance_of(part: PlacedObject) -> Array:
    """That of the registration (d + 6, d + 6), SI; wide where it has none."""
    covariance = part.registration.covariance
    if covariance is None or not np.isfinite(covariance).all():
        return np.diag(Box.of(part.model).scale ** 2)
    return covariance


def _covariance_of_first_frame(part: PlacedObject) -> Array:
    """The same with what the model's own errors do to one frame; nothing at rest shows a per-sequence parameter."""
    covariance = _covariance_of(part).copy()
    if part.object.at_rest:
        unknown = [k for k, p in enumerate(part.model.parameters) if p.name in part.options.per_sequence]
        covariance[unknown], covariance[:, unknown] = 0.0, 0.0
        covariance[unknown, unknown] = Box.of(part.model).scale[unknown] ** 2
    elif (errors := ModelErrors.of(part.model)) is not None:
        parameters = part.registration.state.parameters
        covariance[: len(parameters), : len(parameters)] += errors.at(parameters).parameters
    return covariance


class OpenedSurface(Reregistration):
    """Tells a tracker frame by frame where an earlier pass over the recording found the surface open, as at a crack.

    In a pose that such frames have no part in, the points beside the crack may be too far off to be believed.

    Parameters
    ----------
    placed : the object.
    frames : by number, what was found up to then.
    """

    def __init__(self, placed: PlacedObject, frames: Mapping[int, tuple[DisplacementJump, ...]]) -> None:
        super().__init__(placed)
        self.frames = frames

    @property
    def first(self) -> int:
        """Number of the first of the frames."""
        return min(self.frames)

    def tracker(self, frames: Sequence[Frame], current: Tracker | RigTracker) -> Tracker | RigTracker:
        """The current one, told of what was found."""
        found = self.frames.get(frames[0].index)
        if found is not None and isinstance(current, Tracker):
            current.know_jumps(found)
        return current


class Sharpening(Reregistration):
    """Estimates the one pose anew while frames come, in a thread of its own.

    A tracker in another pose may follow other points of the reference frame. So each estimate rests on the one before
    it, with its covariance, and on the frames of the tracker that this made.

    Parameters
    ----------
    placed : the object as the run began with it.

    Attributes
    ----------
    part : the object in the pose that the present tracker has.
    """

    def __init__(self, placed: PlacedObject) -> None:
        super().__init__(placed)
        self.part = placed
        self._n_estimated = self._n_submitted = 0
        self._seen, self._every, self._count, self._due_at = list[Keyframe](), 1, 0, FIRST_TIME
        self._last_seen: Keyframe | None = None
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="still pose")
        self._running: Future[tuple[PlacedObject, Tracker | RigTracker]] | None = None

    def tracker(self, frames: Sequence[Frame], current: Tracker | RigTracker) -> Tracker | RigTracker:
        """The tracker for the next frames: the current one, or one with a pose from more frames."""
        assert isinstance(current, Tracker)
        if current.last_seen is not None and current.last_seen is not self._last_seen and not current.jumps:
            self._take(current.last_seen)
        if self._running is not None and self._running.done():
            self.part, new = self._running.result()
            assert isinstance(new, Tracker)
            self._running, self._n_estimated = None, self._n_estimated + self._n_submitted
            self._seen, self._every = [], 1
            new.take_over(current)
            return new
        # After an estimate that took long more frames than those may be there, but few of the new tracker.
        if self._running is None and self._count >= self._due_at and len(self._seen) >= FIRST_TIME:
            self._due_at, self._n_submitted = 2 * self._count, len(self._seen)
            self._running = self._executor.submit(self._sharpened, tuple(self._seen))
        return current

    def _take(self, keyframe: Keyframe) -> None:
        """Take in a frame; as many are kept as a choice of them needs, however long the run."""
        self._last_seen, self._count = keyframe, self._count + 1
        if self._count % self._every == 0:
            self._seen.append(keyframe)
        if len(self._seen) > MOST_KEPT:
            self._seen, self._every = self._seen[::2], 2 * self._every

    def _sharpened(self, keyframes: Sequence[Keyframe]) -> tuple[PlacedObject, Tracker | RigTracker]:
        part = with_still_pose(self.part, keyframes, estimated=self._n_estimated)
        return part, part.new_tracker()
