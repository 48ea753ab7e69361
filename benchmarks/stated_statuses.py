"""Statuses where something is wrong, on staged scenes with exact truth: what is said, and how often wrongly.

    python benchmarks/stated_statuses.py [--seeds N] [--scenes "sheet,wedge on a table,..."]

A frame is confidently wrong if it is tracked, off by more than 5 mm (mean over all nodes), and by more than
five times what it states. Objects start from 16 landmarks with 0.3 px of noise; `map` says what comes of
their registration in a map of a scan. `right` is the right model of an object in full view, for comparison.
`one size` are mesh and landmarks that are both 10 % too large, which one camera cannot tell: it is listed,
but not counted in the last line.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.support.rendered_object import CAMERA, scanned, wedge
from tests.support.staged_scenes import SCENES, Scene
from tests.support.stated_cases import (
    Outcome,
    Shown,
    covered,
    in_unit,
    landmarks,
    moving,
    passing,
    placed_by_landmarks,
    run_case,
    stated,
)

from morph_dslam.online.mesh_registration.register import register_mesh
from morph_dslam.online.placement import Placement
from morph_dslam.online.registration import register
from morph_dslam.similarity import SimilarityTransform

Case = tuple[str, Callable[[], Outcome]]


def cases(scene: Scene, seed: int) -> Iterator[Case]:
    """All cases from landmarks, by name."""

    def run(shown: list[Shown], model=None, back_at: int | None = None, **options) -> Outcome:
        placed = placed_by_landmarks(scene, model or scene.model, seed)
        return run_case(scene, placed, shown, back_at, **options)

    yield "right", lambda: run(moving(scene, 60)[::2])
    for name, other in scene.others.items():
        yield f"wrong model: {name}", lambda other=other: run(moving(scene, 80)[::2], other)
    for factor in (1000.0, 25.4):
        yield f"mesh in a unit {factor:g} times too large", lambda factor=factor: _in_unit(scene, factor)
    yield (
        "one size: mesh and landmarks 10 % too large",
        lambda: run(moving(scene, 60)[::4], in_unit(scene.model, 1.1)),
    )
    yield "absent", lambda: run([Shown(None)] * 20, in_sequence=False)
    frames, free_again = covered(scene)
    yield "covered for 60 frames", lambda: run(frames, back_at=free_again)
    yield "a second one passes beside it", lambda: run(passing(scene, 60))
    yield "a second one passes before it", lambda: run(passing(scene, 60, 0.5, 0.08))


def _in_unit(scene: Scene, factor: float) -> Outcome:
    """Landmarks in their own unit, the mesh in another."""
    points, pixels = landmarks(scene, scene.model)
    model = in_unit(scene.model, factor)
    found = register(model, scene.stage.camera, points, pixels)
    return run_case(scene, Placement(model, None, found.state, {}, found.flags), moving(scene, 5))


def map_cases(seed: int) -> Iterator[Case]:
    """What `morph register` says; "tracked" and "frames" are of one registration, wrong if it is 5 mm off."""
    rotation = cv2.Rodrigues(np.random.default_rng(seed).uniform(-1.0, 1.0, 3))[0]
    world = SimilarityTransform(3.7, np.asarray(rotation), np.array([0.5, -1.2, 2.0]))
    metric = SimilarityTransform(1.0, world.rotation, world.translation)
    two = (np.array([-0.08, 0.0, 0.0]), np.array([0.08, 0.03, 0.0]))
    nodes = wedge()[0]
    yield "map: right", lambda: _in_map(nodes, world, seed, (np.zeros(3),))
    for stretch in ([1.0, 1.0, 1.5], [1.1, 1.0, 1.0]):
        name = f"map: wrong model, {' x '.join(f'{s:g}' for s in stretch)}"
        yield name, lambda stretch=stretch: _in_map(nodes * stretch, world, seed, (np.zeros(3),))
    yield (
        "map: mesh 25.4 times too large, metric map",
        lambda: _in_map(25.4 * nodes, metric, seed, (np.zeros(3),), True),
    )
    yield "map: absent", lambda: _in_map(nodes, world, seed, ())
    yield "map: a second one", lambda: _in_map(nodes, world, seed, two)


def _in_map(nodes, world: SimilarityTransform, seed: int, objects, metric: bool = False) -> Outcome:
    _, triangles, _ = wedge()
    points, views = scanned(world, objects, seed=seed, with_images=True)
    found = register_mesh(nodes, triangles, points, views, CAMERA, metric)
    off = (world.inverse @ found.world_from_object).apply(nodes) - wedge()[0]
    error = min(float(np.linalg.norm(off - place, axis=1).mean()) for place in objects)
    if found.outline.contradicts:
        said = f"the outline does not fit: {100 * found.outline.share:.0f} % of it"
        return Outcome((said,), 1, 0, 1, largest_error=error)
    if found.ambiguous:
        return Outcome(("ambiguous",), 1, 0, 1, largest_error=error)
    return Outcome((f"scale {found.world_from_object.scale:.3f}",), 1, 1, 0, int(error > 5e-3), None, error)


def _line(scene: str, case: str, outcomes: list[Outcome]) -> str:
    said = next((line for outcome in outcomes for line in outcome.said), "nothing")
    frames, wrong = sum(o.n_frames for o in outcomes), sum(o.n_wrong for o in outcomes)
    seen, lost = sum(o.n_tracked for o in outcomes), sum(o.n_lost for o in outcomes)
    refused = sum(o.n_frames == 0 for o in outcomes)
    largest = [o.largest_error for o in outcomes if np.isfinite(o.largest_error)]
    error = f"{1e3 * max(largest):6.1f}" if largest else "     -"
    backs = [o.back_after for o in outcomes if o.back_after is not None]
    back = f" back after {max(backs)}" if backs else ""
    return (
        f"{scene:19} | {case:43} | refused {refused} of {len(outcomes)} | tracked {seen:4} lost {lost:4} | "
        f"largest error mm {error} | confident wrong {wrong} of {frames}{back} | {said[:100]}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--scenes", default=",".join([*SCENES, "map"]))
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    wrong, total = 0, 0
    for name in arguments.scenes.split(","):
        found: dict[str, list[Outcome]] = {}
        for seed in tqdm(range(arguments.seeds), desc=name, unit="seed"):
            every = map_cases(seed) if name == "map" else cases(SCENES[name](seed), seed)
            for case, run in every:
                found.setdefault(case, []).append(stated(run))
        for case, outcomes in found.items():
            print(_line(name, case, outcomes), flush=True)
            if not case.startswith("one size"):
                wrong += sum(o.n_wrong for o in outcomes)
                total += sum(o.n_frames for o in outcomes)
    print(f"confident_wrong={wrong}/{total}")


if __name__ == "__main__":
    main()
