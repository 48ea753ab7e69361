"""Camera tracking on rendered films with exact truth: starts, wrong maps, errors, recovery.

    python benchmarks/slam_rendered.py [--seeds N] [--scenes general,table,...]

Every film ends with a blackout of one second, after which its last second is seen backwards. A line for each
scene says in how many seeds the camera was tracked on a right map, waited (no map, with a reason), or had a
wrong map: one whose path misses the true one by more than 5 % of its length (median, after Sim(3)). The error
is the median over seeds of the median position error, `worst` the largest, in percent of the path's length.
`relocalised` counts the right maps in which the camera was found again within the second after the blackout,
at the right place.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.support.rendered_room import (
    CAMERA,
    SHEET_NODES,
    RoomFilm,
    checkerboard,
    closed_room,
    hand_held,
    pose,
    room,
    room_with_sheet,
    round_trip,
    wall,
)

from morph_dslam.extend.geometry import fit_similarity
from morph_dslam.extend.slam import Slam, SlamFrame, trajectory_of, warm_up

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Film = tuple[Iterator[Image], Array]

FPS = 30
#: A map is wrong if its path misses by more than this part of its length.
WRONG = 0.05


def _film(
    scene: Callable, seed: int, path: Array, change: Callable[[Image, int], Image] | None = None, prints: int = 1
) -> Film:
    film = RoomFilm(seed=seed, scene=scene, prints=prints)

    def images() -> Iterator[Image]:
        for index, place in enumerate(path):
            image = film.frame(place)
            yield image if change is None else change(image, index)

    return images(), path


def general(seed: int) -> Film:
    return _film(room, seed, hand_held(120, seed))


def table(seed: int) -> Film:
    return _film(wall, seed, hand_held(120, seed))


def repetitive(seed: int) -> Film:
    return _film(checkerboard, seed, hand_held(120, seed))


def turn_first(seed: int) -> Film:
    turns = [pose((0.0, 0.0, 0.0), (0.0, 0.008 * i, 0.0)) for i in range(25)]
    return _film(room, seed, np.array([*turns, *(turns[-1] @ p for p in hand_held(95, seed))]))


def fast(seed: int) -> Film:
    """Three times as fast after the start, each frame the mean of five within half a frame time."""
    path = np.concatenate([hand_held(240, seed)[:40], hand_held(240, seed)[40::3]])
    film = RoomFilm(seed=seed)

    def images() -> Iterator[Image]:
        for index, place in enumerate(path):
            before = path[max(index - 1, 0)]
            steps = [place + s * (before - place) for s in np.linspace(0.0, 0.5, 5)]
            yield np.mean([film.frame(step) for step in steps], axis=0).astype(np.uint8)

    return images(), path


def loop(seed: int) -> Film:
    return _film(closed_room, seed, round_trip(220), prints=4)


def lighting(seed: int) -> Film:
    """Brightness swings between 0.4 and 1, within a second, with a shadow that crosses the picture."""

    def change(image: Image, index: int) -> Image:
        gain = np.full(image.shape[1], 0.7 + 0.3 * np.cos(2.0 * np.pi * index / FPS))
        edge = (7 * index) % (2 * image.shape[1])
        gain[max(edge - 200, 0) : edge] *= 0.6
        return np.clip(image * gain, 0, 255).astype(np.uint8)

    return _film(room, seed, hand_held(120, seed), change)


def hand(seed: int) -> Film:
    """After the start a textureless disc of a quarter of the picture's width wanders over it."""

    def change(image: Image, index: int) -> Image:
        if index < 30:
            return image
        centre = (int(320 + 250 * np.sin(0.09 * index)), int(240 + 180 * np.sin(0.07 * index + seed)))
        return np.asarray(cv2.circle(image, centre, 110, 150, -1), dtype=np.uint8)

    return _film(room, seed, hand_held(120, seed), change)


def moving_object(seed: int) -> Film:
    """A third of the picture is a sheet that begins to move, by 1.5 cm a frame, after a second."""
    path, film = hand_held(120, seed, reach=0.3), RoomFilm(seed=seed, scene=room_with_sheet)
    film.nodes[-SHEET_NODES:] = (film.nodes[-SHEET_NODES:] - [0, 0, 1.65]) * [1.35, 1.35, 1.0] + [0, 0, 1.65]
    rest = film.nodes[-SHEET_NODES:].copy()

    def images() -> Iterator[Image]:
        for index, place in enumerate(path):
            shift = np.array([0.15 * np.sin(0.1 * max(index - FPS, 0)), 0.0, 0.0])
            film.nodes[-SHEET_NODES:] = rest + shift
            yield film.frame(place)

    return images(), path


SCENES = {
    "general": general,
    "table": table,
    "repetitive": repetitive,
    "turn_first": turn_first,
    "fast": fast,
    "loop": loop,
    "lighting": lighting,
    "hand": hand,
    "moving_object": moving_object,
}


@dataclass(frozen=True)
class Outcome:
    """What one film gave; ``error`` is a part of the path's length."""

    verdict: str
    error: float
    relocalised: bool
    reason: str


def run(film: Film) -> Outcome:
    """Track one film, black it out, and show its last second backwards."""
    images, path = film
    slam, kept, frames = Slam(CAMERA), [], []
    for index, image in enumerate(images):
        kept = [*kept[-FPS + 1 :], image]
        frames.append(slam.process_frame(image, index, index / FPS))
    after = [np.full_like(kept[0], 3)] * FPS + kept[::-1]
    places = [path[-1]] * FPS + list(path[: -FPS - 1 : -1])
    late = [slam.process_frame(image, len(path) + i, i / FPS) for i, image in enumerate(after)]
    refined = slam.refine_map([*frames, *late])
    frames, late = refined[: len(frames)], refined[len(frames) :]
    return _outcome(slam, frames, late, path, np.array(places))


def _outcome(slam: Slam, frames: list[SlamFrame], late: list[SlamFrame], path: Array, places: Array) -> Outcome:
    found = [frame for frame in frames if slam.is_placed(frame)]
    if len(found) < 3:
        return Outcome("waited", np.nan, False, frames[-1].reason)
    estimate, truth = trajectory_of(slam, found).positions, np.array([path[f.index][:3, 3] for f in found])
    to_truth = fit_similarity(estimate, truth)
    length = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    error = float(np.median(np.linalg.norm(to_truth.apply(estimate) - truth, axis=1)) / length)
    again = [(frame, place) for frame, place in zip(late, places, strict=True) if slam.is_placed(frame)]
    misses = [np.linalg.norm(to_truth.apply(trajectory_of(slam, [f]).positions)[0] - p[:3, 3]) for f, p in again[-5:]]
    relocalised = bool(misses) and late[-1].pose is not None and float(np.median(misses)) < WRONG * length
    return Outcome("right" if error < WRONG else "wrong", error, relocalised, "")


def line(name: str, outcomes: list[Outcome]) -> str:
    """The line of one scene."""
    count = {v: sum(o.verdict == v for o in outcomes) for v in ("right", "waited", "wrong")}
    n, errors = len(outcomes), [100.0 * o.error for o in outcomes if o.verdict != "waited"] or [np.nan]
    back = sum(o.relocalised for o in outcomes if o.verdict == "right")
    return (
        f"{name}: right={count['right']}/{n} waited={count['waited']} wrong={count['wrong']} "
        f"error_percent={np.median(errors):.2f} worst={np.max(errors):.2f} "
        f"relocalised={back}/{count['right']}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20, help="films of each scene")
    parser.add_argument("--scenes", default=",".join(SCENES), help="which scenes, separated by commas")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.scenes.split(",") if name not in SCENES]
    if unknown:
        print(f"slam_rendered: there is no scene {unknown[0]}; there are {', '.join(SCENES)}", file=sys.stderr)
        return 2
    cv2.setNumThreads(1)
    warm_up()
    for name in arguments.scenes.split(","):
        outcomes = [run(SCENES[name](seed)) for seed in tqdm(range(arguments.seeds), desc=name, unit="film")]
        print(line(name, outcomes), flush=True)
        for seed, outcome in enumerate(outcomes):
            if outcome.verdict == "waited":
                print(f"  seed {seed} waited: {outcome.reason}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
