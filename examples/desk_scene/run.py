"""Map a real desk, register a cube in it without and with hints, track it, and compare it with the truth.

The recording (lagadic/visp-images, rbt) is not part of the project: a folder with `rgb/0000.jpg` to `rgb/0098.jpg`,
`depth/` every third frame (5000 values per metre, as in TUM's layout), `camera.yaml`, `cube.obj` in metres, and the
camera path `tags_shutter_corrected.txt`. The cube's true pose in frame 0 is from six corners picked by hand (0.95 px).
A real cube has rounded corners, so that the picked ones are too near to each other and their pose too far away:
`depth_mm`, the median distance of the measured depth of frame 0 from the cube's faces, says that the true faces are
6.5 mm nearer. `measured_mm` is the distance of a place from the picked pose moved along its ray to the measured depth.

Where it was found without a hint in a map of all frames, the cube is tracked through them by their colour, and the
videos are in output/. (Depth in tracking turns the cube by degrees here, see docs/tracking.md.) `still_mm` and
`still_deg` are how far it seems to move on the desk while the true path of the camera goes by, mean and largest: the
path's own errors of a few millimetres are in them.

The last line gives the largest errors of the cube in frame 0 (centre or size, and angle modulo its 24 rotations), of
the places found, that of the camera's path from colour alone, how many of four maps give the cube without a hint and
with three points clicked in frame 25 (landmarks.csv), how many places were unambiguous and wrong, and the longest
registration, seconds; all by the picked pose. What begins with `measured_` is the same by the measured depth.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.geometry import fit_similarity
from morph_dslam.extend.registration import draw_registration
from morph_dslam.extend.slam import Trajectory, load_trajectory, refine_camera, save_camera
from morph_dslam.extend.studies import build_rigid
from support import data_folder

Array = NDArray[np.float64]
HERE = Path(__file__).resolve().parent
#: The cube in the camera of frame 0, metres, and its edge.
CAMERA_FROM_CUBE = np.array(
    [
        [-0.56878, -0.82135, 0.04330, -0.04612],
        [-0.05068, -0.01754, -0.99856, 0.04988],
        [0.82093, -0.57015, -0.03165, 0.51173],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
EDGE_MM, FPS, N_FRAMES, DEPTHS_PER_METRE = 85.0, 30.0, 99, 5000.0
#: Each map's first and last frame, and whether it uses the depth images.
MAPS: dict[str, tuple[int | None, int | None, bool]] = {
    "colour": (None, None, False),
    "depth": (None, None, True),
    "start": (0, 50, True),
    "rest": (20, 97, False),
}
#: What counts as found: centre and size, mm, and angle, degrees.
PLACE_LIMIT, ANGLE_LIMIT = 5.0, 3.0


@dataclass(frozen=True)
class Attempt:
    """One registration: its errors (None if nothing was found), whether it is called ambiguous, and its time.

    ``depth_mm`` is `depth_gap` at the place, ``measured_mm`` as ``place_mm`` by `at_measured_depth`.
    """

    map: str
    hint: str
    seconds: float
    place_mm: float | None = None
    angle_deg: float | None = None
    depth_mm: float | None = None
    measured_mm: float | None = None
    ambiguous: bool = True

    def off(self, measured: bool) -> float:
        """The place's error, mm, by the picked pose or by the measured depth; infinite if there is no place."""
        found = self.measured_mm if measured else self.place_mm
        return np.inf if found is None else found

    def is_right(self, measured: bool) -> bool:
        """Whether the place is right by the picked pose, or by the measured depth."""
        return self.off(measured) <= PLACE_LIMIT and self.angle_deg is not None and self.angle_deg <= ANGLE_LIMIT

    def line(self) -> str:
        if self.place_mm is None:
            return f"{self.map} {self.hint}: not found ({self.seconds:.1f} s)"
        return (
            f"{self.map} {self.hint}: place_mm={self.place_mm:.2f} angle_deg={self.angle_deg:.2f} "
            f"measured_mm={self.measured_mm:.2f} depth_mm={self.depth_mm:+.1f} "
            f"ambiguous={'yes' if self.ambiguous else 'no'} ({self.seconds:.1f} s)"
        )


def as_tum(data: Path, folder: Path) -> Path:
    """The recording in the layout of the TUM benchmark, by links."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("rgb", "depth"):
        if not (folder / name).exists():
            (folder / name).symlink_to((data / name).resolve())
    colour = [f"{k / FPS:.6f} rgb/{k:04d}.jpg\n" for k in range(N_FRAMES)]
    depth = [f"{k / FPS:.6f} depth/{k:04d}.png\n" for k in range(0, N_FRAMES, 3)]
    (folder / "rgb.txt").write_text("".join(colour))
    (folder / "depth.txt").write_text("".join(depth))
    return folder


def frame_0(scene: md.Scene, frames: Path) -> Array:
    """The pose (4, 4), camera_from_world, of frame 0 in a map; found in it if it is none of its frames."""
    path = scene.trajectory
    if 0 not in path.indices:
        path = md.map_scene(md.open_source(frames, 0, 3), scene.camera, known=scene).trajectory
    return np.linalg.inv(path.world_from_camera[int(np.flatnonzero(path.indices == 0)[0])])


def path_errors(path: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """Root mean square of the path's error, mm, and the map's units per metre, both by the fitted similarity."""
    frames = np.rint(truth.timestamps * FPS).astype(int)
    _, ours, theirs = np.intersect1d(path.indices, frames, return_indices=True)
    found, true = path.world_from_camera[ours, :3, 3], truth.world_from_camera[theirs, :3, 3]
    fitted = fit_similarity(found, true)
    misses = np.linalg.norm(fitted.apply(found) - true, axis=1)
    return 1e3 * float(np.sqrt(np.mean(misses**2))), 1.0 / fitted.scale


def depth_gap(camera_from_cube: Array, camera: md.Camera, depth: Array) -> float:
    """Median distance of measured depths (h, w), metres, from the drawn faces of the cube, mm; positive behind them."""
    row, column = np.nonzero(depth > 0.0)
    rays = camera.rays(np.column_stack([column, row]).astype(float))
    turned, eye = rays @ camera_from_cube[:3, :3], -camera_from_cube[:3, :3].T @ camera_from_cube[:3, 3]
    half = EDGE_MM / 2e3
    # The ray enters the cube where it has crossed the nearer plane of all three pairs (slabs).
    entries = (-half * np.sign(turned) - eye) / turned
    face, drawn = entries.argmax(axis=1), entries.max(axis=1)
    beside = np.abs(eye + drawn[:, None] * turned)
    beside[np.arange(len(face)), face] = 0.0
    on_face = beside.max(axis=1) < 0.9 * half
    return 1e3 * float(np.median(depth[row, column][on_face] - drawn[on_face]))


def at_measured_depth(camera: md.Camera, depth: Array) -> Array:
    """The picked pose (4, 4) moved along its ray until its faces lie at the measured depth (h, w), metres."""
    pose = CAMERA_FROM_CUBE.copy()
    for _ in range(3):
        pose[:3, 3] *= 1.0 + depth_gap(pose, camera, depth) / 1e3 / pose[2, 3]
    return pose


@dataclass(frozen=True)
class Tracked:
    """The cube tracked through all frames.

    Attributes
    ----------
    map : in which.
    n_tracked : frames in which it was.
    turns, shifts : (f,) degrees and mm by which it seems to be off its mean place on the desk, in those of them that
        have a true pose of the camera.
    """

    map: str
    n_tracked: int
    turns: Array
    shifts: Array

    def line(self) -> str:
        return (
            f"{self.map} tracked: tracked={self.n_tracked}/{N_FRAMES} still_mm={self.shifts.mean():.2f} "
            f"largest_mm={self.shifts.max():.2f} still_deg={self.turns.mean():.2f} largest_deg={self.turns.max():.2f}"
        )


def track_cube(name: str, scene: md.Scene, placed: md.Registration, frames: Path, truth: Trajectory) -> Tracked:
    """Track a registered cube into ``output/NAME``, with a video, and compare it with a cube that stands still."""
    folder = HERE / "output" / name
    folder.mkdir(parents=True, exist_ok=True)
    scene.save(folder / "map.h5")
    save_camera(folder / "camera.yaml", scene.camera)
    placed.save(folder / "registration.json", folder / "map.h5", HERE / "output" / "cube.morph")
    options = md.TrackOptions(
        frames=frames,
        model=HERE / "output" / "cube.morph",
        camera=folder / "camera.yaml",
        registration=folder / "registration.json",
        first=0,
        output=folder / "run",
        overwrite=True,
    )
    md.track(options)
    run = md.load_run(folder / "run")
    known = dict(zip(np.rint(truth.timestamps * FPS).astype(int).tolist(), truth.world_from_camera, strict=True))
    rows = [row for row in np.flatnonzero(run.tracked).tolist() if int(run.frames[row]) in known]
    cubes = np.array([known[int(run.frames[row])] @ run.camera_from_object[row] for row in rows])
    turns, places = Rotation.from_matrix(cubes[:, :3, :3]), cubes[:, :3, 3]
    angles = np.degrees((turns.mean().inv() * turns).magnitude())
    return Tracked(name, int(run.tracked.sum()), angles, 1e3 * np.linalg.norm(places - places.mean(axis=0), axis=1))


def attempt(
    name: str, hint: str, scene: md.Scene, model: md.ReducedModel, camera_0: Array, unit: float, depth: Array
) -> tuple[Attempt, md.Registration | None]:
    """Register the cube once and compare it with the truth, and with measured depths (h, w), metres, in frame 0."""
    began = time.perf_counter()
    try:
        found = md.register(scene, model, landmarks=HERE / "landmarks.csv" if hint == "clicks" else None)
    except md.MorphError as error:
        print(f"{name} {hint}: {error}")
        return Attempt(name, hint, time.perf_counter() - began), None
    seconds = time.perf_counter() - began
    assert found.map_registration is not None
    placed = found.map_registration.world_from_object
    pose = camera_0 @ placed.matrix
    centre = pose[:3, 3] / placed.scale
    turn = CAMERA_FROM_CUBE[:3, :3].T @ (pose[:3, :3] / placed.scale)
    angles = [(Rotation.from_matrix(turn) * each).magnitude() for each in Rotation.create_group("O")]
    off = 1e3 * float(np.linalg.norm(centre - CAMERA_FROM_CUBE[:3, 3]))
    size = EDGE_MM * abs(placed.scale / unit - 1.0)
    there = np.vstack([np.column_stack([pose[:3, :3] / placed.scale, centre]), [0.0, 0.0, 0.0, 1.0]])
    gap, angle = depth_gap(there, scene.camera, depth), float(np.degrees(min(angles)))
    measured = 1e3 * float(np.linalg.norm(centre - at_measured_depth(scene.camera, depth)[:3, 3]))
    picture = HERE / "output" / f"{name}_{hint}.jpg"
    cv2.imwrite(str(picture), draw_registration(found, scene))
    return Attempt(name, hint, seconds, max(off, size), angle, gap, max(measured, size), found.ambiguous), found


def write_report(attempts: list[Attempt], tracked: list[Tracked], last_line: str) -> None:
    """Write `output/report.md`."""
    lines = [
        "# The cube on the desk",
        "",
        "| map | hint | place [mm] | angle [deg] | by measured depth [mm] | measured depth from its faces [mm] "
        "| ambiguous | s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for each in attempts:
        errors = "- | - | - | -"
        if each.place_mm is not None:
            errors = f"{each.place_mm:.2f} | {each.angle_deg:.2f} | {each.measured_mm:.2f} | {each.depth_mm:+.1f}"
        doubt = "yes" if each.ambiguous else "no"
        lines.append(f"| {each.map} | {each.hint} | {errors} | {doubt} | {each.seconds:.1f} |")
    pictures = [f"![{each.map}]({each.map}_{each.hint}.jpg)" for each in attempts if each.place_mm is not None]
    videos = [f"- [{each.line()}]({each.map}/run/augmented.mp4)" for each in tracked]
    (HERE / "output" / "report.md").write_text(
        "\n".join([*lines, "", *pictures, "", *videos, "", f"`{last_line}`", ""])
    )


def counts(attempts: list[Attempt], measured: bool) -> tuple[float, float, str, int]:
    """Largest errors of the places found, mm and degrees, how many there are by hint, and how many are wrong."""
    stated = [each for each in attempts if not each.ambiguous]
    found = [each for each in stated if each.is_right(measured)]
    plain, hinted = (sum(each.hint == hint for each in found) for hint in ("plain", "clicks"))
    place = max((each.off(measured) for each in found), default=np.nan)
    angle = max((each.angle_deg or 0.0 for each in found), default=np.nan)
    return place, angle, f"found_plain={plain}/4 found_hinted={hinted}/4", len(stated) - len(found)


def run(arguments: argparse.Namespace) -> None:
    output = HERE / "output"
    frames = as_tum(arguments.data, output / "recording")
    model = build_rigid(arguments.data / "cube.obj", "m", output / "cube.morph")
    given = md.load_camera(arguments.data / "camera.yaml")
    colour_only = md.SlamOptions(use_depth=False)
    camera = refine_camera(md.open_source(frames), given, ("readout",), colour_only).camera
    print(f"readout_ms={1e3 * camera.readout_s:.1f}")
    truth = load_trajectory(arguments.data / "tags_shutter_corrected.txt")
    stored = cv2.imread(str(arguments.data / "depth" / "0000.png"), cv2.IMREAD_UNCHANGED)
    depth = np.asarray(stored, dtype=np.float64) / DEPTHS_PER_METRE
    print(f"truth: depth_mm={depth_gap(CAMERA_FROM_CUBE, camera, depth):+.1f}")
    attempts, tracked, path_mm = list[Attempt](), list[Tracked](), np.nan
    for name, (first, last, with_depth) in MAPS.items():
        scene = md.map_scene(md.open_source(frames, first, last), camera, replace(colour_only, use_depth=with_depth))
        error, unit = path_errors(scene.trajectory, truth)
        path_mm = error if name == "colour" else path_mm
        camera_0, unit = frame_0(scene, frames), 1.0 if scene.is_metric else unit
        for hint in ("plain", "clicks"):
            tried, placed = attempt(name, hint, scene, model, camera_0, unit, depth)
            attempts.append(tried)
            print(tried.line(), flush=True)
            if placed is not None and hint == "plain" and first is None:
                tracked.append(track_cube(name, scene, placed, frames, truth))
                print(tracked[-1].line(), flush=True)
    picked, measured = (counts(attempts, by_depth) for by_depth in (False, True))
    place, angle, found, wrong = picked
    last_line = (
        f"place_mm={place:.2f} angle_deg={angle:.2f} path_mm={path_mm:.2f} {found} wrong={wrong} "
        f"seconds={max(each.seconds for each in attempts):.1f} measured_place_mm={measured[0]:.2f} "
        + " ".join(f"measured_{part}" for part in measured[2].split())
        + f" measured_wrong={measured[3]}"
    )
    write_report(attempts, tracked, last_line)
    print(last_line)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=data_folder("rbt_scene"), help="folder of the recording (%(default)s)"
    )
    return run_and_report_errors(run, parser.parse_args(), "what was mapped and registered so far is in output/")


if __name__ == "__main__":
    sys.exit(main())
