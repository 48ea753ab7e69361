"""A sheet that lies on a printed table and bulges there, before a moving camera; its map and its place in it.

The place comes from the truth and the camera's path in the map, not from `morph register`.
"""

from __future__ import annotations

import cv2
import numpy as np

from morph_dslam.geometry import fit_similarity
from morph_dslam.io.camera_files import load_camera
from morph_dslam.model import load_model
from morph_dslam.registration.registration import KeyframePose, MapRegistration, registration_in_map
from morph_dslam.render.simulation import simulate
from morph_dslam.slam.map_files import save_map
from morph_dslam.slam.scene import trajectory_of
from morph_dslam.slam.slam import Slam
from morph_dslam.sources import open_source
from tests.support.scenes import write_scene

#: Frames of the scan, in which the sheet is flat, and all frames.
SCAN, FRAMES = 40, 60
_CAMERA = "camera = { width = 480, height = 360, fx = 420.0, fy = 420.0, cx = 239.5, cy = 179.5 }\n"
_TAIL = """
[[parameters]]
frame = 41
arch = 0.0
[[parameters]]
frame = 59
arch = 30.0
skew = 0.2

[sensor]
noise = 1.5

[[environment.rectangles]]
texture = "table.png"
centre_mm = [0, 0, -2]
right_mm = [1200, 0, 0]
down_mm = [0, -1200, 0]
[[environment.rectangles]]
texture = "table.png"
centre_mm = [0, 500, 100]
right_mm = [1200, 0, 0]
down_mm = [0, 0, -400]

[[camera_path]]
frame = 0
position_mm = [-150, -420, 480]
target_mm = [0, 0, 0]
[[camera_path]]
frame = 18
position_mm = [20, -340, 600]
target_mm = [0, 0, 0]
[[camera_path]]
frame = 39
position_mm = [180, -420, 480]
target_mm = [0, 0, 0]
[[camera_path]]
frame = 59
position_mm = [60, -450, 500]
target_mm = [0, 0, 0]
"""


def make_anchored_recording(folder):
    """Write `sheet.morph`, `sequence/`, `map.h5` and `registration.json` in ``folder``."""
    noise = np.random.default_rng(5).integers(20, 236, (150, 150, 3), dtype=np.uint8)
    table = cv2.resize(noise, (900, 900), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(folder / "table.png"), table)
    scene = write_scene(folder, top=f"frames = {FRAMES}\n", tail=_TAIL, camera=_CAMERA)
    simulate(scene, folder / "sequence", progress=False)
    truth = np.load(folder / "sequence" / "truth.npz")
    camera = load_camera(folder / "sequence" / "camera.yaml")
    slam = Slam(camera)
    frames = [
        slam.process_frame(frame.image, frame.index, frame.timestamp)
        for frame in open_source(folder / "sequence" / "frames", 0, SCAN - 1)
    ]
    frames = slam.refine_map(frames)
    save_map(folder / "map.h5", slam.map, camera)
    write_registration(folder / "registration.json", load_model(folder / "sheet.morph"), slam, frames, truth)


def write_registration(path, model, slam, frames, truth, centre=(0.0, 0.0, 0.0), **files):
    """A registration that is as good as the camera's path in the map."""
    path_in_map = trajectory_of(slam, frames)
    seen = [frame.index for frame in frames if frame.pose is not None]
    placed = _similarity(path_in_map.world_from_camera, truth["camera_from_object"][seen], np.array(centre))
    size = 0.5 * placed.scale
    spread = np.array([1e-3, *[1e-3] * 3, *[1e-3 * size] * 3])
    in_map = MapRegistration(placed, np.array(centre), np.diag(spread**2))
    keyframes = [
        KeyframePose(keyframe.index, in_map.pose_in(keyframe.camera_from_world)) for keyframe in slam.map.keyframes
    ]
    facts = {"from": "map", "score": 100.0, "runner_up_score": 10.0, "rms_px": 0.1}
    registration_in_map(model, in_map, keyframes, facts).save(path, **files)


def _similarity(map_from_camera, camera_from_object, centre):
    """Map from object: points about the object where each camera has them, at the scale of the path."""
    centres = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in camera_from_object])
    scale = fit_similarity(centres, map_from_camera[:, :3, 3]).scale
    points = centre + np.random.default_rng(0).uniform(-0.2, 0.2, (50, 3))
    there = [
        camera[:3, 3] + scale * (points @ pose[:3, :3].T + pose[:3, 3]) @ camera[:3, :3].T
        for camera, pose in zip(map_from_camera, camera_from_object, strict=True)
    ]
    return fit_similarity(np.tile(points, (len(there), 1)), np.concatenate(there))
