"""Sums of products of splines against the functions that they stand for."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam.model import Parameter
from morph_dslam.model.basis_functions import cubic_spline_basis
from morph_dslam.reduction.separated_terms import Terms, multiplied, spline_terms
from morph_dslam.reduction.separation import separate

PARAMETERS = (Parameter("force", "force", "N", -1.0, 2.0, 0.0), Parameter("place", "length", "mm", 0.1, 0.4, 0.1))
BASES = tuple(cubic_spline_basis(np.linspace(p.lower, p.upper, 30)) for p in PARAMETERS)
SPACE = np.linspace(0.0, 1.0, 8)
WEIGHTS = np.linspace(1.0, 3.0, 4) / 8.0


def deflection(mu: np.ndarray) -> np.ndarray:
    """(4 points x 2 components,): two products."""
    return mu[0] * np.sin(3.0 * mu[1]) * SPACE + mu[1] ** 2 * SPACE**2


def factor(mu: np.ndarray) -> np.ndarray:
    return np.array([[1.0 + mu[1]], [np.exp(mu[0])]])


def deflection_terms() -> Terms:
    return spline_terms(separate(deflection, PARAMETERS, "it"), BASES)


def box_points(count: int) -> np.ndarray:
    unit = np.random.default_rng(3).random((count, 2))
    return np.array([-1.0, 0.1]) + unit * np.array([3.0, 0.3])


def test_a_field_is_the_sum_with_as_few_modes_as_its_rank() -> None:
    twice = deflection_terms() + deflection_terms()
    field, singular_values = twice.field(WEIGHTS, 2, 1e-8)
    assert field.n_modes == 2
    modes = field.modes.reshape(2, -1)
    np.testing.assert_allclose((modes * np.repeat(WEIGHTS, 2)) @ modes.T, np.eye(2), atol=1e-12)
    for mu in box_points(6):
        np.testing.assert_allclose(field.value(mu).ravel(), 2.0 * deflection(mu), atol=1e-5)
    mean = np.mean([np.sum(np.repeat(WEIGHTS, 2) * (2.0 * deflection(mu)) ** 2) for mu in box_points(5_000)])
    assert np.sum(singular_values**2) == pytest.approx(mean, rel=5e-2)


def test_a_single_mode_is_the_best_one() -> None:
    field, singular_values = deflection_terms().field(WEIGHTS, 2, 0.9)
    assert field.n_modes == 1
    points, root = box_points(3_000), np.sqrt(np.repeat(WEIGHTS, 2))
    exact = np.array([root * deflection(mu) for mu in points])
    found = np.array([root * field.value(mu).ravel() for mu in points])
    optimum = np.linalg.norm(np.linalg.svd(exact, compute_uv=False)[1:])
    assert np.linalg.norm(exact - found) == pytest.approx(optimum, rel=2e-2)
    assert np.linalg.norm(exact - found) / np.sqrt(len(points)) == pytest.approx(singular_values[1], rel=5e-2)


def test_terms_are_multiplied_by_functions_of_the_parameters() -> None:
    """Each term's vector times its own scalar: a stress, say, from a mode and a modulus."""
    scalars = Terms(
        np.eye(2),
        tuple(
            b.interpolate(np.linspace(b.lower, b.upper, 30), np.column_stack(columns))
            for b, columns in zip(
                BASES,
                [(np.ones(30), np.linspace(-1.0, 2.0, 30)), (np.linspace(0.1, 0.4, 30), np.ones(30))],
                strict=True,
            )
        ),
        BASES,
    )
    vectors = np.array([[1.0, -2.0, 0.5], [0.0, 3.0, 1.0]])
    product = multiplied(scalars, separate(lambda mu: (factor(mu) * vectors).ravel(), PARAMETERS, "it"))
    field, _ = product.field(np.ones(1), 3, 1e-10)
    for mu in box_points(6):
        exact = mu[1] * (1.0 + mu[1]) * vectors[0] + mu[0] * np.exp(mu[0]) * vectors[1]
        np.testing.assert_allclose(field.value(mu).ravel(), exact, atol=2e-5)
