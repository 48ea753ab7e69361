"""Errors that points have in common, against sums over all pairs of points one by one."""

import numpy as np
import pytest

from morph_dslam.tracking.covariance import (
    ALIKE_SHARE,
    FACTOR_TOLERANCE,
    MOST_COMPARED,
    PAIR_SHARE,
    SharedErrors,
    gaussian_factor,
)

WINDOW = 15


def places(count: int):
    """Points on a curved surface, 300 by 200 pixels."""
    x, y = np.random.default_rng(3).uniform([[0.0], [0.0]], [[300.0], [200.0]], (2, count))
    return np.column_stack([x, y, 40.0 * np.sin(x / 90.0)])


def covariance_and_pairs(points):
    """Of each two points (p, p): how alike an error is, and whether they are compared."""
    spread = np.sqrt(np.sum(np.var(points, axis=0)))
    alike, pairs = np.zeros((2, len(points), len(points)))
    for i, one in enumerate(points):
        for j, other in enumerate(points):
            distance = np.linalg.norm(one - other)
            alike[i, j] = np.exp(-0.5 * (distance / (ALIKE_SHARE * spread)) ** 2)
            pairs[i, j] = distance < PAIR_SHARE * spread and np.abs(one - other).max() >= WINDOW
    return alike, pairs


def test_a_factor_of_few_columns_holds_the_covariance():
    points = places(400)
    factor = gaussian_factor(points, 70.0)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    assert np.abs(factor @ factor.T - np.exp(-0.5 * (apart / 70.0) ** 2)).max() < FACTOR_TOLERANCE
    assert factor.shape[1] < 60


@pytest.fixture
def case():
    """Points of which some do not count, their derivatives and weights."""
    rng, points = np.random.default_rng(5), places(90)
    used = rng.random(90) < 0.8
    jacobian = np.where(used[:, None, None], rng.standard_normal((90, 2, 4)) + 1.0, 0.0)
    scores = rng.uniform(0.5, 2.0, (90, 1, 1)) * jacobian
    return points, used, jacobian, scores


def test_what_pairs_have_in_common_is_the_mean_over_them(case):
    points, used, jacobian, _ = case
    common, (_, pairs) = SharedErrors(points, WINDOW), covariance_and_pairs(points)
    chosen = [(i, j) for i, j in np.argwhere(pairs) if used[i] and used[j]]
    assert common.n_pairs(used) == len(chosen)
    mean = sum(jacobian[i].T @ jacobian[j] for i, j in chosen) / (2 * len(chosen))
    np.testing.assert_allclose(common.in_common(jacobian, len(chosen)), mean, rtol=1e-9, atol=1e-12)


def test_the_gradient_of_an_alike_error_and_what_is_left_of_it(case):
    points, used, jacobian, scores = case
    common, (alike, pairs) = SharedErrors(points, WINDOW), covariance_and_pairs(points)
    both = np.kron(alike, np.eye(2))  # alike in the same coordinate of others
    rows, weighted = jacobian.reshape(-1, 4), scores.reshape(-1, 4)
    gradients = common.gradients(scores)
    expected = weighted.T @ both @ weighted
    np.testing.assert_allclose(gradients.T @ gradients, expected, rtol=0.02, atol=0.005 * expected.max())
    gain = np.linalg.inv(weighted.T @ rows)
    remover = np.eye(len(rows)) - rows @ gain @ weighted.T
    counted = np.kron(pairs * np.outer(used, used), np.eye(2)) > 0
    left = (remover @ both @ remover.T)[counted].mean()
    assert common.share_left(used, jacobian, gradients, gain) == pytest.approx(left, abs=0.01)


def test_of_many_points_some_tell_what_all_have_in_common():
    points = places(4 * MOST_COMPARED)
    wave = np.column_stack([np.sin(points[:, 0] / 200.0), np.cos(points[:, 1] / 150.0)])[:, :, None]
    common, used = SharedErrors(points, WINDOW), np.ones(len(points), dtype=bool)
    spread = np.sqrt(np.sum(np.var(points, axis=0)))
    apart = points[:, None] - points[None]
    pairs = np.linalg.norm(apart, axis=2) < PAIR_SHARE * spread
    pairs &= np.abs(apart).max(axis=2) >= WINDOW
    expected = np.sum((wave[:, None, :, 0] * wave[None, :, :, 0]).sum(axis=2)[pairs]) / (2 * pairs.sum())
    assert common.in_common(wave, common.n_pairs(used))[0, 0] == pytest.approx(expected, rel=0.05)
