"""Cameras estimated from points that a moving camera saw; pixels are OpenCV's projections of an exact motion."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.errors import MapError
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.slam.camera_notes import camera_notes
from morph_dslam.slam.camera_terms import TERMS, CameraEstimate, TermEstimate, with_terms_of
from morph_dslam.slam.rigid_map import GOOD, Followed, RigidMap
from morph_dslam.slam.rolling_shutter import MiddleRowPoses, correct_path
from morph_dslam.slam.scene import refine_camera
from morph_dslam.slam.self_calibration import estimate_camera

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
LENS = (-0.28, 0.07, 0.0, 0.0)
FPS, N_FRAMES = 30.0, 60


def pose_at(time, reach):
    """camera_from_world (4, 4) of a camera that sways before points 2 to 4 m away."""
    result = np.eye(4)
    result[:3, :3] = Rotation.from_rotvec(0.5 * reach * np.sin([1.3 * time, 2.0 * time + 1.0, 1.1 * time])).as_matrix()
    result[:3, 3] = reach * np.array([np.sin(2.2 * time), 0.5 * np.sin(1.7 * time + 0.5), 0.4 * np.sin(1.4 * time)])
    return result


def project(camera, points, pose):
    """OpenCV's pixels (n, 2) of points (n, 3)."""
    turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
    return cv2.projectPoints(points, turn, pose[:3, 3], camera.matrix, np.array(camera.distortion or (0.0,) * 4))[0][
        :, 0
    ]


def recorded_pixels(camera, points, time, reach):
    """Where the shutter records points (n, 3): the row decides when a rolling one does, which decides the row."""
    pixels = project(camera, points, pose_at(time, reach))
    for _ in range(3 if camera.readout_s else 0):
        times = time + camera.readout_s * (pixels[:, 1] - 239.5) / 480.0
        pixels = np.concatenate(
            [project(camera, point[None], pose_at(t, reach)) for point, t in zip(points, times, strict=True)]
        )
    return pixels


def recording(true, given, seed=0, reach=0.4, n_points=150, n_frames=N_FRAMES):
    """Map, path and sightings as a map of the ``given`` camera has them: rough points and poses, undistorted pixels."""
    rng, rigid_map = np.random.default_rng(seed), RigidMap()
    points = rng.uniform([-1.6, -1.2, 2.0], [1.6, 1.2, 4.0], (n_points, 3))
    rigid_map.add_points(points + 0.02 * rng.standard_normal(points.shape), np.zeros((n_points, 2)), 0, GOOD)
    times, poses, seen = np.arange(n_frames) / FPS, [], []
    for time in times:
        pixels = recorded_pixels(true, points, time, reach)
        local = points @ pose_at(time, reach)[:3, :3].T + pose_at(time, reach)[:3, 3]
        inside = (local[:, 2] > 0.5) & (pixels > 5).all(axis=1) & (pixels < [635, 475]).all(axis=1)
        ids = np.flatnonzero(inside)
        noisy = pixels[ids] + 0.2 * rng.standard_normal((len(ids), 2))
        undistorted = given.undistort_pixels(noisy)
        good = np.isfinite(undistorted).all(axis=1)
        seen.append(Followed(ids[good], undistorted[good]))
        pose = pose_at(time, reach)
        pose[:3, 3] += 0.003 * rng.standard_normal(3)
        poses.append(np.linalg.inv(pose))
    return rigid_map, given, Trajectory(times, np.array(poses), np.arange(n_frames)), seen


@pytest.mark.slow
@pytest.mark.parametrize(
    ("true", "given", "wrong"),
    [
        (CAMERA, CAMERA, set()),
        (replace(CAMERA, distortion=LENS), replace(CAMERA, distortion=LENS), set()),
        (CAMERA, replace(CAMERA, fx=577.5, fy=577.5), {"focal"}),
        (CAMERA, replace(CAMERA, fx=472.5, fy=472.5), {"focal"}),
        (CAMERA, replace(CAMERA, cx=349.5), {"centre"}),
        (CAMERA, replace(CAMERA, cy=209.5), {"centre"}),
        (replace(CAMERA, distortion=LENS), CAMERA, {"radial"}),
        (replace(CAMERA, distortion=LENS), replace(CAMERA, distortion=(0.28, -0.07, 0.0, 0.0)), {"radial"}),
    ],
    ids=["right", "right lens", "long", "short", "centre x", "centre y", "no lens", "wrong sign"],
)
def test_a_wrong_camera_is_named_and_a_right_one_is_not(true, given, wrong):
    estimate = estimate_camera(*recording(true, given))
    assert {term for term, found in estimate.terms.items() if found.is_wrong} == wrong
    assert all(found.is_observable for found in estimate.terms.values())
    assert estimate.camera.fx == pytest.approx(525.0, rel=0.01)
    assert [estimate.camera.cx, estimate.camera.cy] == pytest.approx([319.5, 239.5], abs=6.0)
    assert (estimate.camera.distortion or (0.0, 0.0))[:2] == pytest.approx((true.distortion or LENS[2:])[:2], abs=0.02)
    assert bool(list(camera_notes(estimate))) == bool(wrong)


@pytest.mark.parametrize(("estimated", "is_unlikely"), [(678.7, True), (740.0, False)])
def test_a_given_value_outside_of_a_wide_interval_is_unlikely(estimated, is_unlikely):
    std, given = 51.85, 840.0
    focal = TermEstimate((given,), (estimated,), (std,), abs(estimated / given - 1.0), std / given, 0.03)
    assert not focal.is_observable
    (note,) = camera_notes(CameraEstimate(CAMERA, {"focal": focal}))
    assert ("the given focal length is unlikely" in note) == is_unlikely


def test_a_lens_whose_elements_are_not_centred_spoils_no_focal_length():
    true = replace(CAMERA, distortion=(-0.12, 0.04, 0.002, -0.002))
    given = replace(CAMERA, fx=530.0, fy=530.0, distortion=(-0.1, 0.04, 0.0, 0.0))
    data = recording(true, given)
    found, without = (estimate_camera(*data, terms) for terms in (TERMS, ("focal", "centre", "radial")))
    assert found.terms["tangential"].is_refuted
    assert found.camera.distortion[2:4] == pytest.approx((0.002, -0.002), abs=0.001)
    assert found.camera.fx == pytest.approx(525.0, rel=0.004)
    assert without.camera.fx != pytest.approx(525.0, rel=0.004)


def test_one_term_of_another_camera():
    lens = (-0.12, 0.04, 0.002, -0.001, 0.01)
    other = replace(CAMERA, fx=530.0, fy=530.0, distortion=lens, readout_s=0.01)
    assert with_terms_of(CAMERA, other, ("tangential",)).distortion == (0.0, 0.0, 0.002, -0.001, 0.0)
    assert with_terms_of(CAMERA, other, ("radial",)).distortion == (-0.12, 0.04, 0.0, 0.0, 0.01)
    assert with_terms_of(other, CAMERA, ("radial", "tangential")).distortion == ()
    assert with_terms_of(other, CAMERA, ("focal", "readout")) == replace(CAMERA, distortion=lens)


def test_a_fisheye_has_no_tangential_terms(tmp_path):
    fisheye = replace(CAMERA, distortion=(0.0, 0.0, 0.0, 0.0), lens_model="fisheye")
    assert set(estimate_camera(*recording(CAMERA, fisheye), TERMS).terms) == {"focal", "centre", "radial", "readout"}
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((480, 640, 3), np.uint8))
    with pytest.raises(MapError, match="fisheye lens has no tangential terms"):
        refine_camera(tmp_path, fisheye, ("tangential",))


@pytest.mark.slow
def test_deviations_are_those_of_repeated_recordings():
    errors = []
    for seed in range(12):
        terms = estimate_camera(*recording(CAMERA, CAMERA, seed, n_points=100, n_frames=30)).terms
        errors.append([(terms[t].estimated[0] - terms[t].given[0]) / terms[t].std[0] for t in ("focal", "radial")])
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.5


def test_errors_that_are_alike_in_many_images_of_a_point_count_once():
    """An error of each point that swings slowly over the frames is no noise that many frames average out."""
    errors = []
    for seed in range(8):
        rigid_map, given, path, seen = recording(CAMERA, CAMERA, seed, n_points=100, n_frames=30)
        bias = 0.5 * np.random.default_rng(100 + seed).standard_normal((100, 2))
        swinging = [np.sin(k / 5.0 + np.arange(100))[:, None] * bias for k in range(30)]
        seen = [Followed(f.ids, f.pixels + shift[f.ids]) for f, shift in zip(seen, swinging, strict=True)]
        found = estimate_camera(rigid_map, given, path, seen).terms["focal"]
        errors.append((found.estimated[0] - 525.0) / found.std[0])
    assert np.sqrt(np.mean(np.square(errors))) < 1.6


def test_a_small_motion_shows_no_focal_length():
    found = estimate_camera(*recording(CAMERA, replace(CAMERA, fx=577.5, fy=577.5), reach=0.012)).terms["focal"]
    assert not found.is_observable
    assert not found.is_wrong
    assert found.estimated[0] - 3.0 * found.std[0] < 525.0 < found.estimated[0] + 3.0 * found.std[0]


@pytest.mark.parametrize("few", [{"n_points": 30}, {"n_frames": 5}])
def test_too_little_leaves_the_camera_as_known_before(few):
    estimate = estimate_camera(*recording(CAMERA, CAMERA, **few))
    assert estimate.camera == CAMERA
    assert not any(found.is_observable or found.is_wrong for found in estimate.terms.values())
    assert estimate.terms["focal"].std == pytest.approx((0.3 * 525.0,))
    assert len(list(camera_notes(estimate))) == 1


def test_a_plane_filmed_without_turning_shows_no_focal_length():
    """Depths and focal length may grow together: a given one 10 % off is neither confirmed nor refuted."""
    given, rng, rigid_map = replace(CAMERA, fx=577.5, fy=577.5), np.random.default_rng(0), RigidMap()
    points = rng.uniform([-1.6, -1.2, 3.0], [1.6, 1.2, 3.0], (150, 3))
    rigid_map.add_points(
        points * [1.0, 1.0, 1.1] + 0.02 * rng.standard_normal(points.shape), np.zeros((150, 2)), 0, GOOD
    )
    times, poses, seen = np.arange(N_FRAMES) / FPS, [], []
    for time in times:
        pose = np.eye(4)
        pose[:3, 3] = 0.4 * np.array([np.sin(2.2 * time), 0.5 * np.sin(1.7 * time), 0.4 * np.sin(1.4 * time)])
        pixels = project(CAMERA, points, pose) + 0.2 * rng.standard_normal((150, 2))
        ids = np.flatnonzero((pixels > 5).all(axis=1) & (pixels < [635, 475]).all(axis=1))
        seen.append(Followed(ids, pixels[ids]))
        pose[2, 3] *= 1.1
        poses.append(np.linalg.inv(pose))
    estimate = estimate_camera(rigid_map, given, Trajectory(times, np.array(poses)), seen)
    focal = estimate.terms["focal"]
    assert not focal.is_observable
    assert not focal.is_wrong
    assert abs(focal.estimated[0] - 525.0) < 2.0 * focal.std[0]


def test_frames_that_share_few_points_with_the_others_take_no_part():
    rigid_map, given, path, seen = recording(CAMERA, CAMERA)
    few = [frame[frame.ids < 3] if k % 3 == 0 else frame for k, frame in enumerate(seen)]
    estimate = estimate_camera(rigid_map, given, path, few)
    assert estimate.terms["focal"].is_observable
    assert estimate.camera.fx == pytest.approx(525.0, rel=0.01)


def test_of_a_long_recording_a_part_whose_frames_share_points_counts():
    """No frame shares a point with one that is 60 frames away."""
    rigid_map, given, path, seen = recording(CAMERA, CAMERA, n_frames=300, n_points=600)
    passing = [frame[np.abs(frame.ids - 2 * k) < 60] for k, frame in enumerate(seen)]
    estimate = estimate_camera(rigid_map, given, path, passing)
    assert not any(found.is_wrong for found in estimate.terms.values())
    assert estimate.camera.fx == pytest.approx(525.0, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("readout_s", [0.03, -0.02])
def test_the_readout_time_of_a_rolling_shutter(readout_s):
    true = replace(CAMERA, readout_s=readout_s)
    rigid_map, given, path, seen = recording(true, CAMERA, n_points=80, n_frames=30)
    estimate = estimate_camera(rigid_map, given, path, seen)
    assert estimate.terms["readout"].is_wrong
    assert estimate.camera.readout_s == pytest.approx(readout_s, rel=0.06)
    assert not any(estimate.terms[term].is_wrong for term in ("focal", "centre", "radial"))
    only = estimate_camera(rigid_map, given, path, seen, ["readout"])
    assert only.camera == replace(CAMERA, readout_s=only.camera.readout_s)
    assert only.camera.readout_s == pytest.approx(readout_s, rel=0.06)


def test_timestamps_that_are_rounded_tell_no_velocity_and_leave_the_rest_as_it_is():
    rigid_map, given, path, seen = recording(CAMERA, CAMERA, n_points=80, n_frames=30)
    rounded = Trajectory(np.round(path.timestamps), path.world_from_camera)
    estimate = estimate_camera(rigid_map, given, rounded, seen)
    assert estimate.terms["readout"].std == pytest.approx((0.03,), rel=1e-3)  # as before anything was measured
    assert estimate.camera.fx == pytest.approx(525.0, rel=0.01)
    assert not list(camera_notes(estimate))


def test_poses_are_of_the_middle_rows():
    true = replace(CAMERA, readout_s=0.03)
    rigid_map, _, path, seen = recording(true, CAMERA, n_points=80, n_frames=30)
    rigid_map.positions = np.random.default_rng(0).uniform([-1.6, -1.2, 2.0], [1.6, 1.2, 4.0], (80, 3))
    truth = np.array([np.linalg.inv(pose_at(time, 0.4))[:3, 3] for time in path.timestamps])
    errors = [
        np.linalg.norm(correct_path(rigid_map, camera, path, seen).positions - truth, axis=1)[1:-1]
        for camera in (true, replace(true, readout_s=1e-9))
    ]
    assert np.median(errors[0]) < 0.0015
    assert np.median(errors[1]) > 0.004


def test_the_poses_of_a_path_are_those_of_the_middle_rows_frame_by_frame():
    true = replace(CAMERA, readout_s=0.03)
    rigid_map, _, path, seen = recording(true, CAMERA, n_points=80, n_frames=30)
    rigid_map.positions = np.random.default_rng(0).uniform([-1.6, -1.2, 2.0], [1.6, 1.2, 4.0], (80, 3))
    rows, misses = MiddleRowPoses(rigid_map, true), []
    for time, pose, followed in zip(path.timestamps, path.camera_from_world, seen, strict=True):
        found, truth = rows.add(time, pose, followed), np.linalg.inv(pose_at(time, 0.4))[:3, 3]
        misses.append([np.linalg.norm(np.linalg.inv(one)[:3, 3] - truth) for one in (found, pose)])
    by_row, by_frame = np.median(misses[1:], axis=0)
    assert by_row < 0.0025
    assert by_frame > 2.0 * by_row
