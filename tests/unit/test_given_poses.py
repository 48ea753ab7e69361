"""Poses that are given to a map, and the velocities that a tracker takes from them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.slam.frame_images import FrameImages
from morph_dslam.slam.map_files import map_from_trajectory
from morph_dslam.slam.rigid_map import Followed
from morph_dslam.slam.rolling_shutter import velocities
from morph_dslam.slam.tracking import Tracked, Tracker
from morph_dslam.sources.frames import Frame

CAMERA, PX_PER_METRE, FPS = Camera(240, 180, 220.0, 220.0, 119.5, 89.5), 360.0, 30.0
VELOCITY = np.array([0.5, 0.3, 0.0])


class Wall:
    """Frames of a textured wall at z = 1 m, before which a camera moves steadily; its rows are read over a time."""

    name, fps = "wall", FPS

    def __init__(self, readout_s, n=16):
        rng = np.random.default_rng(0)
        texture = cv2.GaussianBlur(rng.integers(0, 256, (700, 900), np.uint8), (0, 0), 2.0)
        texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
        rows, columns = np.mgrid[:180, :240].astype(np.float32)
        self.frames = []
        for index in range(n):
            times = index / FPS + readout_s * (rows - 89.5) / 180.0
            x, y = (columns - 119.5) / 220.0 + 0.5 * times, (rows - 89.5) / 220.0 + 0.3 * times
            at = (PX_PER_METRE * x + 300.0).astype(np.float32), (PX_PER_METRE * y + 300.0).astype(np.float32)
            image = cv2.remap(texture, *at, cv2.INTER_CUBIC)
            self.frames.append(Frame(index, index / FPS, cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)))

    def __len__(self):
        return len(self.frames)

    def __iter__(self):
        return iter(self.frames)


@pytest.mark.parametrize("readout_s", [0.0, 0.03])
def test_a_readout_time_counts_where_poses_are_given(readout_s):
    wall = Wall(readout_s)
    poses = np.tile(np.eye(4), (len(wall), 1, 1))
    times = np.arange(len(wall)) / FPS
    poses[:, :3, 3] = times[:, None] * VELOCITY
    images = FrameImages(replace(CAMERA, readout_s=readout_s))
    found = map_from_trajectory(Trajectory(times, poses), wall, images)
    for keyframe in found.keyframes:
        # A world that stands still moves the other way in the camera's axes.
        np.testing.assert_allclose(keyframe.twist, [0.0, 0.0, 0.0, *-VELOCITY], atol=1e-9)
    depths = found.positions[found.good, 2]
    assert len(depths) > 100
    assert np.sqrt(np.mean((depths - 1.0) ** 2)) < 0.003


@pytest.mark.parametrize("fps", [30.0, 240.0])
def test_poses_by_numbers_belong_to_the_frames_of_these_numbers_at_any_rate(fps):
    """Every third frame has a pose: the others are left out, where the poses beside are 4 ms away too."""
    wall = Wall(0.0)
    wall.fps, wall.frames = fps, [replace(frame, timestamp=frame.index / fps) for frame in wall.frames]
    numbers = np.arange(0, len(wall), 3)
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[:, :3, 3] = (numbers / FPS)[:, None] * VELOCITY
    found = map_from_trajectory(Trajectory(numbers.astype(float), poses, is_numbered=True), wall, FrameImages(CAMERA))
    assert all(keyframe.index % 3 == 0 for keyframe in found.keyframes)
    assert np.sqrt(np.mean((found.positions[found.good, 2] - 1.0) ** 2)) < 0.003


@pytest.mark.parametrize("hz", [30, 100, 500])
def test_noise_of_poses_moves_rows_by_no_more_than_itself_however_dense_they_are(hz):
    """Of a camera that stands still, poses have 0.05 degrees of noise about each axis; 30 ms are read in."""
    times, noise = np.arange(300) / hz, np.random.default_rng(0).normal(0.0, np.radians(0.05), (300, 3))
    poses = np.tile(np.eye(4), (300, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(noise).as_matrix()
    turned = velocities(times, poses, 0.03)[1:-1, :3] * 0.015  # up to the first or last row
    # Of two poses 60 ms apart, or 67 at 30 Hz, the difference over four, or over four and a half.
    assert np.sqrt(np.mean(turned**2)) < 1.1 * np.sqrt(2.0) / 4.0 * np.radians(0.05)


def test_velocities_by_dense_poses_follow_the_camera():
    """It swings by 0.1 sin(w t) rad: differences over a time h to either side are sin(w h) / (w h) of the rate."""
    times, w, h = np.arange(200) / 200.0, 2.0 * np.pi, 0.03
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(0.1 * np.sin(w * times), [0.0, 1.0, 0.0])).as_matrix()
    found = velocities(times, poses, h)
    expected = 0.1 * w * np.cos(w * times[10:-10]) * np.sin(w * h) / (w * h)
    np.testing.assert_allclose(found[10:-10, 1], expected, atol=1e-9)
    # At the ends, poses are on one side alone.
    assert found[0, 1] == pytest.approx(0.1 * np.sin(w * h) / h)


def test_the_velocity_after_a_camera_was_found_again_is_that_since_then():
    wall = Wall(0.0)
    poses = np.tile(np.eye(4), (len(wall), 1, 1))
    times = np.arange(len(wall)) / FPS
    poses[:, :3, 3] = times[:, None] * VELOCITY
    path, images = Trajectory(times, poses), FrameImages(CAMERA)
    known = map_from_trajectory(path, wall, images)
    views = [images.prepare(frame.image, frame.index, frame.timestamp) for frame in wall]
    tracker = Tracker(known, CAMERA)
    tracker.place(path.camera_from_world[0], known.keyframes[0].seen, times[0])
    assert isinstance(tracker.track(views[1]), Tracked)
    # The next two are lost; in the one after these the camera is found by other means.
    in_view, pixels = known.good, CAMERA.project(known.positions[known.good] - poses[4, :3, 3])
    inside = ((pixels > 0.0) & (pixels < [239.0, 179.0])).all(axis=1)
    tracker.place(path.camera_from_world[4], Followed(in_view[inside], pixels[inside]), times[4])
    tracked = tracker.track(views[5])
    assert isinstance(tracked, Tracked)
    np.testing.assert_allclose(tracked.twist[3:], -VELOCITY, atol=0.03)
