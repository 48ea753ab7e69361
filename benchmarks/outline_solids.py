"""Outlines of a solid in rendered recordings with exact truth: the boot seal, plain and printed, seen whole and hidden.

    python benchmarks/outline_solids.py [--only plain,printed,hidden]

The scene is that of examples/boot_seal/scene.toml: a scan, then the lever turns to 51 degrees and back. `plain` is
the seal in one grey, so that its outline is all there is; its place in the map of the scene, which has texture, is
the one that its true poses in the keyframes give, stated with 0.3 mm and 1 mrad. `printed` is the example's, `hidden`
the same behind a disc that covers about 60 % of it while the lever turns; both are registered in the map by the
example's chain, with an unknown side.

A line for each: mean and largest error of the lever and mean error of the solid's nodes, in the frames in which it is
deformed, how many of its stated deviations the lever is off by in 95 % of them, and the time of a frame. The model is
that of examples/boot_seal (`python examples/boot_seal/run.py`); recordings and maps are kept in output/outline_solids.
"""

from __future__ import annotations

import argparse
import csv
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples" / "boot_seal"))

import cv2
import numpy as np
import track as seal
from numpy.typing import NDArray

import morph_dslam as md
from morph_dslam.extend.geometry import RigidTransform, SimilarityTransform
from morph_dslam.extend.registration import run_registration
from morph_dslam.extend.slam import run_slam
from morph_dslam.registration.registration import MapRegistration, Registration
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.tracking.estimator import State
from support import keep_sequence

Array = NDArray[np.float64]
EXAMPLE = seal.HERE
MODEL = EXAMPLE / "output" / "boot_seal.morph"
OUTPUT = Path(__file__).resolve().parent / "output" / "outline_solids"
#: How well the place of the plain seal is known: metres and rad, and the map's unit as a share.
PLACE_STD, TURN_STD, SCALE_STD = 3e-4, 1e-3, 1e-3
#: The disc of scene_occluded.toml hides 40 % of the seal; this one as much more as its area is larger, pixels.
DISC_PX = 77
#: Sum of the colours' differences, grey levels, by which a pixel shows something else.
LEAST_DIFFERENCE = 30


@dataclass(frozen=True)
class Errors:
    """Of the frames (f,) in which the seal is deformed: lever, rad, over its deviation, and nodes, metres."""

    lever: Array
    sigmas: Array
    nodes: Array
    milliseconds: Array
    n_frames: int

    def line(self, name: str) -> str:
        lever = np.degrees(np.abs(self.lever))
        return (
            f"{name}: lever_deg={lever.mean():.3f} largest_deg={lever.max():.3f} mean_mm={1e3 * self.nodes.mean():.3f} "
            f"sigma95={np.percentile(self.sigmas, 95):.2f} tracked={len(lever)}/{self.n_frames} "
            f"median_ms={np.median(self.milliseconds):.2f}"
        )


def recorded(name: str) -> Path:
    """The folder of a case with its recording and its map, made once."""
    folder = OUTPUT / name
    folder.mkdir(parents=True, exist_ok=True)
    text = (EXAMPLE / ("scene_occluded.toml" if name == "hidden" else "scene.toml")).read_text()
    text = text.replace('"output/boot_seal.morph"', f'"{MODEL}"').replace("radius_px = 60", f"radius_px = {DISC_PX}")
    if name == "plain":
        cv2.imwrite(str(folder / "grey.png"), np.full((64, 64, 3), 128, dtype=np.uint8))
        text = text.replace('texture = "gravel"', 'texture = "grey.png"')
    scene = folder / "scene.toml"
    if not scene.is_file() or scene.read_text() != text:
        scene.write_text(text)
    keep_sequence(scene, MODEL, folder / "recording")
    if not (folder / "scan" / "map.h5").is_file():
        camera, frames = folder / "recording" / "camera.yaml", folder / "recording" / "frames"
        run_slam(source=frames, camera=camera, output=folder / "scan", first=0, last=seal.FROZEN_AT, overwrite=True)
    return folder


def place_in_map(nodes: Array, true_poses: list[Array], camera_poses: list[Array]) -> SimilarityTransform:
    """Where keyframes, that truly see an object's nodes (n, 3) in some poses, have it in a map, as by a board.

    Parameters
    ----------
    true_poses : (4, 4) of the object in the camera of each keyframe, metres.
    camera_poses : (4, 4) camera_from_world of each, in the map's unit.
    """
    # World points of a keyframe are s a - b; the map's unit s makes those of all keyframes most alike.
    a, b = [], []
    for of_object, of_world in zip(true_poses, camera_poses, strict=True):
        a.append(RigidTransform.from_matrix(of_object).apply(nodes) @ of_world[:3, :3])
        b.append(np.tile(of_world[:3, 3] @ of_world[:3, :3], (len(nodes), 1)))
    apart_a, apart_b = (np.array(x) - np.mean(x, axis=0) for x in (a, b))
    scale = float((apart_a * apart_b).sum() / (apart_a**2).sum())
    world = scale * np.mean(a, axis=0) - np.mean(b, axis=0)
    left, _, right = np.linalg.svd((world - world.mean(axis=0)).T @ (nodes - nodes.mean(axis=0)))
    rotation = (left * [1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return SimilarityTransform(scale, rotation, world.mean(axis=0) - scale * rotation @ nodes.mean(axis=0))


def placed(model: md.ReducedModel, scene: md.Scene, truth: Array) -> Registration:
    """The object where the true poses (n, 4, 4) in the keyframes have it in the map."""
    keyframes = sorted(scene.map.keyframes, key=lambda keyframe: keyframe.index)
    place = place_in_map(model.nodes, [truth[k.index] for k in keyframes], [k.camera_from_world for k in keyframes])
    deviations = [SCALE_STD, *[TURN_STD] * 3, *[PLACE_STD * place.scale] * 3]
    known = MapRegistration(place, model.nodes.mean(axis=0), np.diag(np.square(deviations)))
    last = keyframes[-1]
    pose = known.pose_in(last.camera_from_world)
    covariance = np.zeros((len(model.parameters) + 6,) * 2)
    covariance[-6:, -6:] = known.pose_covariance(pose)
    return Registration(model, State(model.default, pose), covariance, last.index, map_registration=known, scene=scene)


def plain(folder: Path) -> Errors:
    """The plain seal, frame by frame."""
    model, camera = md.load_model(MODEL), md.load_camera(folder / "recording" / "camera.yaml")
    truth = np.load(folder / "recording" / "truth.npz")
    scene = md.load_scene(folder / "scan" / "map.h5", camera)
    registration = placed(model, scene, truth["camera_from_object"])
    tracker = md.Tracker(model, camera, registration, md.TrackerOptions(use_outline=True))
    rows, n_frames = [], 0
    for frame in md.open_source(folder / "recording" / "frames", registration.frame):
        result, mu = tracker.track(frame), truth["parameters"][frame.index]
        n_frames += mu[0] > seal.BEGUN
        if result.estimate is None or not mu[0] > seal.BEGUN:
            continue
        state = result.estimate.state
        there = RigidTransform.from_matrix(truth["camera_from_object"][frame.index]).apply(model.positions(mu))
        apart = state.camera_from_object.apply(model.positions(state.parameters)) - there
        lever, deviation = state.parameters[0] - mu[0], result.estimate.parameter_std[0]
        rows.append((lever, abs(lever) / deviation, np.linalg.norm(apart, axis=1).mean(), result.total_ms))
    return Errors(*np.array(rows).T, n_frames=n_frames)


def printed(folder: Path, use_outline: bool) -> Errors:
    """The printed seal, registered and tracked as in the example."""
    camera, out = folder / "recording" / "camera.yaml", folder / "registration"
    if not (out / "registration.json").is_file():
        run_registration(folder / "scan" / "map.h5", MODEL, camera, out)
    run = folder / ("with_outline" if use_outline else "without_outline")
    summary = md.track(
        md.TrackOptions(
            frames=folder / "recording" / "frames",
            model=MODEL,
            camera=camera,
            registration=out / "registration.json",
            first=seal.FROZEN_AT,
            output=run,
            tracker=md.TrackerOptions(use_outline=use_outline),
            video=False,
            overwrite=True,
        )
    )
    found = seal.errors(run, folder / "recording", MODEL)
    rows = seal.deformed_frames(found, folder / "recording")
    with (run / "frames.csv").open() as file:
        stated = {int(row["frame"]): np.radians(float(row["lever_std_deg"])) for row in csv.DictReader(file)}
    lever, deviations = found.lever[rows], np.array([stated[frame] for frame in found.frames[rows]])
    levers = np.load(folder / "recording" / "truth.npz")["parameters"][list(stated), 0]
    n_frames = int((levers > seal.BEGUN).sum())
    nodes = found.nodes[rows].mean(axis=1)
    return Errors(lever, np.abs(lever) / deviations, nodes, summary["median_ms"], n_frames)


def hidden_share() -> float:
    """Mean share of the seal's pixels that the disc hides while the seal is deformed: where both recordings differ."""
    model, shares = md.load_model(MODEL), []
    camera, truth = (OUTPUT / "printed" / "recording" / name for name in ("camera.yaml", "truth.npz"))
    camera, truth = md.load_camera(camera), np.load(truth)
    deformed = np.flatnonzero(truth["parameters"][:, 0] > seal.BEGUN)
    pairs = [md.open_source(OUTPUT / case / "recording" / "frames", deformed[0]) for case in ("hidden", "printed")]
    for hidden, whole in zip(*pairs, strict=True):
        pose = RigidTransform.from_matrix(truth["camera_from_object"][whole.index])
        nodes = pose.apply(model.positions(truth["parameters"][whole.index]))
        drawn = rasterise(camera.project(nodes), nodes[:, 2], model.triangles, camera.height, camera.width)
        differs = np.abs(hidden.image.astype(int) - whole.image).sum(axis=2) > LEAST_DIFFERENCE
        shares.append(float(differs[drawn.covered].mean()))
    return float(np.mean(shares))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="plain,printed,hidden", help="cases, with commas (%(default)s)")
    arguments = parser.parse_args()
    lines = []
    for name in arguments.only.split(","):
        folder = recorded(name)
        if name == "plain":
            lines.append(plain(folder).line("plain, outline alone"))
        else:
            lines += [
                printed(folder, use).line(f"{name}, {'with' if use else 'without'} outline") for use in (False, True)
            ]
        if name == "hidden" and (OUTPUT / "printed" / "recording").is_dir():
            lines.append(f"hidden_share={hidden_share():.2f}")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
