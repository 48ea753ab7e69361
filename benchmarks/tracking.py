"""Where the time of a frame goes, beside tracking with the whole mesh drawn, in the same run.

    python benchmarks/tracking.py [--frames 40] [--solid MODEL]

A sheet and a large solid are rendered in motion before a plain background and tracked twice, frame by frame
in turn: as the tracker does it (nodes of the surface alone, single precision, faces that are turned away left
out) and plainly (all nodes, double precision, both faces). The solid is the boot seal where its model has
been built, with the angle about its axis as a parameter, and a thick tube otherwise. Times of whole frames
are processor time, so that other programs matter little; times of stages are on the wall. The errors show
that both are right.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam import Camera, FrameResult, Parameter, ReducedModel, Registration, Tracker, load_model
from morph_dslam.extend import one_thread_for_algebra
from morph_dslam.extend.geometry import RigidTransform, rotation_exp
from morph_dslam.extend.models import ParameterFunctions, SeparatedField, SurfacePoints, total_degree_indices
from morph_dslam.extend.rendering import rasterise, render_textured
from morph_dslam.extend.tracking import BoundPoints, Estimator, State, moved
from morph_dslam.model.revolution import with_revolution_angle
from morph_dslam.tracking.binding import DrawnSurface

Array = NDArray[np.float64]
CAMERA = Camera(640, 480, 528.0, 528.0, 320.0, 240.0)
SEAL = Path(__file__).resolve().parents[1] / "examples/boot_seal/output/boot_seal.morph"


def smooth_model(name: str, nodes: Array, triangles: NDArray, n_modes: int, d: int = 3) -> ReducedModel:
    """A model with smooth modes whose size falls with the degree, as a POD's does."""
    rng = np.random.default_rng(0)
    x = (nodes - nodes.mean(axis=0)) / np.ptp(nodes, axis=0).max()
    waves = 4.0 * rng.standard_normal((n_modes, 3))
    modes = np.cos(np.einsum("nx,mx->mn", x, waves) + np.arange(n_modes)[:, None])[:, :, None]
    modes = modes * rng.uniform(-1.0, 1.0, (n_modes, 1, 3))
    indices = total_degree_indices(d, 5)
    size = 0.02 * np.exp(-1.0 * indices.sum(axis=1))[:, None] * (indices.sum(axis=1) > 0)[:, None]
    functions = ParameterFunctions(
        -np.ones(d), np.ones(d), indices, size * rng.standard_normal((len(indices), n_modes)) / 3.0
    )
    parameters = tuple(Parameter(letter, "ratio", "1", -1.0, 1.0, 0.0) for letter in "abcd"[:d])
    return ReducedModel(name, nodes, triangles, parameters, SeparatedField(modes, functions))


def quads(first: NDArray, second: NDArray, third: NDArray, fourth: NDArray) -> NDArray:
    """Two triangles (2 k, 3) for each of k quadrilaterals, with the corners in this order around."""
    a, b, c, d = (part.ravel() for part in (first, second, third, fourth))
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def sheet() -> ReducedModel:
    s, t = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 48), np.linspace(-1, 1, 34)))
    index = np.arange(48 * 34).reshape(34, 48)
    triangles = quads(index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
    return smooth_model("sheet", np.column_stack([0.21 * s, 0.1485 * t, 0.0 * s]), triangles, 30)


def tube(around: int = 96, high: int = 60, thick: int = 5) -> ReducedModel:
    """A thick tube of solid cells; the surface is its outside, inside and both ends."""
    angle, height, radius = (
        2.0 * np.pi * np.arange(around) / around,
        np.linspace(-0.05, 0.05, high),
        np.linspace(0.03, 0.045, thick),
    )
    r, z, a = np.meshgrid(radius, height, angle, indexing="ij")
    nodes = np.column_stack([(r * np.cos(a)).ravel(), (r * np.sin(a)).ravel(), z.ravel()])
    index = np.arange(nodes.shape[0]).reshape(thick, high, around)
    index = np.concatenate([index, index[:, :, :1]], axis=2)
    outer, inner, top, bottom = index[-1], index[0], index[:, -1], index[:, 0]
    faces = [
        quads(outer[:-1, :-1], outer[:-1, 1:], outer[1:, 1:], outer[1:, :-1]),
        quads(inner[:-1, :-1], inner[1:, :-1], inner[1:, 1:], inner[:-1, 1:]),
        quads(top[:-1, :-1], top[1:, :-1], top[1:, 1:], top[:-1, 1:]),
        quads(bottom[:-1, :-1], bottom[:-1, 1:], bottom[1:, 1:], bottom[1:, :-1]),
    ]
    return smooth_model("tube", nodes, np.concatenate(faces), 105)


@dataclass(frozen=True)
class Film:
    """Rendered frames of a model that moves and deforms a little, with the states in them."""

    images: list[NDArray[np.uint8]]
    states: list[State]


def render(model: ReducedModel, count: int, distance: float) -> Film:
    """The object turns, shifts and deforms; its texture is noise, laid on along two of its axes."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.integers(0, 256, (600, 600)).astype(np.uint8), (0, 0), 2.0)
    texture = np.interp(texture, [np.min(texture), np.max(texture)], [0, 255]).astype(np.uint8)
    low, size = model.nodes.min(axis=0), np.ptp(model.nodes, axis=0)
    share = (model.nodes - low) / np.maximum(size, 1e-9)
    coordinates = 30.0 + 540.0 * np.column_stack([share[:, 0], share[:, 1 if size[2] < 1e-9 else 2]])
    centre, upright = model.nodes.mean(axis=0), np.diag([1.0, -1.0, -1.0])
    if size[2] > 1e-9:
        upright = rotation_exp(np.array([0.5 * np.pi, 0.0, 0.0])) @ upright
    images, states = [], []
    for time_share in np.linspace(0.0, 1.0, count):
        turn = rotation_exp(np.array([0.2, 0.3 * np.sin(3.0 * time_share), 0.1 * time_share])) @ upright
        place = np.array([0.02 * np.sin(4.0 * time_share), 0.0, distance]) - turn @ centre
        reach = 0.4 * time_share * (model.upper - model.default)
        states.append(State(model.default + reach, RigidTransform(turn, place)))
        nodes = states[-1].camera_from_object.apply(model.positions(states[-1].parameters))
        buffers = rasterise(CAMERA.project(nodes), nodes[:, 2], model.triangles, 480, 640)
        drawn = render_textured(buffers, model.triangles, coordinates, texture)
        image = np.where(buffers.covered, drawn, 120) + 2.0 * rng.standard_normal((480, 640))
        images.append(np.repeat(np.clip(image, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2))
    return Film(images, states)


def new_tracker(model: ReducedModel, film: Film, plain: bool) -> Tracker:
    """A tracker at the first frame that has compiled everything; plain: with the whole mesh drawn."""

    def whole(model: ReducedModel) -> DrawnSurface:
        return DrawnSurface(model, closed=False)

    def begin() -> Tracker:
        with patch.object(DrawnSurface, "of", whole if plain else DrawnSurface.of):
            return Tracker(model, CAMERA, Registration(model, film.states[0]), reference=film.images[0])

    begin().track(film.images[0])
    return begin()


def error_mm(model: ReducedModel, result: FrameResult, truth: State) -> float:
    if result.estimate is None:
        return float("nan")
    found, places = result.estimate.state, []
    for state in (found, truth):
        places.append(state.camera_from_object.apply(model.positions(state.parameters)))
    return 1e3 * float(np.linalg.norm(places[0] - places[1], axis=1).mean())


def compare(model: ReducedModel, distance: float, frames: int) -> None:
    film = render(model, frames, distance)
    trackers = {"tracker": new_tracker(model, film, False), "whole mesh": new_tracker(model, film, True)}
    times: dict[str, list[float]] = {name: [] for name in trackers}
    results: dict[str, list[FrameResult]] = {name: [] for name in trackers}
    for image in film.images[1:]:
        for name, tracker in trackers.items():
            start = time.process_time()
            results[name].append(tracker.track(image))
            times[name].append(1e3 * (time.process_time() - start))
    drawn = DrawnSurface.of(model)
    print(
        f"\n{model.name}: {len(model.nodes)} nodes, {len(drawn.model.nodes)} on the surface of "
        f"{len(model.triangles)} triangles, {'closed' if drawn.closed else 'open'}, "
        f"{model.displacement.n_modes} modes, {len(model.parameters)} parameters"
    )
    print(f"{'':<12}{'frame [ms]':>11}{'ratio':>8}{'error [mm]':>12}{'tracked':>9}   stages [ms, wall]")
    base = float(np.median(times["tracker"]))
    for name, found in results.items():
        stages = {stage: np.median([result.timings_ms[stage] for result in found]) for stage in found[0].timings_ms}
        errors = [error_mm(model, r, s) for r, s in zip(found, film.states[1:], strict=True)]
        shares = ", ".join(f"{stage} {value:.1f}" for stage, value in stages.items() if value > 0.05)
        tracked = sum(result.estimate is not None for result in found)
        median = float(np.median(times[name]))
        print(
            f"{name:<12}{median:>11.2f}{median / base:>8.2f}{np.nanmean(errors):>12.3f}"
            f"{tracked:>5}/{len(found):<3}   {shares}"
        )


def estimator_alone(model: ReducedModel, repeats: int = 300) -> None:
    """500 points of a model with 30 modes and 3 parameters, and the pose, from the previous frame's state."""
    rng = np.random.default_rng(1)
    surface = SurfacePoints(rng.integers(0, len(model.triangles), 500), rng.dirichlet(np.ones(3), 500))
    points, estimator = BoundPoints.from_surface(model, surface), Estimator(model, CAMERA)
    turn = rotation_exp(np.array([0.2, -0.3, 0.1])) @ np.diag([1.0, -1.0, -1.0])
    truth = State(np.array([0.3, 0.2, -0.4]), RigidTransform(turn, np.array([0.02, 0.0, 0.6])))
    pixels = CAMERA.project(points.in_camera(truth)) + 0.3 * rng.standard_normal((500, 2))
    start = moved(truth, np.array([0.03, 0.03, 0.03, 0.01, 0.01, 0.01, 0.003, 0.003, 0.003]))
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        estimate = estimator.estimate(points, pixels, np.ones(500), start)
        times.append(1e3 * (time.process_time() - begin))
    print(
        f"\nestimator alone: 500 points, {model.displacement.n_modes} modes, 3 parameters and pose: "
        f"{np.median(times):.2f} ms in {estimate.iterations} iterations"
    )


@one_thread_for_algebra
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=40, help="frames rendered and tracked (%(default)s)")
    parser.add_argument("--solid", type=Path, default=SEAL, help="model of a body of revolution about z (%(default)s)")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    flat = sheet()
    compare(flat, 0.6, arguments.frames)
    solid = tube()
    if arguments.solid.is_file():
        solid = with_revolution_angle(load_model(arguments.solid), np.array([0.0, 0.0, 1.0]))
    compare(solid, 4.0 * float(np.ptp(solid.nodes, axis=0).max()), arguments.frames)
    estimator_alone(flat)


if __name__ == "__main__":
    main()
