"""Scenes of which a part moves while they are mapped; pixels are OpenCV's projections of an exact motion."""

import csv
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.slam.camera_notes import camera_notes
from morph_dslam.slam.camera_terms import CameraEstimate, TermEstimate
from morph_dslam.slam.pose import PoseEstimate
from morph_dslam.slam.result import STAGES, SlamFrame, SlamStatus
from morph_dslam.slam.rigid_map import GOOD, Keyframe, RigidMap
from morph_dslam.slam.run_files import write_run
from morph_dslam.slam.scene import Scene, load_scene
from morph_dslam.slam.scene_rigidity import SceneNotRigid, motion_in_scene, neighbours_share, without_smooth_field
from morph_dslam.slam.slam import Slam

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
NOISE_PX, N_KEYFRAMES = 0.04, 10


def mapped(speed, camera=CAMERA, n_keyframes=N_KEYFRAMES):
    """A map, its path and sightings, of a wall with a step, before which a board moves sideways.

    ``speed`` : of the board, metres a keyframe; ``camera`` : what the map was made with.
    """
    rng, rigid_map = np.random.default_rng(0), RigidMap()
    board = np.column_stack([rng.uniform(-0.45, 0.45, (100, 2)), np.full(100, 1.6)])
    room = rng.uniform([-1.8, -1.4, 3.0], [1.8, 1.4, 3.0], (250, 3))
    room[:, 2] += 0.4 * room[:, 0] + 0.5 * (room[:, 1] > 0.4)  # a wall at an angle, and a step
    room = room[(np.abs(room[:, :2]) > 0.3 * room[:, 2:]).any(axis=1)]  # the board hides what is behind it
    points = np.concatenate([room, board])
    rigid_map.add_points(points, np.zeros((len(points), 2)), 0, GOOD)
    times, places = np.arange(n_keyframes) / 3.0, []
    for k, time in enumerate(times):
        turn, shift = 0.15 * np.sin([1.3 * time, time + 1.0, 0.0]), 0.4 * np.sin([1.1 * time, 0.6 * time, 0.4 * time])
        moved = points + np.outer(np.arange(len(points)) >= len(room), [speed * k, 0.0, 0.0])
        pixels = cv2.projectPoints(moved, turn, shift, CAMERA.matrix, None)[0][:, 0]
        pixels = pixels + NOISE_PX * rng.standard_normal(pixels.shape)
        ids = np.flatnonzero((pixels > 5).all(axis=1) & (pixels < [635, 475]).all(axis=1))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
        rigid_map.add_keyframe(Keyframe(k, time, np.zeros((0, 0), np.uint8), pose, ids, pixels[ids]))
        places.append(np.linalg.inv(pose))
    seen = list(rigid_map.seen_in_keyframes().values())
    return rigid_map, camera, CAMERA, Trajectory(times, np.array(places), np.arange(n_keyframes)), seen


def test_a_part_that_moves_steadily_is_found():
    found = motion_in_scene(*mapped(speed=0.01))
    assert isinstance(found, SceneNotRigid)
    assert found.correlation > 0.25
    # Neighbours in one group miss by more than the noise of one coordinate has them miss.
    assert found.shared_px > NOISE_PX
    assert found.n_keyframes == N_KEYFRAMES
    assert found.content()["kind"] == "scene_not_rigid"


def scene_of(speed):
    """What a run that made such a map gives."""
    rigid_map, camera, _, path, seen = mapped(speed)
    slam = Slam(camera)
    slam.map = rigid_map
    numbered = enumerate(zip(path.timestamps.tolist(), seen, strict=True))
    timings = dict.fromkeys(STAGES, 0.0)
    pose = PoseEstimate(np.eye(4), np.diag([1e-6] * 3 + [4e-4, 4e-4, 1e-4]), np.ones(0, dtype=bool), 0.1)
    frames = tuple(
        SlamFrame(k, time, SlamStatus.TRACKED, pose=pose, points=points, timings_ms=timings)
        for k, (time, points) in numbered
    )
    return Scene(camera, rigid_map, path, frames, slam)


@pytest.mark.parametrize("speed", [0.0, 0.01], ids=["rigid", "moves"])
def test_a_right_camera_is_not_accused_where_the_scene_moved(tmp_path, speed):
    scene = scene_of(speed)
    accused = {term for term, found in scene.camera_estimate().terms.items() if found.is_wrong}
    summary = scene.summary()
    assert bool(accused) == bool(speed)
    assert (summary["camera"] is None) == bool(speed)
    assert [notice["kind"] for notice in summary["notices"]] == ["scene_not_rigid"] * bool(speed)
    assert summary["flags"] == [notice["text"] for notice in summary["notices"]]
    scene.save(tmp_path / "map.h5")  # the other commands repeat it
    assert list(load_scene(tmp_path / "map.h5", CAMERA).camera_notes) == summary["flags"]


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "stated"), [(0.0, 0.03), (0.01, np.inf)], ids=["rigid", "moves"])
def test_deviations_of_poses_are_unknown_where_the_scene_moved(tmp_path, speed, stated):
    """Else the root of the variances' sum: 0.02, 0.02 and 0.01 map units along the axes."""
    write_run(tmp_path, scene_of(speed), {})
    with (tmp_path / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["position_std"]) for row in rows] == pytest.approx([stated] * N_KEYFRAMES)


@pytest.mark.parametrize(
    "camera", [CAMERA, replace(CAMERA, fx=577.5, fy=577.5), replace(CAMERA, cx=349.5)], ids=["right", "long", "centre"]
)
def test_a_rigid_scene_is_not_accused_whatever_its_camera(camera):
    assert motion_in_scene(*mapped(0.0, camera)) is None


def test_a_wrong_camera_to_begin_with_is_no_motion():
    rigid_map, camera, _, path, seen = mapped(0.0)
    assert motion_in_scene(rigid_map, camera, replace(CAMERA, fx=540.0, fy=540.0), path, seen) is None


def test_few_keyframes_say_nothing():
    assert motion_in_scene(*mapped(speed=0.01, n_keyframes=3)) is None


def test_what_neighbours_share_is_the_part_of_the_misses_that_is_no_noise():
    """A shift of a whole frame by (s, 0) beside noise of deviation n a coordinate: s^2 and s^2 + 2 n^2."""
    rng, shift, noise = np.random.default_rng(0), 0.2, 0.15
    pixels, frames = rng.uniform(0, 500, (8000, 2)), np.repeat(np.arange(4), 2000)
    misses = noise * rng.standard_normal((8000, 2))
    shared, total = neighbours_share(pixels, misses, frames)
    assert np.abs(shared / total).max() < 0.05
    assert total == pytest.approx(2.0 * noise**2, rel=0.06)
    shared, total = neighbours_share(pixels, misses + np.array([shift, 0.0]), frames)
    assert shared == pytest.approx(shift**2, rel=0.1)
    assert total == pytest.approx(shift**2 + 2.0 * noise**2, rel=0.06)


def test_a_smooth_field_is_taken_out_of_the_misses_and_a_board_s_part_is_not():
    """A bowl over the picture, as of a lens, and a square of which all points miss by a pixel."""
    rng, frames = np.random.default_rng(0), np.repeat([0, 1], 1500)
    pixels = rng.uniform(0, 500, (3000, 2))
    x, y = (pixels / 500.0).T
    bowl = np.column_stack([0.4 + 0.3 * x - 0.5 * x * y, 0.2 * y * y - 0.1 * x])
    assert without_smooth_field(pixels, bowl, frames) == pytest.approx(np.zeros((3000, 2)), abs=0.02)
    board = ((np.abs(x - 0.5) < 0.2) & (np.abs(y - 0.5) < 0.2))[:, None] * [1.0, 0.0]
    rest = without_smooth_field(pixels, board + 0.5 * rng.standard_normal((3000, 2)), frames)
    assert rest[board[:, 0] > 0, 0].mean() - rest[board[:, 0] == 0, 0].mean() > 0.3


def test_a_term_that_was_refined_is_not_to_be_refined_again():
    focal = TermEstimate((520.8,), (599.3,), (5.0,), abs(599.3 / 520.8 - 1.0), 5.0 / 520.8, 0.03)
    centre = TermEstimate((319.5, 239.5), (319.5, 279.5), (2.0, 2.0), 40.0, 2.0, 12.0)
    estimate = CameraEstimate(CAMERA, {"focal": focal, "centre": centre})
    (alone,) = camera_notes(CameraEstimate(CAMERA, {"focal": focal}), refined=("focal",))
    assert "contradicts itself" in alone
    assert "morph slam --refine-camera" not in alone
    contradiction, advice = camera_notes(estimate, refined=("focal",))
    assert contradiction == alone
    assert "principal point" in advice
    assert "focal length" not in advice
