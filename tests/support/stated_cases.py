"""What is said where a recording or its model is not what it should be, and how often it is wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from morph_dslam.errors import RegistrationError
from morph_dslam.model import ReducedModel
from morph_dslam.online.estimation import State
from morph_dslam.online.pipeline import Tracker
from morph_dslam.online.placement import Placement
from morph_dslam.online.registration import register
from morph_dslam.online.results import RunResults, flags
from tests.support.staged_scenes import Scene, aside, confidently_wrong, mean_error

#: Frames of a recording at 30 a second that show one unit of a scene's time.
FRAMES = 120


@dataclass(frozen=True)
class Outcome:
    """What one case came to.

    Attributes
    ----------
    said : the error, or the flags of the run and the reasons of lost frames. n_frames : of the recording.
    n_tracked, n_lost : of them. n_wrong : confidently wrong. back_after : frames after the object could be
        seen whole again until it was tracked; None if it never was.
    largest_error : of a tracked frame, metres; NaN without one. statuses : of the frames.
    """

    said: tuple[str, ...]
    n_frames: int = 0
    n_tracked: int = 0
    n_lost: int = 0
    n_wrong: int = 0
    back_after: int | None = None
    largest_error: float = float("nan")
    statuses: tuple[str, ...] = ()


@dataclass(frozen=True)
class Shown:
    """One frame: the true state of the object, None if it is absent; others like it; how much is covered."""

    state: State | None
    others: tuple[State, ...] = ()
    cover: float = 0.0


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


def placed_by_landmarks(scene: Scene, model: ReducedModel, seed: int) -> Placement:
    """As `place_by_landmarks` does it, in the scene's first frame."""
    found = register(model, scene.stage.camera, *landmarks(scene, model, seed=seed))
    return Placement(model, None, found.state, {}, found.flags, covariance=found.covariance)


def run_case(
    scene: Scene, placement: Placement, shown: Iterable[Shown], back_at: int | None = None, **options
) -> Outcome:
    """Track what is shown from the scene's first frame, in which the object is where ``placement`` says."""
    reference = scene.stage.frame([scene.state(0.0)])
    tracker = Tracker(
        placement.model,
        scene.stage.camera,
        reference,
        placement.state,
        reference_covariance=placement.covariance,
        **options,
    )
    run, wrong, errors, back = RunResults(placement.model, 0), 0, [np.nan], None
    for number, view in enumerate(shown):
        states = [*view.others, *([] if view.state is None else [view.state])]
        result = tracker.process_frame(scene.stage.frame(states, cover=view.cover))
        run.add(number, number / 30.0, result)
        if result.status != "tracked":
            continue
        if view.state is None:
            wrong += 1  # there is nothing to track
            continue
        errors.append(mean_error(placement.model, result.estimate, scene.model, view.state))
        wrong += confidently_wrong(placement.model, result, scene.model, view.state)
        if back is None and back_at is not None and number >= back_at:
            back = number - back_at
    reasons = Counter(_gist(r.reason) for r in run.results if r.status != "tracked")
    return Outcome(
        (*placement.flags, *flags(run), *reasons),
        len(run),
        int(run.tracked.sum()),
        int((~run.tracked).sum()),
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


def passing(scene: Scene, n: int = 60, nearer: float = 0.0, depth: float = 0.0) -> list[Shown]:
    """Another one like it comes in from the right after 10 frames, to just beside the object, and goes again.

    ``nearer`` is the part of the distance by which it comes over the object; ``depth`` metres in front of it.
    """
    frames = []
    for k, view in enumerate(moving(scene, n)):
        way = abs(np.clip((k - 10) / (n - 10), 0.0, 1.0) - 0.5) * 2.0
        step = scene.beside * (1.0 - nearer + 3.0 * way)
        other = replace_shape(view.state, scene.state(0.9 - k / FRAMES))
        frames.append(replace(view, others=(aside(other, [step, 0.0, -depth]),) if k >= 10 else ()))
    return frames


def replace_shape(place: State, shape: State) -> State:
    """The state ``place`` with the parameters of ``shape``."""
    return State(shape.parameters, place.camera_from_object)


def in_unit(model: ReducedModel, factor: float) -> ReducedModel:
    """The model as it is when its mesh was read in a unit ``factor`` times too large."""
    field = model.displacement
    return replace(model, nodes=factor * model.nodes, displacement=field.with_modes(factor * field.modes))
