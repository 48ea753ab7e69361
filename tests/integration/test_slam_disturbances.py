"""What must neither crash nor mislead camera tracking: wrong calibration, noise, black frames, a reset."""

import json
import threading
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest

from morph_dslam.cli.app import main
from morph_dslam.errors import CameraError
from morph_dslam.io.trajectory import load_trajectory
from morph_dslam.slam.map_files import load_map
from morph_dslam.slam.mapping import Mapper
from morph_dslam.slam.output import suspected_focal_factor
from morph_dslam.slam.rigid_map import RigidMap
from morph_dslam.slam.slam import Slam
from tests.support.rendered_room import CAMERA, RoomFilm, hand_held, wall


@pytest.fixture(scope="module")
def images(room_film):
    return room_film[0]


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
    assert factor_with([film.frame(place) for place in hand_held(80, seed=2)], 1.2) == pytest.approx(1 / 1.2, rel=0.02)


def command_on_film(folder, images, focal_length):
    """`morph slam` on a film of the images, with a camera file that gives this focal length, pixels."""
    (folder / "film").mkdir()
    for index, image in enumerate(images):
        cv2.imwrite(str(folder / "film" / f"{index:04d}.png"), image)
    (folder / "camera.yaml").write_text(
        f"width: 640\nheight: 480\nfx: {focal_length}\nfy: {focal_length}\ncx: 319.5\ncy: 239.5\n"
    )
    camera, run = str(folder / "camera.yaml"), str(folder / "run")
    return ["slam", str(folder / "film"), "--camera", camera, "--no-video", "-o", run]


def test_the_run_says_that_the_calibration_is_suspect(tmp_path, images, capsys):
    assert main(command_on_film(tmp_path, images, 446)) == 0
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


def all_frames(slam, images, first=0):
    """Frames at a pace that leaves the mapper's thread the time it needs."""
    for index, image in enumerate(images, start=first):
        yield slam.process_frame(image, index, index / 30.0)
        while slam._making.is_running:
            time.sleep(0.001)


def under_way(slam, images):
    """Go on until the mapper has begun work that is not done; returns the next frame's number."""
    for index, image in enumerate(images):
        slam.process_frame(image, index, index / 30.0)
        if slam.map.keyframes and slam._making.is_running:
            return index + 1
        while slam._making.is_running:
            time.sleep(0.001)
    raise AssertionError("the mapper was never at work")


@pytest.fixture
def may_go_on(monkeypatch):
    """An event that the mapper waits for before it inserts a keyframe."""
    event, insert = threading.Event(), Mapper.insert

    def held_up(mapper, tracked, view):
        assert event.wait(timeout=60.0)
        yield from insert(mapper, tracked, view)

    monkeypatch.setattr(Mapper, "insert", held_up)
    return event


def test_a_reset_while_the_mapper_is_at_work_forgets_what_it_does(images, may_go_on):
    slam = Slam(CAMERA, threaded=True)
    under_way(slam, images)
    slam.reset()
    may_go_on.set()
    assert not slam.map.keyframes
    status = [frame.status for frame in all_frames(slam, images[30:60])]
    assert status[0] == "waiting"
    assert status[-1] == "tracked"
    # The new map's points have nothing of the old one.
    assert {keyframe.index for keyframe in slam.map.keyframes} <= set(range(30))
    assert len(slam.map.keyframes) > 2


def test_freezing_waits_for_nobody_and_the_map_stays(images, may_go_on):
    """Freezing returns though the mapper's step cannot end before: with any waiting this would hang."""
    slam = Slam(CAMERA, threaded=True)
    after = under_way(slam, images)
    n_keyframes, positions = len(slam.map.keyframes), slam.map.positions.copy()
    slam.freeze()
    may_go_on.set()
    later = list(all_frames(slam, images[after : after + 10], after))
    slam.refine_map()
    assert {frame.status for frame in later} == {"tracked"}
    assert len(slam.map.keyframes) == n_keyframes
    assert np.array_equal(slam.map.positions, positions)
    slam.reset()
    assert not slam.is_frozen
    assert [frame.status for frame in all_frames(slam, images[30:60])][-1] == "tracked"


@pytest.mark.parametrize("at", [3, 12, 20, 33])
def test_an_interrupt_at_any_frame_keeps_what_was_mapped(tmp_path, images, monkeypatch, at):
    track = Slam.process_frame

    def interrupted(slam, image, index, *rest):
        if index == at:
            raise KeyboardInterrupt
        return track(slam, image, index, *rest)

    monkeypatch.setattr(Slam, "process_frame", interrupted)
    run = tmp_path / "run"
    assert main(command_on_film(tmp_path, images, 525)) == 130
    summary = json.loads((run / "summary.json").read_text())
    assert summary["n_frames"] == at
    assert (summary["n_tracked"] > 0) == (at > 10)
    if summary["n_tracked"]:
        assert len(load_trajectory(run / "trajectory.txt")) == summary["n_tracked"]
        assert len(load_map(run / "map.h5", CAMERA).good) == summary["n_map_points"] > 80
