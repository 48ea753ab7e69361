"""A-priori PGD against closed forms, direct solves and the optimal (SVD) separation."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from morph_dslam.model.basis_functions import cubic_spline_basis, hat_basis
from morph_dslam.reduction.pgd import PgdSolution, solve_pgd
from morph_dslam.reduction.separable_problem import ParameterAxis, SeparableProblem, collocation_axis, galerkin_axis
from morph_dslam.reduction.tensor_formats import khatri_rao


def on_grid(solution: PgdSolution, *grids: np.ndarray) -> np.ndarray:
    """The separated solution (n, g_1, ..., g_d) at all points of the grids."""
    tables = tuple(
        basis.evaluate(grid) @ factor
        for basis, factor, grid in zip(solution.functions.bases, solution.functions.factors, grids, strict=True)
    )
    return (solution.modes.T @ khatri_rao(tables).T).reshape(-1, *(len(grid) for grid in grids))


# --- a Euler-Bernoulli cantilever; Hermite elements are exact at their nodes ---

LENGTH, RIGIDITY, ELEMENTS = 2.0, 3.0, 40


def hermite_stiffness(rigidity: np.ndarray) -> sp.csc_array:
    """Of a clamped beam, degrees of freedom (w, w') of the nodes behind the clamp."""
    h = LENGTH / ELEMENTS
    element = np.array([[12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h]] * 2, dtype=float)
    element[2] = -element[0]
    element[3] = [6 * h, 2 * h * h, -6 * h, 4 * h * h]
    matrix = np.zeros((2 * ELEMENTS + 2, 2 * ELEMENTS + 2))
    for e in range(ELEMENTS):
        matrix[2 * e : 2 * e + 4, 2 * e : 2 * e + 4] += rigidity[e] / h**3 * element
    return sp.csc_array(matrix[2:, 2:])


def beam_with_moving_load() -> tuple[SeparableProblem, np.ndarray]:
    """A unit force at each of the nodes in turn; the problem and the nodes' positions."""
    positions = np.linspace(0.0, LENGTH, ELEMENTS + 1)[1:]
    axis = collocation_axis(positions)
    matrix = hermite_stiffness(np.full(ELEMENTS, RIGIDITY))
    loads = np.zeros((2 * ELEMENTS, ELEMENTS))
    loads[2 * np.arange(ELEMENTS), np.arange(ELEMENTS)] = 1.0
    ones = axis.multiplied_by(np.ones((1, ELEMENTS)))
    return SeparableProblem((axis,), (matrix,), (ones,), loads, (np.eye(ELEMENTS),), matrix), positions


def test_the_tip_of_a_cantilever_follows_the_influence_function_of_euler_and_bernoulli() -> None:
    problem, s = beam_with_moving_load()
    solution = solve_pgd(problem, max_modes=20, tolerance=1e-5)
    tip = on_grid(solution, s)[-2]
    np.testing.assert_allclose(tip, s**2 * (3.0 * LENGTH - s) / (6.0 * RIGIDITY), rtol=1e-4, atol=1e-6)


def test_pgd_is_the_optimal_separation_in_energy_and_its_dual_residual_the_error() -> None:
    problem, s = beam_with_moving_load()
    stiffness = problem.matrices[0].toarray()
    root = scipy.linalg.cholesky(stiffness)
    exact = np.linalg.solve(stiffness, problem.loads)
    singular = np.linalg.svd(root @ exact, compute_uv=False)
    for n_modes in (1, 3, 5, 10, 20):
        solution = solve_pgd(problem, max_modes=n_modes, tolerance=0.0)
        error = np.linalg.norm(root @ (exact - on_grid(solution, s))) / np.linalg.norm(singular)
        optimum = np.linalg.norm(singular[n_modes:]) / np.linalg.norm(singular)
        assert optimum * (1.0 - 1e-6) <= error <= 1.02 * optimum
        assert solution.residuals[-1] == pytest.approx(error, rel=0.01)


def beam_with_moving_load_and_stiffness() -> tuple[SeparableProblem, np.ndarray]:
    """The outer half 0.2 to 5 times as stiff, by its logarithm on a cubic spline axis."""
    problem, s = beam_with_moving_load()
    outer = np.arange(ELEMENTS) >= ELEMENTS // 2
    inner_half, outer_half = hermite_stiffness(RIGIDITY * ~outer), hermite_stiffness(RIGIDITY * outer)
    log_kappa = galerkin_axis(cubic_spline_basis(np.linspace(np.log(0.2), np.log(5.0), 12)))
    n_points = len(log_kappa.points)
    problem = SeparableProblem(
        (problem.axes[0], log_kappa),
        (inner_half, outer_half),
        (
            problem.axes[0].multiplied_by(np.ones((2, ELEMENTS))),
            log_kappa.multiplied_by([np.ones(n_points), np.exp(log_kappa.points)]),
        ),
        problem.loads,
        (np.eye(ELEMENTS), np.ones((ELEMENTS, n_points))),
        sp.csc_array(inner_half + outer_half),
    )
    return problem, s


def test_a_stiffness_as_second_parameter_agrees_with_direct_solves() -> None:
    """Compared off the nodes of the stiffness axis."""
    problem, s = beam_with_moving_load_and_stiffness()
    inner_half, outer_half = problem.matrices
    solution = solve_pgd(problem, max_modes=25, tolerance=0.0)
    samples = np.log([0.2, 0.37, 1.3, 2.9, 5.0])
    exact = np.stack([splu(sp.csc_array(inner_half + np.exp(k) * outer_half)).solve(problem.loads) for k in samples], 2)
    found = on_grid(solution, s, samples)
    assert np.linalg.norm(found - exact) <= 1e-3 * np.linalg.norm(exact)
    mu, h = np.array([1.3, 0.4]), 1e-5
    _, slopes = solution.functions.evaluate(mu)
    up, down = (solution.functions.evaluate(mu + np.array([0.0, step]))[0] for step in (h, -h))
    np.testing.assert_allclose(slopes[1], (up - down) / (2.0 * h), rtol=1e-5, atol=1e-7)


# --- the interface ---


def test_it_stops_at_the_tolerance_and_says_whether_it_got_there() -> None:
    problem, _ = beam_with_moving_load()
    reached = solve_pgd(problem, max_modes=40, tolerance=0.05)
    assert reached.converged
    assert reached.residuals[-1] <= 0.05 < reached.residuals[-2]
    assert len(reached.modes) == len(reached.residuals) == reached.functions.n_functions
    short = solve_pgd(problem, max_modes=2, tolerance=1e-6)
    assert not short.converged
    assert len(short.modes) == 2


def test_arrays_that_do_not_fit_are_refused() -> None:
    problem, _ = beam_with_moving_load()
    axis = ParameterAxis(hat_basis([0.0, 1.0, 2.0]), np.array([0.5, 1.5]), np.ones(2))
    with pytest.raises(ValueError, match="images of axis 0"):
        SeparableProblem(
            (axis,), problem.matrices, problem.images, problem.loads, problem.load_functions, problem.metric
        )
