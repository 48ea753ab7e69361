"""Rigs of cameras: against rendered boards with known poses, and OpenCV's calibration of its own stereo pictures."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.calibration.board import Board, find_corners
from morph_dslam.camera import Camera
from morph_dslam.cli import app as cli
from morph_dslam.errors import CameraError
from morph_dslam.extend.calibration import calibrate_rig
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.camera_files import load_rig
from morph_dslam.registration.board import BoardFile, FiducialBoard
from tests.support.real_data import real_data
from tests.support.rendered_board import fiducial_image

FIRST = Camera(640, 480, 541.0, 538.5, 327.3, 236.1, (-0.27, 0.09, 8e-4, -5e-4))
CAMERAS = (FIRST, replace(FIRST, fx=520.0, fy=519.0, cx=310.0), replace(FIRST, width=600, cx=301.0, distortion=()))
POSES = (
    RigidTransform.identity(),
    RigidTransform(Rotation.from_rotvec([0.02, -0.25, 0.03]).as_matrix(), np.array([0.11, 0.005, 0.02])),
    RigidTransform(Rotation.from_rotvec([0.1, 0.3, -0.1]).as_matrix(), np.array([-0.14, -0.03, 0.03])),
)
MARKERS = FiducialBoard(
    BoardFile(kind="charuco", dictionary="5x5_100", columns=8, rows=6, square_mm=28.0, marker_mm=20.0)
)


def board_poses(n_views, seed):
    """Where the board is for the first camera, tilted by up to 35 degrees."""
    rng, middle = np.random.default_rng(seed), np.array([*MARKERS.size, 0.0]) / 2
    poses = []
    for _ in range(n_views):
        turn = Rotation.from_rotvec(np.deg2rad([*rng.uniform(-35, 35, 2), rng.uniform(-20, 20)])).as_matrix()
        centre = np.array([*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.24, 0.36)])
        poses.append(RigidTransform(turn, centre - turn @ middle))
    return poses


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A folder with the pictures of each camera, and the board's file."""
    folder, poses = tmp_path_factory.mktemp("rig"), board_poses(12, seed=1)
    for number, (camera, pose) in enumerate(zip(CAMERAS, POSES, strict=True)):
        (folder / str(number)).mkdir()
        for frame, of_board in enumerate(poses):
            image = fiducial_image(camera, MARKERS, pose @ of_board, seed=10 * frame + number)
            cv2.imwrite(str(folder / str(number) / f"{frame:02}.png"), image)
    lines = [f"{key} = {value!r}" for key, value in MARKERS.description.model_dump(exclude_none=True).items()]
    (folder / "board.toml").write_text("\n".join(lines))
    return folder


def off(found: RigidTransform, true: RigidTransform) -> tuple[float, float]:
    """Distance, metres, and angle, radians."""
    turn = Rotation.from_matrix(found.rotation.T @ true.rotation).magnitude()
    return float(np.linalg.norm(found.translation - true.translation)), float(turn)


@pytest.mark.slow
def test_the_command_writes_where_three_cameras_are(filmed, tmp_path, capsys):
    command = ["calibrate", filmed / "0", "--with", filmed / "1", "--with", filmed / "2", "--board"]
    command += [filmed / "board.toml", "-o", tmp_path / "rig.yaml"]
    assert cli.main([str(word) for word in command]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith("cameras=3 frames=12/12 rms_px=0.")
    assert (tmp_path / "rig_cam2_calibration.png").stat().st_size > 10_000
    for (camera, pose), true, at in zip(load_rig(tmp_path / "rig.yaml"), CAMERAS, POSES, strict=True):
        assert camera.fx == pytest.approx(true.fx, rel=2e-3)
        assert camera.width == true.width
        apart, turn = off(pose, at)
        assert apart < 0.3e-3
        assert turn < np.deg2rad(0.1)


def test_stated_deviations_are_those_of_the_errors_and_a_frame_of_another_instant_is_left_out(filmed, tmp_path):
    for number in range(3):
        (tmp_path / str(number)).symlink_to(filmed / str(number))
    (tmp_path / "late").mkdir()
    for picture in (filmed / "1").iterdir():
        # The picture with number 5 is that of the next instant.
        source = filmed / "1" / "06.png" if picture.name == "05.png" else picture
        (tmp_path / "late" / picture.name).symlink_to(source)
    rig = calibrate_rig([[tmp_path / "0"], [tmp_path / "late"]], MARKERS)
    assert rig.left_out == (5,)
    assert "left out: 5" in rig.remarks()[0]
    assert list(tmp_path.glob("*.yaml")) == []
    apart, turn = off(rig.camera_from_first[1], POSES[1])
    assert apart < 3.0 * rig.deviations[1, 0]
    assert turn < 3.0 * rig.deviations[1, 1]
    assert rig.deviations[1, 0] < 0.3e-3


def test_pictures_that_are_all_a_frame_late_give_no_camera_file(filmed, tmp_path):
    """Of a board that is somewhere else in each frame."""
    late = tmp_path / "late"
    late.mkdir()
    for frame in range(11):
        (late / f"{frame:02}.png").symlink_to(filmed / "1" / f"{frame + 1:02}.png")
    with pytest.raises(CameraError, match=r"do not go together: the residual of .* pixels is large"):
        calibrate_rig([[filmed / "0"], [late]], MARKERS, tmp_path / "rig.yaml")
    assert not (tmp_path / "rig.yaml").exists()


def test_what_cannot_be_a_rig_is_refused(filmed, tmp_path):
    with pytest.raises(CameraError, match="turned by half a turn"):
        calibrate_rig([[filmed / "0"], [filmed / "1"]], Board(8, 6, 0.028))
    (tmp_path / "elsewhere").mkdir()
    for frame, picture in enumerate(sorted((filmed / "1").iterdir())):
        (tmp_path / "elsewhere" / f"{frame + 100}.png").symlink_to(picture)
    with pytest.raises(CameraError, match="camera 1 saw the board in 0 frames together with another one"):
        calibrate_rig([[filmed / "0"], [tmp_path / "elsewhere"]], MARKERS)
    with pytest.raises(CameraError, match=r"00\.png and 00\.png have one number"):
        calibrate_rig([[*sorted((filmed / "0").iterdir()), *sorted((filmed / "1").iterdir())]], MARKERS)


@pytest.mark.slow
def test_opencvs_stereo_pictures_give_the_pose_that_opencv_finds(tmp_path):
    folder, board = real_data("opencv_calib"), Board(9, 6, 0.025)
    pictures = [sorted(folder.glob(f"{side}??.jpg")) for side in ("left", "right")]
    rig = calibrate_rig(pictures, board, tmp_path / "pair.yaml")
    assert len(rig.frames) >= 12
    grey = [
        [cv2.imread(str(side[0].with_name(f"{name}{n:02}.jpg")), cv2.IMREAD_GRAYSCALE) for n in rig.frames]
        for side, name in zip(pictures, ("left", "right"), strict=True)
    ]
    corners = [[np.float32(find_corners(image, board)) for image in side] for side in grey]
    cameras = [calibration.solution.camera for calibration in rig.cameras]
    lenses = [part for camera in cameras for part in (camera.matrix, np.array(camera.distortion))]
    points = [board.points.astype(np.float32)] * len(rig.frames)
    found = cv2.stereoCalibrate(points, *corners, *lenses, (640, 480), flags=cv2.CALIB_FIX_INTRINSIC)
    apart, turn = off(rig.camera_from_first[1], RigidTransform(found[5], np.ravel(found[6])))
    assert apart < 0.1e-3
    assert turn < np.deg2rad(0.02)
    # The pair's baseline is 3.33 squares, as OpenCV's own calibration of all parameters has it.
    assert np.linalg.norm(rig.camera_from_first[1].translation) == pytest.approx(3.33 * 0.025, rel=5e-3)
