"""Loops: a rendered round trip that closes, and the pose graph that closes it."""

import threading
import time

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.geometry import fit_similarity
from morph_dslam.slam.loop_closing import LoopCloser, Similarities, optimise
from morph_dslam.slam.output import trajectory_of
from morph_dslam.slam.rigid_map import Keyframe
from morph_dslam.slam.slam import Slam
from tests.support.rendered_room import RoomFilm, closed_room, pose, round_trip

NONE = np.empty(0, dtype=np.int64)
CAMERA = Camera(480, 360, 380.0, 380.0, 239.5, 179.5)


def keyframe_errors(slam, truth):
    """Distances of the keyframes' centres from the true ones, metres, aligned by the first ten."""
    poses = np.linalg.inv(np.array([k.camera_from_world for k in slam.map.keyframes]))[:, :3, 3]
    expected = np.array([truth[k.index][:3, 3] for k in slam.map.keyframes])
    return np.linalg.norm(fit_similarity(poses[:10], expected[:10]).apply(poses) - expected, axis=1)


def test_a_round_trip_closes(monkeypatch):
    film = RoomFilm(seed=4, scene=closed_room, camera=CAMERA, prints=4)
    truth, slam = round_trip(200), Slam(CAMERA)
    close, errors = LoopCloser.close, []

    def recorded(closer):
        before = keyframe_errors(slam, truth)
        close(closer)
        errors.append((before, keyframe_errors(slam, truth)))

    monkeypatch.setattr(LoopCloser, "close", recorded)
    frames = [slam.process_frame(film.frame(place), i, i / 30.0) for i, place in enumerate(truth)]
    assert slam.n_loops == len(errors) >= 1
    before, after = errors[0]
    assert before[-1] > 0.015
    assert after[-1] < 0.25 * before[-1]
    assert np.sqrt((after**2).mean()) < 0.7 * np.sqrt((before**2).mean())
    assert {frame.status for frame in frames[10:]} == {"tracked"}
    # The whole path, 5 m long.
    slam.refine_map()
    left = path_errors(slam, frames, truth)
    assert np.median(left) < 0.01
    assert left.max() < 0.02


def path_errors(slam, frames, truth):
    """Distances of the camera's centres from the true ones, metres, aligned by one scale."""
    estimate = trajectory_of(slam, frames).positions
    expected = np.array([truth[f.index][:3, 3] for f in frames if f.pose is not None])
    return np.linalg.norm(fit_similarity(estimate, expected).apply(estimate) - expected, axis=1)


def test_a_round_trip_closes_beside_the_frames(monkeypatch):
    film = RoomFilm(seed=4, scene=closed_room, camera=CAMERA, prints=4)
    truth, slam = round_trip(200), Slam(CAMERA, threaded=True)
    closed_by, close = [], LoopCloser.close

    def noted(closer):
        closed_by.append(threading.current_thread().name)
        close(closer)

    monkeypatch.setattr(LoopCloser, "close", noted)
    frames = []
    for index, place in enumerate(truth):
        frames.append(slam.process_frame(film.frame(place), index, index / 30.0))
        # However busy the machine is, the mapper has all the time it needs between two frames.
        while slam._making.is_running:
            time.sleep(0.001)
    # What is left of drift may be so little that old points are found again by themselves at the end.
    slam.refine_map()
    assert slam.n_loops >= 1
    assert {name.split("_")[0] for name in closed_by} == {"mapper"}
    assert {frame.status for frame in frames[10:]} == {"tracked"}
    errors = path_errors(slam, frames, truth)
    assert np.median(errors) < 0.01
    assert errors.max() < 0.02


@pytest.mark.parametrize("threaded", [False, True])
def test_a_view_that_is_wanted_goes_before_the_loop(threaded, monkeypatch):
    """Beside the frames none can be kept while a loop is closed; so that is begun after a frame."""
    making = Slam(CAMERA, threaded=threaded)._making
    making._map.keyframes.append(Keyframe(0, 0.0, np.zeros((4, 4), np.uint8), np.eye(4), NONE, NONE))
    monkeypatch.setattr(LoopCloser, "has_found", True)
    monkeypatch.setattr(LoopCloser, "close", lambda closer: monkeypatch.setattr(LoopCloser, "has_found", False))
    making.advance()
    assert LoopCloser.has_found == threaded
    assert making.can_keep
    making.end_frame()
    assert making.can_keep != threaded
    making.stop()


def transforms(rng, n, spread=1.0):
    rotations = Rotation.from_rotvec(spread * rng.normal(size=(n, 3))).as_matrix()
    return Similarities(np.exp(0.3 * spread * rng.normal(size=n)), rotations, spread * rng.normal(size=(n, 3)))


def test_transforms_are_composed_and_inverted_as_matrices():
    rng = np.random.default_rng(0)
    first, second, points = transforms(rng, 5), transforms(rng, 5), rng.normal(size=(5, 3))
    assert (first @ second).apply(points) == pytest.approx(first.apply(second.apply(points)))
    assert first.inverse.apply(first.apply(points)) == pytest.approx(points)
    poses = np.array([pose(t, r) for t, r in zip(rng.normal(size=(4, 3)), rng.normal(size=(4, 3)), strict=True)])
    of_poses = Similarities.of_poses(poses)
    assert of_poses.camera_from_world() == pytest.approx(poses)
    assert of_poses.translations == pytest.approx(np.linalg.inv(poses)[:, :3, 3])


RING = np.array([[i, (i + 1) % 8] for i in range(8)] + [[0, 2], [3, 6]])


@pytest.mark.parametrize("with_scale", [True, False])
def test_exact_measurements_are_met(with_scale):
    rng = np.random.default_rng(1)
    truth, moved = transforms(rng, 8), transforms(rng, 8, 0.2)
    if not with_scale:
        truth, moved = (Similarities(np.ones(8), s.rotations, s.translations) for s in (truth, moved))
    start = truth @ moved
    start = Similarities(*(np.concatenate([a[:1], b[1:]]) for a, b in zip(parts(truth), parts(start), strict=True)))
    measured = truth[RING[:, 0]].inverse @ truth[RING[:, 1]]
    found = optimise(start, RING, measured, with_scale)
    for one, other in zip(parts(found), parts(truth), strict=True):
        assert one == pytest.approx(other, abs=1e-6)


def parts(similarities):
    return similarities.scales, similarities.rotations, similarities.translations


def test_contradictions_are_spread_as_least_squares_does():
    rng = np.random.default_rng(2)
    truth = transforms(rng, 8)
    measured = truth[RING[:, 0]].inverse @ truth[RING[:, 1]] @ transforms(rng, len(RING), 0.05)

    def transforms_of(steps):
        steps = np.vstack([np.zeros(7), steps.reshape(-1, 7)])
        turned = Rotation.from_rotvec(steps[:, :3]).as_matrix()
        return truth @ Similarities(np.exp(steps[:, 6]), turned, steps[:, 3:6])

    def residuals(steps):
        estimate = transforms_of(steps)
        left = measured @ (estimate[RING[:, 0]].inverse @ estimate[RING[:, 1]]).inverse
        turns = Rotation.from_matrix(left.rotations).as_rotvec()
        return np.column_stack([turns, left.translations, np.log(left.scales)]).ravel()

    expected = transforms_of(least_squares(residuals, np.zeros(49), xtol=1e-12).x)
    found = optimise(truth, RING, measured, with_scale=True)
    assert found.translations == pytest.approx(expected.translations, abs=1e-5)
    assert found.scales == pytest.approx(expected.scales, abs=1e-5)
    assert np.abs(found.translations - truth.translations).max() > 0.01
