"""Functions through values on grids, whose sizes lines decide; recognising grids among samples."""

import numpy as np
import pytest

from morph_dslam.model import Parameter
from morph_dslam.reduction.grid_functions import (
    EvenGrid,
    functions_on_grid,
    interpolation_nodes,
    sizes_along_lines,
    values_on_grid,
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
