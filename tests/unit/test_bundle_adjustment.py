"""Bundle adjustment against scipy's least squares, exact scenes and finite differences."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from morph_dslam.slam.bundle_adjustment import Observations, adjust, total_cost
from tests.support.rendered_room import pose as rigid_pose

INTRINSICS = np.array([520.0, 515.0, 321.0, 238.0])
BASELINE_PX = 50.0


def images(poses, points, depth):
    local = np.einsum("cij,pj->cpi", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    u = INTRINSICS[0] * local[..., 0] / local[..., 2] + INTRINSICS[2]
    v = INTRINSICS[1] * local[..., 1] / local[..., 2] + INTRINSICS[3]
    right = u - BASELINE_PX / local[..., 2] if depth else np.full_like(u, np.nan)
    return np.stack([u, v, right], axis=-1)


def scene(depth=False, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, -1, 3], [1, 1, 5], size=(40, 3))
    vectors = np.column_stack([0.05 * rng.normal(size=(5, 3)), rng.uniform(-0.4, 0.4, size=(5, 3))])
    poses = np.array([rigid_pose(vector[3:], vector[:3]) for vector in vectors])
    seen = rng.random((5, 40)) < 0.8
    seen[:2] = True
    camera_idx, point_idx = np.nonzero(seen)
    pixels = images(poses, points, depth)[seen] + noise * rng.normal(size=(seen.sum(), 3))
    observations = Observations(camera_idx, point_idx, pixels[:, :2], pixels[:, 2] if depth else None)
    return poses, vectors, points, observations


def disturbed(poses, points, fixed, seed=1):
    rng = np.random.default_rng(seed)
    moved = poses.copy()
    for c in np.flatnonzero(~fixed):
        turn, shift = rng.normal(size=(2, 3))
        moved[c] = rigid_pose(0.02 * shift, 0.01 * turn) @ poses[c]
    return moved, points + 0.03 * rng.normal(size=points.shape)


@pytest.mark.parametrize(("depth", "n_fixed"), [(False, 2), (True, 1)])
def test_exact_pixels_give_the_exact_scene(depth, n_fixed):
    poses, _, points, observations = scene(depth)
    fixed = np.arange(5) < n_fixed
    start = disturbed(poses, points, fixed)
    found = adjust(*start, observations, INTRINSICS, fixed, BASELINE_PX, iterations=50, tolerance=1e-14)
    assert np.allclose(found.camera_from_world, poses, atol=1e-7)
    assert np.allclose(found.points, points, atol=1e-7)


def test_noisy_pixels_give_the_optimum_that_scipy_finds():
    poses, vectors, points, observations = scene(noise=0.5)
    fixed = np.arange(5) < 2
    pixels = observations.pixels

    def residuals(x):
        moved = poses.copy()
        moved[2:] = [rigid_pose(vector[3:], vector[:3]) for vector in x[:18].reshape(3, 6)]
        predicted = images(moved, x[18:].reshape(-1, 3), False)
        return (predicted[observations.camera_idx, observations.point_idx, :2] - pixels).ravel()

    expected = least_squares(residuals, np.concatenate([vectors[2:].ravel(), points.ravel()]), xtol=1e-14)
    start = disturbed(poses, points, fixed)
    # With so wide a Huber function every error counts squared, as in the reference.
    found = adjust(*start, observations, INTRINSICS, fixed, huber_px=1e6, iterations=60, tolerance=1e-15)
    assert found.cost == pytest.approx(expected.cost, rel=1e-8)
    assert np.allclose(found.points.ravel(), expected.x[18:], atol=1e-5)


def test_outliers_hardly_move_the_result():
    poses, _, points, observations = scene(noise=0.3)
    wrong = observations.pixels.copy()
    wrong[::25] += 60.0
    fixed = np.arange(5) < 2
    start = disturbed(poses, points, fixed)
    spoilt = Observations(observations.camera_idx, observations.point_idx, wrong)
    found = adjust(*start, spoilt, INTRINSICS, fixed, huber_px=1.0, iterations=60)
    plain = adjust(*start, spoilt, INTRINSICS, fixed, huber_px=1e6, iterations=60)
    error = np.abs(found.camera_from_world - poses)[:, :3, 3].max()
    assert error < 0.25 * np.abs(plain.camera_from_world - poses)[:, :3, 3].max()


def test_fixed_cameras_stay_and_the_cost_is_the_sum_of_huber_terms():
    poses, _, points, observations = scene(noise=1.0)
    fixed = np.arange(5) < 2
    found = adjust(*disturbed(poses, points, fixed), observations, INTRINSICS, fixed)
    assert np.array_equal(found.camera_from_world[:2], poses[:2])
    predicted = images(found.camera_from_world, found.points, False)
    errors = np.linalg.norm(
        predicted[observations.camera_idx, observations.point_idx, :2] - observations.pixels, axis=1
    )
    expected = np.where(errors <= 2.0, errors**2 / 2.0, 2.0 * (errors - 1.0)).sum()
    assert found.cost == pytest.approx(expected, rel=1e-9)


def test_a_point_behind_its_camera_counts_as_a_miss():
    behind = np.array([[0.0, 0.0, -1.0]])
    zero = np.zeros(1, dtype=np.int64)
    cost = total_cost(
        np.eye(4)[None], behind, zero, zero, np.array([[0.0, 0.0, np.nan]]), np.append(INTRINSICS, 0.0), 2.0
    )
    assert cost == pytest.approx(2.0 * (1000.0 - 1.0))
