"""The iterative solver of elements of higher order against numpy."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solvers.linear_solver import AssembledLinearisation, LinearSolver
from morph_dslam.mechanics.solvers.two_level import MOST_ITERATIONS, RELATIVE_RESIDUAL, LowerOrder, TwoLevelSolver

#: The lower order has every third dof, and two more that the higher one has not.
N = 240
KEPT = np.arange(0, N, 3)
FREE = np.random.default_rng(4).random(N) < 0.9


def higher_order(skew: float) -> np.ndarray:
    """A chain of springs between neighbours of neighbours, as stiff as may be, on a weak foundation."""
    matrix = np.zeros((N, N))
    for i, j in [(i, i + d) for d in (1, 2) for i in range(N - d)]:
        matrix[np.ix_([i, j], [i, j])] += [[1.0, -1.0 + skew], [-1.0 - skew, 1.0]]
    return matrix + 1e-4 * np.eye(N)


def lower_order(matrix: np.ndarray, softer: float = 1.0) -> LowerOrder:
    """The tangent in which the added dofs follow the kept ones, some percent too soft."""
    added = np.setdiff1d(np.arange(N), KEPT)
    free_kept, free_added = KEPT[FREE[KEPT]], added[FREE[added]]
    inner = np.linalg.solve(matrix[np.ix_(free_added, free_added)], matrix[np.ix_(free_added, free_kept)])
    size = len(KEPT) + 2
    tangent, free = np.eye(size), np.zeros(size, dtype=bool)
    own = 1 + np.flatnonzero(FREE[KEPT])
    free[own] = True
    tangent[np.ix_(own, own)] = softer * (
        matrix[np.ix_(free_kept, free_kept)] - matrix[np.ix_(free_kept, free_added)] @ inner
    )
    linearisation = AssembledLinearisation(np.zeros(size), sp.csr_matrix(tangent), LinearSolver(free, False))
    return LowerOrder(linearisation, 1 + np.arange(len(KEPT)), KEPT)


@pytest.mark.parametrize("skew", [0.0, 0.1], ids=["symmetric", "unsymmetric"])
@pytest.mark.parametrize("part", [np.array, np.tril, np.triu], ids=["whole", "lower", "upper"])
def test_solves_with_a_lower_order_that_is_too_soft(skew: float, part) -> None:
    matrix = higher_order(skew)
    stored = sp.csr_matrix(matrix if skew else part(matrix))
    solver = TwoLevelSolver(FREE, not skew, lower_order(matrix, 0.8))
    solved = solver.factorise(stored.data, stored.indices, stored.indptr)
    right = np.random.default_rng(2).standard_normal((2, N))
    expected = np.linalg.solve(matrix[np.ix_(FREE, FREE)], right[:, FREE].T).T
    found = solved.solve(right)
    assert not found[:, ~FREE].any()
    residual = right[:, FREE] - found[:, FREE] @ matrix[np.ix_(FREE, FREE)].T
    assert np.all(
        np.linalg.norm(residual, axis=1) <= 1.001 * RELATIVE_RESIDUAL * np.linalg.norm(right[:, FREE], axis=1)
    )
    # Smooth and short waves alike: the matrix alone says nothing of the former.
    np.testing.assert_allclose(found[:, FREE], expected, atol=0.1 * np.abs(expected).max())
    np.testing.assert_allclose(solved.solve(right[0]), found[0], rtol=1e-12)
    assert not solved.solve(np.where(FREE, 0.0, 1.0)).any()


def test_added_dofs_are_solved_for_alone_where_all_others_are_held() -> None:
    matrix, free = higher_order(0.0), FREE.copy()
    free[KEPT] = False
    stored = sp.csr_matrix(matrix)
    solver = TwoLevelSolver(free, True, lower_order(matrix))
    found = solver.factorise(stored.data, stored.indices, stored.indptr).solve(np.ones(N))
    expected = np.linalg.solve(matrix[np.ix_(free, free)], np.ones(int(free.sum())))
    np.testing.assert_allclose(found[free], expected, atol=0.05 * expected.max())


def test_says_when_it_does_not_converge() -> None:
    """A matrix that has nothing in common with the lower order."""
    stored = sp.csr_matrix(np.random.default_rng(3).standard_normal((N, N)) + np.diag(np.ones(N)))
    solver = TwoLevelSolver(FREE, False, lower_order(higher_order(0.0)))
    with pytest.raises(SolverError, match=f"in {MOST_ITERATIONS} iterations"):
        solver.factorise(stored.data, stored.indices, stored.indptr).solve(np.ones(N))


def test_a_tangent_that_is_not_finite_is_refused() -> None:
    matrix = higher_order(0.0)
    stored = sp.csr_matrix(matrix * np.where(np.eye(N), np.nan, 1.0))
    with pytest.raises(SolverError, match="not finite"):
        TwoLevelSolver(FREE, True, lower_order(matrix)).factorise(stored.data, stored.indices, stored.indptr)
