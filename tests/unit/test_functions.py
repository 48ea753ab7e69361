"""Parameter functions against numpy's Chebyshev series, closed forms and finite differences."""

import numpy as np
import pytest
from scipy.special import eval_chebyt

from morph_dslam.model.functions import (
    ParameterFunctions,
    evaluate_functions,
    evaluate_functions_numpy,
    total_degree_indices,
)


def random_functions(dimension, degree, n_functions=7, seed=0):
    rng = np.random.default_rng(seed)
    indices = total_degree_indices(dimension, degree)
    lower = rng.uniform(-3.0, -1.0, dimension)
    coefficients = rng.normal(size=(len(indices), n_functions))
    return ParameterFunctions(lower, lower + rng.uniform(0.5, 4.0, dimension), indices, coefficients)


@pytest.mark.parametrize(("dimension", "degree"), [(1, 0), (1, 1), (1, 9), (2, 5), (4, 4)])
def test_compiled_functions_equal_their_numpy_twin(dimension, degree):
    functions = random_functions(dimension, degree)
    rng = np.random.default_rng(1)
    arguments = (functions.lower, functions.upper, functions.multi_indices, functions.coefficients)
    for mu in rng.uniform(functions.lower - 0.1, functions.upper + 0.1, (20, dimension)):
        np.testing.assert_allclose(
            evaluate_functions(mu, *arguments),
            evaluate_functions_numpy(mu, *arguments),
            rtol=1e-10,
            atol=1e-10,
        )


def test_values_are_sums_of_products_of_chebyshev_polynomials():
    functions = random_functions(3, 4)
    mu = functions.lower + np.array([0.2, 0.5, 0.9]) * (functions.upper - functions.lower)
    products = np.prod(eval_chebyt(functions.multi_indices, np.array([-0.6, 0.0, 0.8])), axis=1)
    np.testing.assert_allclose(functions.evaluate(mu)[0], products @ functions.coefficients, rtol=1e-12)


def test_gradient_by_central_differences():
    functions, step = random_functions(4, 5), 1e-6
    rng = np.random.default_rng(2)
    for mu in rng.uniform(functions.lower, functions.upper, (10, 4)):
        gradient = functions.evaluate(mu)[1]
        for k in range(4):
            offset = step * np.eye(4)[k]
            difference = (functions.evaluate(mu + offset)[0] - functions.evaluate(mu - offset)[0]) / (
                2 * step
            )
            np.testing.assert_allclose(gradient[k], difference, rtol=1e-5, atol=1e-5)


def test_total_degree_indices_are_all_and_ordered():
    indices = total_degree_indices(3, 4)
    assert len(np.unique(indices, axis=0)) == len(indices) == 35  # (3 + 4)! / (3! 4!)
    totals = indices.sum(axis=1)
    assert totals.max() == 4
    assert (np.diff(totals) >= 0).all()
    assert indices[0].tolist() == [0, 0, 0]
