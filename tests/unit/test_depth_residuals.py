"""Depth residuals against finite differences, exact planes, and the spread of repeated measurements."""

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.tracking.depth import SIGMA_AT_1M, PointDepths
from morph_dslam.tracking.estimator import Estimator, State, moved
from morph_dslam.tracking.sequence_filter import SequenceFilter
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points, measured
from tests.support.rendered_sequence import CAMERA

MODEL = bent_sheet_model(22, 16)
POSE = RigidTransform(
    rotation_exp(np.array([0.2, -0.3, 0.05])) @ np.diag([1.0, -1.0, -1.0]), np.array([0.02, -0.01, 0.6])
)
TRUTH = State(np.array([0.035, 0.3, 0.1]), POSE)
SIGMA_PX = 0.4


def measured_depths(points, rng, sigma=0.0, huber_px=2.0 * SIGMA_PX):
    """Depths with noise, of all points but every fifth; weighed against pixels of SIGMA_PX."""
    depths = points.in_camera(TRUTH)[:, 2] + sigma * rng.standard_normal(len(points))
    weights = np.full(len(points), SIGMA_PX / max(sigma, 1e-3))
    weights[::5], depths[::5] = 0.0, 77.0
    return PointDepths(depths, weights, SIGMA_PX**2, huber_px)


def test_gradient_is_that_of_the_cost_of_depths():
    """The cost is recomputed from positions; some residuals are beyond Huber's limit and some are not."""
    points = bound_points(MODEL, 80)
    depths = measured_depths(points, np.random.default_rng(1), 2e-3, huber_px=0.4)
    state = moved(TRUTH, np.full(9, 2e-3))

    def cost(at):
        far = np.abs(depths.weights * (points.in_camera(at)[:, 2] - depths.depths))[depths.weights > 0.0]
        h = depths.huber_px
        assert 0.1 < (far > h).mean() < 0.9
        return np.sum(np.where(far > h, h * (far - 0.5 * h), 0.5 * far**2))

    found, _, gradient, _ = depths.terms(points, state)
    assert found == pytest.approx(cost(state))
    exact = PointDepths(points.in_camera(state)[:, 2], depths.weights, SIGMA_PX**2, depths.huber_px)
    hessian = exact.terms(points, state)[1]
    for k, unit in enumerate(np.eye(9)):
        slope = (cost(moved(state, 1e-7 * unit)) - cost(moved(state, -1e-7 * unit))) / 2e-7
        assert gradient[k] == pytest.approx(slope, rel=1e-4, abs=1e-3)
        # Where all depths are met the Hessian is that of the gradient.
        ahead, behind = (exact.terms(points, moved(state, sign * 1e-6 * unit))[2] for sign in (1, -1))
        np.testing.assert_allclose(hessian[k], (ahead - behind) / 2e-6, atol=1e-6 * np.abs(hessian).max())


def test_depth_helps_along_the_sight_line_and_deviations_say_how_much():
    """Repeated measurements: the spread is as stated, and less than without depth."""
    points, estimator = bound_points(MODEL, 80), Estimator(MODEL, CAMERA)
    found, stated = {True: [], False: []}, {True: [], False: []}
    for seed in range(60):
        rng = np.random.default_rng(seed)
        pixels = CAMERA.project(points.in_camera(TRUTH)) + SIGMA_PX * rng.standard_normal((80, 2))
        for with_depth in (True, False):
            depths = measured_depths(points, rng, 0.6e-3) if with_depth else None
            seen = measured(points, pixels, depths=depths)
            estimate = SequenceFilter(estimator, []).fuse(seen, estimator.fit(seen, TRUTH))
            found[with_depth].append([*estimate.state.parameters, *estimate.state.camera_from_object.translation])
            stated[with_depth].append([*estimate.parameter_std, *estimate.pose_std[3:]])
    spread = {key: np.std(values, axis=0) for key, values in found.items()}
    assert spread[True][5] < 0.6 * spread[False][5]
    assert (spread[True][:3] < 0.95 * spread[False][:3]).all()
    for key in (True, False):
        np.testing.assert_allclose(np.mean(stated[key], axis=0), spread[key], rtol=0.35)


def test_wrong_depths_do_not_take_pixels_along():
    points, rng = bound_points(MODEL, 80), np.random.default_rng(3)
    depths = measured_depths(points, rng, 1e-3)
    depths.depths[1:12] += 0.3
    pixels = CAMERA.project(points.in_camera(TRUTH))
    estimate = Estimator(MODEL, CAMERA).estimate(points, pixels, np.ones(80), TRUTH, depths=depths)
    off = np.linalg.norm(points.in_camera(estimate.state) - points.in_camera(TRUTH), axis=1)
    assert off.max() < 1.5e-3


def plane_image(normal, distance):
    """Depth (h, w) of the plane normal . x = distance."""
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = CAMERA.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
    return (distance / (rays @ normal)).reshape(CAMERA.height, CAMERA.width).astype(np.float32)


def test_depth_between_pixels_of_a_slanted_plane_with_holes_is_that_of_the_plane():
    rng, normal = np.random.default_rng(4), np.array([0.5, -0.3, 0.8])
    image = plane_image(normal, 0.6)
    image[rng.random(image.shape) < 0.2] = np.nan
    pixels = rng.uniform([10, 10], [630, 470], (50, 2))
    used = np.ones(50, dtype=bool)
    used[7] = False
    found = PointDepths.sampled(image, pixels, used, CAMERA, SIGMA_PX**2)
    exact = 0.6 / (CAMERA.rays(pixels) @ normal)
    assert found.weights[7] == 0.0
    seen = found.weights > 0.0
    assert seen.sum() > 45
    np.testing.assert_allclose(found.depths[seen], exact[seen], rtol=3e-5)
    # The weight: half the deviation at half the distance squared.
    expected = SIGMA_PX / (SIGMA_AT_1M * exact[seen] ** 2 * 3 / 5)
    np.testing.assert_allclose(found.weights[seen], expected, rtol=1e-3)


def test_jumps_holes_and_the_image_border_have_no_depth():
    image = plane_image(np.array([0.0, 0.0, 1.0]), 0.6)
    image[:, 320:] = 0.9
    image[100:110, 100:110] = np.nan
    pixels = np.array([[200.0, 200.0], [319.0, 200.0], [105.0, 105.0], [1.0, 200.0], [np.nan, 3.0]])
    found = PointDepths.sampled(image, pixels, np.ones(5, dtype=bool), CAMERA, 1.0)
    assert (found.weights > 0.0).tolist() == [True, False, False, False, False]


def test_lens_is_taken_into_account():
    """The depth image is as recorded, pixels are of the undistorted image."""
    camera = Camera(640, 480, 528.0, 528.0, 320.0, 240.0, (-0.3, 0.1, 0.0, 0.0))
    normal = np.array([0.5, -0.3, 0.8])
    rows, columns = np.mgrid[:480, :640]
    recorded = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    rays = camera.rays(camera.undistort_pixels(recorded))
    image = (0.6 / (rays @ normal)).reshape(480, 640).astype(np.float32)
    pixels = np.array([[60.0, 60.0], [580.0, 400.0]])
    found = PointDepths.sampled(image, pixels, np.ones(2, dtype=bool), camera, 1.0)
    np.testing.assert_allclose(found.depths, 0.6 / (camera.rays(pixels) @ normal), atol=1e-4)


def test_padding_adds_points_without_depth():
    depths = measured_depths(bound_points(MODEL, 10), np.random.default_rng(0)).padded(14)
    assert len(depths.depths) == 14
    assert depths.count == 8
