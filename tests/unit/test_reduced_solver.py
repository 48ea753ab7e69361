"""The reduced solver on a solid block against full finite element solutions at unseen parameters."""

import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.reduction.galerkin import FullSolutions, ReducedSolver, balancing_weights, solid_equations
from morph_dslam.studies.solid_study import SolidStudy
from tests.support.block_study import bent_block

BLOCK = bent_block(["20 mm", "20 mm", "40 mm"], [2, 2, 4], 0.45, "30 deg", "5 mm")
BOX = np.array([[-np.pi / 6, np.pi / 6], [0.0, 0.005]])


def full_solutions(sweep, samples):
    state, found = sweep.first_state(), []
    for sample in samples:
        found.append(sweep.advance(state, sample))
    return FullSolutions(samples, np.array([s.dofs for s in found]), np.array([s.slopes for s in found]))


def scattered(count, seed):
    return BOX[:, 0] + np.random.default_rng(seed).random((count, 2)) * np.diff(BOX, axis=1).T


@pytest.fixture(scope="module", params=["displacement", "mixed"])
def solved(request):
    formulation = {"threads": 1, "formulation": request.param}
    sweep = SolidStudy.model_validate(BLOCK | {"solver": formulation}).sweep_problem()
    solver = ReducedSolver(sweep.problem, full_solutions(sweep, scattered(12, 1)), BOX, 1e-4)
    return solver, full_solutions(sweep, scattered(6, 2))


def test_unseen_solutions_are_met_and_errors_estimated(solved):
    solver, unseen = solved
    for mu, truth in zip(unseen.samples, unseen.states, strict=True):
        reduced = solver.solve(mu)
        missed = np.linalg.norm((solver.lift(reduced, mu) - truth)[solver.measured]) / solver.largest
        assert missed < 1e-3
        assert solver.estimate(reduced, mu) == pytest.approx(missed, rel=0.05)


def test_solutions_do_not_depend_on_what_was_solved_before(solved):
    solver, unseen = solved
    again = [solver.solve(mu) for mu in unseen.samples[::-1]][::-1]
    for mu, reduced in zip(unseen.samples, again, strict=True):
        residual = solver.galerkin.residual(reduced, mu)
        correction = solver.galerkin.linearise(reduced, mu).solve(residual)
        assert np.linalg.norm(correction) < 1e-6 * np.linalg.norm(reduced)


def test_a_start_that_is_far_off_is_mended_by_newtons_method(solved, monkeypatch):
    solver, unseen = solved
    mu, truth = unseen.samples[0], unseen.states[0]
    monkeypatch.setattr(solver, "_corrected", lambda *_: None)
    missed = (solver.lift(solver.solve(mu), mu) - truth)[solver.measured]
    assert np.linalg.norm(missed) < 1e-3 * solver.largest


def test_pressures_weigh_as_much_as_displacements():
    vectors = np.array([[1.0, 2.0, 3e6, 4e6]])
    weights = balancing_weights(vectors, np.array([True, True, False, False]))
    assert weights == pytest.approx([1.0, 1.0, 2e-13, 2e-13])


def test_a_solid_that_remembers_has_no_galerkin_model():
    with pytest.raises(StudyError, match=r'use reduction.method = "pod"'):
        solid_equations(None)
