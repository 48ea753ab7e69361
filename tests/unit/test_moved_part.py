"""A part of a known map that stands elsewhere: told from points that scatter, from what keeps moving, and from few."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.slam.known_map_checks import moved_part
from morph_dslam.slam.rigid_map import GOOD, Followed, RigidMap

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
N_FRAMES, N_POINTS = 40, 200
STILL = Rotation.identity()


def recording(n_moved, motion, noise_px=0.3):
    """Map, path, and points that agree and do not.

    ``motion`` : at a time, how the first ``n_moved`` points are turned about their middle, and shifted, metres.
    """
    rng, rigid_map = np.random.default_rng(5), RigidMap(40.0)
    points = rng.uniform([-1.3, -1.0, 2.5], [1.3, 1.0, 4.5], (N_POINTS, 3))
    rigid_map.add_points(points, np.zeros((N_POINTS, 2)), 0, GOOD)
    times, poses, seen, astray = np.arange(N_FRAMES) / 15.0, [], {}, {}
    for index, time in enumerate(times):
        now, middle = points.copy(), points[:n_moved].mean(axis=0)
        turn, shift = motion(time)
        now[:n_moved] = turn.apply(points[:n_moved] - middle) + middle + shift
        camera_turn = Rotation.from_rotvec([0.05 * np.sin(time), 0.2 * np.sin(1.3 * time), 0.0])
        place = np.array([0.2 * np.sin(time), 0.0, 0.1])
        local = camera_turn.apply(now) + place
        pixels = CAMERA.project(local) + noise_px * rng.standard_normal((N_POINTS, 2))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera_turn.as_matrix(), place
        poses.append(np.linalg.inv(pose))
        moved = np.arange(n_moved)
        astray[index], seen[index] = (
            Followed(moved, pixels[moved]),
            Followed(np.arange(n_moved, N_POINTS), pixels[n_moved:]),
        )
    return rigid_map, CAMERA, Trajectory(times, np.array(poses), np.arange(N_FRAMES)), seen, astray


@pytest.mark.parametrize("angle", [0.0, 0.1])
def test_a_part_that_was_moved_is_named_with_how_far(angle):
    shift = np.array([0.05, 0.0, -0.03])
    found = moved_part(*recording(50, lambda _: (Rotation.from_rotvec([0.0, angle, 0.0]), shift)))
    assert found is not None
    assert (found.n_frames, found.share, found.unit) == (N_FRAMES, pytest.approx(0.25), "m")
    assert found.shift == pytest.approx(np.linalg.norm(shift), rel=0.15)


def test_a_few_points_are_not_a_part_of_the_map():
    assert moved_part(*recording(15, lambda _: (STILL, np.array([0.05, 0.0, 0.0])))) is None


def test_what_keeps_moving_is_no_part_that_was_moved():
    """A person who walks to and fro by half a metre."""
    assert moved_part(*recording(50, lambda time: (STILL, np.array([0.5 * np.sin(4.0 * time), 0.0, 0.0])))) is None


def test_points_that_scatter_are_none():
    """Matches that are wrong one by one, as of repeated texture."""
    assert moved_part(*recording(50, lambda _: (STILL, np.zeros(3)), noise_px=12.0)) is None
