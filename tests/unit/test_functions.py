"""Parameter functions against numpy's Chebyshev series, closed forms and finite differences."""

import numpy as np
import pytest
from scipy.special import eval_chebyt

from morph_dslam.model.functions import ParameterFunctions, total_degree_indices


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
    for mu in rng.uniform(functions.lower - 0.1, functions.upper + 0.1, (20, dimension)):
        for compiled, plain in zip(functions.evaluate(mu), functions.evaluate_numpy(mu), strict=True):
            np.testing.assert_allclose(compiled, plain, rtol=1e-10, atol=1e-10)


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
            difference = (functions.evaluate(mu + offset)[0] - functions.evaluate(mu - offset)[0]) / (2 * step)
            np.testing.assert_allclose(gradient[k], difference, rtol=1e-5, atol=1e-5)


def test_polynomials_go_on_as_tangents_outside_the_box():
    """Value at the nearer end plus slope times distance, for each parameter in turn and for both together."""
    functions = random_functions(2, 6)
    ends, width = functions.upper, functions.upper - functions.lower
    value, gradient = functions.evaluate(ends)
    for k in range(2):
        beyond = ends + 0.3 * width * np.eye(2)[k]
        expected = value + 0.3 * width[k] * gradient[k]
        np.testing.assert_allclose(functions.evaluate(beyond)[0], expected, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(functions.evaluate(beyond)[1][k], gradient[k], rtol=1e-10, atol=1e-10)
        assert functions.inside(beyond).tolist() == [k != 0, k != 1]
    corner = ends + 0.3 * width
    cross = functions.partial(ends, (1, 1))
    expected = value + 0.3 * width @ gradient + 0.09 * width.prod() * cross
    np.testing.assert_allclose(functions.evaluate(corner)[0], expected, rtol=1e-10, atol=1e-10)


def test_mixed_functions_are_the_linear_combinations_of_the_old():
    functions, mixing = random_functions(2, 3), np.random.default_rng(3).normal(size=(7, 4))
    mu = functions.lower + 0.3
    for new, old in zip(functions.mixed(mixing).evaluate(mu), functions.evaluate(mu), strict=True):
        np.testing.assert_allclose(new, old @ mixing, rtol=1e-12)


def test_total_degree_indices_are_all_and_ordered():
    indices = total_degree_indices(3, 4)
    assert len(np.unique(indices, axis=0)) == len(indices) == 35  # (3 + 4)! / (3! 4!)
    totals = indices.sum(axis=1)
    assert totals.max() == 4
    assert (np.diff(totals) >= 0).all()
    assert indices[0].tolist() == [0, 0, 0]
