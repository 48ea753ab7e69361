"""The tracker beside plain alternatives on the same rendered recordings, in the same run.

    python benchmarks/alternatives.py [--frames 150] [--only "demo sheet"]

Each recording is tracked frame by frame with the tracker as it is, and with one thing replaced at a time:

- differences of the field: the model gives displacements only; their derivatives are forward differences
  (of values from the routine that gives derivatives too, so this row is rather too dear);
- differences of the residual: no chain rule at all, each unknown is shifted by itself;
- linear elastic: the model linearised about the undeformed state (of a sheet in grips: about the default);
- hat functions: piecewise linear between N values of each parameter, as interpolation between solved states
  would be; N to the number of parameters is how many states would have to be solved.

Every variant registers itself by the same landmarks. Errors are distances of all nodes from the truth, in the
camera frame without alignment. Times are processor time of the estimator in a frame, all its calls together.
Needs the products of `make demo` and of examples/boot_seal/track.py; what is missing is left out and said.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray

from alternative_functions import Differenced, Hats, Linearised
from morph_dslam import (
    Camera,
    MorphError,
    ReducedModel,
    Registration,
    Tracker,
    load_camera,
    load_model,
    open_source,
    register_landmarks,
)
from morph_dslam.extend import one_thread_for_algebra
from morph_dslam.extend.geometry import RigidTransform
from morph_dslam.extend.registration import Landmarks
from morph_dslam.extend.tracking import BoundPoints, Estimate, Estimator, State, moved

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[1]
#: Shift of an unknown for a difference, in shares of its scale.
SHIFT = 1e-5
#: Many and exact landmarks, so that what is left of the error is the variant's.
LANDMARKS, LANDMARK_PX = 100, 0.1


@dataclass(frozen=True)
class Recording:
    """A rendered recording: folder, model, first frame to track, and how many values hat functions have."""

    name: str
    folder: Path
    model: Path
    first: int
    hats: tuple[int, ...]


RECORDINGS = (
    Recording("demo sheet", ROOT / "demo/sequence", ROOT / "demo/sheet.morph", 0, (3, 5, 9)),
    Recording(
        "boot seal", ROOT / "examples/boot_seal/output/recording",
        ROOT / "examples/boot_seal/output/boot_seal.morph", 150, (3, 5, 9),
    ),
)  # fmt: skip


class Counted(Estimator):
    """Counts iterations and processor time of all estimators since they were last set to zero."""

    iterations, seconds = 0, 0.0

    def estimate(self, *arguments, **named) -> Estimate:
        begin = time.thread_time()
        found = super().estimate(*arguments, **named)
        Counted.seconds += time.thread_time() - begin
        Counted.iterations += found.iterations
        return found


class ByDifferences(Counted):
    """The derivative of every residual by every unknown is a forward difference."""

    def evaluate(self, points, pixels, weights, state, normals=None, prior=None, depths=None):
        def residuals(at: State) -> Array:
            return self.camera.project(points.in_camera(at)) - pixels

        base, size = residuals(state), len(state.parameters) + 6
        jacobian = np.empty((len(pixels), 2, size))
        for k in range(size):
            step = np.zeros(size)
            step[k] = SHIFT * self.scale[k]
            jacobian[:, :, k] = (residuals(moved(state, step)) - base) / step[k]
        length, huber = np.linalg.norm(base, axis=1), self.options.huber_px
        seen = np.isfinite(length) & (weights > 0.0)
        r, j, n = base[seen], jacobian[seen], length[seen]
        rho = np.where(n > huber, huber * (n - 0.5 * huber), 0.5 * n**2)
        w = weights[seen] * np.minimum(1.0, huber / np.maximum(n, 1e-300))
        flat = (j * w[:, None, None]).reshape(-1, size)
        return weights[seen] @ rho, flat.T @ j.reshape(-1, size), flat.T @ r.ravel(), base


def variants(model: ReducedModel, hats: tuple[int, ...]) -> dict[str, tuple[ReducedModel, type[Counted]]]:
    """Models and estimators by the name of the row."""

    def of(functions) -> ReducedModel:
        return replace(model, displacement=replace(model.displacement, functions=functions))

    functions = model.displacement.functions
    rows: dict[str, tuple[ReducedModel, type[Counted]]] = {
        "as it is": (model, Counted),
        "differences of the field": (of(Differenced(functions)), Counted),
        "differences of the residual": (model, ByDifferences),
        "linear elastic": (of(Linearised(functions, model.default)), Counted),
    }
    for count in hats:
        solved = count ** len(model.parameters)
        rows[f"hat functions, {count} values ({solved} states)"] = (of(Hats(functions, count)), Counted)
    return rows


def landmarks_at(folder: Path, frame: int, camera: Camera, model: ReducedModel) -> Landmarks:
    """Material points that the camera sees in a frame, and their pixels."""
    truth, rng = np.load(folder / "truth.npz"), np.random.default_rng(0)
    state = true_state(truth, frame)
    points = BoundPoints.from_surface(model, _seen(model, camera, state))
    chosen = rng.choice(len(points), LANDMARKS, replace=False)
    pixels = camera.project(points.in_camera(state))[chosen]
    return Landmarks(points.rest[chosen], pixels + LANDMARK_PX * rng.standard_normal(pixels.shape))


def _seen(model: ReducedModel, camera: Camera, state: State):
    """Surface points of pixels that the object covers."""
    from morph_dslam.extend.tracking import bind_pixels, draw_view, view_of

    view = view_of(model, camera, state)
    rows, columns = np.nonzero(draw_view(view, model.triangles, camera).covered)
    chosen = np.random.default_rng(1).choice(len(rows), 200, replace=False)
    return bind_pixels(model, camera, view, np.column_stack([columns, rows])[chosen].astype(float))[0]


def true_state(truth, frame: int) -> State:
    return State(truth["parameters"][frame], RigidTransform.from_matrix(truth["camera_from_object"][frame]))


@dataclass(frozen=True)
class Row:
    """What a variant cost and how well it did, by tracked frame."""

    errors_mm: list[float]
    iterations: list[int]
    milliseconds: list[float]
    lost: int
    why: str = ""


def follow(model: ReducedModel, kind: type[Counted], recording: Recording, exact: ReducedModel, frames: int) -> Row:
    """Track the recording with a variant of the model and of the estimator."""
    camera, truth = load_camera(recording.folder / "camera.yaml"), np.load(recording.folder / "truth.npz")
    last = min(recording.first + frames, len(truth["frame"])) - 1
    landmarks = landmarks_at(recording.folder, recording.first, camera, exact)
    row, tracker = Row([], [], [], 0), None
    with (
        patch("morph_dslam.tracking.tracker.Estimator", kind),
        patch("morph_dslam.tracking.frame_estimation.Estimator", kind),
    ):
        for frame in open_source(recording.folder / "frames", recording.first, last):
            if tracker is None:
                try:
                    placed = register_landmarks(model, camera, landmarks)
                except MorphError as error:
                    return Row([], [], [], last + 1 - recording.first, str(error))
                tracker = Tracker(model, camera, Registration(model, placed.state), reference=frame.image)
                tracker.track(frame.image)  # compiles
                tracker = Tracker(model, camera, Registration(model, placed.state), reference=frame.image)
            Counted.iterations, Counted.seconds = 0, 0.0
            estimate = tracker.track(frame.image).estimate
            if estimate is None:
                row = replace(row, lost=row.lost + 1)
                continue
            row.iterations.append(Counted.iterations)
            row.milliseconds.append(1e3 * Counted.seconds)
            row.errors_mm.append(error_mm(model, estimate.state, exact, true_state(truth, frame.index)))
    return row


def error_mm(model: ReducedModel, found: State, exact: ReducedModel, truth: State) -> float:
    """Mean distance of all nodes."""
    here = found.camera_from_object.apply(model.positions(found.parameters))
    there = truth.camera_from_object.apply(exact.positions(truth.parameters))
    return 1e3 * float(np.linalg.norm(here - there, axis=1).mean())


def compare(recording: Recording, frames: int) -> None:
    if not (recording.folder / "truth.npz").is_file() or not recording.model.is_file():
        print(f"\n{recording.name}: there is no {recording.folder}, left out")
        return
    exact = load_model(recording.model)
    print(
        f"\n{recording.name}: {len(exact.nodes)} nodes, {exact.displacement.n_modes} modes, "
        f"{len(exact.parameters)} parameters"
    )
    print(f"{'':<40}{'error [mm]':>12}{'95 %':>8}{'iterations':>12}{'estimate [ms]':>15}{'lost':>6}")
    for name, (model, kind) in variants(exact, recording.hats).items():
        row = follow(model, kind, recording, exact, frames)
        if not row.errors_mm:
            print(f"{name:<40}   not a frame: {row.why or 'lost in all'}")
            continue
        print(
            f"{name:<40}{np.mean(row.errors_mm):>12.3f}{np.percentile(row.errors_mm, 95):>8.3f}"
            f"{np.mean(row.iterations):>12.1f}{np.median(row.milliseconds):>15.2f}{row.lost:>6}"
        )


@one_thread_for_algebra
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=150, help="of each recording (%(default)s)")
    parser.add_argument("--only", choices=[r.name for r in RECORDINGS], help="one of the recordings")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    for recording in RECORDINGS:
        if arguments.only in (None, recording.name):
            compare(recording, arguments.frames)


if __name__ == "__main__":
    main()
