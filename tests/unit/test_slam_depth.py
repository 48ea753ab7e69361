"""Depth at pixels from depth images and from the rows of a stereo pair."""

import cv2
import numpy as np
import pytest

from morph_dslam.camera import Camera, StereoCamera
from morph_dslam.geometry import RigidTransform
from morph_dslam.slam.frame_images import DepthImage, FrameImages, StereoImages, depth_of
from morph_dslam.slam.pose import refine_pose
from tests.support.rendered_sequence import printed_texture

BASELINE_PX = 40.0
PIXELS = np.array([[20.0, 15.0], [30.25, 20.5], [44.9, 33.3]])


def slanted_depth():
    """A plane: its inverse depth is linear in the image."""
    rows, columns = np.mgrid[:60, :80]
    return 1.0 / (0.4 + 0.002 * columns - 0.001 * rows)


def test_depth_between_pixels_is_that_of_the_plane():
    columns = DepthImage(slanted_depth().astype(np.float32), BASELINE_PX).right_columns(PIXELS)
    expected = 1.0 / (0.4 + 0.002 * PIXELS[:, 0] - 0.001 * PIXELS[:, 1])
    assert depth_of(PIXELS, columns, BASELINE_PX) == pytest.approx(expected, rel=1e-5)


def test_holes_edges_and_the_outside_give_no_depth():
    depth = slanted_depth().astype(np.float32)
    depth[15, 21], depth[:, 31:] = np.nan, 1.0
    image = DepthImage(depth, BASELINE_PX)
    found = image.right_columns(np.vstack([PIXELS, [[79.5, 3.0], [-2.0, 4.0]]]))
    assert np.isnan(found).tolist() == [True, True, False, True, True]
    # What is measured far from where it is expected is another surface.
    far = image.right_columns(PIXELS[2:], expected=np.array([found[2] - 10.0]))
    assert np.isnan(far).all()


def test_samples_of_a_depth_image_are_on_its_plane_and_away_from_holes():
    depth = slanted_depth().astype(np.float32)
    depth[:30, :40] = np.nan
    samples = DepthImage(depth, BASELINE_PX).samples()
    columns, rows, found = samples.astype(float).T
    assert len(samples) > 30
    assert not ((columns < 40) & (rows < 30)).any()
    assert found == pytest.approx(1.0 / (0.4 + 0.002 * columns - 0.001 * rows), rel=1e-5)


def shifted_pair(disparity):
    texture = printed_texture(240, 320, seed=2)
    height, width = texture.shape
    grid_x, grid_y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    right = cv2.remap(texture, grid_x + np.float32(disparity), grid_y, cv2.INTER_LINEAR)
    return texture, right


@pytest.mark.parametrize("disparity", [3.0, 17.4, 60.75])
def test_corners_are_found_in_their_row_of_the_right_image(disparity):
    left, right = shifted_pair(disparity)
    corners = cv2.goodFeaturesToTrack(left, 150, 0.02, 8).reshape(-1, 2).astype(float)
    corners = corners[(corners[:, 0] > 100) & (corners[:, 0] < 300)]
    pair = StereoImages(left, right, 50.0)
    found = corners[:, 0] - pair.right_columns(corners)
    measured = np.isfinite(found)
    assert measured.mean() > 0.7
    assert np.quantile(np.abs(found[measured] - disparity), 0.95) < 0.1
    near = corners[:, 0] - pair.right_columns(corners, expected=corners[:, 0] - disparity - 2.0)
    assert np.nanmedian(near) == pytest.approx(disparity, abs=0.05)


LEFT = Camera(320, 240, 300.0, 302.0, 161.0, 118.0, (-0.2, 0.05, 2e-4, 2e-5))
RIGHT = Camera(320, 240, 310.0, 309.0, 157.0, 121.0, (-0.1, 0.02, 0.0, 1e-4))
#: A plane n x = d before the left camera, not square to it, metres.
NORMAL, DISTANCE = np.array([0.2, -0.1, 1.0]), 1.5


def picture_of_plane(camera, camera_from_left):
    """What a camera sees of a printed plane whose texture has 400 pixels a metre."""
    texture = printed_texture(1600, 1600, seed=3)
    rows, columns = np.mgrid[: camera.height, : camera.width]
    recorded = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    matrix, lens = camera.matrix, np.array([*camera.distortion])
    pixels = cv2.undistortPoints(recorded[:, None], matrix, lens)[:, 0]  # OpenCV's lens, not ours
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ camera_from_left.rotation
    centre = camera_from_left.inverse.translation
    points = centre + rays * ((DISTANCE - NORMAL @ centre) / (rays @ NORMAL))[:, None]
    places = (400.0 * points[:, :2] + 800.0).astype(np.float32).reshape(camera.height, camera.width, 2)
    return cv2.remap(texture, places, None, cv2.INTER_LINEAR)


def test_depths_of_a_pair_that_is_turned_are_along_the_axis_of_the_left_camera():
    turn = cv2.Rodrigues(np.array([0.02, -0.08, 0.03]))[0]
    right_from_left = RigidTransform(turn, np.array([0.0, 0.004, 0.01]) - turn @ np.array([0.11, 0.0, 0.0]))
    left, right = (picture_of_plane(LEFT, RigidTransform.identity()), picture_of_plane(RIGHT, right_from_left))
    images = FrameImages(StereoCamera(LEFT, RIGHT, right_from_left))
    assert images.camera == LEFT
    view = images.prepare(left, 0, 0.0, right=right)
    corners = cv2.goodFeaturesToTrack(view.grey, 200, 0.02, 8).reshape(-1, 2).astype(float)
    corners = corners[np.abs(corners - [160.0, 120.0]).max(axis=1) < 85.0]
    rays = np.column_stack([(corners - [161.0, 118.0]) / [300.0, 302.0], np.ones(len(corners))])
    expected = DISTANCE / (rays @ NORMAL)
    found = view.depth.at(corners)
    seen = np.isfinite(found)
    assert seen.mean() > 0.6
    # A tenth of a pixel of 22 is 0.5 %; the turns of the rectified camera would be 3 % at the edges.
    assert np.quantile(np.abs(found / expected - 1.0)[seen], 0.9) < 0.01
    assert abs(np.median((found / expected)[seen]) - 1.0) < 0.002
    columns = corners[:, 0] - images.baseline_px / expected
    near = view.depth.right_columns(corners, columns + 2.0)
    assert np.nanquantile(np.abs(near - columns), 0.9) < 0.2
    assert np.isnan(view.depth.at(np.array([[-500.0, 100.0], [1e6, 100.0]]))).all()


def test_a_repeated_pattern_gives_no_depth_without_an_expectation():
    board = np.kron(np.indices((15, 20)).sum(axis=0) % 2, np.ones((16, 16))).astype(np.uint8) * 150 + 50
    corners = np.array([[x, y] for x in (160.0, 192.0, 224.0) for y in (64.0, 96.0, 128.0)]) - 0.5
    assert np.isnan(StereoImages(board, board, 50.0).right_columns(corners)).all()


def test_depth_fixes_the_distance_that_pixels_leave_open():
    """With all points at one depth, a small field of view and noise, moving back looks like nothing."""
    rng = np.random.default_rng(0)
    intrinsics, points = (
        np.array([500.0, 500.0, 320.0, 240.0]),
        rng.uniform([-0.05, -0.05, 2.95], [0.05, 0.05, 3.05], size=(100, 3)),
    )
    truth = np.eye(4)
    truth[2, 3] = 0.3
    local = points + truth[:3, 3]
    pixels = local[:, :2] / local[:, 2:] * 500.0 + intrinsics[2:] + 0.3 * rng.normal(size=(100, 2))
    right = pixels[:, 0] - BASELINE_PX / local[:, 2] + 0.3 * rng.normal(size=100)
    right[::2] = np.nan
    without = refine_pose(np.eye(4), points, pixels, intrinsics)
    found = refine_pose(np.eye(4), points, pixels, intrinsics, right=right, baseline_px=BASELINE_PX)
    # Fifty columns of 0.3 px noise: 0.3 / (b / z^2) / sqrt(50).
    expected = 0.3 / (BASELINE_PX / 3.3**2) / np.sqrt(50)
    assert abs(found.camera_from_world[2, 3] - 0.3) < 3.0 * expected
    assert np.sqrt(found.covariance[5, 5]) == pytest.approx(expected, rel=0.4)
    assert without.covariance[5, 5] > 1.5 * found.covariance[5, 5]
