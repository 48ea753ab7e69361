"""The reference's error by an outline or depths, against one least squares fit of all unknowns."""

import numpy as np
import pytest

from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.linearization import Linearization
from morph_dslam.tracking.reference_correction import (
    CorrectionCheck,
    PushedDepths,
    PushedTexture,
    corrected,
    of_whole_outline,
)

N_POINTS, N_OUTLINE, N_UNKNOWNS, N_FACTORS = 12, 30, 5, 4
SQUARED_PX, WEIGHT, COMMON_PX = 0.04, 0.3, 0.7
#: What was found before, and normal equations of an outline without points.
NOT_YET, NO_OUTLINE = np.zeros(N_FACTORS + 3), (np.zeros((N_UNKNOWNS, 3)), np.zeros((3, 3)), np.zeros(3))
#: Of the points whose fits are checked: how many, their deviation, pixels, and what the correction moves them by.
N_CHECKED, NOISE_PX, SHIFT_PX = 60, 0.2, 0.4


@pytest.fixture(scope="module")
def frame():
    """Derivatives of points and of an outline by the unknowns, the outline's normals, and residuals of both."""
    rng = np.random.default_rng(0)
    angles = rng.uniform(0.0, 2.0 * np.pi, N_OUTLINE)
    return (
        rng.standard_normal((N_POINTS, 2, N_UNKNOWNS)),
        rng.standard_normal((N_UNKNOWNS, N_FACTORS)),
        rng.standard_normal((N_OUTLINE, N_UNKNOWNS)),
        np.column_stack([np.cos(angles), np.sin(angles)]),
        rng.standard_normal((N_POINTS, 2)),
        rng.standard_normal(N_OUTLINE),
    )


def correction(frame, with_outline=None, before=None):
    """As `corrected` finds it; again, where the points have been corrected by what it found ``before``."""
    jacobian, transfer, across, normals, residuals, off = frame
    residuals = residuals if before is None else residuals + before.shift
    points = Linearization.of(jacobian, residuals, np.ones(N_POINTS), 1e3)
    weights = np.full(N_OUTLINE, WEIGHT)
    flat = jacobian.reshape(-1, N_UNKNOWNS)
    hessian = flat.T @ flat + WEIGHT * across.T @ across
    gradient = flat.T @ residuals.ravel() + WEIGHT * across.T @ off
    whole = of_whole_outline(across, off, weights, normals, COMMON_PX)
    texture, causes = PushedTexture(points, transfer, None, with_outline), NOT_YET if before is None else before.causes
    return corrected(texture, (hessian, gradient), whole, SQUARED_PX, np.ones(N_UNKNOWNS), causes)


def design(frame, with_outline=None):
    """Rows of one fit of state, error factors and errors of the whole outline, in deviations of a number.

    ``with_outline`` : (N_FACTORS, 3) covariance of the factors and the errors of the outline; None for none.
    """
    jacobian, transfer, across, normals, residuals, off = frame
    flat, sigma = jacobian.reshape(-1, N_UNKNOWNS), np.sqrt(SQUARED_PX)
    common = np.column_stack([np.ones(N_OUTLINE), normals])
    nothing = np.zeros
    known = np.eye(N_FACTORS + 3)
    if with_outline is not None:
        known[:N_FACTORS, N_FACTORS:], known[N_FACTORS:, :N_FACTORS] = with_outline, with_outline.T
    rows = np.block(
        [
            [flat, flat @ transfer, nothing((2 * N_POINTS, 3))],
            [np.sqrt(WEIGHT) * across, nothing((N_OUTLINE, N_FACTORS)), np.sqrt(WEIGHT) * COMMON_PX * common],
            [nothing((N_FACTORS + 3, N_UNKNOWNS)), sigma * np.linalg.cholesky(np.linalg.inv(known)).T],
        ]
    )
    return rows, np.concatenate([residuals.ravel(), np.sqrt(WEIGHT) * off, np.zeros(N_FACTORS + 3)])


def test_it_is_that_of_one_fit_of_all_unknowns(frame):
    found, (rows, left) = correction(frame), design(frame)
    together = np.linalg.lstsq(rows, -left)[0]
    of_factors = slice(N_UNKNOWNS, N_UNKNOWNS + N_FACTORS)
    np.testing.assert_allclose(found.found, together[of_factors], rtol=1e-8)
    covariance = SQUARED_PX * np.linalg.inv(rows.T @ rows)[of_factors, of_factors]
    np.testing.assert_allclose(found.left @ found.left, covariance, rtol=1e-8)
    moves = np.einsum("pkn,n->pk", frame[0], frame[1] @ together[of_factors])
    np.testing.assert_allclose(found.shift, moves, rtol=1e-8)


def test_an_outline_does_not_make_good_what_it_has_put_into_the_reference_itself(frame):
    """Against one fit that knows how both go together; and again from there, which changes nothing."""
    with_outline = np.random.default_rng(8).standard_normal((N_FACTORS, 3))
    with_outline *= 0.8 / np.linalg.norm(with_outline, 2)
    found, (rows, left) = correction(frame, with_outline), design(frame, with_outline)
    together, covariance = np.linalg.lstsq(rows, -left)[0], SQUARED_PX * np.linalg.inv(rows.T @ rows)
    of_factors, of_outline = slice(N_UNKNOWNS, N_UNKNOWNS + N_FACTORS), slice(N_UNKNOWNS + N_FACTORS, None)
    for each in (found, correction(frame, with_outline, found)):
        np.testing.assert_allclose(each.found, together[of_factors], rtol=1e-8)
        np.testing.assert_allclose(each.left @ each.left, covariance[of_factors, of_factors], rtol=1e-8)
        np.testing.assert_allclose(each.left @ each.with_outline, covariance[of_factors, of_outline], rtol=1e-8)


def test_what_the_points_still_tell_is_what_is_left_beside_unknown_error_factors(frame):
    found = correction(frame)
    jacobian = frame[0].reshape(-1, N_UNKNOWNS)
    by_factors = jacobian @ frame[1]
    covariance = np.eye(2 * N_POINTS) + by_factors @ by_factors.T / SQUARED_PX
    told = jacobian.T @ np.linalg.solve(covariance, jacobian)
    np.testing.assert_allclose(jacobian.T @ jacobian - found.information_lost, told, rtol=1e-8, atol=1e-10)


def test_depths_tell_of_it_what_one_fit_of_all_unknowns_does(frame):
    """An error factor moves their residuals by what it has the depths too large, in pixels by the depths' weight."""
    jacobian, transfer, _, _, residuals, _ = frame
    rng, flat = np.random.default_rng(6), jacobian.reshape(-1, N_UNKNOWNS)
    slopes, off = rng.standard_normal((N_POINTS, N_UNKNOWNS)), rng.standard_normal(N_POINTS)
    metres, per_metre = 1e-3 * rng.standard_normal((N_POINTS, N_FACTORS)), 400.0
    depths = PushedDepths(off, slopes, per_metre * metres, metres)
    points = Linearization.of(jacobian, residuals, np.ones(N_POINTS), 1e3)
    whole = flat.T @ flat + slopes.T @ slopes, flat.T @ residuals.ravel() + slopes.T @ off
    texture = PushedTexture(points, transfer, depths)
    found = corrected(texture, whole, NO_OUTLINE, SQUARED_PX, np.ones(N_UNKNOWNS), NOT_YET)
    known = np.sqrt(SQUARED_PX) * np.eye(N_FACTORS)
    rows = np.block([[flat, flat @ transfer], [slopes, per_metre * metres], [np.zeros((N_FACTORS, N_UNKNOWNS)), known]])
    together = np.linalg.lstsq(rows, -np.concatenate([residuals.ravel(), off, np.zeros(N_FACTORS)]))[0]
    np.testing.assert_allclose(found.found, together[N_UNKNOWNS:], rtol=1e-8)
    covariance = SQUARED_PX * np.linalg.inv(rows.T @ rows)[N_UNKNOWNS:, N_UNKNOWNS:]
    np.testing.assert_allclose(found.left @ found.left, covariance, rtol=1e-8)
    # The points of an outline, which come after the texture's, have no depths.
    measured = PointDepths(np.full(N_POINTS + 3, 0.5), np.full(N_POINTS + 3, per_metre), SQUARED_PX, 1.0)
    shifted = found.of_depths(measured).depths - 0.5
    np.testing.assert_allclose(shifted, np.append(-metres @ together[N_UNKNOWNS:], np.zeros(3)), atol=1e-12)


def test_without_an_outline_the_registration_stays_as_it_is(frame):
    """At the minimum of the points' own cost, where the outline has no points."""
    jacobian, transfer, *_ = frame
    flat = jacobian.reshape(-1, N_UNKNOWNS)
    noise = np.random.default_rng(1).standard_normal(2 * N_POINTS)
    residuals = (noise - flat @ np.linalg.lstsq(flat, noise)[0]).reshape(-1, 2)
    points = Linearization.of(jacobian, residuals, np.ones(N_POINTS), 1e3)
    whole = flat.T @ flat, np.zeros(N_UNKNOWNS)
    found = corrected(PushedTexture(points, transfer), whole, NO_OUTLINE, 1.0, np.ones(N_UNKNOWNS), NOT_YET)
    np.testing.assert_allclose(found.found, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.left, np.eye(N_FACTORS), atol=1e-10)


def checked(check, rng, pull_px=0.0, frames=1, found=0.0):
    """Let a check see frames whose points an outline draws along, from where they fit, by so much and by their noise.

    The points are fitted by themselves, and then again with the state off by a draw of its own covariance. The error
    factors that make it good are ``found`` deviations from what was stated.
    """
    for _ in range(frames):
        jacobian = rng.standard_normal((2 * N_CHECKED, N_UNKNOWNS))
        noise = NOISE_PX * rng.standard_normal(2 * N_CHECKED)
        alone = noise - jacobian @ np.linalg.lstsq(jacobian, noise)[0]
        covariance = NOISE_PX**2 * np.linalg.inv(jacobian.T @ jacobian)
        pulled = jacobian @ rng.standard_normal(N_UNKNOWNS)
        pulled *= pull_px / np.sqrt(np.mean(pulled**2))
        beside = alone + pulled + jacobian @ rng.multivariate_normal(np.zeros(N_UNKNOWNS), covariance)
        shift = np.full((N_CHECKED, 2), SHIFT_PX)
        factors = found * np.ones(N_FACTORS) / np.sqrt(N_FACTORS)
        residuals = alone.reshape(-1, 2), beside.reshape(-1, 2)
        check.learn(*residuals, shift, np.ones(N_CHECKED), 1.0, N_UNKNOWNS, factors)
    return check.is_refuted


def test_noise_does_not_refute_a_correction():
    """A draw as far off as four deviations comes in one first frame of 16000."""
    rng = np.random.default_rng(2)
    assert not any(checked(CorrectionCheck(), rng) for _ in range(1000))


def test_what_a_correction_to_first_order_lacks_does_not_refute_it():
    rng = np.random.default_rng(3)
    assert not any(checked(CorrectionCheck(), rng, 0.05 * SHIFT_PX) for _ in range(1000))


def test_points_that_are_drawn_from_where_they_fit_refute_it():
    """By as much as their noise: the registration's error would have left them where they fit."""
    rng = np.random.default_rng(4)
    assert all(checked(CorrectionCheck(), rng, NOISE_PX) for _ in range(100))


def test_an_error_that_the_registration_does_not_have_refutes_it():
    """Four factors together are more than five deviations off in one registration of 20000."""
    rng = np.random.default_rng(7)
    assert not any(checked(CorrectionCheck(), rng, found=4.0) for _ in range(100))
    assert all(checked(CorrectionCheck(), rng, found=5.5) for _ in range(100))


def test_a_frame_can_do_without_a_correction_that_the_registration_does_not_allow():
    """Before the frames have refuted it for good."""
    residuals, weights = np.full((N_CHECKED, 2), NOISE_PX), np.ones(N_CHECKED)
    check, asked = CorrectionCheck(), (residuals, residuals, 0.0 * residuals, weights, 1.0, N_UNKNOWNS)
    assert all(check.learn(*asked, np.array(own)) for own in ([1.0, -1.0, 0.5, 0.0], [2.0, 0.0, 0.0, -2.0]))
    assert not check.learn(*asked, np.array([0.0, 6.0, 0.0, 0.0]))
    assert not check.is_refuted


def test_clutter_that_passes_does_not_refute_it_and_what_stays_does():
    rng, check = np.random.default_rng(5), CorrectionCheck()
    assert not checked(check, rng, frames=6)
    assert not checked(check, rng, 1.0, frames=3)
    assert not checked(check, rng, frames=2)
    assert not checked(check, rng, 1.0, frames=5)
    assert checked(check, rng, 1.0)
    assert checked(check, rng, frames=20), "given up for good"
