"""Separation of vectors that are known sums of products."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.model import Parameter
from morph_dslam.reduction.separation import separate

SPACE = np.linspace(0.0, 1.0, 200)
PARTS = np.random.default_rng(0).standard_normal((4, 50))


def ranges(**ends: tuple[float, float]) -> tuple[Parameter, ...]:
    return tuple(Parameter(name, "ratio", "1", *pair, pair[0]) for name, pair in ends.items())


def stiffness(mu: np.ndarray) -> np.ndarray:
    """Two Young's moduli (Pa) and a common Poisson's ratio, as in Hooke's law."""
    first, second, nu = mu
    shear, lame = 0.5 / (1.0 + nu), nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    return first * (shear * PARTS[0] + lame * PARTS[1]) + second * (shear * PARTS[2] + lame * PARTS[3])


def moving_load(mu: np.ndarray) -> np.ndarray:
    """A force, and where its Gaussian patch is."""
    return mu[0] * np.exp(-((SPACE - mu[1]) ** 2) / (2.0 * 0.05**2))


@pytest.mark.parametrize(
    ("function", "parameters", "most_terms"),
    [
        (stiffness, ranges(first=(1e6, 5e6), second=(1e3, 9e6), nu=(0.1, 0.45)), 6),
        (moving_load, ranges(force=(-5.0, 8.0), place=(0.2, 0.9)), 50),
        (lambda mu: 0.0 * mu[0] * SPACE, ranges(force=(0.0, 1.0)), 0),
        (lambda mu: SPACE + 0.0 * mu[0], ranges(force=(0.0, 1.0)), 1),
        (lambda mu: np.array([np.sin(mu[0]), np.cos(mu[0]) - 1.0]), ranges(angle=(-0.4, 0.8)), 3),
    ],
)
def test_a_sum_of_products_is_found_to_rounding(function, parameters, most_terms) -> None:
    found = separate(function, parameters, "it")
    assert found.n_terms <= most_terms
    lower, upper = np.array([[p.lower, p.upper] for p in parameters]).T
    points = lower + np.random.default_rng(7).random((20, len(lower))) * (upper - lower)
    size = max(np.linalg.norm(function(mu)) for mu in points)
    for mu in [lower, upper, *points]:
        assert np.linalg.norm(found.value(mu) - function(mu)) <= 1e-10 * size


def test_a_longer_vector_takes_the_functions_of_its_probe() -> None:
    parameters = ranges(first=(1e6, 5e6), second=(1e3, 9e6), nu=(0.1, 0.45))
    probe = np.random.default_rng(1).standard_normal((3, 50))
    found = separate(stiffness, parameters, "it", lambda mu: probe @ stiffness(mu))
    mu = np.array([1.7e6, 4e5, 0.33])
    np.testing.assert_allclose(found.value(mu), stiffness(mu), rtol=1e-9, atol=1e-9 * 1e6)


def test_what_is_no_short_sum_names_the_parameters_that_are_coupled() -> None:
    parameters = ranges(speed=(0.1, 1.0), scale=(1.0, 2.0), time=(0.1, 1.0))
    with pytest.raises(StudyError, match=r"the load is no short sum .* of speed and time: use"):
        separate(lambda mu: np.exp(-((SPACE - mu[0] * mu[2]) ** 2) / 0.005), parameters, "the load")


def test_what_is_not_smooth_names_its_parameter() -> None:
    with pytest.raises(StudyError, match="the load does not depend smoothly enough on place"):
        separate(lambda mu: np.maximum(SPACE - mu[0], 0.0), ranges(place=(0.1, 1.0)), "the load")
