"""Registration of rigid objects on rendered desks, where a larger textured board and clutter stand around them.

    python benchmarks/rendered_desks.py [--seeds N] [--first K] [--hints none distance clicks guess] [--again maps]
                                        [--metric PERCENT] [--cache FOLDER] [--make-only] [--pictures]

A desk (desk_scenes.py) has one of 13 shapes, with few marks on it, or from seed 1000 on a smooth animal of one colour
(figurines.py), and is filmed in 81 frames of 640x480 pixels by a trembling hand with a rolling shutter; SLAM maps it
with one camera, so without a scale. The object is then registered as `morph register` does: without a hint, with a
rough distance (10 to 30 % off), with four points clicked in one frame (1 px off each way), or with a guess in one frame
(24 px aside, 8 % too near or too far, turned by 8 degrees).
With ``--metric 1`` the maps are scaled to metres first, each but for an error of its own, of which 1 % is the standard
deviation, as the maps of a depth camera or a stereo pair are.
Desks and maps are kept in the cache; ``--again maps`` makes new maps of the recordings.

A registration counts as right where it is unambiguous and, in the first keyframe in which the object is registered,
the middle of its box is within 5 mm (6 % of the object's diagonal if that is larger) and its attitude within 3 degrees
of the true ones, up to the object's own rotations; as wrong where it is unambiguous and not right. `points` are the
map's points on the object.
"""

from __future__ import annotations

import argparse
import sys
import time
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import morph_dslam as md
from desk_scenes import Shape, shape_of, with_sharp_edges, write_desk
from morph_dslam.extend.geometry import RigidTransform, SimilarityTransform, fit_similarity
from morph_dslam.extend.registration import Landmarks, draw_registration
from morph_dslam.extend.slam import Trajectory, run_slam
from morph_dslam.extend.studies import build_rigid
from morph_dslam.registration.registration import MapRegistration
from morph_dslam.tracking.anchoring import points_on_object
from support import keep

Array = NDArray[np.float64]
CACHE = Path(__file__).resolve().parent / "output" / "rendered_desks"
HINTS = ("none", "distance", "clicks", "guess")
#: What counts as right: place, mm, or share of the object's diagonal if that is larger; angle, degrees.
PLACE_LIMIT, PLACE_SHARE, ANGLE_LIMIT = 5.0, 0.06, 3.0
#: How far a distance given as a hint is off, as a share, and a clicked point, pixels.
DISTANCE_OFF, CLICK_OFF, N_CLICKS = (0.1, 0.3), 1.0, 4
#: How far a guess is off: aside, pixels; the distance, as a share; the attitude, degrees.
GUESS_ASIDE, GUESS_DISTANCE, GUESS_TURN = 24.0, 0.08, 8.0


@dataclass(frozen=True)
class Desk:
    """A desk with its map and the truth.

    Attributes
    ----------
    camera_from_object : (T, 4, 4) true poses, metres.
    pixels, visible : (T, p, 2) and (T, p) of points spread over the object.
    surface : (p, 3) these points, object frame, metres.
    place : the true place in the map, by the camera's path and the first keyframe.
    """

    seed: int
    shape: Shape
    model: md.ReducedModel
    scene: md.Scene
    camera_from_object: Array
    pixels: Array
    visible: NDArray[np.bool_]
    surface: Array
    place: SimilarityTransform

    @property
    def points(self) -> int:
        """How many of the map's points are on the object."""
        true = MapRegistration(self.place, np.zeros(3), None)
        return int(points_on_object(self.scene.map.positions, true, self.model)[0].sum())

    @property
    def place_limit(self) -> float:
        """Of what counts as right, mm."""
        return max(PLACE_LIMIT, PLACE_SHARE * float(np.linalg.norm(np.ptp(self.shape.points, axis=0))))


@dataclass(frozen=True)
class Attempt:
    """One registration: its errors (None if nothing was found), whether it is called ambiguous, and its time."""

    hint: str
    seconds: float
    place_mm: float | None = None
    angle_deg: float | None = None
    scale: float = np.nan
    within: bool = False
    ambiguous: bool = True

    @property
    def is_right(self) -> bool:
        return self.within and not self.ambiguous

    @property
    def is_wrong(self) -> bool:
        return not self.within and not self.ambiguous

    def text(self) -> str:
        if self.place_mm is None:
            return f"{self.hint}: not found ({self.seconds:.1f} s)"
        verdict = "right" if self.is_right else "wrong" if self.is_wrong else "ambiguous"
        near = " though near" if self.within and self.ambiguous else ""
        return (
            f"{self.hint}: {verdict}{near} place_mm={self.place_mm:.1f} angle_deg={self.angle_deg:.2f} "
            f"scale_percent={100.0 * self.scale:+.1f} ({self.seconds:.1f} s)"
        )


def build_models(surface: Path) -> None:
    """The object as a user would build it, and for pictures with sharp edges."""
    model = build_rigid(surface, "mm", surface.with_suffix(".morph"))
    md.save_model(surface.with_name("sharp.morph"), with_sharp_edges(model))


def made(seed: int, cache: Path, again: bool) -> Path:
    """The folder of a seed with its recording and its map; each is made unless it was made of the same desk."""
    folder = cache / f"{seed:02}"
    desk = write_desk(seed, folder)
    keep(folder / "sharp.morph", desk[:1], lambda: build_models(desk[0]))
    recording, scan = folder / "recording", folder / "scan"
    keep(recording, desk, partial(md.simulate, desk[-1], recording, progress=False))
    (recording / "depth.h5").unlink(missing_ok=True)
    if again:
        (folder / "scan.made-from").unlink(missing_ok=True)
    keep(
        scan,
        desk,
        partial(
            run_slam, recording / "frames", recording / "camera.yaml", scan, video=False, overwrite=True, progress=False
        ),
    )
    return folder


def load_desk(seed: int, folder: Path) -> Desk:
    model = md.load_model(folder / "object.morph")
    scene = md.load_scene(folder / "scan" / "map.h5", md.load_camera(folder / "recording" / "camera.yaml"))
    truth = np.load(folder / "recording" / "truth.npz")
    poses = truth["camera_from_object"]
    first = RigidTransform.from_matrix(poses[0])
    keyframes = scene.map.keyframes
    in_map = [RigidTransform.from_matrix(keyframe.camera_from_world) for keyframe in keyframes]
    true = [RigidTransform.from_matrix(poses[keyframe.index]) for keyframe in keyframes]
    centres = [np.array([pose.inverse.translation for pose in path]) for path in (true, in_map)]
    place = fit_similarity(centres[0], centres[1])
    # The path alone leaves a turn about itself open: attitude and place are those of the first keyframe.
    seen = in_map[0].inverse
    place = SimilarityTransform(
        place.scale,
        seen.rotation @ true[0].rotation,
        seen.rotation @ (place.scale * true[0].translation) + seen.translation,
    )
    surface = first.inverse.apply(1e-3 * truth["points_mm"][0])
    return Desk(seed, shape_of(seed)[1], model, scene, poses, truth["pixels"], truth["visible"], surface, place)


def in_metres(desk: Desk, percent: float) -> Desk:
    """The desk in a metric map, the scale of which is off by so much (one standard deviation)."""
    off = np.exp(1e-2 * percent * np.random.default_rng([99, desk.seed]).normal())
    factor = np.array([1.0, 1.0, 1.0, off / desk.place.scale])
    rigid_map, path = deepcopy(desk.scene.map), desk.scene.trajectory
    rigid_map.positions = factor[3] * rigid_map.positions
    rigid_map.baseline_px = 1.0
    for keyframe in rigid_map.keyframes:
        keyframe.camera_from_world[:3] *= factor
    poses = path.world_from_camera.copy()
    poses[:, :3] *= factor
    scene = replace(desk.scene, map=rigid_map, trajectory=Trajectory(path.timestamps, poses, path.indices))
    place = SimilarityTransform(float(off), desk.place.rotation, factor[3] * desk.place.translation)
    return replace(desk, scene=scene, place=place)


def hints_of(desk: Desk, hint: str, folder: Path) -> dict[str, object]:
    """What a user would give, as arguments of `md.register`; files are written to the folder."""
    rng = np.random.default_rng([17, desk.seed])
    if hint == "distance":
        off = rng.uniform(*DISTANCE_OFF) * rng.choice([-1.0, 1.0])
        distance = np.median([np.linalg.norm(pose[:3, 3]) for pose in desk.camera_from_object])
        return {"distance": float(distance) * (1.0 + off)}
    if hint == "clicks":
        keyframe = desk.scene.map.keyframes[len(desk.scene.map.keyframes) // 2].index
        seen = np.flatnonzero(desk.visible[keyframe])
        pixels = desk.pixels[keyframe, seen]
        chosen = [int(np.argmax(np.linalg.norm(pixels - pixels.mean(axis=0), axis=1)))]
        while len(chosen) < min(N_CLICKS, len(seen)):
            chosen.append(int(np.argmax(np.linalg.norm(pixels[:, None] - pixels[chosen], axis=2).min(axis=1))))
        clicked = pixels[chosen] + rng.normal(0.0, CLICK_OFF, (len(chosen), 2))
        return {"landmarks": Landmarks(desk.surface[seen[chosen]], clicked, np.full(len(chosen), keyframe))}
    if hint == "guess":
        return {"guess": write_guess(desk, folder / "guess.toml", rng)}
    return {}


def write_guess(desk: Desk, path: Path, rng: np.random.Generator) -> Path:
    """The file of a guess in the keyframe in the middle."""
    keyframe = desk.scene.map.keyframes[len(desk.scene.map.keyframes) // 2].index
    true = desk.camera_from_object[keyframe]
    aside, turn = rng.normal(size=2), rng.normal(size=3)
    aside *= GUESS_ASIDE * true[2, 3] / desk.scene.camera.fx / np.linalg.norm(aside)
    turned = Rotation.from_rotvec(np.radians(GUESS_TURN) * turn / np.linalg.norm(turn)).as_matrix() @ true[:3, :3]
    place = (1.0 + GUESS_DISTANCE * rng.choice([-1.0, 1.0])) * (true[:3, 3] + np.append(aside, 0.0))
    angles = Rotation.from_matrix(turned).as_euler("xyz", degrees=True)
    pose = f"[pose]\nposition_mm = {(1e3 * place).tolist()}\nrotation_deg = {angles.tolist()}\n"
    path.write_text(f"frame = {keyframe}\n{pose}")
    return path


def angle_between(a: Array, b: Array, shape: Shape) -> float:
    """Degrees between two attitudes (3, 3) of an object, up to its own rotations."""
    if shape.symmetry == "Cinf":
        return float(np.degrees(np.arccos(np.clip(a[:, 2] @ b[:, 2], -1.0, 1.0))))
    turns = [a.T @ b @ each.as_matrix() for each in shape.rotations]
    return float(np.degrees(min(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)) for turn in turns)))


def attempt(desk: Desk, hint: str, folder: Path, picture: Path | None) -> Attempt:
    """Register the object once and compare it with the truth in its first keyframe."""
    began = time.perf_counter()
    try:
        found = md.register(desk.scene, desk.model, **hints_of(desk, hint, folder))  # type: ignore[arg-type]
    except md.MorphError as error:
        print(f"seed={desk.seed} {hint}: {error}")
        return Attempt(hint, time.perf_counter() - began)
    seconds = time.perf_counter() - began
    assert found.map_registration is not None
    if picture is not None:
        cv2.imwrite(str(picture), draw_registration(found, desk.scene))
    first = min(found.keyframes, key=lambda keyframe: keyframe.frame)
    true = desk.camera_from_object[first.frame]
    place = 1e3 * float(np.linalg.norm(first.pose.translation - true[:3, 3]))
    angle = angle_between(first.pose.rotation, true[:3, :3], desk.shape)
    scale = found.map_registration.world_from_object.scale / desk.place.scale - 1.0
    within = place <= desk.place_limit and angle <= ANGLE_LIMIT
    return Attempt(hint, seconds, place, angle, scale, within, found.ambiguous)


def last_line(attempts: list[list[Attempt]], points: list[int], count: int) -> str:
    """Of the registrations without a hint; ``hinted`` are those that are right with each of the hints tried.

    ``place_mm`` is the mean of all places found.
    """
    plain = [each for desk in attempts for each in desk if each.hint == "none"]
    hinted = []
    for hint in HINTS[1:]:
        tried = [each for desk in attempts for each in desk if each.hint == hint]
        if tried:
            hinted.append(
                f"{hint}:{sum(a.is_right for a in tried)}/{len(tried)}(wrong:{sum(a.is_wrong for a in tried)})"
            )
    seconds = [each.seconds for desk in attempts for each in desk]
    places = [each.place_mm for desk in attempts for each in desk if each.place_mm is not None]
    unaided = "-"
    if plain:
        unaided = (
            f"{sum(each.is_right for each in plain)}/{count} wrong={sum(each.is_wrong for each in plain)} "
            f"ambiguous={sum(each.ambiguous for each in plain)}"
        )
    return (
        f"right={unaided} hinted={','.join(hinted) or '-'} place_mm={np.mean(places) if places else np.nan:.1f} "
        f"seconds={np.median(seconds):.1f} slowest={max(seconds):.1f} points={np.median(points):.0f}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=30, help="how many (%(default)s)")
    parser.add_argument("--first", type=int, default=0, help="the first of them (%(default)s)")
    parser.add_argument("--hints", nargs="+", choices=HINTS, default=["none"], help="to register with (%(default)s)")
    parser.add_argument(
        "--metric", type=float, metavar="PERCENT", help="scale the maps to metres, but for such an error"
    )
    parser.add_argument("--again", choices=["maps"], help="make these anew")
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of the desks and maps (%(default)s)")
    parser.add_argument("--make-only", action="store_true", help="render and map, register nothing")
    parser.add_argument("--pictures", action="store_true", help="draw every registration, beside its map")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    attempts, points = [], []
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        folder = made(seed, arguments.cache, arguments.again == "maps")
        desk = load_desk(seed, folder)
        desk = desk if arguments.metric is None else in_metres(desk, arguments.metric)
        points.append(desk.points)
        start = f"seed={seed} shape={shape_of(seed)[0]} keyframes={len(desk.scene.map.keyframes)} points={points[-1]}"
        if arguments.make_only:
            print(start, flush=True)
            continue
        pictures = [folder / f"{hint}.jpg" if arguments.pictures else None for hint in arguments.hints]
        attempts.append([attempt(desk, hint, folder, at) for hint, at in zip(arguments.hints, pictures, strict=True)])
        print(start, *(each.text() for each in attempts[-1]), flush=True)
    if attempts:
        print(last_line(attempts, points, arguments.seeds))
    return 0


if __name__ == "__main__":
    sys.exit(main())
