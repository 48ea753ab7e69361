"""The reference's error by an outline, against one least squares fit of all unknowns."""

import numpy as np
import pytest

from morph_dslam.tracking.linearization import Linearization
from morph_dslam.tracking.reference_correction import COMMON_PX, PushedTexture, corrected, of_common_errors

N_POINTS, N_OUTLINE, N_UNKNOWNS, N_FACTORS = 12, 30, 5, 4
SQUARED_PX, WEIGHT = 0.04, 0.3


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


def correction(frame, factor=1.0):
    jacobian, transfer, across, normals, residuals, off = frame
    points = Linearization.of(jacobian, residuals, np.ones(N_POINTS), 1e3)
    weights = np.full(N_OUTLINE, WEIGHT)
    flat = jacobian.reshape(-1, N_UNKNOWNS)
    hessian = flat.T @ flat + WEIGHT * across.T @ across
    gradient = flat.T @ residuals.ravel() + WEIGHT * across.T @ off
    common = of_common_errors(across, off, weights, normals, SQUARED_PX)
    whole = hessian - common[0], gradient - common[1]
    texture = PushedTexture(points, transfer, factor)
    return corrected(texture, whole, SQUARED_PX, np.ones(N_UNKNOWNS), np.zeros(N_FACTORS))


def design(frame, factor=1.0):
    """Rows of one fit of state, error factors and errors of the whole outline, in deviations of a number."""
    jacobian, transfer, across, normals, residuals, off = frame
    flat, sigma = jacobian.reshape(-1, N_UNKNOWNS), np.sqrt(SQUARED_PX)
    common = np.column_stack([np.ones(N_OUTLINE), normals])
    nothing = np.zeros
    rows = np.block(
        [
            [flat, flat @ transfer, nothing((2 * N_POINTS, 3))],
            [np.sqrt(WEIGHT) * across, nothing((N_OUTLINE, N_FACTORS)), np.sqrt(WEIGHT) * common],
            [nothing((N_FACTORS, N_UNKNOWNS)), sigma / np.sqrt(factor) * np.eye(N_FACTORS), nothing((N_FACTORS, 3))],
            [nothing((3, N_UNKNOWNS + N_FACTORS)), sigma / COMMON_PX * np.eye(3)],
        ]
    )
    return rows, np.concatenate([residuals.ravel(), np.sqrt(WEIGHT) * off, np.zeros(N_FACTORS + 3)])


@pytest.mark.parametrize("factor", [1.0, 6.0])
def test_it_is_that_of_one_fit_of_all_unknowns(frame, factor):
    found, (rows, left) = correction(frame, factor), design(frame, factor)
    together = np.linalg.lstsq(rows, -left)[0]
    of_factors = slice(N_UNKNOWNS, N_UNKNOWNS + N_FACTORS)
    np.testing.assert_allclose(found.found, together[of_factors], rtol=1e-8)
    covariance = SQUARED_PX * np.linalg.inv(rows.T @ rows)[of_factors, of_factors]
    np.testing.assert_allclose(factor * found.left @ found.left, covariance, rtol=1e-8)
    moves = np.einsum("pkn,n->pk", frame[0], frame[1] @ together[of_factors])
    np.testing.assert_allclose(found.shift, moves, rtol=1e-8)


def test_what_the_points_still_tell_is_what_is_left_beside_unknown_error_factors(frame):
    found = correction(frame)
    jacobian = frame[0].reshape(-1, N_UNKNOWNS)
    by_factors = jacobian @ frame[1]
    covariance = np.eye(2 * N_POINTS) + by_factors @ by_factors.T / SQUARED_PX
    told = jacobian.T @ np.linalg.solve(covariance, jacobian)
    np.testing.assert_allclose(jacobian.T @ jacobian - found.untold, told, rtol=1e-8, atol=1e-10)


def test_without_an_outline_the_registration_stays_as_it_is(frame):
    """At the minimum of the points' own cost, where the outline has no points."""
    jacobian, transfer, *_ = frame
    flat = jacobian.reshape(-1, N_UNKNOWNS)
    noise = np.random.default_rng(1).standard_normal(2 * N_POINTS)
    residuals = (noise - flat @ np.linalg.lstsq(flat, noise)[0]).reshape(-1, 2)
    points = Linearization.of(jacobian, residuals, np.ones(N_POINTS), 1e3)
    whole = flat.T @ flat, np.zeros(N_UNKNOWNS)
    found = corrected(PushedTexture(points, transfer, 1.0), whole, 1.0, np.ones(N_UNKNOWNS), np.zeros(N_FACTORS))
    np.testing.assert_allclose(found.found, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.left, np.eye(N_FACTORS), atol=1e-10)
