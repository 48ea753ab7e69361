"""Trajectory files and COLMAP models: read to known poses, written by the format, and what is refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.errors import CameraError, TrajectoryError
from morph_dslam.io.camera_files import load_camera
from morph_dslam.io.colmap import ColmapImage, write_colmap_model
from morph_dslam.io.trajectory import Trajectory, load_trajectory, save_trajectory

# A quarter turn about z: x goes to y.
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
HALF = np.sqrt(0.5)


def write(path, text):
    path.write_text(text)
    return path


def test_tum(tmp_path):
    path = write(
        tmp_path / "truth.txt",
        f"# timestamp tx ty tz qx qy qz qw\n1305031102.2 1 2 3 0 0 {HALF} {HALF}\n\n1305031102.1 0 0 0 0 0 0 1\n",
    )
    trajectory = load_trajectory(path)
    np.testing.assert_array_equal(trajectory.timestamps, [1305031102.1, 1305031102.2])
    np.testing.assert_allclose(trajectory.world_from_camera[1, :3, :3], QUARTER, atol=1e-12)
    np.testing.assert_allclose(trajectory.positions, [[0, 0, 0], [1, 2, 3]])
    assert trajectory.length == pytest.approx(np.sqrt(14.0))


def test_kitti(tmp_path):
    path = write(tmp_path / "00.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n0 -1 0 5 1 0 0 6 0 0 1 7\n")
    trajectory = load_trajectory(path)
    np.testing.assert_array_equal(trajectory.timestamps, [0.0, 1.0])
    np.testing.assert_allclose(trajectory.world_from_camera[1, :3, :3], QUARTER, atol=1e-12)
    np.testing.assert_allclose(trajectory.positions[1], [5, 6, 7])


def test_colmap_holds_the_inverse_pose(tmp_path):
    # The camera stands at (0, 0, 3) turned a quarter about z: x_camera = R^T (x - c).
    path = write(
        tmp_path / "images.txt",
        "# Image list with two lines of data per image:\n"
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
        f"2 {HALF} 0 0 {-HALF} 0 0 -3 1 left/frame_0012.png\n"
        "100 200 -1 50 60 7\n"
        "1 1 0 0 0 -1 -2 -3 1 left/frame_0011.png\n"
        "\n",
    )
    trajectory = load_trajectory(path)
    np.testing.assert_array_equal(trajectory.timestamps, [11, 12])
    np.testing.assert_allclose(trajectory.positions, [[1, 2, 3], [0, 0, 3]], atol=1e-12)
    np.testing.assert_allclose(trajectory.world_from_camera[1, :3, :3], QUARTER, atol=1e-12)


def test_seven_scenes_poses_are_made_orthonormal(tmp_path):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = 1.0002 * QUARTER, [1, 2, 3]
    np.savetxt(tmp_path / "frame-000030.pose.txt", pose)
    trajectory = load_trajectory(tmp_path)
    np.testing.assert_array_equal(trajectory.timestamps, [1.0])
    np.testing.assert_allclose(trajectory.world_from_camera[0, :3, :3], QUARTER, atol=1e-12)


def test_a_seven_scenes_pose_that_is_no_text_is_named(tmp_path):
    (tmp_path / "frame-000030.pose.txt").write_bytes("1 0 0 0 größe".encode("latin-1"))
    with pytest.raises(TrajectoryError, match=r"frame-000030\.pose\.txt is not a text file"):
        load_trajectory(tmp_path)


def rigid(vector, shift):
    """A pose (4, 4) by its rotation vector, degrees, and its place."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(vector, degrees=True).as_matrix(), shift
    return matrix


def sensor_file(folder, body_from_sensor):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sensor.yaml").write_text(
        f"%YAML:1.0\nT_BS:\n  cols: 4\n  rows: 4\n  data: {body_from_sensor.ravel().tolist()}\n"
    )


@pytest.mark.parametrize("kind", ["state_groundtruth_estimate0", "vicon0"])
def test_euroc_poses_of_the_body_become_those_of_cam0(tmp_path, kind):
    world_from_camera = [rigid((10.0 * i, -20.0, 5.0), (0.1 * i, 0.2, -0.3)) for i in range(3)]
    body_from_camera, body_from_sensor = rigid((3.0, -4.0, 90.0), (-0.02, -0.06, 0.01)), np.eye(4)
    base = tmp_path / "mav0"
    path = base / kind / "data.csv"
    path.parent.mkdir(parents=True)
    if kind == "vicon0":  # a marker of its own on the body
        body_from_sensor = rigid((0.0, 30.0, 0.0), (0.08, 0.0, -0.01))
        sensor_file(path.parent, body_from_sensor)
    lines = [
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x [m]"
    ]
    for i, pose in enumerate(world_from_camera):
        world_from_sensor = pose @ np.linalg.inv(body_from_camera) @ body_from_sensor
        x, y, z, w = Rotation.from_matrix(world_from_sensor[:3, :3]).as_quat()
        values = ",".join(f"{value:.9f}" for value in (*world_from_sensor[:3, 3], w, x, y, z))
        lines.append(f"{1403636579763555584 + 50_000_000 * i},{values},nan")
    write(path, "\n".join(lines) + "\n")
    with pytest.raises(TrajectoryError, match=r"EuRoC's body, and there is no .*cam0/sensor.yaml.*leave the file in"):
        load_trajectory(path)
    sensor_file(base / "cam0", body_from_camera)
    found = load_trajectory(path)
    np.testing.assert_allclose(found.world_from_camera, world_from_camera, atol=1e-8)
    assert found.timestamps == pytest.approx(1403636579.763555584 + 0.05 * np.arange(3), abs=1e-6)
    write(path, lines[0] + "\n1403636579763555584,1.0\n")
    with pytest.raises(TrajectoryError, match="line 2 has 2 values"):
        load_trajectory(path)
    (base / "cam0" / "sensor.yaml").write_text("rate_hz: 20\n")
    with pytest.raises(CameraError, match="T_BS is not a list of numbers"):
        load_trajectory(path)


def test_what_is_saved_is_read_back(tmp_path):
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, :3], poses[1, :3, 3] = QUARTER, [0.1, -0.2, 0.3]
    save_trajectory(tmp_path / "t.txt", Trajectory(np.array([1305031102.160407, 1305031102.19433]), poses))
    read = load_trajectory(tmp_path / "t.txt")
    np.testing.assert_allclose(read.timestamps, [1305031102.160407, 1305031102.19433], atol=1e-6, rtol=0)
    np.testing.assert_allclose(read.world_from_camera, poses, atol=1e-8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no camera poses"),
        ("1 2 3\n", "line 1 has 3 numbers: a TUM file has timestamp"),
        ("# x\n1 0 0 0 0 0 0 word\n", "line 2: could not convert"),
        ("1 0 0 nan 0 0 0 1\n", "line 1 holds a value that is not finite"),
        ("1 0 0 0 0 0 0 0\n", "line 1: the quaternion's norm is 0, not 1"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "line 1: the first three columns are not a rotation"),
        ("# Image list\n1 1 0 0 0 0 0 0\n", "line 2: an image is ID QW"),
        ("# Image list\n1 1 0 0 0 0 0 0 1 left.png\n", "line 2: left.png has no number"),
    ],
)
def test_files_that_are_refused(tmp_path, text, message):
    path = write(tmp_path / "poses.txt", text)
    with pytest.raises(TrajectoryError, match=message) as caught:
        load_trajectory(path)
    assert str(path) in str(caught.value)


def test_missing_binary_and_empty_folder(tmp_path):
    with pytest.raises(TrajectoryError, match="cannot read the trajectory"):
        load_trajectory(tmp_path / "absent.txt")
    (tmp_path / "image.txt").write_bytes(bytes(range(128, 256)))
    with pytest.raises(TrajectoryError, match="not a text file"):
        load_trajectory(tmp_path / "image.txt")
    with pytest.raises(TrajectoryError, match="holds no camera poses"):
        load_trajectory(tmp_path)


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
