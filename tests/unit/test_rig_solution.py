"""Where cameras of a rig are to each other, by corners with known errors."""

from types import SimpleNamespace

import numpy as np
import pytest

from morph_dslam.calibration.board import Board
from morph_dslam.calibration.rig import solve_rig
from morph_dslam.calibration.views import View
from morph_dslam.camera import Camera
from morph_dslam.errors import CameraError
from morph_dslam.geometry import RigidTransform, rotation_exp

POINTS = Board(9, 6, 0.025).points - Board(9, 6, 0.025).points.mean(axis=0)
POSES = (
    RigidTransform.identity(),
    RigidTransform(rotation_exp(np.array([0.0, 0.2, 0.0])), np.array([-0.15, 0.0, 0.02])),
    RigidTransform(rotation_exp(np.array([0.0, -0.2, 0.0])), np.array([0.15, 0.0, 0.02])),
)
#: r - 0.35 r^3 is largest at r = 0.976, with 0.651: pixels farther than 416 px from the middle show nothing.
LENS = Camera(1280, 960, 640.0, 640.0, 639.5, 479.5, (-0.35, 0.0, 0.0, 0.0))
PLAIN = Camera(1280, 960, 1000.0, 1000.0, 639.5, 479.5)


def calibrated(camera):
    solution = SimpleNamespace(camera=camera, focal_deviation=(0.5, 0.5), centre_deviation=(0.5, 0.5))
    return SimpleNamespace(solution=solution, found=SimpleNamespace(size=(1280, 960)))


def filmed(camera, frames, rng, shift=0.0, points=POINTS):
    """Views of each camera by their frames, {frame: numbers of cameras}; the last one's board is where it was later."""
    seen = tuple({} for _ in POSES)
    for frame, numbers in frames.items():
        turn = rotation_exp(0.35 * rng.standard_normal(3))
        board = RigidTransform(turn, np.array([*0.05 * rng.standard_normal(2), 0.7]))
        late = RigidTransform(rotation_exp(shift * rng.standard_normal(3)) @ turn, board.translation)
        for number in numbers:
            pose = POSES[number] @ (late if number == 2 else board)
            corners = camera.project_recorded(pose.apply(points)) + 0.05 * rng.standard_normal((len(points), 2))
            seen[number][frame] = View(f"{frame}.png", points, corners)
    return seen


def test_a_camera_whose_frames_are_all_left_out_is_refused():
    frames = {**dict.fromkeys(range(12), (0, 1)), **dict.fromkeys(range(100, 103), (0, 2))}
    placed = solve_rig([calibrated(PLAIN)] * 3, filmed(PLAIN, frames, np.random.default_rng(0)))
    for found, true in zip(placed.camera_from_first, POSES, strict=True):
        np.testing.assert_allclose(found.translation, true.translation, atol=2e-3)
    late = filmed(PLAIN, frames, np.random.default_rng(0), shift=0.1)
    with pytest.raises(CameraError, match="camera 2 saw the board in 0 frames"):
        solve_rig([calibrated(PLAIN)] * 3, late)


def test_views_with_corners_that_no_ray_has_are_left_out():
    seen = filmed(LENS, dict.fromkeys(range(8), (0, 1)), np.random.default_rng(0))[:2]
    beyond = seen[1][3].corners.copy()
    beyond[:3] = [[1200.0, 479.5], [1210.0, 500.0], [1190.0, 520.0]]
    seen[1][3] = View("3.png", POINTS, beyond)
    placed = solve_rig([calibrated(LENS)] * 2, seen)
    assert placed.left_out == (3,)
    assert placed.rms_px < 0.1
    np.testing.assert_allclose(placed.camera_from_first[1].translation, POSES[1].translation, atol=2e-3)


@pytest.mark.parametrize("bend", [0.0, 0.002, 0.005])
def test_cameras_are_placed_by_a_board_that_is_bent(bend):
    """Its shape is known from the cameras' own calibrations; OpenCV's start for flat boards takes none beyond 1 mm."""
    bent = POINTS + bend * np.column_stack([np.zeros((len(POINTS), 2)), 1.0 - (POINTS[:, 0] / 0.1) ** 2])
    seen = filmed(PLAIN, dict.fromkeys(range(12), (0, 1)), np.random.default_rng(1), points=bent)[:2]
    placed = solve_rig([calibrated(PLAIN)] * 2, seen)
    assert placed.rms_px == pytest.approx(0.05 * np.sqrt(2.0), rel=0.15)
    np.testing.assert_allclose(placed.camera_from_first[1].translation, POSES[1].translation, atol=2e-3)
