"""Functions through values on grids, whose sizes lines decide, and at scattered samples; recognising grids."""

import numpy as np
import pytest

from morph_dslam.model import Parameter
from morph_dslam.model.basis_functions import chebyshev_basis
from morph_dslam.reduction.grid_functions import (
    EvenGrid,
    functions_on_grid,
    interpolation_nodes,
    sizes_along_lines,
    values_on_grid,
)
from morph_dslam.reduction.sparse_expansion import (
    ScatteredValues,
    expansion_rows,
    expansion_train,
    fit_expansion,
    polynomial_functions,
    weighted_degree_indices,
)
from morph_dslam.reduction.task import parameter_bases

PARAMETERS = (Parameter("stretch", "ratio", "1", 1.0, 3.0, 1.0), Parameter("force", "force", "N", -2.0, 2.0, 0.0))
BOX = np.array([[1.0, 3.0], [-2.0, 2.0]])


def field(mu):
    """Rational in the first parameter, quadratic in the second."""
    return np.array([1.0 / mu[0] + mu[1], np.log(mu[0]) * (1.0 + 0.2 * mu[1] ** 2)])


@pytest.mark.parametrize("basis", ["chebyshev", "cubic_spline"])
@pytest.mark.parametrize("form", ["tucker", "tensor_train", "cp"])
def test_functions_are_as_good_as_lines_ask(basis, form):
    allowed = 1e-3
    sizes = sizes_along_lines(lambda mu: field(mu) / allowed, PARAMETERS, basis, slice(0, 2))
    assert sizes[1] == 4, "a quadratic needs no more than the least number of nodes"
    assert 5 <= sizes[0] <= 25
    bases = parameter_bases(basis, PARAMETERS, sizes)
    tensor = values_on_grid(field, tuple(interpolation_nodes(b) for b in bases))
    functions = functions_on_grid(tensor, bases, form, 1e-5)
    for mu in BOX[:, 0] + np.random.default_rng(0).random((30, 2)) * np.diff(BOX, axis=1).T:
        value, gradient = functions.evaluate(mu)
        assert value == pytest.approx(field(mu), abs=2 * allowed)
        slope = [[-1 / mu[0] ** 2, (1 + 0.2 * mu[1] ** 2) / mu[0]], [1.0, 0.4 * mu[1] * np.log(mu[0])]]
        assert gradient == pytest.approx(np.array(slope), abs=0.05)


def test_samples_on_a_grid_are_recognised_in_any_order():
    points = np.stack(np.meshgrid(np.linspace(1, 3, 5), np.linspace(-2, 2, 4), indexing="ij"), -1).reshape(-1, 2)
    shuffled = points[np.random.default_rng(3).permutation(20)]
    grid = EvenGrid.of(shuffled, BOX)
    assert grid is not None
    assert grid.counts == (5, 4)
    assert np.array_equal(grid.tensor(shuffled)[0, :, 2], np.linspace(1, 3, 5))
    assert np.array_equal(grid.tensor(shuffled)[1, 1], np.linspace(-2, 2, 4))


def test_what_is_no_full_even_grid_is_not_taken_for_one():
    even = np.linspace(1, 3, 9)[:, None]
    assert EvenGrid.of(np.delete(even, 4, axis=0), BOX[:1]) is None, "a sample is missing"
    assert EvenGrid.of(1.0 + (even - 1.0) ** 2 / 2.0, BOX[:1]) is None, "not even"
    assert EvenGrid.of(even[:-1], BOX[:1]) is None, "the upper end is missing"
    assert EvenGrid.of(np.linspace(1, 3, 3)[:, None], BOX[:1]) is None, "too few for cubic splines"


WIDE = np.array([[-1.0, 2.0], [0.0, 1.0], [10.0, 30.0], [-0.5, 0.5], [2.0, 3.0]])


def smooth(mu):
    """Three functions that are no sums of products."""
    x = (mu - WIDE[:, 0]) / np.diff(WIDE, axis=1)[:, 0]
    return np.array(
        [np.exp(x @ [0.5, -0.3, 0.2, 0.1, 0.4]), np.sin(x @ [1.0, 0.2, 0.5, 0.1, 0.3]), 1.0 / (2.0 + x[0] * x[4])]
    )


@pytest.fixture(scope="module")
def expansion():
    scattered = ScatteredValues(smooth, WIDE)
    found = fit_expansion(scattered, WIDE, [4, 4, 4, 4, 4], 1e-4, slice(0, 3))
    return scattered, *found


def test_the_set_of_degrees_is_the_weighted_simplex():
    found = {tuple(m) for m in weighted_degree_indices([4, 2]).tolist()}
    assert found == {(a, b) for a in range(5) for b in range(3) if a / 4 + b / 2 <= 1.0}


def test_the_expansion_is_good_where_it_was_not_fitted(expansion):
    _, indices, coefficients, error = expansion
    assert error <= 1e-4
    points = WIDE[:, 0] + np.random.default_rng(0).random((50, 5)) * np.diff(WIDE, axis=1).T
    truth = np.array([smooth(mu) for mu in points])
    assert np.abs(expansion_rows(points, WIDE, indices) @ coefficients - truth).max() < 1e-3


def test_the_train_is_the_expansion_up_to_its_tolerance(expansion):
    _, indices, coefficients, _ = expansion
    bases = tuple(chebyshev_basis(*ends, int(degree)) for ends, degree in zip(WIDE, indices.max(axis=0), strict=True))
    polynomial = polynomial_functions(WIDE, indices, coefficients)
    points = WIDE[:, 0] + np.random.default_rng(1).random((40, 5)) * np.diff(WIDE, axis=1).T
    exact, loose = (expansion_train(indices, coefficients, bases, tol) for tol in (1e-13, 1e-3))
    for mu in points:
        value, gradient = polynomial.evaluate(mu)
        found, slopes = exact.evaluate(mu)
        assert found == pytest.approx(value, abs=1e-10)
        assert slopes == pytest.approx(gradient, abs=1e-9)
        assert loose.evaluate(mu)[0] == pytest.approx(value, abs=1e-2)
    assert loose.n_floats < exact.n_floats


def test_more_samples_continue_the_fewer():
    short, long = ScatteredValues(smooth, WIDE), ScatteredValues(smooth, WIDE)
    short.extend_to(20)
    long.extend_to(11)
    long.extend_to(20)
    assert np.array_equal(short.samples, long.samples)
    assert np.all((short.samples > WIDE[:, 0]) & (short.samples < WIDE[:, 1]))
