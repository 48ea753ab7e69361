"""Calibration against boards rendered with known cameras, and against OpenCV's published calibration."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.calibration.board import Board, find_corners
from morph_dslam.calibration.calibrate import Calibration, calibrate
from morph_dslam.calibration.solve import solve_intrinsics
from morph_dslam.calibration.views import View, Views, select_by_coverage
from morph_dslam.camera import Camera
from morph_dslam.cli import app as cli
from morph_dslam.errors import CameraError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.camera_files import load_camera
from morph_dslam.registration.board import load_board
from tests.support.real_data import real_data
from tests.support.rendered_board import board_image, board_poses, fiducial_image, turned_tags

BOARD = Board(9, 6, 0.025)
CAMERA = Camera(640, 480, 541.0, 538.5, 327.3, 236.1, (-0.27, 0.09, 8e-4, -5e-4))
FISHEYE = Camera(640, 480, 260.0, 259.0, 322.0, 237.0, (0.02, -0.008, 0.003, -0.0006), "fisheye")


@pytest.fixture(scope="module")
def pictures():
    """Pictures of the board by `CAMERA`, and the poses."""
    poses = board_poses(CAMERA, BOARD, 16, 40.0, seed=2)
    return [board_image(CAMERA, BOARD, pose, seed) for seed, pose in enumerate(poses)], poses


def write_all(folder, images):
    folder.mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(str(folder / f"{number:02}.png"), image)
    return folder


def exact_views(camera, poses, board=BOARD):
    """Views with the exact corners."""
    return [
        View(f"view {k}", board.points, camera.project_recorded(p.apply(board.points))) for k, p in enumerate(poses)
    ]


@pytest.mark.slow
def test_corners_are_where_the_board_is(pictures):
    images, poses = pictures
    for image, pose in zip(images, poses, strict=True):
        corners = find_corners(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), BOARD)
        # The same corner is first, so that they compare one by one.
        distances = np.linalg.norm(corners - CAMERA.project_recorded(pose.apply(BOARD.points)), axis=1)
        assert np.sqrt((distances**2).mean()) < 0.06
        assert distances.max() < 0.3


@pytest.mark.usefixtures("drawn_figures")
def test_the_command_finds_the_camera(pictures, tmp_path, capsys):
    folder = write_all(tmp_path / "images", pictures[0])
    output = folder / "cam.yaml"
    # What an earlier run left behind is no picture of the board.
    cv2.imwrite(str(folder / "cam_calibration.png"), np.zeros((50, 50), np.uint8))
    command = ["calibrate", str(folder), "--board", "9x6", "--square", "25 mm", "-o", str(output)]
    assert cli.main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith("fx=54")
    assert "views=16/16" in lines[-1]
    assert lines[1].startswith("00.png")
    found = load_camera(output)
    assert found.fx == pytest.approx(CAMERA.fx, rel=2e-3)
    assert found.fy == pytest.approx(CAMERA.fy, rel=2e-3)
    assert (found.cx, found.cy) == pytest.approx((CAMERA.cx, CAMERA.cy), abs=1.0)
    # The whole mapping, where the board was seen, not only its coefficients, which trade with each other.
    grid = np.stack(np.meshgrid(np.linspace(60, 580, 9), np.linspace(60, 420, 7)), axis=-1).reshape(-1, 2)
    rays = CAMERA.rays(CAMERA.undistort_pixels(grid))
    assert np.linalg.norm(found.project_recorded(rays) - grid, axis=1).max() < 1.5
    assert (folder / "cam_calibration.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_video_is_calibrated_from_a_selection_of_its_frames(pictures, tmp_path):
    path = tmp_path / "board.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (640, 480))
    for image in [np.full_like(pictures[0][0], 90), *pictures[0]]:
        writer.write(image)
    writer.release()
    calibration = calibrate([path], BOARD)
    assert list(tmp_path.iterdir()) == [path]
    assert calibration.solution.camera.fx == pytest.approx(CAMERA.fx, rel=3e-3)
    assert calibration.found.n_searched == 17
    assert [view.name for view in calibration.found.views][:2] == ["frame 1", "frame 2"]


@pytest.mark.parametrize(
    ("camera", "lens"), [(CAMERA, "radial-tangential"), (FISHEYE, "fisheye")], ids=["pinhole", "fisheye"]
)
def test_exact_corners_give_the_exact_camera(camera, lens):
    poses = board_poses(camera, BOARD, 15, 40.0, seed=4)
    solution = solve_intrinsics(exact_views(camera, poses), BOARD, (640, 480), lens)
    np.testing.assert_allclose(solution.camera.intrinsics, camera.intrinsics, rtol=2e-4)
    assert solution.rms < 2e-3
    np.testing.assert_allclose(
        [pose.translation for pose in solution.camera_from_board], [pose.translation for pose in poses], atol=2e-4
    )


@pytest.mark.parametrize(
    ("camera", "lens"), [(CAMERA, "radial-tangential"), (FISHEYE, "fisheye")], ids=["pinhole", "fisheye"]
)
def test_the_stated_deviation_is_that_of_repeated_calibrations(camera, lens):
    board = Board(8, 6, 0.025)  # of no orientation, so that the board's shape is not solved for
    exact = exact_views(camera, board_poses(camera, board, 12, 40.0, seed=5), board)
    rng, found, stated = np.random.default_rng(0), [], []
    for _ in range(16):
        noisy = [View(v.name, v.points, v.corners + rng.normal(scale=0.1, size=v.corners.shape)) for v in exact]
        solution = solve_intrinsics(noisy, board, (640, 480), lens)
        found.append(solution.camera.intrinsics[[0, 2, 3]])
        stated.append([solution.focal_deviation[0], *solution.centre_deviation])
    focal = np.array(found)[:, 0]
    assert np.mean(focal) == pytest.approx(camera.fx, abs=3 * np.std(focal) / np.sqrt(16) + 0.05)
    # The standard deviation of 16 values is itself known to 18 per cent.
    assert np.mean(stated, axis=0) == pytest.approx(np.std(found, axis=0, ddof=1), rel=0.5)


def test_a_bent_board_is_solved_for():
    # An arch of 1 mm over the board's length; as a flat board it shifts the focal length.
    bent = BOARD.points.copy()
    bent[:, 2] = 1e-3 * (1.0 - ((bent[:, 0] - 0.1) / 0.1) ** 2)
    poses = board_poses(CAMERA, BOARD, 15, 40.0, seed=6)
    views = [View(f"{k}", BOARD.points, CAMERA.project_recorded(pose.apply(bent))) for k, pose in enumerate(poses)]
    solution = solve_intrinsics(views, BOARD, (640, 480))
    assert solution.camera.fx == pytest.approx(CAMERA.fx, rel=5e-4)
    assert solution.flatness > 0.5e-3
    flat = solve_intrinsics(views[:7], BOARD, (640, 480))
    assert abs(flat.camera.fx - CAMERA.fx) > 3.0 * abs(solution.camera.fx - CAMERA.fx)


def test_views_that_fit_no_camera_are_left_out():
    views = exact_views(CAMERA, board_poses(CAMERA, BOARD, 12, 40.0, seed=7))
    moved = views[3].corners + np.random.default_rng(0).normal(scale=3.0, size=(54, 2))
    views[3] = View("moving", BOARD.points, moved)
    solution = solve_intrinsics(views, BOARD, (640, 480))
    assert solution.left_out == ("moving",)
    assert solution.camera.fx == pytest.approx(CAMERA.fx, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("shift", "is_told"), [(16.0, True), (0.0, False)])
def test_pictures_of_two_cameras_are_told(shift, is_told):
    poses, rng = board_poses(CAMERA, BOARD, 16, 40.0, seed=9), np.random.default_rng(0)
    other = replace(CAMERA, cx=CAMERA.cx + shift)
    views = [
        View(f"{name}{k:02d}.jpg", view.points, view.corners + rng.normal(scale=0.1, size=view.corners.shape))
        for name, camera, part in (("left", CAMERA, poses[:8]), ("right", other, poses[8:]))
        for k, view in enumerate(exact_views(camera, part))
    ]
    solution = solve_intrinsics(views, BOARD, (640, 480))
    remarks = list(Calibration(solution, Views(tuple(views), (640, 480), 16), BOARD).remarks())
    assert any("'left...' and 'right...'" in remark for remark in remarks) == is_told


def test_face_on_views_are_refused(tmp_path, refused):
    poses = board_poses(CAMERA, BOARD, 8, 2.0, seed=8)
    images = [board_image(CAMERA, BOARD, pose, seed) for seed, pose in enumerate(poses)]
    folder = write_all(tmp_path / "images", images)
    output = tmp_path / "cam.yaml"
    command = ["calibrate", str(folder), "--board", "9x6", "--square", "25 mm", "-o", str(output)]
    message = refused(*command)
    assert "the focal length is not determined" in message
    assert "tilt the board" in message
    assert not output.exists()


@pytest.mark.slow
def test_boards_that_are_not_found_or_too_seldom(pictures, tmp_path):
    few = write_all(tmp_path / "few", pictures[0][:3])
    with pytest.raises(CameraError, match=r"the board was found in 3 images only; 5 are needed"):
        calibrate([few], BOARD, tmp_path / "cam.yaml")
    with pytest.raises(CameraError, match=r"no board of 10x7 inner corners was found in 3 images: count"):
        calibrate([few], Board(10, 7, 0.025), tmp_path / "cam.yaml")
    cv2.imwrite(str(few / "99.png"), pictures[0][0][:240])
    with pytest.raises(CameraError, match=r"99\.png is 640x240 pixels, the images before it are 640x480"):
        calibrate([few], BOARD, tmp_path / "cam.yaml")
    with pytest.raises(CameraError, match="there is no folder"):
        calibrate([few], BOARD, tmp_path / "absent" / "cam.yaml")
    with pytest.raises(CameraError, match="give images, or one folder, or one recording"):
        calibrate([few, few], BOARD, tmp_path / "cam.yaml")


def test_a_camera_file_that_cannot_be_written(pictures, tmp_path):
    folder = write_all(tmp_path / "images", pictures[0][:6])
    with pytest.raises(CameraError, match=r"cannot write .*images: a camera file has the ending \.yaml"):
        calibrate([folder], BOARD, folder)
    (tmp_path / "cam.yaml").mkdir()
    with pytest.raises(CameraError, match=r"cannot write .*cam\.yaml: Is a directory"):
        calibrate([folder], BOARD, tmp_path / "cam.yaml")


@pytest.mark.parametrize(
    ("board", "square", "message"),
    [
        ("9", "25 mm", "'9' is no board: give its inner corners, 9x6 say"),
        ("2x6", "25 mm", "too small"),
        ("9x6", "25", "'25' is no length"),
        ("9x6", "25 inch", "one of m, cm, mm"),
        ("9x6", "-3 mm", "impossible"),
    ],
)
def test_boards_that_are_refused(board, square, message):
    with pytest.raises(CameraError, match=message):
        Board.parse(board, square)


def test_boards_as_users_write_them():
    assert Board.parse(" 9 x 6", "25mm") == Board.parse("9X6", "0.025 m") == BOARD


def test_selection_prefers_views_that_differ():
    # Twenty almost equal views and four others: the four are taken first.
    rng = np.random.default_rng(0)
    rest = board_poses(CAMERA, BOARD, 1, 5.0, seed=9)[0]
    corners = CAMERA.project_recorded(rest.apply(BOARD.points))
    same = [View("", BOARD.points, corners + rng.normal(scale=0.2, size=corners.shape)) for _ in range(20)]
    others = exact_views(CAMERA, board_poses(CAMERA, BOARD, 4, 40.0, seed=10))
    chosen = select_by_coverage([*same[:10], *others, *same[10:]], (640, 480), most=5)
    assert set(range(10, 14)) <= set(chosen)
    assert len(chosen) == 5
    assert select_by_coverage(others, (640, 480), most=30) == [0, 1, 2, 3]


CHARUCO = {"kind": "charuco", "dictionary": "5x5_100", "columns": 8, "rows": 6, "square_mm": 28, "marker_mm": 20}
TAGS = {"kind": "grid", "dictionary": "apriltag_36h11", "columns": 5, "rows": 4, "marker_mm": 36, "gap_mm": 10}


def partial_poses(camera, size, n_views, seed):
    """Poses of a print of ``size`` metres that is about as large as the image, tilted by up to 40 degrees."""
    rng, poses, middle = np.random.default_rng(seed), [], np.array([0.5 * size[0], 0.5 * size[1], 0.0])
    for _ in range(n_views):
        turn = Rotation.from_rotvec(np.deg2rad([*rng.uniform(-40, 40, 2), rng.uniform(-30, 30)])).as_matrix()
        depth = camera.fx * size[0] / camera.width * rng.uniform(0.75, 1.2)
        centre = np.array([*rng.uniform(-0.25, 0.25, 2) * depth, depth])
        poses.append(RigidTransform(turn, centre - turn @ middle))
    return poses


@pytest.mark.slow
@pytest.mark.parametrize(
    ("described", "printed"),
    [(CHARUCO, lambda board: board), (TAGS, lambda board: board), (TAGS, turned_tags)],
    ids=["charuco", "OpenCV's tags", "AprilTag's tags"],
)
def test_a_board_of_markers_may_be_seen_in_part(tmp_path, capsys, described, printed):
    (tmp_path / "board.toml").write_text("\n".join(f"{key} = {value!r}" for key, value in described.items()))
    board = printed(load_board(tmp_path / "board.toml"))
    poses = partial_poses(CAMERA, board.size, 14, seed=3)
    images = [fiducial_image(CAMERA, board, pose, seed) for seed, pose in enumerate(poses)]
    folder = write_all(tmp_path / "images", images)
    command = ["calibrate", str(folder), "--board", str(tmp_path / "board.toml"), "-o", str(tmp_path / "cam.yaml")]
    assert cli.main(command) == 0
    assert "views=14/14" in capsys.readouterr().out
    found = load_camera(tmp_path / "cam.yaml")
    # 0.5 pixels; straight lines along the edges of markers, which this lens bends, put fx 1.6 pixels too low.
    np.testing.assert_allclose(found.intrinsics, CAMERA.intrinsics, atol=0.5)


def test_a_board_of_markers_that_is_not_there_or_described_twice(pictures, tmp_path, refused):
    (tmp_path / "board.toml").write_text("\n".join(f"{key} = {value!r}" for key, value in CHARUCO.items()))
    folder = write_all(tmp_path / "images", pictures[0][:3])
    command = ["calibrate", folder, "--board", tmp_path / "board.toml", "-o", tmp_path / "cam.yaml"]
    message = refused(*command)
    assert "no board of 8x6 squares with markers of 5x5_100 was found in 3 images: compare the dictionary" in message
    assert "--square is for a checkerboard" in refused(*command, "--square", "28 mm")
    assert "say how large a square of the checkerboard is" in refused(*command[:3], "8x6", *command[4:])


@pytest.mark.parametrize("side", ["left", pytest.param("right", marks=pytest.mark.slow)])
def test_opencvs_pictures_give_the_published_focal_length(side, tmp_path):
    folder = real_data("opencv_calib")
    calibration = calibrate(sorted(folder.glob(f"{side}??.jpg")), BOARD, tmp_path / "cam.yaml")
    # Of the pair, solved together with one focal length for both cameras (intrinsics.yml).
    published = 534.80326845051309
    camera = calibration.solution.camera
    assert camera.fx == pytest.approx(published, rel=5e-3)
    assert camera.fy == pytest.approx(published, rel=5e-3)
    if side == "left":
        alone = load_camera(folder / "left_intrinsics.yml")
        assert camera.fx == pytest.approx(alone.fx, rel=5e-3)
