"""COLMAP text models: what is written is what other readers understand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.io.camera_files import load_camera
from morph_dslam.io.colmap import ColmapImage, write_colmap_model
from morph_dslam.io.trajectory import load_trajectory

CAMERA = Camera(640, 480, 500.0, 510.0, 320.5, 238.0)


@pytest.fixture
def model(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, 3], [1, 1, 5], size=(8, 3))
    images = []
    for number, ids in ((4, [0, 2, 3, 7]), (11, [1, 2, 3, 5])):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(0.2 * rng.normal(size=3)).as_matrix()
        pose[:3, 3] = 0.2 * rng.normal(size=3)
        pixels = CAMERA.project(points[ids] @ pose[:3, :3].T + pose[:3, 3])
        images.append(ColmapImage(f"{number:06d}.png", pose, np.array(ids), pixels))
    write_colmap_model(tmp_path / "colmap", CAMERA, images, points)
    return tmp_path / "colmap", images, points


def test_camera_and_poses_are_read_back(model):
    folder, images, _ = model
    read = load_camera(folder / "cameras.txt")
    assert (read.width, read.height) == (640, 480)
    assert read.intrinsics == pytest.approx(CAMERA.intrinsics)
    path = load_trajectory(folder / "images.txt")
    assert path.timestamps.tolist() == [4.0, 11.0]
    expected = [np.linalg.inv(image.camera_from_world) for image in images]
    assert path.world_from_camera == pytest.approx(np.array(expected), abs=1e-8)


def test_points_project_to_their_pixels_by_the_written_numbers(model):
    """By the format's description alone: PINHOLE, quaternions with w first, tracks of image id and row."""
    folder, _, points = model
    fx, fy, cx, cy = (float(word) for word in (folder / "cameras.txt").read_text().split()[4:])
    lines = (folder / "images.txt").read_text().splitlines()
    views = {}
    for head, body in zip(lines[::2], lines[1::2], strict=True):
        words = head.split()
        quaternion, shift = np.array(words[1:5], float), np.array(words[5:8], float)
        views[int(words[0])] = (Rotation.from_quat(np.roll(quaternion, -1)), shift, np.array(body.split(), float))
    rows = [line.split() for line in (folder / "points3D.txt").read_text().splitlines()]
    # Two of the eight points are seen by no image.
    assert [int(row[0]) for row in rows] == [1, 2, 3, 4, 6, 8]
    for row in rows:
        position = np.array(row[1:4], float)
        assert position == pytest.approx(points[int(row[0]) - 1], abs=1e-8)
        assert float(row[7]) < 1e-3
        for image, index in np.array(row[8:], int).reshape(-1, 2):
            turn, shift, seen = views[image]
            x, y, z = turn.apply(position) + shift
            assert seen.reshape(-1, 3)[index] == pytest.approx(
                [fx * x / z + cx, fy * y / z + cy, float(row[0])], abs=2e-3
            )
