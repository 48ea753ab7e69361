"""Sparse Chebyshev expansions and their tensor trains, against the functions that they expand."""

import numpy as np
import pytest

from morph_dslam.model.basis_functions import chebyshev_basis
from morph_dslam.reduction.sparse_expansion import (
    ScatteredValues,
    expansion_rows,
    expansion_train,
    fit_expansion,
    polynomial_functions,
    weighted_degree_indices,
)

BOX = np.array([[-1.0, 2.0], [0.0, 1.0], [10.0, 30.0], [-0.5, 0.5], [2.0, 3.0]])


def smooth(mu):
    """Three functions that are no sums of products."""
    x = (mu - BOX[:, 0]) / np.diff(BOX, axis=1)[:, 0]
    return np.array(
        [np.exp(x @ [0.5, -0.3, 0.2, 0.1, 0.4]), np.sin(x @ [1.0, 0.2, 0.5, 0.1, 0.3]), 1.0 / (2.0 + x[0] * x[4])]
    )


@pytest.fixture(scope="module")
def expansion():
    scattered = ScatteredValues(smooth, BOX)
    found = fit_expansion(scattered, BOX, [4, 4, 4, 4, 4], 1e-4, slice(0, 3))
    return scattered, *found


def test_the_set_of_degrees_is_the_weighted_simplex():
    found = {tuple(m) for m in weighted_degree_indices([4, 2]).tolist()}
    assert found == {(a, b) for a in range(5) for b in range(3) if a / 4 + b / 2 <= 1.0}


def test_the_expansion_is_good_where_it_was_not_fitted(expansion):
    _, indices, coefficients, error = expansion
    assert error <= 1e-4
    points = BOX[:, 0] + np.random.default_rng(0).random((50, 5)) * np.diff(BOX, axis=1).T
    truth = np.array([smooth(mu) for mu in points])
    assert np.abs(expansion_rows(points, BOX, indices) @ coefficients - truth).max() < 1e-3


def test_the_train_is_the_expansion_up_to_its_tolerance(expansion):
    _, indices, coefficients, _ = expansion
    bases = tuple(chebyshev_basis(*ends, int(degree)) for ends, degree in zip(BOX, indices.max(axis=0), strict=True))
    polynomial = polynomial_functions(BOX, indices, coefficients)
    points = BOX[:, 0] + np.random.default_rng(1).random((40, 5)) * np.diff(BOX, axis=1).T
    exact, loose = (expansion_train(indices, coefficients, bases, tol) for tol in (1e-13, 1e-3))
    for mu in points:
        value, gradient = polynomial.evaluate(mu)
        found, slopes = exact.evaluate(mu)
        assert found == pytest.approx(value, abs=1e-10)
        assert slopes == pytest.approx(gradient, abs=1e-9)
        assert loose.evaluate(mu)[0] == pytest.approx(value, abs=1e-2)
    assert loose.n_floats < exact.n_floats


def test_more_samples_continue_the_fewer():
    short, long = ScatteredValues(smooth, BOX), ScatteredValues(smooth, BOX)
    short.extend_to(20)
    long.extend_to(11)
    long.extend_to(20)
    assert np.array_equal(short.samples, long.samples)
    assert np.all((short.samples > BOX[:, 0]) & (short.samples < BOX[:, 1]))
