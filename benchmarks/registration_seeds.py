"""Registration of the boot seal in rendered scans that differ in everything but the seal itself.

    python benchmarks/registration_seeds.py [--seeds N] [--first N] [--again maps]

In every seed the seal stands elsewhere and is turned, the camera takes another path around it, and the
table, the wall, the boxes, the light and the noise are others. A scan of 150 frames is rendered, mapped by
SLAM (with one camera, so without a scale) and the seal registered in the map. Recordings and maps are kept
in output/registration_seeds, so that a second run costs the registration only; ``--again maps`` makes new
maps of the recordings that are there.

A line for each seed says by how much the scale is off (against that which brings the true camera path
nearest to the map's), how far the seal's middle is off in the camera frames of the keyframes, on average
and in the last one, where tracking starts, and how far its axis is tilted. The normalised errors are those
of scale, tilt and place over their predicted standard deviations.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam import MorphError, Registration, Scene, load_camera, load_scene
from morph_dslam.extend.geometry import RigidTransform, cross_matrix, fit_similarity
from morph_dslam.extend.registration import run_registration
from morph_dslam.extend.slam import run_slam
from support import keep_sequence

Array = NDArray[np.float64]
HERE = Path(__file__).resolve().parent
MODEL = HERE.parent / "examples" / "boot_seal" / "output" / "boot_seal.morph"
OUTPUT = HERE / "output" / "registration_seeds"
GROUNDS, PICTURES = ("brick", "coffee", "gravel", "rocket"), ("chelsea", "rocket", "coffee", "astronaut")
#: The example's camera path about the seal: frame, degrees about the vertical, distance and height, mm.
PATH = ((0, -11.0, 306.0, 230.0), (40, -38.0, 306.0, 200.0), (100, 38.0, 306.0, 260.0), (149, 12.0, 296.0, 220.0))
#: What counts as registered: relative error of the scale, and of the place, mm.
SCALE_LIMIT, PLACE_LIMIT = 0.01, 1.5


def scene_text(seed: int, path: Sequence[tuple[int, float, float, float]] = PATH) -> str:
    """The scene file of a seed; a longer path that begins as `PATH` changes nothing else."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform([-40.0, -40.0], [40.0, 30.0])
    light, turn = rng.uniform([-0.8, -0.9], [0.8, -0.2]), rng.uniform(0.0, 360.0)
    lines = [
        f'model = "{MODEL}"\nframes = {path[-1][0] + 1}\nfps = 30.0\nseed = {seed}\n',
        "[camera]\nwidth = 640\nheight = 480\nfx = 560.0\nfy = 560.0\ncx = 320.0\ncy = 240.0\n",
        '[surface]\ntexture = "gravel"\n',
        f"[light]\ndirection = [{light[0]:.3f}, {light[1]:.3f}, 1.0]\n",
        "[sensor]\nblur_px = 0.5\nnoise = 2.0\n",
        f"[[pose]]\nframe = 0\nposition_mm = [{x:.2f}, {y:.2f}, 0]\nrotation_deg = [0, 0, {turn:.2f}]\n",
    ]
    return "\n".join([*lines, *_surroundings(rng, x, y), *_camera_path(rng, x, y, path)])


def _surroundings(rng: np.random.Generator, x: float, y: float) -> list[str]:
    """A table, a wall, and one to three boxes behind and beside the seal."""
    table, wall, far = rng.choice(GROUNDS), rng.choice(PICTURES), rng.uniform(300.0, 420.0)
    lines = [
        f'[[environment.rectangles]]\ntexture = "{table}"\ncentre_mm = [0, 0, 0]\n'
        "right_mm = [900, 0, 0]\ndown_mm = [0, -900, 0]\n",
        f'[[environment.rectangles]]\ntexture = "{wall}"\ncentre_mm = [0, {far:.1f}, 200]\n'
        "right_mm = [900, 0, 0]\ndown_mm = [0, 0, -400]\n",
    ]
    for side in rng.permutation([-1.0, 1.0, 0.0])[: rng.integers(1, 4)]:
        size = rng.uniform([50, 50, 30], [100, 80, 90])
        place = (x + 160.0 * side + rng.uniform(-15, 15), y + rng.uniform(60, 140) + 60.0 * (side == 0.0))
        texture, turn = rng.choice(PICTURES), rng.uniform(-40.0, 40.0)
        lines.append(
            f'[[environment.boxes]]\ntexture = "{texture}"\n'
            f"centre_mm = [{place[0]:.1f}, {place[1]:.1f}, {size[2] / 2:.2f}]\n"
            f"size_mm = [{size[0]:.1f}, {size[1]:.1f}, {size[2]:.2f}]\nturn_deg = {turn:.1f}\n"
        )
    return lines


def _camera_path(
    rng: np.random.Generator, x: float, y: float, path: Sequence[tuple[int, float, float, float]]
) -> list[str]:
    """The example's path, mirrored or not, turned about the seal, nearer or farther, and disturbed."""
    lines = []
    mirrored, about, farther = rng.choice([-1.0, 1.0]), rng.uniform(-15.0, 15.0), rng.uniform(0.9, 1.15)
    for frame, angle, distance, height in path:
        turn = np.radians(mirrored * angle + about + rng.uniform(-6.0, 6.0))
        away = farther * distance + rng.uniform(-20.0, 20.0)
        target = np.array([x, y, 42.0]) + rng.normal(0.0, 6.0, 3)
        lines.append(
            f"[[camera_path]]\nframe = {frame}\nposition_mm = [{x + away * np.sin(turn):.1f}, "
            f"{y - away * np.cos(turn):.1f}, {height + rng.uniform(-40.0, 40.0):.1f}]\n"
            f"target_mm = [{target[0]:.1f}, {target[1]:.1f}, {target[2]:.1f}]\n"
        )
    return lines


def recorded(seed: int) -> Path:
    """The folder of a seed with its recording, rendered once."""
    folder = OUTPUT / f"{seed:02}"
    folder.mkdir(parents=True, exist_ok=True)
    scene = folder / "scene.toml"
    if not scene.is_file() or scene.read_text() != scene_text(seed):
        scene.write_text(scene_text(seed))
    keep_sequence(scene, MODEL, folder / "recording", progress=False)
    (folder / "recording" / "depth.h5").unlink(missing_ok=True)
    return folder


def mapped(folder: Path, again: bool, last: int | None = None) -> None:
    """The map of a recording up to its frame ``last``, made once."""
    if again or not (folder / "scan" / "map.h5").is_file():
        run_slam(
            source=folder / "recording" / "frames",
            camera=folder / "recording" / "camera.yaml",
            output=folder / "scan",
            last=last,
            video=False,
            overwrite=True,
        )


@dataclass(frozen=True)
class Outcome:
    """Errors of one registration.

    Attributes
    ----------
    scale : relative.
    places : (k,) of the seal's middle in the keyframes, metres.
    tilt : of the axis, rad.
    normalised : of scale, tilts and place in the last keyframe over their standard deviations.
    """

    scale: float
    places: Array
    tilt: float
    normalised: Array
    ambiguous: bool

    @property
    def registered(self) -> bool:
        return abs(self.scale) <= SCALE_LIMIT and 1e3 * self.places.mean() <= PLACE_LIMIT and not self.ambiguous


def outcome(registration: Registration, scene: Scene, true_poses: Array) -> Outcome:
    """Compare a registration with the truth, poses (T, 4, 4) of all frames."""
    in_scene, keyframes = registration.map_registration, registration.keyframes
    assert in_scene is not None
    middle, covariance = in_scene.centre, in_scene.covariance
    assert covariance is not None
    truth = [RigidTransform.from_matrix(true_poses[keyframe.frame]) for keyframe in keyframes]
    found = [keyframe.pose for keyframe in keyframes]
    in_map = [RigidTransform.from_matrix(keyframe.camera_from_world) for keyframe in scene.map.keyframes]
    true_scale = fit_similarity(_centres(truth), _centres(in_map)).scale
    scale = float(np.log(in_scene.world_from_object.scale / true_scale))
    misses = np.array([a.apply(middle) - b.apply(middle) for a, b in zip(found, truth, strict=True)])
    places = np.sqrt((misses**2).sum(axis=1))
    tilts = [np.linalg.norm(a.rotation[:, 2] - b.rotation[:, 2]) for a, b in zip(found, truth, strict=True)]
    normalised = [scale / np.sqrt(covariance[0, 0])]
    normalised.extend(_normalised_pose(found[-1], truth[-1], keyframes[-1].covariance, middle))
    return Outcome(scale, places, float(np.mean(tilts)), np.array(normalised), registration.ambiguous)


def _centres(poses: list[RigidTransform]) -> Array:
    return np.array([pose.inverse.translation for pose in poses])


def _normalised_pose(found: RigidTransform, true: RigidTransform, covariance: Array, middle: Array) -> Array:
    """Errors (5,) of the axis's tilts and of the middle's place in the camera frame, by their deviations."""
    axis, arm = found.rotation[:, 2], found.rotation @ middle
    across = np.linalg.svd(axis[None])[2][1:]
    # An increment turns the axis by the cross product, and moves the middle by that and the translation.
    slopes = np.zeros((5, 6))
    slopes[:2, :3] = np.cross(axis, across)
    slopes[2:, :3] = -cross_matrix(arm)
    slopes[2:, 3:] = np.eye(3)
    errors = np.concatenate([across @ (axis - true.rotation[:, 2]), found.apply(middle) - true.apply(middle)])
    return errors / np.sqrt(np.einsum("ij,jk,ik->i", slopes, covariance, slopes))


def line(seed: int, found: Outcome) -> str:
    places = 1e3 * found.places
    return (
        f"seed={seed} scale_percent={100.0 * found.scale:+.3f} position_mm={places.mean():.3f} "
        f"last_mm={places[-1]:.3f} tilt_deg={np.degrees(found.tilt):.3f} "
        f"ambiguous={'yes' if found.ambiguous else 'no'} "
        f"normalised={','.join(f'{value:+.1f}' for value in found.normalised)}"
    )


def last_line(found: list[Outcome], count: int) -> str:
    """How many were registered, the largest errors, and the normalised errors' 95th percentile."""
    scales, places = [100.0 * abs(each.scale) for each in found], [1e3 * each.places.mean() for each in found]
    normalised = np.abs(np.array([each.normalised for each in found]))
    p95 = [float(np.percentile(part, 95)) for part in (normalised[:, 0], normalised[:, 1:3], normalised[:, 3:])]
    return (
        f"registered={sum(each.registered for each in found)}/{count} "
        f"scale_max={np.max(scales):.3f} scale_median={np.median(scales):.3f} "
        f"position_max_mm={np.max(places):.3f} position_median_mm={np.median(places):.3f} "
        f"sigma95_scale={p95[0]:.2f} sigma95_tilt={p95[1]:.2f} sigma95_place={p95[2]:.2f}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20, help="how many (%(default)s)")
    parser.add_argument("--first", type=int, default=0, help="the first of them (%(default)s)")
    parser.add_argument("--again", choices=["maps"], help="make these anew")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    found = []
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        folder = recorded(seed)
        mapped(folder, arguments.again == "maps")
        map_path, camera = folder / "scan" / "map.h5", folder / "recording" / "camera.yaml"
        try:
            registration = run_registration(map_path, MODEL, camera, folder / "registration", overwrite=True)
        except MorphError as error:
            print(f"seed={seed} not registered: {error}", flush=True)
            continue
        truth = np.load(folder / "recording" / "truth.npz")["camera_from_object"]
        found.append(outcome(registration, load_scene(map_path, load_camera(camera)), truth))
        print(line(seed, found[-1]), flush=True)
    print(last_line(found, arguments.seeds))
    return 0


if __name__ == "__main__":
    sys.exit(main())
