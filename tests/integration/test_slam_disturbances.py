"""What must neither crash nor mislead camera tracking: wrong calibration, noise, black frames, a reset."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from morph_dslam.cli import main
from morph_dslam.errors import CameraError
from morph_dslam.online.slam.calibration_check import suspected_focal_factor
from morph_dslam.online.slam.rigid_map import RigidMap
from morph_dslam.online.slam.slam import Slam
from tests.support.rendered_room import CAMERA, RoomFilm, hand_held, wall


@pytest.fixture(scope="module")
def images():
    film = RoomFilm(seed=1)
    return [film.frame(place) for place in hand_held(80, seed=1)]


def follow(slam, images):
    return [slam.process_frame(image, index, index / 30.0) for index, image in enumerate(images)]


def factor_with(images, scale):
    slam = Slam(replace(CAMERA, fx=scale * CAMERA.fx, fy=scale * CAMERA.fy))
    follow(slam, images)
    slam.refine_map()
    return suspected_focal_factor(slam.map, slam.camera.intrinsics)


def test_a_right_focal_length_is_not_suspected(images):
    assert factor_with(images, 1.0) is None
    assert suspected_focal_factor(RigidMap(), CAMERA.intrinsics) is None


@pytest.mark.parametrize("scale", [0.85, 1.2])
def test_a_wrong_focal_length_is_found_out(images, scale):
    assert factor_with(images, scale) == pytest.approx(1.0 / scale, rel=0.02)


def test_a_wrong_focal_length_is_found_out_on_a_plane():
    film = RoomFilm(seed=2, scene=wall)
    assert factor_with([film.frame(place) for place in hand_held(80, seed=2)], 1.2) == pytest.approx(
        1 / 1.2, rel=0.02
    )


def write_film(folder, images):
    folder.mkdir()
    for index, image in enumerate(images):
        cv2.imwrite(str(folder / f"{index:04d}.png"), image)


def test_the_run_says_that_the_calibration_is_suspect(tmp_path, images, capsys):
    write_film(tmp_path / "film", images)
    (tmp_path / "camera.yaml").write_text("width: 640\nheight: 480\nfx: 446\nfy: 446\ncx: 319.5\ncy: 239.5\n")
    command = ["slam", str(tmp_path / "film"), "--camera", str(tmp_path / "camera.yaml"), "--no-video"]
    assert main([*command, "-o", str(tmp_path / "run")]) == 0
    assert "check the calibration" in capsys.readouterr().out
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["suspected_focal_factor"] == pytest.approx(525.0 / 446.0, rel=0.02)


def noise(rng):
    return rng.integers(0, 256, (480, 640)).astype(np.uint8)


def test_the_camera_is_found_again_after_noise_darkness_and_a_standstill(images):
    rng, slam = np.random.default_rng(1), Slam(CAMERA)
    frames = follow(slam, images[:40])
    disturbed = [*(noise(rng) for _ in range(5)), *[np.zeros((480, 640), np.uint8)] * 5]
    assert {frame.status for frame in follow(slam, disturbed)} == {"lost"}
    again = follow(slam, [images[39]] * 8)
    assert [frame.status for frame in again] == ["relocalised", *["tracked"] * 7]
    first, last = frames[-1].pose.camera_from_world, again[-1].pose.camera_from_world
    assert last == pytest.approx(first, abs=2e-3)


def test_an_image_of_another_size_is_refused_and_leaves_the_rest_as_it_was(images):
    slam = Slam(CAMERA)
    follow(slam, images[:25])
    with pytest.raises(CameraError, match="frame 25 is 320x240"):
        slam.process_frame(images[25][::2, ::2], 25, 25 / 30.0)
    assert slam.process_frame(images[25], 25, 25 / 30.0).status == "tracked"


@pytest.mark.parametrize("mode", ["waiting", "mapping", "frozen", "lost"])
def test_a_reset_begins_anew_in_any_mode(images, mode):
    slam = Slam(CAMERA)
    follow(slam, images[: 2 if mode == "waiting" else 25])
    if mode == "frozen":
        slam.freeze()
    if mode == "lost":
        follow(slam, [np.zeros((480, 640), np.uint8)] * 3)
    slam.reset()
    assert not slam.map.keyframes
    assert not slam.is_frozen
    status = [frame.status for frame in follow(slam, images[30:55])]
    assert status[0] == "waiting"
    assert status[-1] == "tracked"
    assert len(slam.map.keyframes) > 2
