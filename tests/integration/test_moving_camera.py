"""Scenes with a world: a moving camera, static surroundings and a depth sensor, against closed forms."""

import cv2
import h5py
import numpy as np
import pytest

from morph_dslam.cli.app import main
from morph_dslam.io.camera_files import load_camera
from morph_dslam.io.trajectory import load_trajectory
from morph_dslam.render.simulation import simulate
from morph_dslam.sources import open_source
from tests.support.scenes import write_scene

WALL = 0.9  # how far ahead of the camera the wall is, metres
#: A sheet that lies flat at z = 0, seen obliquely, and a camera that goes round it.
ROUND = """
[[camera_path]]
frame = 0
position_mm = [0, -500, 400]
target_mm = [0, 0, 0]
[[camera_path]]
frame = 4
position_mm = [300, -450, 350]
target_mm = [20, 10, 0]
"""


def wall_value(x, y):
    """Grey level at fractions x, y in [0, 1] of the wall, x to the right and y down."""
    return 120.0 + 60.0 * np.sin(9.0 * x) + 50.0 * np.cos(7.0 * y + 0.7)


def write_wall_scene(folder, extra=""):
    """A wall 1.2 m x 0.8 m square across the view, 0.9 m ahead; the sheet is behind the camera's wall."""
    x, y = np.meshgrid((np.arange(1200) + 0.5) / 1200, (np.arange(800) + 0.5) / 800)
    cv2.imwrite(str(folder / "wall.png"), np.rint(wall_value(x, y)).astype(np.uint8))
    tail = """
[light]
ambient = 1.0
[[camera_path]]
frame = 0
position_mm = [0, -900, 100]
target_mm = [0, 0, 100]
[[pose]]
frame = 0
position_mm = [0, 500, 100]
[[environment.rectangles]]
texture = "wall.png"
centre_mm = [0, 0, 100]
right_mm = [1200, 0, 0]
down_mm = [0, 0, -800]
"""
    return write_scene(folder, top="frames = 1\n", tail=tail + extra)


def test_a_wall_face_on_shows_its_texture_and_hides_what_is_behind(tmp_path):
    # The sheet would be in view, but all of it is behind the wall: no landmark can be seen.
    scene = write_wall_scene(tmp_path)
    assert main(["simulate", str(scene), "-o", str(tmp_path / "hidden")]) == 2
    # In front of the wall, below the picture's middle, it leaves the upper half to the wall.
    scene.write_text(scene.read_text().replace("[0, 500, 100]", "[0, -250, 0]"))
    simulate(scene, tmp_path / "sequence", progress=False)
    camera = load_camera(tmp_path / "sequence" / "camera.yaml")
    rows, columns = np.indices((240, 320))
    x = (columns - camera.cx) / camera.fx * WALL / 1.2 + 0.5
    y = (rows - camera.cy) / camera.fy * WALL / 0.8 + 0.5
    (frame,) = open_source(tmp_path / "sequence" / "frames")
    upper = (rows < 110) & (np.abs(x - 0.5) < 0.49) & (np.abs(y - 0.5) < 0.49)
    difference = frame.image.astype(float) - wall_value(x, y)[:, :, None]
    assert np.abs(difference[upper]).max() < 2.5
    assert abs(difference[upper].mean()) < 0.4


def test_the_camera_goes_where_its_path_says(tmp_path):
    simulate(write_scene(tmp_path, tail=ROUND), tmp_path / "sequence", progress=False)
    truth = np.load(tmp_path / "sequence" / "truth.npz")
    path = load_trajectory(tmp_path / "sequence" / "groundtruth.txt").world_from_camera
    np.testing.assert_allclose(path[0, :3, 3], [0.0, -0.5, 0.4], atol=1e-8)
    np.testing.assert_allclose(path[4, :3, 3], [0.3, -0.45, 0.35], atol=1e-8)
    # It looks at its target, upright: the target is on the optical axis, and its right side is level.
    to_target = np.array([0.02, 0.01, 0.0]) - path[4, :3, 3]
    np.testing.assert_allclose(path[4, :3, 2], to_target / np.linalg.norm(to_target), atol=1e-8)
    np.testing.assert_allclose(path[:, 2, 0], 0.0, atol=1e-8)
    # The object stays at the world's origin, so its pose in the camera is that of the world.
    np.testing.assert_allclose(truth["camera_from_object"], np.linalg.inv(path), atol=1e-7)


def test_the_depth_sensor_is_as_noisy_as_asked_and_makes_a_recording(tmp_path):
    extra = "[depth_sensor]\nnoise_mm_at_1m = 4.0\nrim_px = 0\n"
    scene = write_wall_scene(tmp_path, extra)
    scene.write_text(scene.read_text().replace("[0, 500, 100]", "[0, -250, 0]"))
    simulate(scene, tmp_path / "sequence", progress=False)
    (frame,) = open_source(tmp_path / "sequence")  # TUM's layout
    assert frame.image.shape == (240, 320, 3)
    assert frame.depth is not None
    wall = frame.depth[20:100, 20:300]
    assert np.mean(wall) == pytest.approx(WALL, abs=1e-4)
    assert np.std(wall) == pytest.approx(4.0e-3 * WALL**2, rel=0.03)
    with h5py.File(tmp_path / "sequence" / "depth.h5") as file:
        assert (file["depth_m"][0, 20:100] == 0.0).all()  # the object's alone


@pytest.mark.parametrize(
    ("tail", "message"),
    [
        ("", "'pose' is missing, or 'camera_path'"),
        ("[[pose]]\nframe = 0\nposition_mm = [0, 0, 600]\n[[environment.boxes]]\ntexture = 'print.png'\n"
         "centre_mm = [0, 0, 0]\nsize_mm = [1, 1, 1]\n", "say with camera_path where the camera is"),
        (ROUND + "[environment]\n", "give it rectangles or boxes"),
        (ROUND + "[[environment.rectangles]]\ntexture = 'print.png'\ncentre_mm = [0, 0, 0]\n"
         "right_mm = [100, 0, 0]\ndown_mm = [50, 50, 0]\n", "perpendicular"),
        (ROUND.replace("[0, -500, 400]", "[0, 0, 400]"), "straight up or down"),
        (ROUND + "[[environment.boxes]]\ntexture = 'none.png'\ncentre_mm = [0, 0, 0]\n"
         "size_mm = [1, 1, 1]\n", "there is no image"),
    ],
)  # fmt: skip
def test_scenes_that_cannot_be_are_one_message(tmp_path, capsys, tail, message):
    assert main(["simulate", str(write_scene(tmp_path, tail=tail)), "-o", str(tmp_path / "out")]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
