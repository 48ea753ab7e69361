"""How the scale of all depths enters a frame: against estimates from depths that are all too large by a factor."""

from dataclasses import replace

import numpy as np

from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.depth_scale import CommonDepthScale
from morph_dslam.tracking.estimator import EstimationOptions, Estimator, Prior
from morph_dslam.tracking.state import pose_increment
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import CAMERA, sheet_state

MODEL = bent_sheet_model(22, 16)
TRUTH = sheet_state(0.3)
ESTIMATOR = Estimator(MODEL, CAMERA, EstimationOptions(max_iterations=60, tolerance=1e-10))
#: Pixels per metre, which the depths weigh, and a scale whose effect is linear.
WEIGHT, SCALE = 200.0, 1e-3


def estimated(points, depths, prior=None):
    """By exact pixels and these depths."""
    pixels = CAMERA.project(points.in_camera(TRUTH))
    return ESTIMATOR.estimate(points, pixels, np.ones(len(points)), TRUTH, prior=prior, depths=depths)


def increment(before, after):
    turned = pose_increment(before.state.camera_from_object, after.state.camera_from_object)
    return np.concatenate([after.state.parameters - before.state.parameters, turned])


def measured(points):
    """Points with depths that are right."""
    return PointDepths(points.in_camera(TRUTH)[:, 2], np.full(len(points), WEIGHT), 1.0, 1e6)


def pushed(scale, points, found, past, depths, prior=None):
    """By the linear theory: how the estimate moves for one deviation of the scale."""
    push = scale.push(points, found.state, past, depths)
    pixels = CAMERA.project(points.in_camera(TRUTH))
    hessian = ESTIMATOR.evaluate(points, pixels, np.ones(len(points)), found.state, None, prior, depths)[1]
    return np.linalg.solve(hessian, push)


def test_an_estimate_moves_with_the_scale_of_the_depths():
    points = bound_points(MODEL, 60, np.random.default_rng(0))
    depths, nothing = measured(points), np.zeros((len(ESTIMATOR.scale),) * 2)
    right, wrong = estimated(points, depths), estimated(points, depths.scaled(1.0 + SCALE))
    by_theory = pushed(CommonDepthScale(SCALE, ESTIMATOR.scale), points, right, nothing, depths)
    np.testing.assert_allclose(by_theory / ESTIMATOR.scale, increment(right, wrong) / ESTIMATOR.scale, atol=2e-5)
    assert np.abs(increment(right, wrong)[-1]) > 0.1 * SCALE * TRUTH.camera_from_object.translation[2]


def test_it_does_not_average_out_over_frames():
    """A frame that rests on one before: the scale has moved what is known from there too, by as much as it did."""
    points = bound_points(MODEL, 60, np.random.default_rng(0))
    depths, nothing = measured(points), np.zeros((len(ESTIMATOR.scale),) * 2)
    scale, d = CommonDepthScale(SCALE, ESTIMATOR.scale), len(MODEL.parameters)
    before, moved = estimated(points, depths), estimated(points, depths.scaled(1.0 + SCALE))
    scale.keep(pushed(scale, points, before, nothing, depths))
    past = nothing.copy()
    past[:d, :d] = np.diag(1e4 / ESTIMATOR.scale[:d] ** 2)
    known = Prior(before.state.parameters, past[:d, :d])
    right = estimated(points, depths, known)
    wrong = estimated(points, depths.scaled(1.0 + SCALE), replace(known, mean=moved.state.parameters))
    by_theory = pushed(scale, points, right, past, depths, known)
    np.testing.assert_allclose(by_theory / ESTIMATOR.scale, increment(right, wrong) / ESTIMATOR.scale, atol=2e-5)


def test_where_the_reference_has_it_already_it_counts_once():
    points = bound_points(MODEL, 10, np.random.default_rng(0))
    nothing = np.zeros((len(ESTIMATOR.scale),) * 2)
    push = CommonDepthScale(0.0, ESTIMATOR.scale).push(points, TRUTH, nothing, measured(points))
    assert not push.any()
