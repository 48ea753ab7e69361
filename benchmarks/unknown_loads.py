"""Where something presses on a block that its model does not foresee, and how hard, from points in one camera.

A silicone block, 100 x 100 x 30 mm, held below, is pressed by a rigid ball of 15 mm radius, up to 8 mm deep, at places
that the model does not know; its one parameter, shear on top, is another load. The truth is solved with another mesh
and law (Yeoh rubber of the same modulus, contact). 500 points of the top are seen from 0.4 m at 40 degrees by a 640x480
camera, with 0.3 px of noise; the pose is known to 0.1 mrad and 0.05 mm, as in a map. What the ball hides is not seen;
or it is ("through", as of a tool that is as thin as its contact); or 40 % of the surface are hidden besides. Figures
are means over the frames from 3 mm on. How many loads, and the method's constants, were chosen at two other places.
Run: python benchmarks/unknown_loads.py
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.interpolate import CloughTocher2DInterpolator, LinearNDInterpolator
from tqdm import tqdm

import morph_dslam as md
from morph_dslam.extend.geometry import RigidTransform, rotation_exp
from morph_dslam.extend.mechanics import ParameterSymbols, RigidSphere, Yeoh, advance, block, fixed
from morph_dslam.extend.models import SurfacePoints, spread_over, von_mises, with_unknown_loads
from morph_dslam.extend.tracking import BoundPoints, Estimate, Estimator, Prior, Reactions, State

SIZE, RADIUS, YOUNG, POISSON = (0.1, 0.1, 0.03), 0.015, 50e3, 0.45
STUDY = {
    "name": "silicone block",
    "mesh": {"generator": "block", "size": ["100 mm", "100 mm", "30 mm"], "divisions": [16, 16, 5], "cells": "hex20"},
    "materials": {"silicone": {"law": "neo_hookean", "young": "50 kPa", "poisson": "0.45"}},
    "supports": [{"kind": "fixed", "on": "z_min"}],
    "loads": [{"kind": "traction", "on": "z_max", "traction": ["shear", "0 Pa", "0 Pa"]}],
    "parameters": {"shear": {"range": ["-1 kPa", "1 kPa"], "default": "0 Pa"}},
    "sampling": {"refined": 0},
}
#: The truth's cells, depths that are solved, and frames from one to the next.
CELLS, DEPTHS, BETWEEN = (20, 20, 6), np.linspace(0.0, 0.008, 21), 2
N_POINTS, NOISE_PX, FROM_DEPTH = 500, 0.3, 0.003
POSE_STD = np.array([1e-4] * 3 + [5e-5] * 3)
CAMERA = md.Camera(640, 480, 560.0, 560.0, 320.0, 240.0)
TILT, DISTANCE = np.radians(40.0), 0.4
#: Stresses count beyond this distance from the ball's axis, m; and the part of the surface that is hidden, by x.
AWAY, HIDDEN_SHARE = 0.02, 0.4
#: What hides points, and what its figures begin with in the last line.
CASES = {"through": "through_", "hidden": "hidden_", "ball": ""}


@dataclass(frozen=True)
class Pressed:
    """The block with the ball in it.

    Attributes
    ----------
    depth : of the ball, m.
    force : that it exerts, N.
    displacement : (n, 3) of the truth's nodes, m.
    von_mises : (n,) at them, Pa.
    """

    depth: float
    force: float
    displacement: np.ndarray
    von_mises: np.ndarray


def press(place: np.ndarray) -> tuple[np.ndarray, list[Pressed]]:
    """The truth's nodes (n, 3), and the frames of a ball that comes down at a place (x, y)."""
    mesh, symbols = (
        block(SIZE, CELLS, "hex20"),
        ParameterSymbols([md.Parameter("depth", "length", "m", 0.0, 0.01, 0.0)]),
    )
    rubber = Yeoh(bulk=YOUNG / 3.0 / (1.0 - 2.0 * POISSON), c10=YOUNG / 4.0 / (1.0 + POISSON), c20=200.0)
    ball = RigidSphere("z_max", (place[0], place[1], SIZE[2] + RADIUS - symbols["depth"]), RADIUS)
    problem = md.SolidProblem(mesh, {"all": rubber}, [fixed("z_min")], [], symbols, contacts=[ball])
    state, solved = problem.initial_state(), []
    for depth in tqdm(DEPTHS, desc="truth", unit="depth"):
        state = advance(problem, state, np.array([depth]))[-1]
        fields = problem.sample(state.dofs, state.mu)
        force = problem.reactions(state.dofs, state.mu, "z_min")[0][2]
        solved.append((depth, force, problem.nodal_displacement(state.dofs), fields["von_mises"]))
    shares = np.arange(1, BETWEEN + 1) / BETWEEN
    frames = []
    for before, after in pairwise(solved):
        frames += [Pressed(*(a + s * (b - a) for a, b in zip(before, after, strict=True))) for s in shares]
    return mesh.nodes, frames


def looking_down() -> RigidTransform:
    """The pose of the block before the camera."""
    target = np.array([SIZE[0] / 2.0, SIZE[1] / 2.0, SIZE[2]])
    eye = target + DISTANCE * np.array([0.0, -np.sin(TILT), np.cos(TILT)])
    forward = (target - eye) / DISTANCE
    right = np.array([1.0, 0.0, 0.0])
    rotation = np.array([right, np.cross(forward, right), forward])
    return RigidTransform(rotation, -rotation @ eye)


def behind_ball(points: np.ndarray, place: np.ndarray, depth: float, pose: RigidTransform) -> np.ndarray:
    """Which points (n, 3) the ball hides."""
    eye = pose.inverse.translation
    sight = (points - eye) / np.linalg.norm(points - eye, axis=1, keepdims=True)
    centre = np.array([*place, SIZE[2] + RADIUS - depth]) - eye
    along = sight @ centre
    return np.sqrt(np.maximum(centre @ centre - along**2, 0.0)) < RADIUS


class _Follower:
    """One estimator over the frames: with unknown loads, or with the study's parameters alone."""

    def __init__(self, model: md.ReducedModel, points: Any, known: RigidTransform) -> None:
        self.model, self.estimator = model, Estimator(model, CAMERA)
        self.points, d = BoundPoints.from_surface(model, points), len(model.parameters)
        information = np.diag((NOISE_PX / POSE_STD) ** 2)
        self.prior = Prior(np.zeros(d), np.zeros((d, d)), known, information, squared_px=NOISE_PX**2)
        self.state = State(model.default, known)

    def follow(self, pixels: np.ndarray, weights: np.ndarray) -> Estimate:
        estimate = self.estimator.estimate(self.points, pixels, weights, self.state, prior=self.prior)
        self.state = estimate.state
        if self.estimator.loads is not None:
            self.estimator.loads.learn(estimate.state.parameters, estimate.covariance, estimate.sigma_px)
        return estimate

    def positions(self, pose: RigidTransform) -> np.ndarray:
        """Of the model's nodes, in the frame of the true pose."""
        return pose.inverse.apply(self.state.camera_from_object.apply(self.model.positions(self.state.parameters)))


def run_place(
    model: md.ReducedModel, loaded: md.ReducedModel, place: np.ndarray, case: str, truth: Any, seed: int
) -> np.ndarray:
    """Figures (frames, 6): place mm, force %, errors with and without loads mm, von Mises %; normalised errors last."""
    nodes, frames = truth
    rng, pose = np.random.default_rng(seed), looking_down()
    top = (model.nodes[model.triangles][:, :, 2] > SIZE[2] - 1e-9).all(axis=1)
    points = spread_over(model.nodes, model.triangles[top], N_POINTS)
    points = SurfacePoints(np.flatnonzero(top)[points.triangles], points.weights)
    error = POSE_STD * rng.standard_normal(6)
    known = RigidTransform(rotation_exp(error[:3]) @ pose.rotation, pose.translation + error[3:])
    both = [_Follower(of, points, known) for of in (loaded, model)]
    reactions, surface = Reactions(loaded), np.unique(model.triangles[top])
    on_top, rest = nodes[:, 2] > SIZE[2] - 1e-9, model.rest_positions(points)
    far = np.linalg.norm(model.nodes[:, :2] - place, axis=1) > AWAY
    rows = []
    for frame in frames:
        moved = CloughTocher2DInterpolator(nodes[on_top, :2], frame.displacement[on_top])
        positions = rest + moved(rest[:, :2])
        pixels = CAMERA.project(pose.apply(positions)) + NOISE_PX * rng.standard_normal((N_POINTS, 2))
        seen = np.full(N_POINTS, True) if case == "through" else ~behind_ball(positions, place, frame.depth, pose)
        if case == "hidden":
            seen &= rest[:, 0] > HIDDEN_SHARE * SIZE[0]
        with_loads, _ = (one.follow(pixels, seen.astype(float)) for one in both)
        if frame.depth < FROM_DEPTH:
            continue
        found = reactions(with_loads)["unknown loads"]
        true_places = model.nodes[surface] + moved(model.nodes[surface, :2])
        errors = [one.positions(pose)[surface] - true_places for one in both]
        stress = LinearNDInterpolator(nodes, frame.von_mises)(model.nodes[far])
        own = von_mises(loaded.stresses["solid"].value(with_loads.state.parameters)[far])
        rows.append(
            [
                1e3 * np.linalg.norm(found.point[:2] - place),
                100.0 * abs(-found.force.value[2] / frame.force - 1.0),
                *(1e3 * np.nanmean(np.linalg.norm(e, axis=1)) for e in errors),
                100.0 * np.sqrt(np.nansum((own - stress) ** 2) / np.nansum(stress**2)),
                np.nanpercentile(_normalised(loaded, with_loads, surface, errors[0]), 95),
            ]
        )
    return np.array(rows)


def _normalised(model: md.ReducedModel, estimate: Estimate, surface: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Errors of heights (n,) over their standard deviations."""
    heights = model.displacement.with_modes(model.displacement.modes[:, surface][:, :, 2:])
    slopes = heights.value_and_sensitivities(estimate.state.parameters)[1][:, :, 0]
    covariance = estimate.covariance[: len(slopes), : len(slopes)]
    return np.abs(errors[:, 2]) / np.sqrt(np.einsum("dn,de,en->n", slopes, covariance, slopes))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=int, default=3, help="at how many places (%(default)s)")
    parser.add_argument("--modes", type=int, default=240, help="unknown loads (%(default)s)")
    parser.add_argument("--time", action="store_true", help="only the time of an estimate with 30 loads")
    parser.add_argument("--keep", type=Path, help="folder to keep the model in")
    arguments = parser.parse_args()
    with TemporaryDirectory() as temporary:
        if arguments.time:
            time_estimator(arguments.keep or Path(temporary))
            return
        compare(arguments.places, arguments.modes, arguments.keep or Path(temporary))


def compare(count: int, modes: int, folder: Path) -> None:
    """Print the figures of each place, and the last line."""
    study = md.make_study(STUDY | {"unknown_loads": {"on": "z_max", "modes": modes}})
    model = md.build(study, folder / "block.morph")
    loaded, rng = with_unknown_loads(model), np.random.default_rng(7)
    rows: dict[str, list[np.ndarray]] = {case: [] for case in CASES}
    for seed in range(count):
        place = 0.05 + 0.02 * (2.0 * rng.random(2) - 1.0)
        truth = press(place)
        for case, found in rows.items():
            found.append(run_place(model, loaded, place, case, truth, seed))
            print(f"({1e3 * place[0]:.1f}, {1e3 * place[1]:.1f}) mm, {case}: {_line(found[-1])}", flush=True)
    print(" ".join(_line(np.concatenate(rows[case]), prefix) for case, prefix in CASES.items()))


def time_estimator(folder: Path, repeats: int = 300) -> None:
    """Print the time of an estimate with 30 loads, three parameters, the pose and 500 points, from the last frame's."""
    traction = {"kind": "traction", "on": "z_max", "traction": ["x", "y", "z"]}
    study = STUDY | {"loads": [traction], "unknown_loads": {"on": "z_max"}}
    study["mesh"] = STUDY["mesh"] | {"divisions": [8, 8, 3], "cells": "hex8"}
    study["parameters"] = {name: {"range": ["-1 kPa", "1 kPa"], "default": "0 Pa"} for name in "xyz"}
    loaded, rng = with_unknown_loads(md.build(md.make_study(study), folder / "small.morph")), np.random.default_rng(0)
    top = (loaded.nodes[loaded.triangles][:, :, 2] > SIZE[2] - 1e-9).all(axis=1)
    points = spread_over(loaded.nodes, loaded.triangles[top], N_POINTS)
    follower = _Follower(loaded, SurfacePoints(np.flatnonzero(top)[points.triangles], points.weights), looking_down())
    pixels, seconds, iterations = CAMERA.project(follower.points.in_camera(follower.state)), [], []
    for _ in range(repeats):
        seen = pixels + NOISE_PX * rng.standard_normal(pixels.shape)
        begin = time.process_time()
        estimate = follower.estimator.estimate(
            follower.points, seen, np.ones(N_POINTS), follower.state, prior=follower.prior
        )
        seconds.append(time.process_time() - begin)
        iterations.append(estimate.iterations)
        follower.state = estimate.state
    print(f"estimator_ms={1e3 * np.median(seconds):.2f} iterations={np.mean(iterations):.1f}")


def _line(rows: np.ndarray, prefix: str = "") -> str:
    place, force, error, without, stress, normalised = rows.mean(axis=0)
    return (
        f"{prefix}place_mm={place:.2f} {prefix}force_percent={force:.1f} {prefix}error_ratio={error / without:.3f} "
        f"{prefix}von_mises_percent={stress:.1f} {prefix}normalised={normalised:.2f}"
    )


if __name__ == "__main__":
    main()
