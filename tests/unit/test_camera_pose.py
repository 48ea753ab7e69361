"""Pose of a camera, small linear algebra and two-view structure, against exact scenes, numpy and scipy."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from morph_dslam.slam.bundle_adjustment import inverse_3x3, make_orthonormal
from morph_dslam.slam.initialization import turn_residual_px
from morph_dslam.slam.pose import camera_centre, find_pose, ray_angles, refine_pose, triangulate, two_view_hypotheses
from tests.support.rendered_room import pose as rigid_pose

INTRINSICS = np.array([520.0, 515.0, 321.0, 238.0])


def pixels_of(pose, points):
    local = points @ pose[:3, :3].T + pose[:3, 3]
    return local[:, :2] / local[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:]


def rays_of(pixels):
    return np.column_stack([(pixels - INTRINSICS[2:]) / INTRINSICS[:2], np.ones(len(pixels))])


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform([-1.5, -1.0, 2.5], [1.5, 1.0, 5.0], size=(200, 3))


TRUTH = rigid_pose([0.2, -0.1, 0.15], [0.05, -0.1, 0.03])


def test_the_pose_of_exact_pixels_is_exact(points):
    found = refine_pose(np.eye(4), points, pixels_of(TRUTH, points), INTRINSICS)
    assert np.allclose(found.camera_from_world, TRUTH, atol=1e-9)
    assert found.inliers.all()


def test_points_elsewhere_are_found_out_and_do_not_matter(points):
    rng = np.random.default_rng(1)
    pixels = pixels_of(TRUTH, points) + 0.3 * rng.normal(size=(200, 2))
    pixels[:50] += rng.uniform(15, 60, size=(50, 2))
    found = refine_pose(np.eye(4), points, pixels, INTRINSICS)
    assert not found.inliers[:50].any()
    assert found.inliers[50:].all()
    assert np.allclose(found.camera_from_world, TRUTH, atol=2e-3)


def test_without_points_that_fit_the_covariance_is_infinite(points):
    found = refine_pose(np.eye(4), points[:3], np.full((3, 2), 5000.0), INTRINSICS)
    assert not found.inliers.any()
    assert np.isinf(found.covariance).all()


def test_the_optimum_and_covariance_are_those_of_scipy(points):
    pixels = pixels_of(TRUTH, points) + 0.5 * np.random.default_rng(2).normal(size=(200, 2))

    def residuals(twist):
        turn = rigid_pose([0.0, 0.0, 0.0], twist[:3])
        moved = turn @ TRUTH
        moved[:3, 3] += twist[3:]
        return (pixels_of(moved, points) - pixels).ravel()

    expected = least_squares(residuals, np.zeros(6), xtol=1e-14)
    found = refine_pose(TRUTH, points, pixels, INTRINSICS, huber_px=1e6, inlier_px=1e6)
    pose = rigid_pose([0.0, 0.0, 0.0], expected.x[:3]) @ TRUTH
    pose[:3, 3] += expected.x[3:]
    assert np.allclose(found.camera_from_world, pose, atol=1e-7)
    covariance = np.linalg.inv(expected.jac.T @ expected.jac) * (expected.fun**2).sum() / (len(expected.fun) - 6)
    assert np.allclose(found.covariance, covariance, rtol=0.01, atol=1e-9)


def test_the_covariance_of_few_points_is_as_wide_as_the_errors():
    """Of errors and deviations by 8 points, whose residuals have 10 degrees of freedom: Fisher's F of mean 10 / 8."""
    rng, squares = np.random.default_rng(0), []
    for _ in range(300):
        points = rng.uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 4.0], size=(8, 3))
        pixels = pixels_of(TRUTH, points) + 0.5 * rng.standard_normal((8, 2))
        found = refine_pose(TRUTH, points, pixels, INTRINSICS, huber_px=10.0, inlier_px=10.0)
        turn = Rotation.from_matrix(TRUTH[:3, :3] @ found.camera_from_world[:3, :3].T)
        shift = TRUTH[:3, 3] - turn.apply(found.camera_from_world[:3, 3])
        away = np.concatenate([turn.as_rotvec(), shift])
        squares.append(away @ np.linalg.solve(found.covariance, away) / 6.0)
    assert np.mean(squares) == pytest.approx(1.25, rel=0.2)


def test_a_pose_is_found_without_a_start_among_wrong_matches(points):
    rng = np.random.default_rng(3)
    far = rigid_pose([0.5, 0.2, 6.0], [0.2, 2.5, -0.4])
    pixels = pixels_of(far, points)
    pixels[::2] = rng.uniform(0, 480, size=(100, 2))
    found = find_pose(points, pixels, INTRINSICS)
    assert np.allclose(found.camera_from_world, far, atol=1e-6)
    assert found.inliers[1::2].all()
    assert find_pose(points, rng.uniform(0, 480, size=(200, 2)), INTRINSICS) is None


def test_matrices_are_inverted_as_by_numpy():
    root = np.random.default_rng(4).normal(size=(3, 3))
    matrix, inverse = root @ root.T + np.eye(3), np.empty((3, 3))
    inverse_3x3(matrix, inverse)
    assert np.allclose(inverse, np.linalg.inv(matrix), rtol=1e-10)


def test_rotations_are_made_orthonormal():
    pose = rigid_pose([1.0, 2.0, 3.0], [0.4, 0.2, -0.9])
    spoilt = pose + np.pad(1e-4 * np.random.default_rng(5).normal(size=(3, 3)), (0, 1))
    mended = spoilt.copy()
    make_orthonormal(mended)
    assert np.allclose(mended[:3, :3] @ mended[:3, :3].T, np.eye(3), atol=1e-14)
    assert np.allclose(mended, pose, atol=3e-4)
    assert np.array_equal(mended[:3, 3], pose[:3, 3])


def test_rays_meet_at_their_point_at_the_angle_of_the_triangle(points):
    first, second = rigid_pose([0, 0, 0], [0, 0, 0]), TRUTH
    found = triangulate(first, second, rays_of(pixels_of(first, points)), rays_of(pixels_of(second, points)))
    assert np.allclose(found, points, atol=1e-9)
    # An equilateral triangle.
    apex = np.array([[0.5, 0.0, np.sqrt(0.75)]])
    assert ray_angles(apex, np.zeros(3), np.array([1.0, 0.0, 0.0])) == pytest.approx([60.0])
    assert np.allclose(TRUTH[:3, :3] @ camera_centre(TRUTH) + TRUTH[:3, 3], 0.0, atol=1e-14)


def errors_deg(found, truth):
    turn = Rotation.from_matrix(found[:3, :3] @ truth[:3, :3].T).magnitude()
    direction = truth[:3, 3] / np.linalg.norm(truth[:3, 3])
    return np.degrees([turn, np.arccos(np.clip(found[:3, 3] @ direction, -1.0, 1.0))])


def test_two_views_of_a_general_scene_give_the_motion(points):
    noise = 0.2 * np.random.default_rng(6).normal(size=(2, 200, 2))
    first, second = pixels_of(np.eye(4), points) + noise[0], pixels_of(TRUTH, points) + noise[1]
    found = two_view_hypotheses(first, second, INTRINSICS)
    turn, direction = errors_deg(found[0].second_from_first, TRUTH)
    assert turn < 0.2
    assert direction < 1.0
    assert found[0].good.sum() > 190
    assert all(other.good.sum() < 100 for other in found[1:])


def test_two_views_of_a_plane_give_the_motion_among_others(points):
    plane = points.copy()
    plane[:, 2] = 3.0 + 0.3 * plane[:, 0] - 0.2 * plane[:, 1]
    found = two_view_hypotheses(pixels_of(np.eye(4), plane), pixels_of(TRUTH, plane), INTRINSICS)
    likely = [h for h in found if h.good.sum() > 150]
    errors = np.array([errors_deg(h.second_from_first, TRUTH) for h in likely])
    assert errors.max(axis=1).min() < 0.05


def test_a_way_around_a_wall_is_no_turn(points):
    """Most points are on a wall that the camera turns about; what stands before it tells that the camera moved."""
    points[:, 2] = np.where(np.arange(200) % 6, 4.0, 2.5)
    around = rigid_pose([0.0, 0.0, 0.0], [0.0, 0.05, 0.0])
    around[:3, 3] = np.array([0.0, 0.0, 4.0]) - around[:3, :3] @ [0.0, 0.0, 4.0]
    residual = turn_residual_px(pixels_of(np.eye(4), points), pixels_of(around, points), INTRINSICS)
    # The camera moved by 4 sin(0.05) beside points that are 1.5 nearer than what a turn explains.
    assert residual == pytest.approx(520.0 * 4.0 * np.sin(0.05) * (1 / 2.5 - 1 / 4.0), rel=0.15)


def test_a_turn_leaves_nothing_and_a_shift_its_parallax(points):
    turned = rigid_pose([0.0, 0.0, 0.0], [0.02, 0.2, 0.1])
    first = pixels_of(np.eye(4), points)
    assert turn_residual_px(first, pixels_of(turned, points), INTRINSICS) == pytest.approx(0.0, abs=1e-6)
    # Points at two depths: the turn can only take up the mean of their shifts.
    points[:, 2] = np.where(np.arange(200) % 2, 2.0, 4.0)
    moved = rigid_pose([0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    residual = turn_residual_px(pixels_of(np.eye(4), points), pixels_of(moved, points), INTRINSICS)
    assert 1.0 < residual < 0.5 * 520.0 * 0.1 * (1 / 2.0 - 1 / 4.0) * 2.5
