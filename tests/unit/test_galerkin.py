"""Galerkin projection on a chain of nonlinear springs, against the chain solved in full and by scipy."""

import numpy as np
import pytest
from scipy.optimize import root
from scipy.sparse import csr_matrix

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.solvers.continuation import advance
from morph_dslam.mechanics.solvers.linear_solver import AssembledLinearisation, LinearSolver
from morph_dslam.mechanics.solvers.newton import State, sensitivities, solve
from morph_dslam.reduction.galerkin import (
    FullSolutions,
    GalerkinEquations,
    ReducedSolver,
    galerkin_modes,
    newton_correction,
)

SPRINGS = 30


class AnchoredTracker:
    """Springs of force e + b e^3, stiffer towards the right; parameters: end displacement, b, body force."""

    def __init__(self):
        self.n_dofs = SPRINGS + 1
        self.free = np.ones(self.n_dofs, dtype=bool)
        self.free[[0, -1]] = False
        self.scale = 1.0
        self.stiffness = np.linspace(1.0, 3.0, SPRINGS) * SPRINGS
        self.solver = LinearSolver(self.free, symmetric=True, engine="sparsecholesky")

    def force(self, e, b):
        return self.stiffness * (e + b * e**3)

    def prescribed(self, mu):
        x = np.zeros(self.n_dofs)
        x[-1] = mu[0]
        return x

    def prescribed_slopes(self, mu):
        slopes = np.zeros((3, self.n_dofs))
        slopes[0, -1] = 1.0
        return slopes

    def residual(self, x, mu):
        tension = self.force(np.diff(x), mu[1])
        r = np.zeros(self.n_dofs)
        r[1:] += tension
        r[:-1] -= tension
        r[1:-1] -= mu[2] / SPRINGS
        return r

    def linearise(self, x, mu):
        e = np.diff(x)
        k = self.stiffness * (1.0 + 3.0 * mu[1] * e**2)
        K = np.zeros((self.n_dofs, self.n_dofs))
        i = np.arange(SPRINGS)
        np.add.at(K, (i, i), k)
        np.add.at(K, (i + 1, i + 1), k)
        K[i, i + 1] = K[i + 1, i] = -k
        return AssembledLinearisation(self.residual(x, mu), csr_matrix(K), self.solver)

    def residual_slopes(self, x, mu):
        tension = self.stiffness * np.diff(x) ** 3
        slopes = np.zeros((3, self.n_dofs))
        slopes[1, 1:] += tension
        slopes[1, :-1] -= tension
        slopes[2, 1:-1] = -1.0 / SPRINGS
        return slopes


CHAIN = AnchoredTracker()
REST = State(np.array([0.0, 20.0, 0.0]), np.zeros(CHAIN.n_dofs))
UPPER = np.array([3.0, 60.0, 8.0])


def solved(mu):
    return advance(CHAIN, REST, mu)[-1]


def by_scipy(mu):
    def free_residual(inner):
        return CHAIN.residual(np.concatenate([[0.0], inner, [mu[0]]]), mu)[1:-1]

    return np.concatenate([[0.0], root(free_residual, np.linspace(0, mu[0], SPRINGS + 1)[1:-1]).x, [mu[0]]])


@pytest.fixture(scope="module")
def projected():
    rng = np.random.default_rng(1)
    samples = REST.mu + rng.random((24, 3)) * (UPPER - REST.mu)
    states = np.array([solved(mu).dofs for mu in samples])
    return GalerkinEquations(CHAIN, galerkin_modes(CHAIN, states, 1e-6, 8))


def test_all_modes_give_the_full_solution():
    everything = np.eye(CHAIN.n_dofs)[CHAIN.free]
    mu = np.array([2.0, 40.0, 5.0])
    full = GalerkinEquations(CHAIN, everything)
    found = solve(full, mu, State(mu, np.zeros(full.n_dofs)))
    assert np.allclose(full.lift(found.dofs, mu), by_scipy(mu), atol=1e-9)


def test_few_modes_solve_unseen_parameters(projected):
    start = State(REST.mu, np.zeros(projected.n_dofs))
    for mu in (np.array([1.1, 33.0, 6.5]), np.array([2.7, 55.0, 1.5])):
        found = advance(projected, start, mu)[-1]
        missed = projected.lift(found.dofs, mu) - by_scipy(mu)
        assert projected.n_dofs <= 8
        assert np.linalg.norm(missed) < 1e-3 * np.linalg.norm(by_scipy(mu))


def test_projected_sensitivities_are_the_differences_of_projected_solutions(projected):
    mu, step = np.array([2.0, 40.0, 5.0]), 1e-5
    start = advance(projected, State(REST.mu, np.zeros(projected.n_dofs)), mu)[-1]
    slopes = projected.full.prescribed_slopes(mu) + sensitivities(projected, start) @ projected.modes
    for k in range(3):
        change = step * np.eye(3)[k] * UPPER
        ahead, behind = (solve(projected, mu + sign * change, start).dofs for sign in (1.0, -1.0))
        difference = projected.lift(ahead, mu + change) - projected.lift(behind, mu - change)
        expected = difference / (2.0 * step * UPPER[k])
        assert np.linalg.norm(slopes[k] - expected) < 1e-5 * np.linalg.norm(expected)


def test_newton_correction_measures_the_error_of_a_projected_solution(projected):
    mu = np.array([2.6, 52.0, 7.0])
    coarse = GalerkinEquations(CHAIN, projected.modes[:3])
    found = advance(coarse, State(REST.mu, np.zeros(3)), mu)[-1]
    x = coarse.lift(found.dofs, mu)
    error = np.linalg.norm(by_scipy(mu) - x)
    assert error > 1e-5
    assert np.linalg.norm(newton_correction(CHAIN, x, mu)) == pytest.approx(error, rel=0.05)


def test_modes_must_leave_prescribed_dofs_alone():
    with pytest.raises(ValueError, match="prescribed"):
        GalerkinEquations(CHAIN, np.ones((1, CHAIN.n_dofs)))


def test_solutions_that_are_all_zero_have_no_relative_error():
    chain = AnchoredTracker()
    samples = np.random.default_rng(0).random((20, 3))
    solutions = FullSolutions(samples, np.zeros((20, chain.n_dofs)), np.zeros((20, 3, chain.n_dofs)))
    with pytest.raises(StudyError):
        ReducedSolver(chain, solutions, np.array([[0.0, 1.0]] * 3), 1e-3)
