"""Compiled loops over small arrays, against numpy."""

import numpy as np
import pytest

from morph_dslam.small_arrays import cholesky_solve, cross, dot, median, scaled


def test_products_of_vectors():
    a, b = np.random.default_rng(1).normal(size=(2, 3))
    assert dot(a, b) == pytest.approx(np.dot(a, b), rel=1e-14)
    assert cross(a, b) == pytest.approx(np.cross(a, b), rel=1e-14)


def test_systems_are_solved():
    rng = np.random.default_rng(4)
    root = rng.normal(size=(12, 12))
    matrix, right = root @ root.T + np.eye(12), rng.normal(size=12)
    assert np.allclose(cholesky_solve(matrix, right), np.linalg.solve(matrix, right), rtol=1e-10)


def test_a_singular_system_gives_a_finite_step():
    assert np.isfinite(cholesky_solve(np.ones((3, 3)), np.arange(3.0))).all()


def test_rows_and_columns_are_scaled():
    matrix, scale = np.random.default_rng(2).normal(size=(5, 5)), np.arange(1.0, 6.0)
    assert np.allclose(scaled(matrix, scale), np.diag(scale) @ matrix @ np.diag(scale), rtol=1e-14)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 17, 100])
def test_the_median_of_any_order_with_numbers_that_are_the_same(count):
    rng = np.random.default_rng(count)
    for digits in (0, 9):
        for _ in range(50):
            values = rng.normal(size=count).round(digits)
            before = values.copy()
            assert median(values) == np.median(before)
            assert np.array_equal(values, before)
