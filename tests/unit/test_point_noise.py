"""Weights of points by how exactly each is measured, against residuals drawn with known variances."""

import numpy as np
import pytest

from morph_dslam.tracking.covariance import LEAST_SPREAD_PX, huber_covariance
from morph_dslam.tracking.noise import LARGEST_POWER, Observations, PixelNoise, PointNoise


def learnt(factor, common_px, frames=60, count=300, seed=0):
    """Spreads (count,) and noise learnt from residuals of variance factor * spread² + common_px²."""
    rng, noise = np.random.default_rng(seed), PointNoise()
    spread = np.exp(rng.uniform(np.log(0.02), np.log(0.3), count))
    deviation = np.sqrt(factor * spread**2 + common_px**2)
    for _ in range(frames):
        residuals = deviation[:, None] * rng.standard_normal((count, 2))
        noise.learn(spread, residuals, np.ones(count, dtype=bool))
    return spread, deviation, noise


@pytest.mark.parametrize(("factor", "common_px"), [(3.0, 0.1), (1.0, 0.05), (3.0, 0.2)])
def test_weights_are_inverse_variances(factor, common_px):
    spread, deviation, noise = learnt(factor, common_px)
    weights = noise.weights(spread, np.ones(len(spread), dtype=bool))
    assert np.median(weights) == pytest.approx(1.0, rel=0.02)
    ratio = weights * deviation**2
    assert ratio.max() / ratio.min() < 1.6
    assert weights.max() / weights.min() > 1.6


def test_points_count_alike_where_patches_do_not_tell():
    """Before anything was learnt, and where what the model leaves is much larger than what patches tell."""
    used = np.arange(300) % 3 > 0
    np.testing.assert_array_equal(PointNoise().weights(np.full(300, 0.1), used), used.astype(float))
    spread, _, noise = learnt(1.0, 2.0)
    weights = noise.weights(spread, used)
    assert weights[used].min() > 0.8 * weights[used].max()
    np.testing.assert_array_equal(weights[~used], 0.0)


def test_what_the_model_leaves_is_no_noise_of_the_patches():
    """Residuals a hundred times as large as the patches explain: they may grow with the spread by chance."""
    spread, _, noise = learnt(100.0**2, 0.5)
    weights = noise.weights(spread, np.ones(300, dtype=bool))
    assert weights.min() > 0.9 * weights.max()


def test_nothing_is_taken_to_be_exact():
    _, _, noise = learnt(3.0, 0.0)
    assert noise.common >= LEAST_SPREAD_PX**2
    weights = noise.weights(np.array([1e-6, 0.02]), np.ones(2, dtype=bool))
    assert weights.max() / weights.min() <= 5.5


def test_the_reference_picture_itself_tells_nothing_of_noise():
    """It agrees with itself to rounding: the frames after it are weighed as if it had not been."""
    _, _, alone = learnt(3.0, 0.1)
    rng, noise = np.random.default_rng(0), PointNoise()
    spread = np.exp(rng.uniform(np.log(0.02), np.log(0.3), 300))
    noise.learn(1e-3 * spread, 1e-6 * rng.standard_normal((300, 2)), np.ones(300, dtype=bool))
    np.testing.assert_array_equal(noise.weights(spread, np.ones(300, dtype=bool)), np.ones(300))
    deviation = np.sqrt(3.0 * spread**2 + 0.1**2)
    for _ in range(60):
        noise.learn(spread, deviation[:, None] * rng.standard_normal((300, 2)), np.ones(300, dtype=bool))
    assert noise.common == pytest.approx(alone.common, rel=0.3)


def test_residuals_of_nothing_do_not_make_an_estimate_exact():
    """A line through 50 points: the covariance is that of points off by a hundredth of a pixel."""
    x = np.linspace(-1.0, 1.0, 50)
    jacobian = np.stack([np.ones(50), x], axis=1)
    sigma, covariance = huber_covariance(
        jacobian.T @ jacobian, np.zeros((50, 2)), np.ones(50), np.full(50, 2), 3.0, np.ones(2)
    )
    assert sigma == 0.01
    np.testing.assert_allclose(covariance, np.diag([1.0 / 50.0, 1.0 / np.sum(x**2)]) * 1e-4, rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize("unseen", [[], [4], [0, 7]])
def test_what_points_do_not_see_leaves_the_covariance_of_all_else(unseen):
    """Ten unknowns of sizes a thousand apart: NumPy's inverse of those that are seen."""
    rng = np.random.default_rng(7)
    jacobian, seen = rng.standard_normal((400, 10)) * np.logspace(-1.5, 1.5, 10), np.ones(10, dtype=bool)
    jacobian[:, unseen], seen[unseen] = 0.0, False
    residuals, hessian = rng.standard_normal((200, 2)), jacobian.T @ jacobian
    _, covariance = huber_covariance(hessian, residuals, np.ones(200), np.full(200, 2), 1e3, np.ones(10))
    variance, among = np.sum(residuals**2) / (400 - 10), np.ix_(seen, seen)
    np.testing.assert_allclose(covariance[among], variance * np.linalg.inv(hessian[among]), rtol=1e-9, atol=1e-15)
    assert (np.diag(covariance)[~seen] > 1e5 * np.diag(covariance)[seen].max()).all()


@pytest.mark.parametrize("power", [1.15, 1.35])
def test_points_that_err_by_more_than_in_proportion_count_for_less(power):
    rng, noise = np.random.default_rng(1), PointNoise()
    spread = np.exp(rng.uniform(np.log(0.03), np.log(0.3), 400))
    deviation, used = 1.2 * spread**power / 0.05 ** (power - 1.0), np.ones(400, dtype=bool)
    for _ in range(80):
        noise.learn(spread, deviation[:, None] * rng.standard_normal((400, 2)), used)
    assert noise.power == pytest.approx(power, abs=0.05)
    ratio = noise.weights(spread, used) * deviation**2
    assert ratio.max() / ratio.min() < 1.5


def test_power_is_one_where_the_model_leaves_something():
    assert learnt(3.0, 0.1)[2].power == 1.0


def test_residuals_of_nothing_give_no_larger_power_than_any():
    spread, noise = np.linspace(0.02, 0.3, 300), PointNoise()
    residuals = np.where(spread[:, None] > 0.16, [0.1, 0.1], 0.0)
    noise.learn(spread, residuals, np.ones(300, dtype=bool))
    assert noise.power == LARGEST_POWER


def test_few_or_equal_points_teach_nothing():
    noise, few = PointNoise(), np.arange(300) < 10
    spread = np.linspace(0.02, 0.3, 300)
    noise.learn(spread, np.ones((300, 2)), few)
    noise.learn(np.full(300, 0.1), np.ones((300, 2)), np.ones(300, dtype=bool))
    assert np.isinf(noise.common)


@pytest.mark.parametrize("lasting", [1.0, 0.5])
@pytest.mark.parametrize("of_outline", [False, True])
def test_what_stays_with_points_is_told_from_what_is_new(of_outline, lasting):
    """Of errors of variance one; a point of an outline, which is off across it alone, gives one number."""
    rng, count, found = np.random.default_rng(6), 160, []
    around = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    normals = np.column_stack([np.cos(around), np.sin(around)]) * of_outline
    points = None  # whose they are does not matter
    seen = Observations(points, np.zeros((count, 2)), np.ones(count), normals, np.eye(count))  # type: ignore[arg-type]
    for _ in range(10):
        stays, noise = rng.standard_normal((count, 2)), PixelNoise(memory=600.0)
        for _ in range(100):
            errors = np.sqrt(lasting) * stays + np.sqrt(1.0 - lasting) * rng.standard_normal((count, 2))
            if of_outline:
                errors = np.sum(errors * normals, axis=1)[:, None] * normals
            noise.add(errors, seen, taken=0.0)
        found.append([noise.common, noise.frame])
    np.testing.assert_allclose(np.mean(found, axis=0), [lasting, 1.0 - lasting], atol=0.12)
