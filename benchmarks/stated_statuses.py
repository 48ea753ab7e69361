"""Statuses where something is wrong, on staged scenes with exact truth: what is said, and how often wrongly.

    python benchmarks/stated_statuses.py [--quick] [--seeds N] [--scenes "sheet,map"] [--only "covered,right"]

Of each case: how often the registration was refused; frames tracked, and not; the largest error of a tracked
frame; frames that are off by more than 1 % of the object's size (mean over all nodes) and by more than three
times what they state ("beyond"); those of them of which nothing says that they are not to be relied on,
neither the frame's reason nor, of a wrong model, a flag of the registration ("confident wrong"). Objects start
from 16 landmarks with 0.3 px of noise, or, "in a map", from a place with errors of a usual size. `map` says
what comes of the registration in a map of a scan. `right` is the right model of an object in full view, for
comparison; `one size` are mesh and landmarks that are both too large or too small, which one camera cannot
tell: it is listed, but not counted in the last line.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.support.bent_sheet import WIDTH, _separated, bent_sheet_model, deflection_terms
from tests.support.rendered_object import CAMERA, scanned, wedge
from tests.support.staged_scenes import SCENES, Scene, aside, drawn_out
from tests.support.stated_cases import (
    FRAMES,
    OUT,
    Outcome,
    Shown,
    behind_a_thing,
    covered,
    exchanged,
    in_unit,
    landmarks,
    moving,
    passing,
    placed_by_landmarks,
    run_case,
    stated,
)

from morph_dslam import register_landmarks
from morph_dslam.extend import one_thread_for_algebra
from morph_dslam.extend.geometry import RigidTransform, SimilarityTransform, rotation_exp
from morph_dslam.extend.registration import Landmarks
from morph_dslam.model import ReducedModel
from morph_dslam.registration.mesh import register_mesh
from morph_dslam.registration.registration import PosePrior, Registration
from morph_dslam.tracking.estimator import State

Case = tuple[str, Callable[[], Outcome]]
#: The scene whose object stays in its place while the camera goes round it, as one in a map does.
ANCHORED = "wedge on a table"
#: How much longer models are than the object, in per cent, along each axis.
DRAWN_OUT = (-10, -6, -4, -2, 2, 4, 6, 10)
#: Units that are taken for others: metres for millimetres, inches for centimetres and millimetres, and so on.
UNITS = (1000.0, 25.4, 10.0, 2.54, 1 / 2.54, 1 / 10.0, 1 / 25.4)


def domed_sheet() -> ReducedModel:
    """A sheet that is clamped all round and bulges: another object with the same print."""
    sheet = bent_sheet_model()
    free = 1.0 - (2.0 * sheet.nodes[:, 1] / WIDTH) ** 2
    terms = deflection_terms(sheet.nodes[:, 0], sheet.nodes[:, 1])
    held = {powers: free[:, None] * field for powers, field in terms.items()}
    return replace(sheet, name="domed sheet", displacement=_separated(held, sheet.parameters))


def linear_sheet() -> ReducedModel:
    """A sheet by linear theory: it grows longer as it bends."""
    sheet = bent_sheet_model()
    terms = deflection_terms(sheet.nodes[:, 0], sheet.nodes[:, 1])
    first = {powers: field if sum(powers[::2]) == 1 else 0.0 * field for powers, field in terms.items()}
    return replace(sheet, name="linear sheet", displacement=_separated(first, sheet.parameters))


def cases(scene: Scene, seed: int, quick: bool) -> Iterator[Case]:
    """All cases from landmarks, by name."""

    def run(shown: list[Shown], model=None, back_at: int | None = None, **options) -> Outcome:
        placed = placed_by_landmarks(scene, model or scene.model, seed)
        return run_case(scene, placed, shown, back_at, **options)

    yield "right", lambda: run(moving(scene, 60)[::2])
    solid = np.ptp(scene.model.nodes[:, 2]) > 0.0
    others = {} if solid else {"domed": domed_sheet(), "linear": linear_sheet()}
    for name, other in (scene.others | others).items():
        yield f"wrong model: {name}", lambda other=other: run(moving(scene, 80)[::2], other)
    for axis in range(3 if solid else 2):
        for percent in DRAWN_OUT[::2] if quick else DRAWN_OUT:
            factors = 1.0 + 0.01 * percent * np.eye(3)[axis]
            other = drawn_out(scene.model, factors)
            name = f"size: {'xyz'[axis]} {percent:+} %"
            yield name, lambda other=other: run(moving(scene, 80)[:: 4 if quick else 2], other)
    for factor in UNITS:
        yield f"unit: mesh {factor:.3g} times as large", lambda factor=factor: _in_unit(scene, factor)
    for factor in (1.1, 0.7):
        other = in_unit(scene.model, factor)
        yield f"one size: {factor:g} times as large", lambda other=other: run(moving(scene, 60)[::4], other)
    yield from _hidden(scene, run, quick)
    yield from _several(scene, run)


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


def _hidden(scene: Scene, run: Callable[..., Outcome], quick: bool) -> Iterator[Case]:
    """The object is absent, or covered."""
    yield "absent", lambda: run([Shown(None)] * 20, in_sequence=False)
    yield "absent: one with another print", lambda: run(strange(scene), in_sequence=False)
    yield "leaves, one with another print comes", lambda: run(replaced(scene))
    for n_covered in (60,) if quick else (30, 60, 150):
        shown, free = covered(scene, n_covered=n_covered)
        name = f"covered {n_covered / 30:g} s"
        yield f"{name}: by an arm", lambda shown=shown, free=free: run(shown, back_at=free)
        for part, width in (("all", 1.3), ("a third", 0.35), ("a quarter", 0.25)):
            shown, free = behind_a_thing(scene, n_covered, width)
            case = f"{name}: {part} of the picture by a print"
            yield case, lambda shown=shown, free=free: run(shown, back_at=free)


def _several(scene: Scene, run: Callable[..., Outcome]) -> Iterator[Case]:
    """Another one like the object is seen too, or instead."""
    yield "another one passes beside it", lambda: run(passing(scene, 60))
    yield "another one passes half before it", lambda: run(passing(scene, 60, 0.5, 0.08))
    yield "another one comes right before it", lambda: run(passing(scene, 60, 1.0, 0.08))
    for name, like_it in (("changed for one like it", True), ("changed for one with another print", False)):
        shown, free = exchanged(scene, like_it)
        yield f"{name} while covered", lambda shown=shown, free=free: run(shown, back_at=free)


def _in_unit(scene: Scene, factor: float) -> Outcome:
    """Landmarks in their own unit, the mesh in another."""
    points, pixels = landmarks(scene, scene.model)
    model = in_unit(scene.model, factor)
    found = register_landmarks(model, scene.stage.camera, Landmarks(points, pixels))
    return run_case(scene, found, moving(scene, 5))


#: Errors of a pose in a map: of the registration, which last, and of the camera; rad and metres.
LASTING, FROM_CAMERA = np.repeat([8e-4, 3e-4], 3), np.repeat([3e-4, 1e-4], 3)


class InMap:
    """An object's place in a map, off by errors of a usual size, which are stated.

    Parameters
    ----------
    seed : of the errors.
    model : undeformed in the map.
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


def anchored_cases(scene: Scene, seed: int) -> Iterator[Case]:
    """Cases of an object whose place in a map is known."""

    def run(shown: list[Shown], model=None, back_at: int | None = None) -> Outcome:
        in_map = InMap(scene, model or scene.model, seed)
        return run_case(scene, in_map.registration(), in_place(shown, scene), back_at, in_map.known)

    yield "in a map: right", lambda: run(moving(scene, 80))
    for name, other in scene.others.items():
        yield f"in a map: wrong model: {name}", lambda other=other: run(moving(scene, 80), other)
    yield "in a map: absent", lambda: run([Shown(None)] * 20)
    for name, (shown, free) in (
        ("covered 2 s by an arm", covered(scene)),
        ("covered 2 s, a third of the picture by a print", behind_a_thing(scene, 60, 0.35)),
        ("changed for one with another print while covered", exchanged(scene, like_it=False)),
        ("changed for one like it while covered", exchanged(scene, like_it=True)),
    ):
        yield f"in a map: {name}", lambda shown=shown, free=free: run(shown, back_at=free)
    for part in (0.05, 0.15, 0.5):
        name = f"in a map: moved by {1e3 * part * scene.beside:.0f} mm"
        yield name, lambda part=part: run(carried_off(scene, offset=part))
    yield "in a map: another one passes half before it", lambda: run(passing(scene, 60, 0.5, 0.08))


def map_cases(seed: int, quick: bool) -> Iterator[Case]:
    """What `morph register` says; "tracked" and "frames" are of one registration."""
    rotation = cv2.Rodrigues(np.random.default_rng(seed).uniform(-1.0, 1.0, 3))[0]
    world = SimilarityTransform(3.7, np.asarray(rotation), np.array([0.5, -1.2, 2.0]))
    metric = SimilarityTransform(1.0, world.rotation, world.translation)
    two = (np.array([-0.08, 0.0, 0.0]), np.array([0.08, 0.03, 0.0]))
    nodes = wedge()[0]
    yield "map: right", lambda: _in_map(nodes, world, seed, (np.zeros(3),))
    stretches = [[1.1, 1.0, 1.0], [1.0, 1.0, 1.5]]
    if not quick:
        stretches += [[0.96, 1.0, 1.0], [1.04, 1.0, 1.0], [0.9, 1.0, 1.0], [1.0, 1.1, 1.0]]
        stretches += [[1.0, 0.85, 1.0], [1.0, 1.0, 0.8], [1.2, 1.2, 1.0]]
    for stretch in stretches:
        name = f"map: wrong model, {' x '.join(f'{s:g}' for s in stretch)}"
        yield name, lambda stretch=stretch: _in_map(nodes * stretch, world, seed, (np.zeros(3),))
    if not quick:
        mirrored = nodes * [-1.0, 1.0, 1.0]
        yield "map: wrong model, mirrored", lambda: _in_map(mirrored, world, seed, (np.zeros(3),), flip=True)
    yield (
        "map: mesh 25.4 times too large, metric map",
        lambda: _in_map(25.4 * nodes, metric, seed, (np.zeros(3),), True),
    )
    yield "map: absent", lambda: _in_map(nodes, world, seed, ())
    yield "map: a second one", lambda: _in_map(nodes, world, seed, two)


def _in_map(nodes, world: SimilarityTransform, seed: int, objects, metric: bool = False, flip: bool = False) -> Outcome:
    """Register ``nodes`` (n, 3), whose surface is turned inside out by a mirror (``flip``), in a scan."""
    true_nodes, triangles, _ = wedge()
    points, views = scanned(world, objects, seed=seed, with_images=True)
    mesh = triangles[:, ::-1] if flip else triangles
    found = register_mesh(nodes, mesh, points, views, CAMERA, metric)
    off = (world.inverse @ found.world_from_object).apply(nodes) - true_nodes
    error = min(float(np.linalg.norm(off - place, axis=1).mean()) for place in objects)
    beyond = int(error > 0.01 * np.linalg.norm(np.ptp(true_nodes, axis=0)))
    said = f"scale {found.world_from_object.scale:.3f}"
    if found.outline.contradicts:
        said = f"the outline does not fit: {100 * found.outline.share:.0f} % of it"
    elif found.ambiguous:
        said = "ambiguous"
    return Outcome((said,), 1, 1, 0, beyond, beyond * (not found.ambiguous), None, error)


def _line(scene: str, case: str, outcomes: list[Outcome]) -> str:
    said = next((line for outcome in outcomes for line in outcome.said), "nothing")
    frames, beyond = sum(o.n_frames for o in outcomes), sum(o.n_beyond for o in outcomes)
    seen, lost = sum(o.n_tracked for o in outcomes), sum(o.n_lost for o in outcomes)
    wrong, refused = sum(o.n_wrong for o in outcomes), sum(o.n_frames == 0 for o in outcomes)
    largest = [o.largest_error for o in outcomes if np.isfinite(o.largest_error)]
    error = f"{1e3 * max(largest):6.1f}" if largest else "     -"
    backs = [o.back_after for o in outcomes if o.back_after is not None]
    back = f" back after {max(backs)}" if backs else ""
    return (
        f"{scene:19} | {case:58} | refused {refused} of {len(outcomes)} | tracked {seen:4} not {lost:4} | "
        f"mm {error} | beyond {beyond:3} confident wrong {wrong:3} of {frames}{back} | "
        f"{said[:100]}"
    )


@one_thread_for_algebra
def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--first", type=int, default=0, help="first seed (%(default)s)")
    parser.add_argument("--seeds", type=int, default=3, help="how many (%(default)s)")
    parser.add_argument("--scenes", default=",".join([*SCENES, "map"]), help="(%(default)s)")
    parser.add_argument("--only", default="", help="cases whose names hold one of these texts")
    parser.add_argument("--quick", action="store_true", help="half the sizes, one duration, fewer frames")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    beyond, wrong, total = 0, 0, 0
    for name in arguments.scenes.split(","):
        found: dict[str, list[Outcome]] = {}
        seeds = range(arguments.first, arguments.first + arguments.seeds)
        for seed in tqdm(seeds, desc=name, unit="seed"):
            for case, run in _of_scene(name, seed, arguments.quick):
                if not any(text in case for text in arguments.only.split(",")):
                    continue
                found.setdefault(case, []).append(stated(run))
        for case, outcomes in found.items():
            print(_line(name, case, outcomes), flush=True)
            if not case.startswith("one size"):
                beyond += sum(o.n_beyond for o in outcomes)
                wrong += sum(o.n_wrong for o in outcomes)
                total += sum(o.n_frames for o in outcomes)
    print(f"beyond_stated={beyond}/{total} confident_wrong={wrong}/{total}")


def _of_scene(name: str, seed: int, quick: bool) -> Iterator[Case]:
    if name == "map":
        yield from map_cases(seed, quick)
        return
    yield from cases(SCENES[name](seed), seed, quick)
    if name == ANCHORED:
        yield from anchored_cases(SCENES[name](seed), seed)


if __name__ == "__main__":
    main()
