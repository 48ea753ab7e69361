"""A sheet that bulges on a table and a wedge before it whose top is pushed, filmed by a rig of two cameras.

The second camera films the end of the scan and what comes then. The registrations of both objects come from
the truth and the camera's path in the map, not from `morph register`; others have poses in the keyframes that
are nearly exact, as those that `morph register` adjusts by the images.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, cross_matrix, rotation_exp
from morph_dslam.io.camera_files import save_camera, save_rig
from morph_dslam.model import ReducedModel, load_model, save_model
from morph_dslam.render.environment import Motion, StaticScene, plan_motion
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.scene_file import Scene, load_scene_file
from morph_dslam.render.scene_renderer import Instant, SceneRenderer, supersampled
from morph_dslam.slam.map_files import save_map
from morph_dslam.slam.slam import Slam
from morph_dslam.tracking.rig import RigCamera
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_anchored import write_registration
from tests.support.staged_scenes import bending_wedge

#: Frames of the scan, in which nothing deforms, all frames, and the first one of the second camera.
SCAN, FRAMES, FIRST_BESIDE = 36, 48, 24
#: Frames of the first camera's second recording, in which it all deforms again.
LEFT_FRAMES = 10
#: How well `adjusted.json` has the objects in the keyframes: turn, rad, and shift, metres.
KEYFRAME_DEVIATIONS = np.array([5e-4, 5e-4, 5e-4, 2e-4, 2e-4, 2e-4])
#: The wedge is so much larger than the one on the stage.
WEDGE_SIZE = 2.0
_CAMERA = Camera(480, 360, 420.0, 420.0, 239.5, 179.5)


def _rig(turn: float) -> tuple[RigCamera, RigCamera]:
    """The second camera 0.22 m beside the first, turned so that both look at the same place 0.55 m away."""
    around, place = rotation_exp(np.array([0.0, turn, 0.0])), np.array([0.0, 0.0, 0.55])
    beside = Camera(480, 360, 400.0, 400.0, 236.0, 182.0)
    pose = RigidTransform(around, place - around @ place)
    return RigCamera(_CAMERA, RigidTransform.identity()), RigCamera(beside, pose)


#: With the second camera to the right of the first, and to the left.
RIG, MIRRORED_RIG = _rig(0.38), _rig(-0.38)
_HEAD = """
model = "{name}.morph"
frames = {frames}
camera = {{ width = 480, height = 360, fx = 420.0, fy = 420.0, cx = 239.5, cy = 179.5 }}
supersampling = 2
[surface]
texture = "{name}.png"
[light]
direction = [-0.3, -0.5, 1.0]
[sensor]
noise = 1.5
"""
_PATH = """
[[camera_path]]
frame = {frame}
position_mm = [{position}]
target_mm = [0, -60, 0]
"""
_SHEET = """
[[parameters]]
frame = {begin}
arch = 0.0
skew = 0.0
[[parameters]]
frame = {end}
arch = 35.0
skew = 0.2
[[environment.rectangles]]
texture = "table.png"
centre_mm = [0, 0, -2]
right_mm = [1400, 0, 0]
down_mm = [0, -1400, 0]
[[environment.rectangles]]
texture = "table.png"
centre_mm = [0, 500, 100]
right_mm = [1400, 0, 0]
down_mm = [0, 0, -500]
"""
_WEDGE = """
[[parameters]]
frame = {begin}
push_x = 0.0
push_y = 0.0
[[parameters]]
frame = {end}
push_x = 15.0
push_y = -10.0
[[pose]]
frame = 0
position_mm = [-90, -290, 0]
"""


@dataclass(frozen=True, eq=False)
class _Film:
    """How many frames, where the first camera is in some of them, mm, and when the objects are deformed."""

    frames: int
    path: dict[int, str]
    begin: int
    end: int


_SCAN_AND_BEND = _Film(
    FRAMES, {0: "-200, -560, 340", 16: "0, -480, 440", 35: "120, -560, 330", 47: "40, -560, 360"}, SCAN, FRAMES - 1
)
#: From where the scan began, and farther round, where the last keyframes show little of the wedge.
_LEFT = _Film(LEFT_FRAMES, {0: "-200, -560, 340", LEFT_FRAMES - 1: "-420, -420, 320"}, 0, LEFT_FRAMES - 1)


@dataclass
class _Part:
    """An object's scene, model and motion."""

    scene: Scene
    model: ReducedModel
    motion: Motion

    def nodes(self, camera: RigCamera, frame: int) -> np.ndarray:
        seen = camera.camera_from_rig @ self.motion.camera_from_object[frame]
        return seen.apply(self.model.positions(self.motion.parameters[frame]))


def load_truth(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """By object the parameters (T, d) and camera_from_object (T, 4, 4) in the first camera."""
    truth: dict[str, dict[str, np.ndarray]] = {}
    with np.load(folder / "truth.npz") as file:
        for key, values in file.items():
            name, _, quantity = key.partition("/")
            truth.setdefault(name, {})[quantity] = values
    return truth


def _save_truth(folder: Path, truth: dict[str, dict[str, np.ndarray]]) -> None:
    values = {f"{name}/{quantity}": x for name, part in truth.items() for quantity, x in part.items()}
    np.savez(folder / "truth.npz", **values)  # pyright: ignore[reportArgumentType]


def make_rig_recording(folder: Path) -> None:
    """Write models, `front/`, `aside/`, `camchain.yaml`, `camera.yaml`, `map.h5`, both registrations and the truth."""
    for seed, (name, cells) in enumerate((("sheet", 75), ("wedge", 75), ("table", 150))):
        noise = np.random.default_rng(seed).integers(20, 236, (cells, cells, 3), dtype=np.uint8)
        picture = cv2.resize(noise, (6 * cells, 6 * cells), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{name}.png"), picture)
    wedge = bending_wedge()
    models = {"sheet": bent_sheet_model(29, 21), "wedge": replace(wedge, nodes=WEDGE_SIZE * wedge.nodes)}
    for name, model in models.items():
        save_model(folder / f"{name}.morph", model)
    parts = {name: _part(folder, name, model, _SCAN_AND_BEND) for name, model in models.items()}
    for camera, name, frames in ((RIG[0], "front", range(FRAMES)), (RIG[1], "aside", range(FIRST_BESIDE, FRAMES))):
        _write_film(folder, name, parts, camera, frames)
    truth = _truth(parts)
    save_camera(folder / "camera.yaml", _CAMERA)
    save_rig(folder / "camchain.yaml", [(part.camera, part.camera_from_rig) for part in RIG])
    _scan(folder, models, truth)
    _save_truth(folder, truth)


def _link_all(source: Path, folder: Path) -> None:
    """Show in ``folder`` what ``source`` holds, but for its truth."""
    for path in source.iterdir():
        if path.name not in {"truth.npz", ".made"}:
            (folder / path.name).symlink_to(path.resolve())


def make_left_recording(rig: Path, folder: Path) -> None:
    """Write `left/` and its truth, and links to what `make_rig_recording` has written in folder ``rig``."""
    _link_all(rig, folder)
    models = {name: load_model(folder / f"{name}.morph") for name in ("sheet", "wedge")}
    parts = {name: _part(folder, name, model, _LEFT) for name, model in models.items()}
    _write_film(folder, "left", parts, RIG[0], range(LEFT_FRAMES))
    _save_truth(folder, _truth(parts))


def make_mirrored_recording(left: Path, folder: Path) -> None:
    """Write `both/` and `mirrored/`, the scan and what `left/` shows after it, and `camchain_mirrored.yaml`.

    The second camera is to the left of the first, and has of the scan the keyframes of the wedge's registration
    alone. What `make_left_recording` has written in folder ``left`` is linked to.
    """
    _link_all(left, folder)
    registration = json.loads((folder / "wedge" / "adjusted.json").read_text())
    keyframes = sorted(keyframe["frame"] for keyframe in registration["keyframes"])
    models = {name: load_model(folder / f"{name}.morph") for name in ("sheet", "wedge")}
    films = {
        film: {name: _part(folder, name, model, film) for name, model in models.items()}
        for film in (_SCAN_AND_BEND, _LEFT)
    }
    for name in ("both", "mirrored"):
        (folder / name).mkdir()
    for first, film, frames in ((0, _SCAN_AND_BEND, keyframes), (SCAN, _LEFT, range(LEFT_FRAMES))):
        for frame, image in _film(folder, films[film], MIRRORED_RIG[1], frames):
            cv2.imwrite(str(folder / "mirrored" / f"{first + frame:06}.png"), image)
    for first, source, count in ((0, "front", SCAN), (SCAN, "left", LEFT_FRAMES)):
        for frame in range(count):
            path = folder / "both" / f"{first + frame:06}.png"
            path.symlink_to(folder / source / f"{frame:06}.png")
    save_rig(folder / "camchain_mirrored.yaml", [(part.camera, part.camera_from_rig) for part in MIRRORED_RIG])
    scan, there = _truth(films[_SCAN_AND_BEND]), _truth(films[_LEFT])
    _save_truth(
        folder,
        {
            name: {key: np.concatenate([scan[name][key][:SCAN], there[name][key]]) for key in scan[name]}
            for name in scan
        },
    )


def _truth(parts: dict[str, _Part]) -> dict[str, dict[str, np.ndarray]]:
    return {
        name: {
            "parameters": part.motion.parameters,
            "camera_from_object": np.stack([pose.matrix for pose in part.motion.camera_from_object]),
        }
        for name, part in parts.items()
    }


def _part(folder: Path, name: str, model: ReducedModel, film: _Film) -> _Part:
    path = folder / f"{name}_{film.frames}.toml"
    moves = {"sheet": _SHEET, "wedge": _WEDGE}[name].format(begin=film.begin, end=film.end)
    camera = [_PATH.format(frame=frame, position=position) for frame, position in film.path.items()]
    path.write_text(_HEAD.format(name=name, frames=film.frames) + "".join(camera) + moves)
    scene = load_scene_file(path)
    return _Part(scene, model, plan_motion(scene, model))


def _write_film(folder, name, parts, camera, frames):
    (folder / name).mkdir()
    for frame, image in _film(folder, parts, camera, frames):
        cv2.imwrite(str(folder / name / f"{frame:06}.png"), image)


def _film(folder, parts, part, frames):
    """The pictures of one camera, with the nearer object before the other."""
    sheet, wedge = parts["sheet"], parts["wedge"]
    poses = [part.camera_from_rig @ pose for pose in sheet.motion.camera_from_world]
    places = np.array([pose.inverse.translation for pose in poses])
    light = np.array(sheet.scene.light.direction)
    around = StaticScene(
        sheet.scene.environment, folder, supersampled(part.camera, 2), places, light, sheet.scene.light.ambient
    )
    with_table = SceneRenderer(sheet.scene, sheet.model, part.camera, folder, 0.3, around)
    alone = SceneRenderer(wedge.scene, wedge.model, part.camera, folder, 0.3)
    for frame in frames:
        nodes = {name: one.nodes(part, frame) for name, one in parts.items()}
        behind = with_table.render([Instant(nodes["sheet"], None, poses[frame])], frame)
        before = alone.render([Instant(nodes["wedge"], None, poses[frame])], frame)
        depth = {name: _depth(part.camera, nodes[name], parts[name].model) for name in parts}
        rest = np.minimum(depth["sheet"], around.buffers(poses[frame], part.camera).depth)
        yield frame, np.where((depth["wedge"] < rest)[:, :, None], before, behind)


def _depth(camera, nodes, model):
    pixels = camera.project(nodes)
    return rasterise(pixels, nodes[:, 2], model.triangles, camera.height, camera.width).depth


def _scan(folder, models, truth):
    slam = Slam(_CAMERA)
    frames = [
        slam.process_frame(cv2.imread(str(folder / "front" / f"{number:06}.png")), number, number / 30.0)
        for number in range(SCAN)
    ]
    frames = slam.refine_map(frames)
    save_map(folder / "map.h5", slam.map, _CAMERA)
    for name, model in models.items():
        (folder / name).mkdir()
        path = folder / name / "registration.json"
        files = {"map_path": folder / "map.h5", "model_path": folder / f"{name}.morph"}
        write_registration(path, model, slam, frames, truth[name], model.nodes.mean(axis=0), **files)
        _write_adjusted(path, truth[name], model.nodes.mean(axis=0))


def _write_adjusted(path, truth, centre):
    """`adjusted.json`: the registration as `morph register` has it, with a pose of its own in each keyframe.

    These are off by the same turn about the middle and the same shift of the object, one draw of what is
    stated.
    """
    content = json.loads(path.read_text())
    error = KEYFRAME_DEVIATIONS * np.random.default_rng(7).standard_normal(6)
    for keyframe in content["keyframes"]:
        exact = truth["camera_from_object"][keyframe["frame"]]
        turn = exact[:3, :3]
        error_factors = np.zeros((6, 6))
        error_factors[:3, :3] = error_factors[3:, 3:] = turn
        error_factors[3:, :3] = cross_matrix(turn @ centre) @ turn
        step = error_factors @ error
        pose = RigidTransform(rotation_exp(step[:3]) @ turn, exact[:3, 3] + step[3:])
        error_factors *= KEYFRAME_DEVIATIONS
        keyframe |= {
            "camera_from_object": pose.matrix.tolist(),
            "error_factors": error_factors.tolist(),
            "covariance": (error_factors @ error_factors.T).tolist(),
        }
    path.with_name("adjusted.json").write_text(json.dumps(content))
