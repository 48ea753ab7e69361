"""Recordings of a scene in which an object is covered, goes, or is not alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from morph_dslam.tracking.estimator import State
from tests.support.staged_scenes import Scene, aside
from tests.support.stated_cases import FRAMES, Shown

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


def crossing(scene: Scene, n: int = 70, depth: float = 0.08) -> list[Shown]:
    """Another one like it crosses the picture from right to left, ``depth`` metres in front of the object."""
    frames = []
    for k, view in enumerate(moving(scene, n)):
        step = scene.beside * np.interp(k, [10, n - 10], [2.5, -2.5])
        other = _another(scene, view.state, k, [step, 0.0, -depth])
        frames.append(replace(view, others=(other,) if 10 <= k < n - 10 else ()))
    return frames


def exchanged(scene: Scene, like_it: bool, n_after: int = 20, beside: bool = False):
    """While all is covered for a second, the object goes away and another one comes.

    ``like_it``: with the same print, so that it is the object to all that see it; otherwise with another one.
    ``beside``: the object stays, and the other one is found beside it.
    """
    frames, free = covered(scene, n_covered=30, n_after=n_after)
    hidden = [k for k, view in enumerate(frames) if view.cover == 1.0]
    found = []
    for k, view in enumerate(frames):
        if k < hidden[len(hidden) // 2]:
            found.append(view)
            continue
        step = [scene.beside if beside else 0.2 * scene.beside, 0.1 * scene.beside, 0.0]
        other = _another(scene, view.state, k, step)
        if beside:
            found.append(replace(view, others=(other,)))
        elif like_it:
            found.append(replace(view, state=other))
        else:
            found.append(replace(view, state=None, strangers=(other,)))
    return found, free


def replaced(scene: Scene, n: int = 70) -> list[Shown]:
    """The object goes out to the left, nothing is there, and one with another print comes in and stays."""
    frames = []
    for k, view in enumerate(moving(scene, n)):
        left = scene.beside * OUT * np.interp(k, [5, 30], [0.0, -1.0])
        right = scene.beside * OUT * np.interp(k, [40, 60], [1.0, 0.0])
        gone = k >= 30
        frames.append(
            Shown(
                None if gone else aside(view.state, [left, 0.0, 0.0]),
                strangers=(aside(view.state, [right, 0.0, 0.0]),) if k >= 40 else (),
            )
        )
    return frames


def strange(scene: Scene, n: int = 30) -> list[Shown]:
    """From the beginning one with another print is where the object is looked for."""
    return [Shown(None, strangers=(view.state,)) for view in moving(scene, n)]


def in_place(shown: list[Shown], scene: Scene) -> list[Shown]:
    """The same frames with the place that a map has the object in, for a scene whose camera alone moves."""
    return [replace(view, place=scene.state((k + 1) / FRAMES).camera_from_object) for k, view in enumerate(shown)]


def carried_off(scene: Scene, n: int = 60, offset: float = 0.15) -> list[Shown]:
    """After 10 frames the object is moved by ``offset`` of `Scene.beside` within 10 more, and stays there."""
    frames = []
    for k, view in enumerate(moving(scene, n)):
        step = scene.beside * offset * np.interp(k, [10, 20], [0.0, 1.0])
        frames.append(replace(view, state=aside(view.state, [step, 0.3 * step, 0.0])))
    return frames


def _another(scene: Scene, place: State, frame: int, step) -> State:
    """One like the object, in another shape, a step (3,) away from it, metres."""
    return aside(State(scene.state(0.9 - frame / FRAMES).parameters, place.camera_from_object), step)
