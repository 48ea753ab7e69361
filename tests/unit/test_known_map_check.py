"""The focal length of a recording in a known map: a zoom is told from what deforms, and from a right recording."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.slam.known_map_checks import focal_note
from morph_dslam.slam.rigid_map import GOOD, Followed, RigidMap
from morph_dslam.slam.self_calibration import estimate_camera

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
N_FRAMES, N_POINTS = 60, 200


def pose_at(time):
    """camera_from_world of a camera that goes around what is 3 m away, and to and fro."""
    turn = Rotation.from_rotvec([0.15 * np.sin(2.1 * time), 0.35 * np.sin(1.3 * time), 0.05 * np.sin(time)])
    pose = np.eye(4)
    pose[:3, :3] = turn.as_matrix()
    pose[:3, 3] = np.array([0, 0, 3.0 + 0.3 * np.sin(1.7 * time)]) - turn.apply([0, 0, 3.0])
    return pose


def recording(true, moved, seed, bend=0.0):
    """Map, path and sightings: OpenCV places the camera by the map's points and takes those within 3 px.

    ``moved`` : displacement (n, 3) of points (n, 3) at a time, metres; ``bend`` of the map itself, metres.
    """
    rng, rigid_map = np.random.default_rng(seed), RigidMap()
    points = rng.uniform([-1.3, -1.0, 2.2], [1.3, 1.0, 4.0], (N_POINTS, 3))
    known = points + bend * np.column_stack([0 * points[:, :2], points[:, 0] ** 2])
    known += 0.003 * rng.standard_normal(points.shape)
    rigid_map.add_points(known, np.zeros((N_POINTS, 2)), 0, GOOD)
    times, poses, seen = np.arange(N_FRAMES) / 15.0, [], []
    for time in times:
        pose = pose_at(time)
        local = (points + moved(points, time)) @ pose[:3, :3].T + pose[:3, 3]
        pixels = true.project(local) + 0.2 * rng.standard_normal((N_POINTS, 2))
        turn, shift = Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3].copy()
        near = np.ones(N_POINTS, dtype=bool)
        for _ in range(4):
            _, turn, shift = cv2.solvePnP(known[near], pixels[near], CAMERA.matrix, None, turn, shift, True)
            off = cv2.projectPoints(known, turn, shift, CAMERA.matrix, None)[0][:, 0] - pixels
            near = np.linalg.norm(off, axis=1) < 3.0
            if near.sum() < 20:
                near = np.argsort(np.linalg.norm(off, axis=1))[:60]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn.ravel()).as_matrix(), shift.ravel()
        poses.append(np.linalg.inv(pose))
        ids = np.flatnonzero(near) if near.dtype == bool else np.sort(near)
        seen.append(Followed(ids, pixels[ids]))
    return rigid_map, CAMERA, Trajectory(times, np.array(poses), np.arange(N_FRAMES)), seen


def still(points, time):
    return np.zeros_like(points)


def breathing(points, time):
    return 0.06 * np.sin(2.0 * time) * (points - [0.0, 0.0, 3.0])


def growing(points, time):
    return 0.02 * time * (points - [0.0, 0.0, 3.0]) * [1.0, 1.0, 0.0]


def bending(points, time):
    return 0.08 * np.sin(1.3 * time) * np.column_stack([0 * points[:, :2], points[:, 0] ** 2 - 0.5])


def note_of(film):
    rigid_map, camera, path, seen = film
    return focal_note(estimate_camera(*film, terms=("focal", "radial")), rigid_map, camera, path, seen)


@pytest.mark.parametrize("zoom", [0.85, 1.1, 1.25])
def test_a_zoom_is_named(zoom):
    note = note_of(recording(replace(CAMERA, fx=525 * zoom, fy=525 * zoom), still, seed=1))
    assert note is not None
    assert float(note.split("by the recording ")[1].split()[0]) == pytest.approx(525 * zoom, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("moved", [still, breathing, growing, bending])
def test_what_deforms_is_no_zoom(moved):
    assert [note_of(recording(CAMERA, moved, seed)) for seed in range(2)] == [None] * 2


def test_a_map_that_is_bent_is_no_zoom():
    assert note_of(recording(CAMERA, still, seed=2, bend=0.05)) is None
