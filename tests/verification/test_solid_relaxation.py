"""A viscous block through the finite elements: relaxation of a Prony series after a sudden stretch."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam.errors import SolverError, StudyError
from morph_dslam.mechanics.materials.isotropic import NeoHookean
from morph_dslam.mechanics.materials.viscoelastic import Prony
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.continuation import advance
from morph_dslam.mechanics.supports import PrescribedDisplacement, fixed
from morph_dslam.meshing.generators import block
from tests.support.solids import distorted, load_parameter

#: g_inf = 0.4, g_1 = 0.6, tau = 2 s.
LAW = NeoHookean(young=3e6, poisson=0.45, prony=Prony((0.6,), (2.0,)))


@pytest.mark.parametrize("cell_type", ["hex8", "tet10", "prism15"])
def test_relaxation(cell_type: str) -> None:
    symbols = load_parameter(pull=0.0, time=0.0)
    supports = [
        PrescribedDisplacement("x_min", x=0.0),
        PrescribedDisplacement("y_min", y=0.0),
        PrescribedDisplacement("z_min", z=0.0),
        PrescribedDisplacement("x_max", x=symbols["pull"]),
    ]
    mesh = distorted(block((1.0, 1.0, 1.0), (2, 2, 2), cell_type), 0.05)
    problem = SolidProblem(mesh, {"all": LAW}, supports, parameters=symbols, time=symbols["time"])
    state = advance(problem, problem.initial_state(), np.array([0.5, 0.0]))[-1]
    at_once = problem.reactions(state.dofs, state.mu, "x_max")[0][0]
    assert at_once == pytest.approx(1.075843e6, rel=1e-6)
    for time, remaining in ((1.0, 0.763918), (4.0, 0.481201)):
        state = advance(problem, state, np.array([0.5, time]))[-1]
        force = problem.reactions(state.dofs, state.mu, "x_max")[0][0]
        assert force / at_once == pytest.approx(remaining, rel=1e-5)
        fields = problem.recovery.at_nodes(state.dofs, state.mu, ("first_piola_kirchhoff", "stress"))
        np.testing.assert_allclose(fields["first_piola_kirchhoff"][:, 0], force, rtol=1e-5)
        np.testing.assert_allclose(fields["von_mises"], force / 0.830679**2, rtol=1e-5)
    with pytest.raises(SolverError, match="time goes back by 1 s"):
        problem.residual(state.dofs, np.array([0.5, 3.0]))


def test_a_viscous_material_needs_a_time() -> None:
    with pytest.raises(StudyError, match="which parameter is the time"):
        SolidProblem(block((1.0, 1.0, 1.0), (1, 1, 1), "hex8"), {"all": LAW}, [fixed("x_min")])
