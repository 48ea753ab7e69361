"""Track the boot seal of the MORPH-DSLAM paper in a rendered recording: scan, registration, deformation.

A camera goes round the undeformed seal on a table and maps the scene; the seal's mesh is found in the map,
which gives the map its scale; then the lever turns, from a side that the registration cannot know because the
seal is a body of revolution. In every frame the camera is found in the map, and with the seal's place there
the angle of the lever, that of the side, and the deformation of the whole solid are estimated. The recording
is rendered, so that its truth is exact. Everything is left in output/; of another scene than scene.toml in a
folder there with the scene's name. In scene_occluded.toml a disc as wide as a hand hides two fifths of the
seal while it is deformed.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import h5py
import numpy as np
from comparison import write_comparison
from numpy.typing import NDArray

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.geometry import RigidTransform, rotation_exp
from morph_dslam.extend.registration import registration_line, run_registration
from morph_dslam.extend.reports import depth_line
from morph_dslam.extend.slam import run_slam
from support import keep_sequence

Array = NDArray[np.float64]
HERE = Path(__file__).resolve().parent
OUTPUT = HERE / "output"
#: The map is kept as it is from this frame on.
FROZEN_AT = 150
#: The angle about the axis counts from so many frames after the lever has turned by `BEGUN`.
SETTLED_AFTER, BEGUN = 60, np.radians(1.0)


@dataclass(frozen=True)
class TrackedSeal:
    """Poses and parameters of a run, and in truth, in the f frames that were tracked.

    The seal is a body of revolution, so that its registration's turn about the axis is arbitrary: it is taken out.

    Attributes
    ----------
    frames : (f,) numbers.
    poses, true_poses : camera_from_object.
    states : (f, 2) lever and side, as estimated, rad; the true side is 0.
    parameters : (f, 1) the true lever, rad.
    """

    frames: NDArray[np.int64]
    poses: list[RigidTransform]
    true_poses: list[RigidTransform]
    states: Array
    parameters: Array

    @classmethod
    def of(cls, run: Path, sequence: Path) -> TrackedSeal:
        """Read a run folder and the truth of its recording; raises MorphError if no frame was tracked."""
        truth = np.load(sequence / "truth.npz")
        with h5py.File(run / "result.h5") as file:
            frames, poses = np.asarray(file["frame"]), np.asarray(file["camera_from_object"])
            states = np.asarray(file["parameters"])
        tracked = np.isfinite(states).all(axis=1)
        if not tracked.any():
            raise md.MorphError("no frame was tracked, so there is nothing to compare")
        frames, poses, states = frames[tracked], poses[tracked], states[tracked]
        true = truth["camera_from_object"][frames]
        between = poses[0][:3, :3].T @ true[0][:3, :3]
        turn = float(np.arctan2(between[1, 0], between[0, 0]))
        back = RigidTransform(rotation_exp(np.array([0.0, 0.0, turn])), np.zeros(3))
        states[:, 1] = (states[:, 1] - turn + np.pi) % (2.0 * np.pi) - np.pi
        return cls(
            frames,
            [RigidTransform.from_matrix(pose) @ back for pose in poses],
            [RigidTransform.from_matrix(pose) for pose in true],
            states,
            truth["parameters"][frames],
        )


@dataclass(frozen=True)
class Errors:
    """Errors by frame: of the lever and of the side (f,), rad, and of the solid's nodes (f, n), metres."""

    frames: NDArray[np.int64]
    lever: Array
    side: Array
    nodes: Array


def errors(run: Path, sequence: Path, model_file: Path) -> Errors:
    """Compare a run with the truth, node by node in the camera frame, without alignment."""
    model, turned = md.load_model(model_file), md.load_model(run / "model.morph")
    seal = TrackedSeal.of(run, sequence)
    nodes = [
        np.linalg.norm(pose.apply(turned.positions(state)) - true_pose.apply(model.positions(mu)), axis=1)
        for pose, true_pose, state, mu in zip(seal.poses, seal.true_poses, seal.states, seal.parameters, strict=True)
    ]
    return Errors(seal.frames, seal.states[:, 0] - seal.parameters[:, 0], seal.states[:, 1], np.array(nodes))


def deformed_frames(found: Errors, sequence: Path) -> NDArray[np.bool_]:
    """Which of the tracked frames (f,) show the seal deformed; raises MorphError if none does."""
    deformed = np.load(sequence / "truth.npz")["parameters"][found.frames, 0] > BEGUN
    if not deformed.any():
        raise md.MorphError("no tracked frame shows the seal deformed: let the scene turn the lever")
    return deformed


def result_line(found: Errors, summary: dict, sequence: Path) -> str:
    """The line that says how well it went, while the seal is deformed."""
    deformed = deformed_frames(found, sequence)
    settled = deformed & (np.cumsum(deformed) > SETTLED_AFTER)
    side = np.degrees(np.abs(found.side[settled])).max() if settled.any() else np.nan
    distances = 1e3 * found.nodes[deformed]
    return (
        f"mean_mm={distances.mean():.3f} median_mm={np.median(distances):.3f} "
        f"p95_mm={np.percentile(distances, 95):.3f} "
        f"lever_deg={np.degrees(np.abs(found.lever[deformed])).mean():.3f} side_deg={side:.3f} "
        f"tracked={summary['n_tracked']}/{summary['n_frames']} median_ms={summary['median_ms']:.2f} "
        f"p95_ms={summary['p95_ms']:.2f}"
    )


def run(arguments: argparse.Namespace) -> None:
    model, scene = arguments.output / "boot_seal.morph", arguments.scene
    output = arguments.output if scene.stem == "scene" else arguments.output / scene.stem
    sequence = output / "recording"
    if not model.is_file():
        raise md.MorphError(f"there is no model {model}: build it with `python examples/{HERE.name}/run.py` first")
    keep_sequence(scene, model, sequence)
    camera, frames = sequence / "camera.yaml", sequence / "frames"
    run_slam(source=frames, camera=camera, output=output / "scan", first=0, last=arguments.frozen_at, overwrite=True)
    registration = run_registration(output / "scan" / "map.h5", model, camera, output / "registration", overwrite=True)
    print(registration_line(registration))
    summary = md.track(
        md.TrackOptions(
            frames=frames,
            model=model,
            camera=camera,
            registration=output / "registration" / "registration.json",
            first=registration.frame,  # the frames before are the scan
            map_path=output / "scan" / "map.h5",
            output=output / "run",
            overwrite=True,
        )
    )
    found = errors(output / "run", sequence, model)
    line = result_line(found, summary, sequence)
    per_frame = {
        "frame": found.frames.tolist(),
        "lever_error_deg": np.degrees(found.lever).tolist(),
        "side_error_deg": np.degrees(found.side).tolist(),
        "mean_error_mm": (1e3 * found.nodes.mean(axis=1)).tolist(),
    }
    (output / "run" / "errors.json").write_text(json.dumps(per_frame, indent=1) + "\n")
    # Of a scene without a depth sensor the exact depths are there.
    depths = sequence if (sequence / "depth.txt").is_file() else sequence / "depth.h5"
    depth = md.evaluate_depth(output / "run", depths, base_frame=int(found.frames[0]))
    deformed = deformed_frames(found, sequence)
    angles = (np.degrees(angle[deformed]) for angle in (found.lever, found.side))
    page = write_comparison(output / "run", found.frames[deformed], 1e3 * found.nodes[deformed], *angles, depth)
    print(f"video   {output / 'run' / 'augmented.mp4'}")
    print(f"picture {output / 'registration' / 'registration.jpg'}")
    print(f"compare {page}")
    print(depth_line(depth))
    print(line)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, default=HERE / "scene.toml", help="scene file (%(default)s)")
    parser.add_argument(
        "--frozen-at", type=int, default=FROZEN_AT, metavar="N", help="last frame of the scan (%(default)s)"
    )
    parser.add_argument("--output", type=Path, default=OUTPUT, help="folder of the model (%(default)s)")
    return run_and_report_errors(run, parser.parse_args(), "what was done so far is kept")


if __name__ == "__main__":
    sys.exit(main())
