"""CP, Tucker and tensor train against tensors of known rank, singular values and another library."""

from __future__ import annotations

import numpy as np
import pytest
import tensorly
from tensorly.decomposition import parafac, tensor_train as tensorly_train, tucker as tensorly_tucker

from morph_dslam.model.basis_functions import chebyshev_basis, cubic_spline_basis
from morph_dslam.reduction.tensor_formats import (
    cp,
    cp_functions,
    khatri_rao,
    multiply_axes,
    tensor_train,
    tensor_train_functions,
    tucker,
    tucker_functions,
    unfold,
)


def relative(error: np.ndarray, reference: np.ndarray) -> float:
    return float(np.linalg.norm(error) / np.linalg.norm(reference))


def inverse_distance() -> np.ndarray:
    """1 / (i + j + k + l + 4), a tensor with quickly falling singular values, (5, 7, 8, 9)."""
    return 1.0 / (np.indices((5, 7, 8, 9)).sum(axis=0) + 4.0)


def sum_of_products(terms: int, shape: tuple[int, ...], seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    columns = [rng.normal(size=(n, terms)) for n in shape]
    return np.einsum("at,bt,ct->abc", *columns)


def test_unfolding_and_products_follow_their_definitions() -> None:
    tensor = sum_of_products(3, (4, 5, 6), 0)
    rng = np.random.default_rng(1)
    a, b, c = (rng.normal(size=(2, n)) for n in tensor.shape)
    np.testing.assert_allclose(
        multiply_axes(tensor, (a, b, c)), np.einsum("ijk,ai,bj,ck->abc", tensor, a, b, c), atol=1e-12
    )
    np.testing.assert_allclose(unfold(tensor, 1)[2], tensor[:, 2].ravel())
    np.testing.assert_allclose(khatri_rao((a.T, b.T))[:, 1], np.kron(a[1], b[1]))


def test_a_sum_of_three_products_has_cp_rank_three() -> None:
    tensor = sum_of_products(3, (6, 7, 8), 2)
    found = cp(tensor, 1e-6, 10, sweeps=500)
    assert found.factors[0].shape[1] == 3
    assert relative(found.full() - tensor, tensor) <= 1e-6


def test_x_plus_y_plus_z_has_all_its_ranks_two() -> None:
    """The sum of the indices is separated with ranks 2 in Tucker and tensor-train form."""
    tensor = np.indices((6, 7, 8)).sum(axis=0).astype(float)
    assert tucker(tensor, 1e-10).core.shape == (2, 2, 2)
    assert [c.shape for c in tensor_train(tensor, 1e-10).cores] == [(1, 6, 2), (2, 7, 2), (2, 8, 1)]
    np.testing.assert_allclose(tucker(tensor, 1e-10).full(), tensor, atol=1e-9)
    np.testing.assert_allclose(tensor_train(tensor, 1e-10).full(), tensor, atol=1e-9)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-5])
def test_the_tolerance_holds_and_is_not_wasted(tolerance: float) -> None:
    """No rank of the train exceeds what the exact singular values of its cut ask for."""
    tensor = inverse_distance()
    norm, share = np.linalg.norm(tensor), tolerance / np.sqrt(3.0)
    train = tensor_train(tensor, tolerance)
    assert relative(train.full() - tensor, tensor) <= tolerance
    for cut in (1, 2, 3):
        values = np.linalg.svd(tensor.reshape(int(np.prod(tensor.shape[:cut])), -1), compute_uv=False)
        needed = np.sum(np.sqrt(np.cumsum(values[::-1] ** 2))[::-1] > share * norm)
        assert train.cores[cut].shape[0] <= needed
    assert relative(tucker(tensor, tolerance).full() - tensor, tensor) <= tolerance
    assert relative(cp(tensor, tolerance, 20).full() - tensor, tensor) <= tolerance


def test_a_matrix_is_truncated_as_eckart_and_young_say() -> None:
    matrix = np.random.default_rng(3).normal(size=(12, 20)) * np.exp(-0.7 * np.arange(20))
    values = np.linalg.svd(matrix, compute_uv=False)
    found = tensor_train(matrix, 1e-2)
    rank = found.cores[1].shape[0]
    best = np.sqrt(np.sum(values[rank:] ** 2))
    assert np.linalg.norm(found.full() - matrix) == pytest.approx(best, rel=1e-9)
    assert best <= 1e-2 * np.linalg.norm(values) < np.sqrt(np.sum(values[rank - 1 :] ** 2))


def test_at_equal_ranks_the_error_equals_tensorlys() -> None:
    tensor = inverse_distance()
    train = tensor_train(tensor, 1e-3)
    ranks = [1, *(c.shape[2] for c in train.cores)]
    theirs = tensorly.tt_to_tensor(tensorly_train(tensor, ranks))
    assert relative(train.full() - tensor, tensor) == pytest.approx(relative(theirs - tensor, tensor), rel=1e-6)
    ours = tucker(tensor, 1e-3, sweeps=30)
    theirs = tensorly.tucker_to_tensor(tensorly_tucker(tensor, ours.core.shape, n_iter_max=100, tol=1e-12))
    assert relative(ours.full() - tensor, tensor) == pytest.approx(relative(theirs - tensor, tensor), rel=1e-2)


def test_orthogonal_iteration_improves_on_hosvd_where_nothing_is_small() -> None:
    tensor = np.random.default_rng(5).normal(size=(6, 7, 8))
    start, ours = tucker(tensor, 0.7, sweeps=0), tucker(tensor, 0.7, sweeps=100)
    assert ours.core.shape == start.core.shape
    assert max(ours.core.shape) < 8
    theirs = tensorly.tucker_to_tensor(tensorly_tucker(tensor, ours.core.shape, n_iter_max=100, tol=1e-12))
    error = relative(ours.full() - tensor, tensor)
    assert error < 0.995 * relative(start.full() - tensor, tensor)
    assert error == pytest.approx(relative(theirs - tensor, tensor), rel=1e-3)


def test_cp_is_no_worse_than_tensorlys_at_equal_rank() -> None:
    tensor = inverse_distance()
    ours = cp(tensor, 1e-12, 4, sweeps=300)
    theirs = tensorly.cp_to_tensor(parafac(tensor, 4, n_iter_max=300, init="svd", tol=1e-12))
    assert ours.factors[0].shape[1] == 4
    assert relative(ours.full() - tensor, tensor) <= 1.2 * relative(theirs - tensor, tensor)


def test_functions_of_the_parameters_follow_the_field_between_the_nodes() -> None:
    """Three functions of three parameters, with their derivatives, from a grid of 12 x 10 x 11 values."""
    grids = (np.linspace(-1.0, 1.0, 12), np.linspace(0.0, 2.0, 10), np.linspace(1.0, 2.0, 11))
    bases = (cubic_spline_basis(grids[0]), chebyshev_basis(0.0, 2.0, 9), cubic_spline_basis(grids[2]))

    def field(a, b, c):
        return np.stack([np.sin(a + b) / c, np.exp(a * c) * b, a + 0.0 * b + c])

    tensor = field(*np.meshgrid(*grids, indexing="ij"))
    found = [
        cp_functions(cp(tensor, 1e-6, 40, sweeps=200), grids, bases),
        tucker_functions(tucker(tensor, 1e-6), grids, bases),
        tensor_train_functions(tensor_train(tensor, 1e-6), grids, bases),
    ]
    a, b, c = mu = np.array([0.23, 1.17, 1.61])
    slopes = np.array(
        [
            [np.cos(a + b) / c, b * c * np.exp(a * c), 1.0],
            [np.cos(a + b) / c, np.exp(a * c), 0.0],
            [-np.sin(a + b) / c**2, a * b * np.exp(a * c), 1.0],
        ]
    )
    for functions in found:
        values, gradient = functions.evaluate(mu)
        np.testing.assert_allclose(values, field(a, b, c), atol=5e-4)
        np.testing.assert_allclose(gradient, slopes, atol=1e-2)
        assert functions.n_floats < tensor.size
