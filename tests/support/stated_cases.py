"""What is said where a recording or its model is not what it should be, and how often it is wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.model import ReducedModel
from morph_dslam.registration.landmarks import register_landmarks
from morph_dslam.registration.messages import Ambiguous, AtBound, OutlineElsewhere, PoorFit, Underdetermined, WrongUnit
from morph_dslam.registration.registration import PosePrior, Registration
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.run_notices import notices_of
from morph_dslam.tracking.run_results import RunResults
from morph_dslam.tracking.tracker import CameraLocalization, Tracker
from tests.support.staged_scenes import Scene, is_beyond, is_doubted, mean_error

#: Frames of a recording at 30 a second that show one unit of a scene's time.
FRAMES = 120
#: Warnings of a registration that say it may be wrong.
DOUBTFUL = (Ambiguous, PoorFit, WrongUnit, OutlineElsewhere, Underdetermined, AtBound)
#: Errors of a pose in a map: of the registration, which last, and of the camera; rad and metres.
LASTING, FROM_CAMERA = np.repeat([8e-4, 3e-4], 3), np.repeat([3e-4, 1e-4], 3)


@dataclass(frozen=True)
class Outcome:
    """What one case came to.

    Attributes
    ----------
    said : the error, or the flags of the run and the reasons of lost frames. n_frames : of the recording.
    n_tracked, n_lost : of them. n_beyond : off beyond what they state. n_wrong : those of them of which
        neither the frame's reason nor, where the model is wrong, a flag of the registration says that they are
        not to be relied on.
    back_after : frames after the object could be seen whole again until it was tracked; None if it never was.
    largest_error : of a tracked frame, metres; NaN without one. statuses : of the frames.
    """

    said: tuple[str, ...]
    n_frames: int = 0
    n_tracked: int = 0
    n_lost: int = 0
    n_beyond: int = 0
    n_wrong: int = 0
    back_after: int | None = None
    largest_error: float = float("nan")
    statuses: tuple[str, ...] = ()


@dataclass(frozen=True)
class Shown:
    """One frame.

    Attributes
    ----------
    state : the true one of the object, None if it is absent. others : of more like it. cover, thing,
    strangers : see `Stage.frame`. place : where the map has the object.
    """

    state: State | None
    others: tuple[State, ...] = ()
    cover: float = 0.0
    thing: tuple[float, float, float, float] | None = None
    strangers: tuple[State, ...] = ()
    place: RigidTransform | None = None


def landmarks(scene: Scene, model: ReducedModel, count: int = 16, seed: int = 0, click_px: float = 0.3):
    """Points of ``model`` (count, 3) and where the corresponding points of the scene's object are seen."""
    truth = scene.state(0.0)
    rng = np.random.default_rng(seed)
    positions = truth.camera_from_object.apply(scene.model.positions(truth.parameters))
    pixels = scene.stage.camera.project(positions)
    nodes = rng.choice(np.flatnonzero(_seen(scene, positions, pixels)), count, replace=False)
    return model.nodes[nodes], pixels[nodes] + click_px * rng.standard_normal((count, 2))


def _seen(scene: Scene, positions, pixels):
    """Nodes (n,) that the object itself does not hide."""
    from morph_dslam.render.rasteriser import rasterise, visible_points

    camera = scene.stage.camera
    buffers = rasterise(pixels, positions[:, 2], scene.model.triangles, camera.height, camera.width)
    return visible_points(pixels, positions[:, 2], buffers.depth, 1e-3)


def placed_by_landmarks(scene: Scene, model: ReducedModel, seed: int) -> Registration:
    """In the scene's first frame."""
    return register_landmarks(model, scene.stage.camera, Landmarks(*landmarks(scene, model, seed=seed)))


class InMap:
    """An object's place in a map, off by errors of a usual size, which are stated.

    Parameters
    ----------
    seed : of the errors. model : undeformed in the map.
    """

    def __init__(self, scene: Scene, model: ReducedModel, seed: int) -> None:
        self._scene, self._model, self._rng = scene, model, np.random.default_rng(seed)
        self._off = LASTING * self._rng.standard_normal(6)

    def registration(self) -> Registration:
        """In the scene's first frame, as a keyframe of the map has it."""
        model, truth = self._model, self._scene.state(0.0).camera_from_object
        covariance = np.zeros((len(model.parameters) + 6,) * 2)
        covariance[-6:, -6:] = np.diag(LASTING**2)
        state = State(model.default, _off_by(truth, self._off))
        return Registration(model, state, covariance)

    def known(self, place: RigidTransform) -> PosePrior:
        """Where the map has the object in a frame whose camera sees it at ``place``."""
        error = self._off + FROM_CAMERA * self._rng.standard_normal(6)
        return PosePrior(_off_by(place, error), np.diag(FROM_CAMERA**2), np.diag(LASTING))


def _off_by(pose: RigidTransform, error) -> RigidTransform:
    return RigidTransform(rotation_exp(error[:3]) @ pose.rotation, pose.translation + error[3:])


def run_case(
    scene: Scene,
    registration: Registration,
    shown: Iterable[Shown],
    back_at: int | None = None,
    in_map: InMap | None = None,
    **options,
) -> Outcome:
    """Track what is shown from the scene's first frame, in which the object is where ``registration`` says."""
    reference = scene.stage.frame([scene.state(0.0)])
    tracker = Tracker(registration.model, scene.stage.camera, registration, reference=reference, **options)
    run, errors, back = RunResults(registration.model, 0), [np.nan], None
    wrong_model = registration.model is not scene.model
    doubtful = wrong_model and any(isinstance(warning, DOUBTFUL) for warning in registration.warnings)
    beyond = wrong = 0
    for number, view in enumerate(shown):
        states = [*view.others, *([] if view.state is None else [view.state])]
        image = scene.stage.frame(states, view.cover, strangers=view.strangers, thing=view.thing)
        known = None if in_map is None or view.place is None else in_map.known(view.place)
        result = tracker.track(image, CameraLocalization(known))
        run.add(number, number / 30.0, result)
        if result.status != "tracked":
            continue
        off = view.state is None or is_beyond(registration.model, result, scene.model, view.state)
        beyond += off
        wrong += off and not doubtful and not is_doubted(result)
        if view.state is None:
            continue
        errors.append(mean_error(registration.model, result.estimate, scene.model, view.state))
        if back is None and back_at is not None and number >= back_at:
            back = number - back_at
    reasons = Counter(_gist(r.reason) for r in run.results if r.status != "tracked")
    return Outcome(
        (*(warning.text for warning in registration.warnings), *(notice.text for notice in notices_of(run)), *reasons),
        len(run),
        int(run.tracked.sum()),
        int((~run.tracked).sum()),
        beyond,
        wrong,
        back,
        float(np.nanmax(errors)) if len(errors) > 1 else np.nan,
        tuple(result.status for result in run.results),
    )


def _gist(reason: str) -> str:
    """A reason without its counts."""
    return "".join("#" if c.isdigit() else c for c in reason).replace("##", "#").replace("##", "#")


def stated(case: Callable[[], Outcome]) -> Outcome:
    """The outcome of a case, an error of the registration being one."""
    try:
        return case()
    except RegistrationError as error:
        return Outcome((f"error: {error}",))


def in_unit(model: ReducedModel, factor: float) -> ReducedModel:
    """The model as it is when its mesh was read in a unit ``factor`` times too large."""
    field = model.displacement
    return replace(model, nodes=factor * model.nodes, displacement=field.with_modes(factor * field.modes))
