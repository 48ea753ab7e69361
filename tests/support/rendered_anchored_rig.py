"""A sheet that bulges on a table and a wedge before it whose top is pushed, filmed by a rig of two cameras.

The second camera films the end of the scan and what comes then. The registrations of both objects come from
the truth and the camera's path in the map, not from `morph register`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from morph_dslam.camera import PinholeCamera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.io.calibration import save_camera
from morph_dslam.model import ReducedModel, save_model
from morph_dslam.online.several.rig import RigCamera
from morph_dslam.online.slam.map_file import save_map
from morph_dslam.online.slam.slam import Slam
from morph_dslam.render.environment import StaticScene
from morph_dslam.render.motion import Motion, plan_motion
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.scene_file import Scene, load_scene_file
from morph_dslam.render.scene_renderer import SceneRenderer, supersampled
from tests.support.bent_sheet import bent_sheet_model
from tests.support.camchain import write_camchain
from tests.support.rendered_anchored import write_registration
from tests.support.staged_scenes import bending_wedge

#: Frames of the scan, in which nothing deforms, all frames, and the first one of the second camera.
SCAN, FRAMES, FIRST_BESIDE = 36, 48, 24
#: The wedge is so much larger than the one on the stage.
WEDGE_SIZE = 2.0

_TURN = rotation_exp(np.array([0.0, 0.38, 0.0]))
_CAMERA = PinholeCamera(480, 360, 420.0, 420.0, 239.5, 179.5)
#: 0.22 m beside the first camera, turned so that both look at the same place 0.55 m away.
RIG = (
    RigCamera(_CAMERA, RigidTransform.identity()),
    RigCamera(
        PinholeCamera(480, 360, 400.0, 400.0, 236.0, 182.0),
        RigidTransform(_TURN, np.array([0.0, 0.0, 0.55]) - _TURN @ np.array([0.0, 0.0, 0.55])),
    ),
)

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
[[camera_path]]
frame = 0
position_mm = [-200, -560, 340]
target_mm = [0, -60, 0]
[[camera_path]]
frame = 16
position_mm = [0, -480, 440]
target_mm = [0, -60, 0]
[[camera_path]]
frame = 35
position_mm = [120, -560, 330]
target_mm = [0, -60, 0]
[[camera_path]]
frame = 47
position_mm = [40, -560, 360]
target_mm = [0, -60, 0]
"""
_SHEET = """
[[parameters]]
frame = 36
arch = 0.0
skew = 0.0
[[parameters]]
frame = 47
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
frame = 36
push_x = 0.0
push_y = 0.0
[[parameters]]
frame = 47
push_x = 15.0
push_y = -10.0
[[pose]]
frame = 0
position_mm = [-90, -290, 0]
"""


@dataclass
class _Part:
    """An object's scene, model and motion."""

    scene: Scene
    model: ReducedModel
    motion: Motion

    def nodes(self, camera: RigCamera, frame: int) -> np.ndarray:
        seen = camera.camera_from_rig @ self.motion.camera_from_object[frame]
        return seen.apply(self.model.positions(self.motion.parameters[frame]))


def make_rig_recording(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """Write models, `front/`, `aside/`, `camchain.yaml`, `camera.yaml`, `map.h5` and both registrations.

    Returns
    -------
    By object, parameters (T, d) and camera_from_object (T, 4, 4) in the first camera.
    """
    for seed, (name, cells) in enumerate((("sheet", 75), ("wedge", 75), ("table", 150))):
        noise = np.random.default_rng(seed).integers(20, 236, (cells, cells, 3), dtype=np.uint8)
        picture = cv2.resize(noise, (6 * cells, 6 * cells), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{name}.png"), picture)
    wedge = bending_wedge()
    models = {"sheet": bent_sheet_model(29, 21), "wedge": replace(wedge, nodes=WEDGE_SIZE * wedge.nodes)}
    parts = {name: _part(folder, name, model) for name, model in models.items()}
    for camera, name, frames in (
        (RIG[0], "front", range(FRAMES)),
        (RIG[1], "aside", range(FIRST_BESIDE, FRAMES)),
    ):
        (folder / name).mkdir()
        for frame, image in _film(folder, parts, camera, frames):
            cv2.imwrite(str(folder / name / f"{frame:06}.png"), image)
    truth = {
        name: {
            "parameters": part.motion.parameters,
            "camera_from_object": np.stack([pose.matrix for pose in part.motion.camera_from_object]),
        }
        for name, part in parts.items()
    }
    save_camera(folder / "camera.yaml", _CAMERA)
    write_camchain(folder / "camchain.yaml", RIG)
    _scan(folder, models, truth)
    return truth


def _part(folder: Path, name: str, model: ReducedModel) -> _Part:
    save_model(folder / f"{name}.morph", model)
    path = folder / f"{name}.toml"
    path.write_text(_HEAD.format(name=name, frames=FRAMES) + {"sheet": _SHEET, "wedge": _WEDGE}[name])
    scene = load_scene_file(path)
    return _Part(scene, model, plan_motion(scene, model))


def _film(folder, parts, part, frames):
    """The pictures of one camera, with the nearer object before the other."""
    sheet, wedge = parts["sheet"], parts["wedge"]
    poses = [part.camera_from_rig @ pose for pose in sheet.motion.camera_from_world]
    places = np.array([pose.inverse.translation for pose in poses])
    light = np.array(sheet.scene.light.direction)
    around = StaticScene(
        sheet.scene.environment,
        folder,
        supersampled(part.camera, 2),
        places,
        light,
        sheet.scene.light.ambient,
    )
    with_table = SceneRenderer(sheet.scene, sheet.model, part.camera, folder, 0.3, around)
    alone = SceneRenderer(wedge.scene, wedge.model, part.camera, folder, 0.3)
    for frame in frames:
        nodes = {name: one.nodes(part, frame) for name, one in parts.items()}
        behind = with_table.render(nodes["sheet"], frame, None, poses[frame])
        before = alone.render(nodes["wedge"], frame, None, poses[frame])
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
    slam.refine_map()
    save_map(folder / "map.h5", slam.map, _CAMERA)
    for name, model in models.items():
        (folder / name).mkdir()
        path = folder / name / "registration.json"
        names = {"map": "../map.h5", "model": f"../{name}.morph"}
        write_registration(path, slam, frames, truth[name], model.nodes.mean(axis=0), names)
