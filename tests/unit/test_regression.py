"""Regression against functions known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam.reduction.regression import fit_functions

LOWER, UPPER = np.array([-2.0, 0.5, 10.0]), np.array([1.0, 1.5, 40.0])


def smooth(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two functions (n, 2) of three parameters and their gradients (n, 3, 2)."""
    a, b, c = x.T
    values = np.column_stack([np.sin(a) * b, np.exp(-c / 30.0) * a**2])
    gradients = np.empty((len(x), 3, 2))
    gradients[:, :, 0] = np.column_stack([np.cos(a) * b, np.sin(a), 0.0 * c])
    gradients[:, :, 1] = np.column_stack([2.0 * a * np.exp(-c / 30.0), 0.0 * b, -np.exp(-c / 30.0) * a**2 / 30.0])
    return values, gradients


def samples(count: int, seed: int) -> np.ndarray:
    return LOWER + (UPPER - LOWER) * np.random.default_rng(seed).random((count, 3))


def test_polynomials_are_recovered_exactly() -> None:
    x = samples(60, 0)
    a, b, c = x.T
    values = (a**2 * b - 0.1 * c)[:, None]
    gradients = np.column_stack([2.0 * a * b, a**2, np.full(len(x), -0.1)])[:, :, None]
    functions, errors = fit_functions(x, values, gradients, LOWER, UPPER, 5, np.arange(60))
    assert errors[2] > 1e-3
    assert errors[3] < 1e-6
    new = samples(20, 1)
    for mu in new:
        value, gradient = functions.evaluate(mu)
        assert value == pytest.approx(mu[0] ** 2 * mu[1] - 0.1 * mu[2], abs=1e-5)
        assert gradient[:, 0] == pytest.approx([2.0 * mu[0] * mu[1], mu[0] ** 2, -0.1], abs=1e-4)


def test_smooth_functions_converge_with_the_degree() -> None:
    x = samples(150, 2)
    values, gradients = smooth(x)
    functions, errors = fit_functions(x, values, gradients, LOWER, UPPER, 8, np.arange(150))
    assert errors[8] < 1e-2 * errors[3]
    new = samples(50, 3)
    expected, slopes = smooth(new)
    for i, mu in enumerate(new):
        value, gradient = functions.evaluate(mu)
        assert value == pytest.approx(expected[i], abs=2e-4)
        assert gradient * (UPPER - LOWER)[:, None] == pytest.approx(slopes[i] * (UPPER - LOWER)[:, None], abs=5e-3)


def test_a_parameter_that_needs_it_gets_a_higher_degree_than_the_others() -> None:
    """1 / (1 + 9 s^2) is smooth but hard for polynomials; the other parameters enter with degree 1."""

    def narrow(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s = (2.0 * x[:, 0] - LOWER[0] - UPPER[0]) / (UPPER[0] - LOWER[0])
        peak = 1.0 / (1.0 + 9.0 * s**2)
        slope = -18.0 * s * peak**2 * 2.0 / (UPPER[0] - LOWER[0])
        values = peak * x[:, 1] + 0.1 * x[:, 2]
        return values[:, None], np.stack([slope * x[:, 1], peak, np.full(len(x), 0.1)], axis=1)[..., None]

    x, new = samples(200, 8), samples(50, 9)
    fits = [fit_functions(x, *narrow(x), LOWER, UPPER, 8, np.arange(200), raise_single=r)[0] for r in (0, 1)]
    assert fits[0].multi_indices.max(axis=0).max() <= 8
    degrees = fits[1].multi_indices.max(axis=0)
    assert degrees[0] >= 12
    assert degrees[1:].max() <= 8
    _, expected = narrow(new)
    missed = [
        np.linalg.norm([fit.evaluate(mu)[1] - slope for mu, slope in zip(new, expected, strict=True)]) for fit in fits
    ]
    assert missed[1] < 0.3 * missed[0]


def test_too_high_a_degree_is_not_chosen_for_noisy_values() -> None:
    """Cross-validation must notice that noise is not worth fitting."""
    rng = np.random.default_rng(4)
    x = samples(80, 5)
    values = x[:, :1] ** 2 + 0.2 * rng.normal(size=(80, 1))
    gradients = np.zeros((80, 3, 1))
    gradients[:, 0, 0] = 2.0 * x[:, 0]
    gradients += 0.5 * rng.normal(size=gradients.shape)
    functions, errors = fit_functions(x, values, gradients, LOWER, UPPER, 8, np.arange(80))
    assert functions.multi_indices.sum(axis=1).max() <= 4
    assert errors[2] < errors[max(errors)]


def test_a_weighted_sample_is_met_more_closely() -> None:
    """A parabola cannot follow the sine; where the weight is, it must."""
    x = samples(80, 4)
    x[0] = LOWER
    values, at_corner = np.sin(2.0 * x[:, :1]), np.sin(-4.0)
    missed = []
    for weight in (1.0, 1e3):
        weights = np.where(np.arange(80) == 0, weight, 1.0)
        functions, _ = fit_functions(x, values, None, LOWER, UPPER, 2, np.arange(80), weights=weights)
        missed.append(abs(functions.evaluate(LOWER)[0][0] - at_corner))
    assert missed[0] > 0.1
    assert missed[1] < 1e-4


def grid(*levels: int) -> np.ndarray:
    """All points (n, d) of a grid of the unit box."""
    axes = np.meshgrid(*(np.linspace(0.0, 1.0, count) for count in levels), indexing="ij")
    return np.stack(axes, axis=-1).reshape(-1, len(levels))


@pytest.mark.parametrize("levels", [(3, 3, 3, 3), (3, 6, 6)])
def test_between_few_levels_no_polynomial_is_taken_that_they_do_not_determine(levels: tuple[int, ...]) -> None:
    """The function is of degree 1 in each parameter: three levels determine it, and left-out samples of a grid are met
    by many others too."""
    x, d = grid(*levels), len(levels)
    x = np.random.default_rng(0).permutation(x)[: 4 * len(x) // 5]

    def function(mu: np.ndarray) -> np.ndarray:
        return np.column_stack([1.0 + mu @ np.arange(1.0, d + 1.0), mu[:, 0] * mu[:, 1] * mu[:, -1]])

    folds = np.arange(len(x))
    fit, _ = fit_functions(x, function(x), None, np.zeros(d), np.ones(d), 8, folds, raise_single=True)
    new = np.random.default_rng(1).random((100, d))
    assert np.array([fit.evaluate(mu)[0] for mu in new]) == pytest.approx(function(new), abs=1e-5)
    assert (fit.multi_indices.max(axis=0) < levels).all()


@pytest.mark.parametrize("scatter", [1e-8, 1e-4, 4e-3])
def test_levels_that_scatter_determine_no_higher_degree(scatter: float) -> None:
    """Parabolas through 0, 1/2 and 1 err by |f'''| / (72 sqrt(3)): 0.013 along the two curved parameters together."""
    x = grid(3, 3, 3, 3)
    x = np.clip(x + scatter * np.random.default_rng(0).uniform(-1.0, 1.0, x.shape), 0.0, 1.0)

    def function(mu: np.ndarray) -> np.ndarray:
        return (np.exp(0.5 * mu[:, :1]) * np.cos(mu[:, 1:2]) + mu[:, 2:3] * mu[:, 3:]) + 0.3 * mu[:, :1] ** 2

    lower, upper = x.min(axis=0), x.max(axis=0)
    fit, _ = fit_functions(x, function(x), None, lower, upper, 8, np.arange(len(x)), raise_single=True)
    new = lower + np.random.default_rng(1).random((200, 4)) * (upper - lower)
    assert np.array([fit.evaluate(mu)[0] for mu in new]) == pytest.approx(function(new), abs=0.02)


@pytest.mark.parametrize("levels", [(2, 9), (3, 9)])
def test_slopes_at_levels_determine_twice_the_degree(levels: tuple[int, int]) -> None:
    """exp(0.8 x) sin(5 y): along x, cubics through values and slopes at both ends err by 0.8^4 e^0.8 / 384 at most."""
    x, new = grid(*levels), np.random.default_rng(0).random((200, 2))

    def function(mu: np.ndarray) -> np.ndarray:
        return np.exp(0.8 * mu[:, :1]) * np.sin(5.0 * mu[:, 1:])

    slopes = np.stack([0.8 * function(x), 5.0 * np.exp(0.8 * x[:, :1]) * np.cos(5.0 * x[:, 1:])], axis=1)
    folds = np.arange(len(x))
    fit, _ = fit_functions(x, function(x), slopes, np.zeros(2), np.ones(2), 8, folds, raise_single=True)
    assert np.array([fit.evaluate(mu)[0] for mu in new]) == pytest.approx(function(new), abs=5e-3)


@pytest.mark.parametrize(("levels", "allowed"), [((3, 3, 3, 3), 1e-3), ((2, 2, 2, 2, 2, 2), 0.2)])
def test_products_that_vanish_with_their_slopes_at_all_samples_are_not_taken(
    levels: tuple[int, ...], allowed: float
) -> None:
    """(x - x^2) (y - y^2) is zero at the corners with its slopes, though of degree 2 in each; so it is of more levels.

    Hermite polynomials along each parameter err by 4e-5 with three levels, and by 1.5^4 / 384 with two.
    """
    x, new = grid(*levels), np.random.default_rng(1).random((200, len(levels)))
    direction = 1.5 * np.arange(1, len(levels) + 1) / len(levels)

    def function(mu: np.ndarray) -> np.ndarray:
        return 1.0 + np.sin(mu @ direction)[:, None]

    slopes = np.cos(x @ direction)[:, None, None] * direction[:, None]
    lower, upper = np.zeros(len(levels)), np.ones(len(levels))
    fit, _ = fit_functions(x, function(x), slopes, lower, upper, 8, np.arange(len(x)), raise_single=True)
    assert np.array([fit.evaluate(mu)[0] for mu in new]) == pytest.approx(function(new), abs=allowed)


def test_a_plane_is_the_fit_of_degree_one() -> None:
    x = samples(40, 6)
    plane = 1.0 + x @ np.array([2.0, -1.0, 0.1])
    for raise_single in (False, True):
        fit, errors = fit_functions(x, plane[:, None], None, LOWER, UPPER, 1, np.arange(40), raise_single=raise_single)
        assert list(errors) == [1]
        new = samples(10, 7)
        assert [fit.evaluate(mu)[0][0] for mu in new] == pytest.approx(1.0 + new @ np.array([2.0, -1.0, 0.1]), abs=1e-5)
