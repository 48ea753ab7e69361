"""What is said where a recording or its model is not what it should be, and how often it is wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.model import ReducedModel
from morph_dslam.registration.landmarks import register_landmarks
from morph_dslam.registration.messages import Ambiguous, AtBound, OutlineElsewhere, PoorFit, Underdetermined, WrongUnit
from morph_dslam.registration.registration import PosePrior, Registration
from morph_dslam.render.rasteriser import rasterise, visible_points
from morph_dslam.tracking.anchoring import CameraLocalization
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.run_notices import notices_of
from morph_dslam.tracking.run_results import RunResults
from morph_dslam.tracking.tracker import Tracker
from tests.support.rendered_sequence import mean_error
from tests.support.staged_scenes import Scene, aside, is_beyond, is_doubted

#: Frames of a recording at 30 a second that show one unit of a scene's time.
FRAMES = 120
#: Warnings of a registration that say it may be wrong.
DOUBTFUL = (Ambiguous, PoorFit, WrongUnit, OutlineElsewhere, Underdetermined, AtBound)


@dataclass(frozen=True)
class Outcome:
    """What one case came to.

    Attributes
    ----------
    said : the error, or the flags of the run and the reasons of lost frames.
    n_frames : of the recording.
    n_tracked, n_lost : of them.
    n_beyond : off beyond what they state.
    n_wrong : those of them of which neither the frame's reason nor, where the model is wrong, a flag of the
        registration says that they are not to be relied on.
    back_after : frames after the object could be seen whole again until it was tracked; None if it never was.
    largest_error : of a tracked frame, metres; NaN without one.
    statuses : of the frames.
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
    state : the true one of the object, None if it is absent.
    others : of more like it.
    cover, thing, strangers : see `Stage.frame`.
    place : where the map has the object.
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
    camera = scene.stage.camera
    buffers = rasterise(pixels, positions[:, 2], scene.model.triangles, camera.height, camera.width)
    return visible_points(pixels, positions[:, 2], buffers.depth, 1e-3)


def placed_by_landmarks(scene: Scene, model: ReducedModel, seed: int) -> Registration:
    """In the scene's first frame."""
    return register_landmarks(model, scene.stage.camera, Landmarks(*landmarks(scene, model, seed=seed)))


def run_case(
    scene: Scene,
    registration: Registration,
    shown: Iterable[Shown],
    back_at: int | None = None,
    known: Callable[[RigidTransform], PosePrior] | None = None,
    **options,
) -> Outcome:
    """Track what is shown from the scene's first frame, in which the object is where ``registration`` says.

    ``known`` says where a map has an object that is seen at a place.
    """
    reference = scene.stage.frame([scene.state(0.0)])
    tracker = Tracker(registration.model, scene.stage.camera, registration, reference=reference, **options)
    run, errors, back = RunResults(registration.model, 0), [np.nan], None
    wrong_model = registration.model is not scene.model
    doubtful = wrong_model and any(isinstance(warning, DOUBTFUL) for warning in registration.warnings)
    beyond = wrong = 0
    for number, view in enumerate(shown):
        states = [*view.others, *([] if view.state is None else [view.state])]
        image = scene.stage.frame(states, view.cover, strangers=view.strangers, thing=view.thing)
        prior = None if known is None or view.place is None else known(view.place)
        result = tracker.track(image, CameraLocalization(prior))
        run.add(number, number / 30.0, result)
        if result.status != "tracked":
            continue
        off = view.state is None or is_beyond(registration.model, result, scene.model, view.state)
        beyond += off
        wrong += off and not doubtful and not is_doubted(result)
        if view.state is None:
            continue
        errors.append(mean_error(registration.model, result.estimate.state, view.state, scene.model))
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


#: Steps aside, in widths of the object, at which it is out of the picture.
OUT = 3.0


def moving(scene: Scene, n: int, start: float = 0.0, **changes) -> list[Shown]:
    """The object alone over ``n`` frames."""
    return [Shown(scene.state(start + k / FRAMES), **changes) for k in range(1, n + 1)]


def covered(scene: Scene, n_before: int = 6, n_covered: int = 60, n_after: int = 30, n_edge: int = 8):
    """An arm is put over all of the picture, stays for ``n_covered`` frames, and is drawn back again.

    Returns
    -------
    The frames, and the number of the first one that is free again.
    """
    shares = [0.0] * n_before + list(np.linspace(0.0, 1.0, n_edge)) + [1.0] * n_covered
    shares += list(np.linspace(1.0, 0.0, n_edge)) + [0.0] * n_after
    frames = [replace(s, cover=c) for s, c in zip(moving(scene, len(shares)), shares, strict=True)]
    return frames, len(shares) - n_after


def behind_a_thing(scene: Scene, n_covered: int, width: float, n_edge: int = 8, n_after: int = 20):
    """A printed thing, ``width`` of the picture wide, comes from the right, moves about, and goes.

    Returns
    -------
    The frames, and the number of the first one that is free again.
    """
    steps = np.arange(n_covered)
    way = [*np.linspace(1.0, 0.0, n_edge), *(0.04 * np.sin(0.3 * steps)), *np.linspace(0.0, 1.0, n_edge)]
    middle = 0.5 - 0.5 * width
    lefts = [1.0] * 4 + [middle + share * (1.0 - middle) for share in way] + [1.0] * n_after
    # Wider than the picture, so that it hides all of it while it moves about.
    things = [(left, -0.1, width, 1.2) for left in lefts]
    frames = [replace(s, thing=t) for s, t in zip(moving(scene, len(things)), things, strict=True)]
    return frames, len(things) - n_after


def passing(scene: Scene, n: int = 60, nearer: float = 0.0, depth: float = 0.0) -> list[Shown]:
    """Another one like it comes in from the right after 10 frames, to just beside the object, and goes again.

    ``nearer`` is the part of the distance by which it comes over the object; ``depth`` metres in front of it.
    """
    frames = []
    for k, view in enumerate(moving(scene, n)):
        way = abs(np.clip((k - 10) / (n - 10), 0.0, 1.0) - 0.5) * 2.0
        step = scene.beside * (1.0 - nearer + OUT * way)
        other = _another(scene, view.state, k, [step, 0.0, -depth])
        frames.append(replace(view, others=(other,) if k >= 10 else ()))
    return frames


def exchanged(scene: Scene, like_it: bool, n_after: int = 20):
    """While all is covered for a second, the object goes away and another one comes.

    ``like_it``: with the same print, so that it is the object to all that see it; otherwise with another one.
    """
    frames, free = covered(scene, n_covered=30, n_after=n_after)
    hidden = [k for k, view in enumerate(frames) if view.cover == 1.0]
    found = []
    for k, view in enumerate(frames):
        if k < hidden[len(hidden) // 2]:
            found.append(view)
            continue
        other = _another(scene, view.state, k, [0.2 * scene.beside, 0.1 * scene.beside, 0.0])
        if like_it:
            found.append(replace(view, state=other))
        else:
            found.append(replace(view, state=None, strangers=(other,)))
    return found, free


def _another(scene: Scene, place: State, frame: int, step) -> State:
    """One like the object, in another shape, a step (3,) away from it, metres."""
    return aside(State(scene.state(0.9 - frame / FRAMES).parameters, place.camera_from_object), step)
