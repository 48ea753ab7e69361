"""How the scale of all depths enters a frame: against estimates from depths that are all too large by a factor."""

from dataclasses import replace

import numpy as np

from morph_dslam.tracking.binding import bind_pixels, view_of
from morph_dslam.tracking.covariance import BoundPart
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.depth_scale import CommonDepthScale
from morph_dslam.tracking.estimator import BoundPoints, EstimationOptions, Estimator, Prior
from morph_dslam.tracking.state import moved, pose_increment
from morph_dslam.tracking.systematic_errors import SystematicErrors
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import CAMERA, sheet_state

MODEL = bent_sheet_model(22, 16)
REFERENCE, TRUTH = sheet_state(0.1), sheet_state(0.3)
ESTIMATOR = Estimator(MODEL, CAMERA, EstimationOptions(huber_px=50.0, max_iterations=60, tolerance=1e-10))
#: Pixels per metre, which the depths weigh, and a scale whose effect is linear.
WEIGHT, SCALE, WINDOW = 200.0, 1e-3, 17


def estimated(points, true_points, factor=1.0, prior=None):
    """By exact pixels, and depths that are so many times as large; and with nothing known of its errors."""
    depths = PointDepths(factor * true_points.in_camera(TRUTH)[:, 2], np.full(len(points), WEIGHT), 1.0, 1e6)
    pixels = CAMERA.project(true_points.in_camera(TRUTH))
    found = ESTIMATOR.estimate(points, pixels, np.ones(len(points)), TRUTH, prior=prior, depths=depths)
    return replace(found, covariance=np.zeros_like(found.covariance)), depths


def increment(before, after):
    turned = pose_increment(before.camera_from_object, after.camera_from_object)
    return np.concatenate([after.parameters - before.parameters, turned]) / ESTIMATOR.scale


def stated(errors, found, depths, **options):
    """Deviations (d + 6,) in units of the unknowns' scale."""
    added = errors.added(found, np.ones(depths.count), 0.0, learns=False, depths=depths, **options)
    return np.sqrt(np.diag(added.covariance)) / ESTIMATOR.scale


def errors_of(points, factors, scale, state=REFERENCE):
    return SystematicErrors(ESTIMATOR, points, [BoundPart(slice(None), state, factors)], WINDOW, scale=scale)


def test_an_estimate_moves_with_the_scale_of_the_depths():
    points = bound_points(MODEL, 60, np.random.default_rng(0))
    (right, depths), (wrong, _) = estimated(points, points), estimated(points, points, 1.0 + SCALE)
    for factors in (None, np.zeros((9, 9))):
        errors = errors_of(points, factors, CommonDepthScale(SCALE))
        off = np.abs(increment(right.state, wrong.state))
        np.testing.assert_allclose(stated(errors, right, depths), off, atol=2e-5)
    assert off[-1] * ESTIMATOR.scale[-1] > 0.1 * SCALE * TRUTH.camera_from_object.translation[2]


def test_it_does_not_average_out_over_frames():
    """A frame that rests on one before: the scale has moved what is known from there too, by as much as it did."""
    points, d = bound_points(MODEL, 60, np.random.default_rng(0)), len(MODEL.parameters)
    errors = errors_of(points, None, CommonDepthScale(SCALE))
    (before, depths), (off, _) = estimated(points, points), estimated(points, points, 1.0 + SCALE)
    stated(errors, before, depths)
    past = np.zeros((d + 6, d + 6))
    past[:d, :d] = np.diag(1e4 / ESTIMATOR.scale[:d] ** 2)
    known = Prior(before.state.parameters, past[:d, :d])
    right, _ = estimated(points, points, prior=known)
    wrong, _ = estimated(points, points, 1.0 + SCALE, replace(known, mean=off.state.parameters))
    by_theory = stated(errors, right, depths, past_information=past)
    np.testing.assert_allclose(by_theory, np.abs(increment(right.state, wrong.state)), atol=2e-5)


def found_too_far_away(rng):
    """A state that depths have too far away in one frame, and how another frame has the object by points bound in it.

    Returns
    -------
    That state, its error factors, of which other causes' are a thousandth as large; the points, the other frame's
    estimate and its depths.
    """
    true_points = bound_points(MODEL, 150, rng)
    seen, step = CAMERA.project(true_points.in_camera(REFERENCE)), np.zeros(9)
    step[8] = SCALE * true_points.in_camera(REFERENCE)[:, 2].mean()
    taken = moved(REFERENCE, step)
    surface, met = bind_pixels(MODEL, CAMERA, view_of(MODEL, CAMERA, taken), seen)
    true_points, points = true_points.take(np.flatnonzero(met)), BoundPoints.from_surface(MODEL, surface)
    factors = np.column_stack([step, 1e-3 * step[8] * np.eye(9)[:, :8]])
    return taken, factors, points, *estimated(points, true_points, 1.0 + SCALE)


def test_a_reference_found_by_depths_is_as_far_off_as_these_and_they_do_not_hold_it_against_that():
    """Depths by which the registration is a little too far away have the object there in all frames."""
    taken, factors, points, found, depths = found_too_far_away(np.random.default_rng(1))
    off = np.abs(increment(TRUTH, found.state))
    assert off[-1] * ESTIMATOR.scale[-1] > 0.8 * factors[8, 0]
    by_theory = stated(errors_of(points, factors, CommonDepthScale(SCALE, True), taken), found, depths)
    np.testing.assert_allclose(by_theory, off, atol=0.1 * off.max())
    # As if its distance were known by something else, depths would seem to hold it.
    assert stated(errors_of(points, factors, None, taken), found, depths)[-1] < 0.6 * off[-1]


def test_a_state_that_frames_with_depths_found_is_off_with_their_scale_and_goes_on_being_so():
    """As a view made from a frame is: of its error, the covariance with the scale is known, not only its own."""
    taken, factors, points, found, depths = found_too_far_away(np.random.default_rng(1))
    off = increment(TRUTH, found.state)
    errors = errors_of(points, factors, CommonDepthScale(SCALE, with_state=SCALE * factors[:, 0]), taken)
    np.testing.assert_allclose(stated(errors, found, depths), np.abs(off), atol=0.1 * np.abs(off).max())
    # And a view that is made from this frame in turn gets the same of this state.
    with_scale = errors.with_scale / (SCALE * ESTIMATOR.scale)
    np.testing.assert_allclose(with_scale, off, atol=0.1 * np.abs(off).max())
    assert not errors.told_by_depths
    # As if the scale had no part in that state, it would seem known by both.
    apart = errors_of(points, factors, CommonDepthScale(SCALE, with_state=np.zeros(9)), taken)
    assert stated(apart, found, depths)[-1] < 0.8 * np.abs(off[-1])


def test_the_part_of_the_scale_that_a_state_does_not_share_comes_beside_it():
    """Half of the scale's variance is the state's error, the other half is independent: both move the estimate."""
    taken, factors, points, found, depths = found_too_far_away(np.random.default_rng(1))
    half = np.sqrt(0.5)
    whole, together, alone = (
        stated(errors_of(points, columns, scale, taken), found, depths) ** 2
        for columns, scale in [
            (factors, CommonDepthScale(SCALE, with_state=half * SCALE * factors[:, 0])),
            (factors, CommonDepthScale(half * SCALE, with_state=half * SCALE * factors[:, 0])),
            (np.zeros((9, 9)), CommonDepthScale(half * SCALE)),
        ]
    )
    np.testing.assert_allclose(whole, together + alone, rtol=1e-6)
