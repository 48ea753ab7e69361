"""Both sparse solvers against numpy: solutions, inertia, saddle points, singular and broken matrices."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solvers.linear_solver import (
    ANALYSE,
    ENVIRONMENT_VARIABLE,
    AssembledLinearisation,
    LinearSolver,
    Pardiso,
    default_engine,
)

ENGINES = ["pardiso", "sparsecholesky"]


@pytest.fixture(params=ENGINES)
def engine(request) -> str:
    if request.param == "pardiso":
        pytest.importorskip("pypardiso", reason="pypardiso is not installed")
    return request.param


def random_symmetric(n: int, negative: int, seed: int = 0) -> np.ndarray:
    """Dense symmetric matrix with so many negative eigenvalues, all between 0.1 and 2 in size."""
    rng = np.random.default_rng(seed)
    vectors, _ = np.linalg.qr(rng.standard_normal((n, n)))
    # As in a structure that loses its stability, the negative ones are the nearest to zero.
    values = np.concatenate([rng.uniform(-0.4, -0.1, negative), rng.uniform(1.0, 2.0, n - negative)])
    return vectors @ np.diag(values) @ vectors.T


def factorised(dense: np.ndarray, free: np.ndarray, engine: str, symmetric: bool = True):
    matrix = sp.csr_matrix(dense)
    return LinearSolver(free, symmetric, engine=engine).factorise(matrix.data, matrix.indices, matrix.indptr)


@pytest.mark.parametrize("part", [np.array, np.tril, np.triu], ids=["whole", "lower", "upper"])
def test_solves_the_free_block_of_a_symmetric_matrix(engine, part) -> None:
    dense = random_symmetric(40, 3)
    free = np.random.default_rng(1).random(40) < 0.7
    right = np.random.default_rng(2).standard_normal((3, 40))
    solution = factorised(part(dense), free, engine).solve(right)
    expected = np.linalg.solve(dense[np.ix_(free, free)], right[:, free].T).T
    np.testing.assert_allclose(solution[:, free], expected, rtol=1e-11, atol=1e-11)
    assert not solution[:, ~free].any()
    np.testing.assert_allclose(factorised(part(dense), free, engine).solve(right[0]), solution[0], atol=1e-12)


def test_solves_an_unsymmetric_matrix(engine) -> None:
    dense = np.random.default_rng(3).standard_normal((30, 30)) + 8.0 * np.eye(30)
    free = np.arange(30) != 4
    right = np.arange(30.0)
    solution = factorised(dense, free, engine, symmetric=False).solve(right)
    np.testing.assert_allclose(solution[free], np.linalg.solve(dense[np.ix_(free, free)], right[free]))


def test_a_matrix_that_turns_out_to_be_symmetric_gives_its_inertia(engine) -> None:
    """One solver, whose matrices are symmetric or not as the state has it."""
    solver, right = LinearSolver(np.ones(30, dtype=bool), symmetric=False, engine=engine), np.arange(30.0)
    for negative, skew in ((2, 0.0), (2, 1e-3), (0, 0.0)):
        dense = random_symmetric(30, negative) + skew * np.triu(np.ones((30, 30)), 1)
        matrix = sp.csr_matrix(dense)
        found = solver.factorise(matrix.data, matrix.indices, matrix.indptr)
        np.testing.assert_allclose(found.solve(right), np.linalg.solve(dense, right), rtol=1e-9, atol=1e-9)
        assert found.negative_pivots == (None if skew else negative)


def test_the_folder_is_not_searched_for_the_library_again(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pypardiso", reason="pypardiso is not installed")
    right, free = np.arange(3.0), np.ones(3, dtype=bool)
    factorised(np.eye(3), free, "pardiso")
    monkeypatch.setattr("glob.glob", lambda *_, **__: pytest.fail("searched again"))
    np.testing.assert_allclose(factorised(2.0 * np.eye(3), free, "pardiso").solve(right), 0.5 * right)


@pytest.mark.parametrize(("n", "negative"), [(1, 1), (12, 2), (60, 0), (60, 4)])
def test_counts_negative_eigenvalues(engine, n, negative) -> None:
    dense = random_symmetric(n, negative)
    assert factorised(dense, np.ones(n, dtype=bool), engine).negative_pivots == negative


def test_says_when_it_cannot_count() -> None:
    many = factorised(random_symmetric(60, 20), np.ones(60, dtype=bool), "sparsecholesky")
    assert many.negative_pivots is None


def test_new_values_and_new_patterns(engine) -> None:
    free = np.ones(20, dtype=bool)
    solver = LinearSolver(free, True, engine=engine)
    right = np.ones(20)
    for dense in (random_symmetric(20, 1, 5), random_symmetric(20, 0, 6), np.diag(np.arange(1.0, 21.0))):
        matrix = sp.csr_matrix(dense)
        solution = solver.factorise(matrix.data, matrix.indices, matrix.indptr).solve(right)
        np.testing.assert_allclose(solution, np.linalg.solve(dense, right), rtol=1e-11, atol=1e-12)


def test_pardiso_analyses_a_pattern_once(monkeypatch) -> None:
    pytest.importorskip("pypardiso", reason="pypardiso is not installed")
    phases = []
    call = Pardiso._call
    monkeypatch.setattr(Pardiso, "_call", lambda self, phase, right: phases.append(phase) or call(self, phase, right))
    free = np.ones(9, dtype=bool)
    solver = LinearSolver(free, True, engine="pardiso")
    for scale in (1.0, 2.0, 3.0):
        matrix = sp.csr_matrix(scale * random_symmetric(9, 0))
        solution = solver.factorise(matrix.data, matrix.indices, matrix.indptr).solve(np.ones(9))
        np.testing.assert_allclose(matrix @ solution, np.ones(9), rtol=1e-12)
    assert phases.count(ANALYSE) == 1
    # A zero on the diagonal asks for weighted matching, and so for a new analysis.
    broken = random_symmetric(9, 3)
    broken[0, 0] = 0.0
    matrix = sp.csr_matrix(np.where(broken == 0.0, 1e-300, broken))
    matrix.data[np.abs(matrix.data) < 1e-200] = 0.0
    solver.factorise(matrix.data, matrix.indices, matrix.indptr)
    assert phases.count(ANALYSE) == 2


def saddle_point(n: int, constraints: int) -> np.ndarray:
    """A chain of stiff and soft springs with rows of constraints, zero on their diagonal."""
    rng = np.random.default_rng(7)
    springs = 10.0 ** rng.uniform(-1.5, 1.5, n + 1)
    stiffness = np.diag(springs[:-1] + springs[1:]) - np.diag(springs[1:-1], 1) - np.diag(springs[1:-1], -1)
    rows = np.zeros((constraints, n))
    rows[np.arange(constraints), np.linspace(0, n - 2, constraints).astype(int)] = 1.0
    rows[np.arange(constraints), np.linspace(0, n - 2, constraints).astype(int) + 1] = -1.0
    return np.block([[stiffness, rows.T], [rows, np.zeros((constraints, constraints))]])


def test_saddle_point_is_solved_to_a_small_residual(engine) -> None:
    """With PARDISO's default settings the residual on saddle points can be 1e-3 without a word of warning."""
    dense = saddle_point(400, 60)
    right = np.random.default_rng(8).standard_normal(460)
    free = np.ones(460, dtype=bool)
    factorisation = factorised(dense, free, engine)
    solution = factorisation.solve(right)
    assert np.abs(dense @ solution - right).max() < 1e-8 * np.abs(right).max()
    if engine == "pardiso":
        assert factorisation.negative_pivots in (60, None)


def test_singular_and_broken_matrices_are_refused(engine) -> None:
    floating = np.array([[1.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    free = np.ones(3, dtype=bool)
    with pytest.raises(SolverError, match="supports"):
        factorised(floating, free, engine).solve(np.array([1.0, 0.0, 0.0]))
    with pytest.raises(SolverError, match="not finite"):
        factorised(np.diag([1.0, np.nan, 1.0]), free, engine)
    with pytest.raises(SolverError, match="not finite"):
        factorised(np.eye(3), free, engine).solve(np.array([np.inf, 0.0, 0.0]))


def test_nothing_free_is_solved_by_zeros(engine) -> None:
    factorisation = factorised(np.eye(3), np.zeros(3, dtype=bool), engine)
    assert factorisation.negative_pivots == 0
    assert not factorisation.solve(np.ones(3)).any()


def test_older_linearisations_are_factorised_again(engine) -> None:
    free = np.array([True, True, True, False])
    solver = LinearSolver(free, True, engine=engine)
    stiff, soft = random_symmetric(4, 0, 1), random_symmetric(4, 0, 2)
    first, second = (AssembledLinearisation(np.zeros(4), sp.csr_matrix(np.tril(k)), solver) for k in (stiff, soft))
    right = np.array([1.0, 2.0, 3.0, 0.0])
    second.solve(right)
    expected = np.linalg.solve(stiff[:3, :3], right[:3])
    np.testing.assert_allclose(first.solve(right)[:3], expected, rtol=1e-12)
    np.testing.assert_allclose(first.apply(right), stiff @ right, rtol=1e-12)


def test_the_environment_chooses_the_engine(monkeypatch) -> None:
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, "sparsecholesky")
    assert default_engine() == "sparsecholesky"
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, "cholmod")
    with pytest.raises(SolverError, match="use pardiso or sparsecholesky"):
        default_engine()
