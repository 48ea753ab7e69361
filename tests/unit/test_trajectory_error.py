"""Trajectory errors: closed forms, and the published figures of a TUM recording."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.cli import app as cli
from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.clock_offset import clock_offset
from morph_dslam.evaluation.trajectory import (
    absolute_error,
    associate,
    evaluate_trajectory,
    match,
    relative_error,
    statistics,
    trajectory_line,
)
from morph_dslam.io.trajectory import Trajectory, load_trajectory, save_trajectory
from tests.support.real_data import real_data


def helix(n=61, start=100.0, step=0.1):
    """A camera that climbs round a circle of 1 m, looking along its way."""
    angle = np.linspace(0.0, 4.0, n)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", angle[:, None]).as_matrix()
    poses[:, :3, 3] = np.column_stack([np.cos(angle), np.sin(angle), 0.2 * angle])
    return Trajectory(start + step * np.arange(n), poses)


def moved(trajectory, scale=1.0):
    """The same path in another world, smaller by ``scale``."""
    change = np.eye(4)
    change[:3, :3] = Rotation.from_rotvec([0.3, 1.0, -2.0]).as_matrix()
    change[:3, 3] = [4.0, -1.0, 0.5]
    poses = change @ trajectory.world_from_camera
    poses[:, :3, 3] /= scale
    return Trajectory(trajectory.timestamps, poses)


def test_association_takes_the_closest_once():
    first, second = np.array([0.0, 0.10, 0.20, 5.0]), np.array([0.004, 0.093, 0.104, 0.196, 6.0])
    np.testing.assert_array_equal(associate(first, second, 0.01), [[0, 0], [1, 2], [2, 3]])
    # Two on one: the closer has it, the other goes without.
    np.testing.assert_array_equal(associate(np.array([0.0, 0.01]), np.array([0.009]), 0.02), [[1, 0]])
    assert associate(np.array([0.0]), np.zeros(0)).shape == (0, 2)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_a_moved_copy_has_no_error(scale):
    truth = helix()
    estimate = moved(truth, scale)
    error = absolute_error(estimate, truth, with_scale=True)
    assert error.truth_from_estimate.scale == pytest.approx(scale, rel=1e-12)
    np.testing.assert_allclose(error.distances, 0.0, atol=1e-12)
    drift = relative_error(estimate, truth, 1.0, scale)
    np.testing.assert_allclose(drift.translations, 0.0, atol=1e-12)
    np.testing.assert_allclose(drift.rotations, 0.0, atol=1e-12)
    assert len(drift.timestamps) == 51


def test_rigid_alignment_keeps_a_wrong_scale():
    # Points on a circle, estimated at half size: alignment makes the centres meet, so each is off by 1/2.
    angle = 2.0 * np.pi * np.arange(40) / 40
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :2, 3] = np.column_stack([np.cos(angle), np.sin(angle)])
    truth = Trajectory(np.arange(40.0), poses)
    error = absolute_error(moved(truth, 2.0), truth, with_scale=False)
    np.testing.assert_allclose(error.distances, 0.5, atol=1e-12)


def test_relative_error_of_a_known_drift():
    # The estimate turns 0.01 rad more about its own x axis and goes 3 mm more along it at every step.
    truth = helix()
    step = np.eye(4)
    step[:3, :3], step[0, 3] = Rotation.from_rotvec([0.01, 0.0, 0.0]).as_matrix(), 0.003
    poses = [np.eye(4)]
    for before, after in zip(truth.world_from_camera, truth.world_from_camera[1:], strict=False):
        poses.append(poses[-1] @ np.linalg.inv(before) @ after @ step)
    drift = relative_error(Trajectory(truth.timestamps, np.array(poses)), truth, 0.1)
    np.testing.assert_allclose(drift.rotations, 0.01, atol=1e-12)
    np.testing.assert_allclose(drift.translations, 0.003, atol=1e-12)


def test_motions_over_gaps_are_left_out():
    truth = helix()
    kept = np.r_[0:20, 40:61]
    broken = Trajectory(truth.timestamps[kept], truth.world_from_camera[kept])
    drift = relative_error(broken, broken, 0.5)
    assert len(drift.timestamps) == (20 - 5) + (21 - 5)
    with pytest.raises(EvaluationError, match="no two poses of the estimate are 50 s apart"):
        relative_error(broken, broken, 50.0)


def test_statistics():
    found = statistics(np.array([3.0, 4.0, 0.0, 5.0]))
    assert list(found.values()) == pytest.approx([np.sqrt(12.5), 3.0, 3.5, np.sqrt(3.5), 0.0, 5.0])


def test_clocks_that_do_not_meet():
    with pytest.raises(EvaluationError, match=r"only 0 poses .* spans 100\.000 to 106\.000 s, the truth 0\.000"):
        match(helix(), helix(start=0.0))


@pytest.mark.usefixtures("drawn_figures")
def test_the_command_writes_figures_and_a_picture(tmp_path, capsys):
    run = tmp_path / "run"
    run.mkdir()
    save_trajectory(run / "trajectory.txt", moved(helix(), 2.0))
    save_trajectory(tmp_path / "truth.txt", helix())
    command = ["evaluate", str(run), "--trajectory", str(tmp_path / "truth.txt")]
    assert cli.main(command) == 0
    wrote, note, line = capsys.readouterr().out.splitlines()
    assert wrote == f"wrote {run / 'trajectory_evaluation.json'} and trajectory_evaluation.png"
    assert "2 times as large as the estimated one" in note
    assert line.startswith("pairs=61/61 ate_se3_mm=")
    assert "ate_sim3_mm=0.00 scale=2.0000 rpe_mm=0.00 rpe_deg=0.000" in line
    figures = json.loads((run / "trajectory_evaluation.json").read_text())
    assert figures["truth_length_m"] == pytest.approx(4.0 * np.sqrt(1.04), rel=1e-3)
    assert figures["sim3"]["absolute_mm"]["max"] < 1e-3
    assert (run / "trajectory_evaluation.png").read_bytes().startswith(b"\x89PNG")


def at(positions, step=0.1):
    """Poses that do not turn, at given places (n, 3)."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    return Trajectory(step * np.arange(len(positions)), poses)


def test_a_still_camera_has_no_scale_and_its_error_is_the_scatter(tmp_path):
    rng = np.random.default_rng(0)
    scatter = 0.002 * rng.standard_normal((61, 3))
    place = [0.06, -0.29999999999999993, 0.049999999999999996]
    rms = 1e3 * np.sqrt(((scatter - scatter.mean(axis=0)) ** 2).sum(axis=1).mean())
    drift = 1e3 * np.sqrt(((scatter[10:] - scatter[:-10]) ** 2).sum(axis=1).mean())
    save_trajectory(tmp_path / "path.txt", at(place + scatter))
    jitter = 1e-4 * rng.standard_normal((61, 3))
    for truth, word in ((at(np.tile(place, (61, 1))), "stands still"), (at(place + jitter), "spreads by 0.1")):
        figures = evaluate_trajectory(tmp_path / "path.txt", truth)
        assert figures["sim3"] is None
        assert figures["se3"]["absolute_mm"]["rmse"] == pytest.approx(rms, rel=0.02)
        assert figures["se3"]["relative_mm"]["rmse"] == pytest.approx(drift, rel=0.02)
        (note,) = figures["notes"]
        assert word in note
        assert "no scale" in note
        line = trajectory_line(figures)
        assert f"ate_se3_mm={figures['se3']['absolute_mm']['rmse']:.2f} ate_sim3_mm=nan scale=nan" in line
        assert json.loads((tmp_path / "path_evaluation.json").read_text())["sim3"] is None


def test_an_estimate_that_stands_still_is_off_by_the_true_path():
    truth = helix()
    spread = 1e3 * np.sqrt(truth.positions.var(axis=0).sum())
    figures = evaluate_trajectory(at(np.tile([0.1, 0.7, -1.3], (61, 1))), at(truth.positions))
    assert figures["sim3"] is None
    assert figures["se3"]["absolute_mm"]["rmse"] == pytest.approx(spread, rel=1e-9)
    (note,) = figures["notes"]
    assert "the estimated path stands still" in note


def test_a_drift_beside_a_smaller_one_is_no_wrong_unit():
    way = np.linspace(0.0, 1.0, 61)[:, None] * [1.0, 0.5, 0.2]
    assert evaluate_trajectory(at(0.004 * way), at(0.0002 * way))["notes"] == []
    # A path in millimetres is one.
    (note,) = evaluate_trajectory(at(1000.0 * way), at(way))["notes"]
    assert "0.001 times as large" in note


def test_mistakes_in_paths_are_named(tmp_path):
    truth = helix(start=0.0, step=0.125)

    def notes(estimate, truth=truth):
        return evaluate_trajectory(moved(estimate), truth)["notes"]

    noise = Rotation.from_rotvec(0.003 * np.random.default_rng(0).standard_normal((61, 3))).as_matrix()
    good = Trajectory(truth.timestamps, truth.world_from_camera.copy())
    good.world_from_camera[:, :3, :3] = noise @ good.world_from_camera[:, :3, :3]
    assert notes(good) == []
    (note,) = notes(good, Trajectory(truth.timestamps, np.linalg.inv(truth.world_from_camera)))
    assert "inverted" in note
    quaternions = Rotation.from_matrix(truth.world_from_camera[:, :3, :3]).as_quat(scalar_first=True)
    rows = np.column_stack([truth.timestamps, truth.positions, quaternions])
    np.savetxt(tmp_path / "truth.txt", rows, fmt="%.6f")
    (note,) = notes(good, load_trajectory(tmp_path / "truth.txt"))
    assert "truth have quaternions that begin with qw" in note
    (note,) = notes(good, Trajectory(np.arange(61.0), truth.world_from_camera))
    assert "of 61 poses" in note
    assert "truth is stamped with whole numbers" in note
    (note,) = evaluate_trajectory(moved(good, 5.0), truth)["notes"]
    assert "5 times as large" in note
    assert "depth images" in note


def swaying(n=120):
    """A camera that sways and turns about all axes."""
    time, poses = np.linspace(0.0, 1.0, n), np.tile(np.eye(4), (n, 1, 1))
    waves = np.sin(2.0 * np.pi * np.outer(time, [0.9, 1.3, 0.7, 1.1, 0.8, 0.6]) + np.arange(6))
    poses[:, :3, 3], poses[:, :3, :3] = 0.5 * waves[:, :3], Rotation.from_rotvec(0.4 * waves[:, 3:]).as_matrix()
    return Trajectory(10.0 * time, poses)


def with_noise(path, millimetres=1.0, degrees=0.05):
    """A path with random errors."""
    rng, poses = np.random.default_rng(0), moved(path).world_from_camera
    poses[:, :3, 3] += 1e-3 * millimetres * rng.standard_normal((len(path), 3))
    turns = Rotation.from_rotvec(np.radians(degrees) * rng.standard_normal((len(path), 3)))
    poses[:, :3, :3] = poses[:, :3, :3] @ turns.as_matrix()
    return Trajectory(path.timestamps, poses)


def seen_from_body(path, body):
    """Poses of a body whose place in the camera's axes is ``body``."""
    return Trajectory(path.timestamps, path.world_from_camera @ body)


def test_a_truth_in_other_axes_is_named_with_the_turn():
    truth, body = swaying(), np.eye(4)
    estimate = with_noise(truth)
    assert evaluate_trajectory(estimate, truth)["notes"] == []
    (note,) = evaluate_trajectory(estimate, seen_from_body(truth, np.diag([1.0, -1.0, -1.0, 1.0])))["notes"]
    assert "truth have the axes of OpenGL" in note
    vector = np.array([20.0, -70.0, 45.0])
    body[:3, :3] = Rotation.from_rotvec(vector, degrees=True).as_matrix()
    (note,) = evaluate_trajectory(estimate, seen_from_body(truth, body))["notes"]
    assert f"constant turn of {np.linalg.norm(vector):.1f} degrees" in note
    found = [float(word) for word in note.split("rotation vector ")[1].split(" in camera")[0].split(",")]
    assert found == pytest.approx(vector.tolist(), abs=0.3)


@pytest.mark.parametrize("vector", [(0.05, -1.0, -0.4), (1.0, 0.0, 3.5)])
def test_a_small_turn_of_the_axes_is_named_where_it_makes_the_error_of_motions(vector):
    # It turns so little that the turns alone do not show it.
    slow, body = swaying(), np.eye(4)
    slow.world_from_camera[:, :3, :3] = Rotation.from_rotvec(
        0.3 * Rotation.from_matrix(slow.world_from_camera[:, :3, :3]).as_rotvec()
    ).as_matrix()
    body[:3, :3] = Rotation.from_rotvec(vector, degrees=True).as_matrix()
    estimate = with_noise(slow, 0.2, 0.005)
    assert evaluate_trajectory(estimate, slow)["notes"] == []
    (note,) = evaluate_trajectory(estimate, seen_from_body(slow, body))["notes"]
    found = [float(word) for word in note.split("rotation vector ")[1].split(" degrees")[0].split(",")]
    assert found == pytest.approx(vector, abs=0.15)
    # White noise of 0.2 mm at both ends of a motion in each coordinate.
    assert float(note.split("differ by ")[1].split(" mm")[0]) == pytest.approx(0.2 * np.sqrt(6.0), rel=0.15)


def test_errors_without_a_turn_of_the_axes_name_none():
    truth = swaying()
    for seed in range(40):
        rng, poses = np.random.default_rng(seed), truth.world_from_camera.copy()
        waves = np.sin(np.outer(np.linspace(0.0, 1.0, len(poses)), rng.uniform(2.0, 40.0, 6)) + 6.0 * rng.random(6))
        poses[:, :3, 3] += 0.01 * waves[:, :3]
        poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(0.01 * waves[:, 3:]).as_matrix()
        notes = evaluate_trajectory(Trajectory(truth.timestamps, poses), truth)["notes"]
        assert not any("rotation vector" in note for note in notes)


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (20.0, -70.0, 45.0)])
def test_a_truth_of_a_point_beside_the_camera_is_named_with_the_lever(vector):
    truth, body = swaying(), np.eye(4)
    body[:3, :3] = Rotation.from_rotvec(vector, degrees=True).as_matrix()
    body[:3, 3] = [0.06, -0.1, 0.12]
    notes = evaluate_trajectory(with_noise(truth), seen_from_body(truth, body))["notes"]
    assert len(notes) == 1 + any(vector)
    found = [float(word) for word in notes[-1].split("(")[1].split(")")[0].split(",")]
    # The camera's centre in the body's axes.
    assert found == pytest.approx((1e3 * np.linalg.inv(body)[:3, 3]).tolist(), abs=3.0)


def test_paths_that_drift_are_not_taken_for_those_of_another_body():
    truth = swaying()
    for seed in range(20):
        rng, poses = np.random.default_rng(seed), [np.eye(4)]
        for before, after in zip(truth.world_from_camera, truth.world_from_camera[1:], strict=False):
            step = np.linalg.inv(before) @ after
            step[:3, 3] += 0.001 * rng.standard_normal(3)
            step[:3, :3] @= Rotation.from_rotvec(0.001 * rng.standard_normal(3)).as_matrix()
            poses.append(poses[-1] @ step)
        assert evaluate_trajectory(Trajectory(truth.timestamps, np.array(poses)), truth)["notes"] == []


def wavering(times):
    """A camera that goes to and fro at speeds that do not repeat within a minute."""
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, 3] = np.column_stack([np.sin(0.9 * times**1.2), 0.6 * np.cos(1.3 * times), 0.3 * np.sin(2.1 * times)])
    return Trajectory(times, poses)


@pytest.mark.parametrize("offset", [5.0, -3.2])
def test_a_constant_offset_of_the_clocks_is_named_and_changes_no_figure(offset):
    truth = wavering(np.arange(0.0, 30.0, 0.01))
    times = np.arange(2.0, 28.0, 1.0 / 30.0)
    late = Trajectory(times + offset, moved(wavering(times), 2.5).world_from_camera)
    found, before, after = clock_offset(late, truth)
    assert found == pytest.approx(-offset, abs=1e-3)
    assert after < 1e-4 < 0.1 < before
    own, true = match(late, truth)
    figures = evaluate_trajectory(late, truth)
    assert any(f"{-offset:+.3f} s" in note for note in figures["notes"])
    expected = absolute_error(own, true, with_scale=False).distances
    assert figures["se3"]["absolute_mm"]["mean"] == pytest.approx(1e3 * float(expected.mean()))


def test_paths_on_one_clock_or_of_other_recordings_name_no_offset():
    truth = wavering(np.arange(0.0, 30.0, 0.01))
    times = np.arange(2.0, 28.0, 1.0 / 30.0)
    for late in (0.0, 0.03):
        assert clock_offset(Trajectory(times + late, moved(wavering(times)).world_from_camera), truth) is None
    other = wavering(times + 40.0).world_from_camera
    assert clock_offset(Trajectory(times, other), truth) is None
    assert clock_offset(helix(n=200, start=2.0), truth) is None  # at a constant speed
    still = Trajectory(times, np.tile(np.eye(4), (len(times), 1, 1)))
    assert clock_offset(still, truth) is None


def test_stamps_in_nanoseconds_are_not_called_numbers_of_frames():
    with pytest.raises(EvaluationError, match="the truth is stamped with nanoseconds"):
        match(helix(), Trajectory(np.rint(1e9 * helix().timestamps), helix().world_from_camera))


def numbered_run(folder, path, first=0):
    """A run folder with the times of its frames, which are numbered from ``first``."""
    folder.mkdir()
    save_trajectory(folder / "trajectory.txt", path)
    rows = [f"{first + row},{time:.6f},tracked" for row, time in enumerate(path.timestamps)]
    (folder / "frames.csv").write_text("\n".join(["frame,timestamp_s,status", *rows, ""]))
    return folder


def write_numbered(path, poses, first=0):
    """Poses as KITTI's file, and as COLMAP's of images that are numbered from ``first``."""
    np.savetxt(path / "kitti.txt", poses[:, :3].reshape(len(poses), 12))
    inverse = np.linalg.inv(poses)
    quaternions = Rotation.from_matrix(inverse[:, :3, :3]).as_quat(scalar_first=True)
    rows = np.column_stack([quaternions, inverse[:, :3, 3]])
    lines = [f"{n + 1} {' '.join(map(str, row))} 1 {first + n:04d}.png\n" for n, row in enumerate(rows)]
    (path / "images.txt").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(("name", "first"), [("kitti.txt", 0), ("images.txt", 0), ("images.txt", 7)])
def test_a_truth_without_times_is_paired_by_frame_number(tmp_path, name, first):
    truth = swaying()
    write_numbered(tmp_path, truth.world_from_camera, first)
    run = numbered_run(tmp_path / "run", Trajectory(np.arange(120) / 30.0, moved(truth, 4.0).world_from_camera), first)
    figures = evaluate_trajectory(run, tmp_path / name)
    assert figures["n_pairs"] == figures["n_poses"] == 120
    assert figures["sim3"]["scale"] == pytest.approx(4.0)
    assert figures["sim3"]["absolute_mm"]["rmse"] < 1e-3
    assert not any("stamped" in note for note in figures["notes"])
    (run / "frames.csv").unlink()
    with pytest.raises(EvaluationError, match="the truth has frame numbers"):
        evaluate_trajectory(run, tmp_path / name)


def test_numbers_of_frames_are_compared_as_they_are_beside_a_table_of_frames(tmp_path):
    """An estimate of another program, as KITTI's file, that was put into the run folder."""
    truth = swaying()
    write_numbered(tmp_path, truth.world_from_camera)
    run = numbered_run(tmp_path / "run", truth)
    (run / "other.txt").write_bytes((tmp_path / "kitti.txt").read_bytes())
    figures = evaluate_trajectory(run / "other.txt", tmp_path / "kitti.txt")
    assert figures["n_pairs"] == 120
    assert figures["se3"]["absolute_mm"]["rmse"] < 1e-6


def test_a_truth_of_other_frames_is_refused(tmp_path):
    truth = swaying()
    write_numbered(tmp_path, truth.world_from_camera)
    run = numbered_run(tmp_path / "run", truth, first=500)
    with pytest.raises(EvaluationError, match="the frames 0 to 119, and none of them"):
        evaluate_trajectory(run, tmp_path / "kitti.txt")


def test_published_figures_of_freiburg1_xyz():
    folder = real_data("trajectories")
    estimate, truth = match(
        load_trajectory(folder / "freiburg1_xyz-rgbdslam.txt"),
        load_trajectory(folder / "freiburg1_xyz-groundtruth.txt"),
    )
    assert len(estimate) == 785
    rigid = statistics(absolute_error(estimate, truth, False).distances)
    similar = absolute_error(estimate, truth, True)
    assert rigid["rmse"] == pytest.approx(0.01347, abs=5e-6)
    assert statistics(similar.distances)["rmse"] == pytest.approx(0.01339, abs=5e-6)
    assert similar.truth_from_estimate.scale == pytest.approx(1.0080, abs=5e-5)
