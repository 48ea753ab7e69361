"""Blocks of elastic and viscous rubber against closed forms: stretch, shear, work, relaxation of a Prony series."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam.errors import SolverError, StudyError
from morph_dslam.mechanics.loads import DeadTraction
from morph_dslam.mechanics.materials.base import Material
from morph_dslam.mechanics.materials.isotropic import NeoHookean, StVenantKirchhoff
from morph_dslam.mechanics.materials.viscoelastic import Prony
from morph_dslam.mechanics.solid import SolidOptions, SolidProblem
from morph_dslam.mechanics.solvers.continuation import advance
from morph_dslam.mechanics.supports import PrescribedDisplacement, fixed
from morph_dslam.meshing.generators import block
from tests.support.solids import FACES, ROLLERS, RUBBER, AffineSupport, distorted, load_parameter, solved

#: Lame's constants 4 and 1 (MPa): Poisson's ratio lambda / 2(lambda + mu), E = 2 mu (1 + nu).
STIFF = NeoHookean(young=2.8e6, poisson=0.4)
#: Hooke's law in the Green-Lagrange strain: l_2^2 = 1 - nu (l^2 - 1) and P = l E (l^2 - 1) / 2.
HOOKE = StVenantKirchhoff(young=3e6, poisson=0.3)


@pytest.mark.parametrize(
    ("material", "lateral", "stress"),
    [(RUBBER, 0.830679, 1.075843e6), (STIFF, 0.846028, 1.022825e6), (HOOKE, 0.625**0.5, 2.8125e6)],
)
@pytest.mark.parametrize(("cell_type", "mixed"), [("hex8", False), ("hex20", True), ("tet10", False)])
def test_uniaxial_stretch(material: Material, lateral: float, stress: float, cell_type: str, mixed: bool) -> None:
    symbols = load_parameter(pull=0.0)
    mesh = distorted(block((1.0, 1.0, 1.0), (2, 2, 2), cell_type), 0.05)
    supports = [*ROLLERS, PrescribedDisplacement("x_max", x=symbols["pull"])]
    problem = SolidProblem(mesh, {"all": material}, supports, parameters=symbols, options=SolidOptions(mixed=mixed))
    state = solved(problem, 0.5)
    displacement = problem.nodal_displacement(state.dofs)
    np.testing.assert_allclose(displacement[:, 1], (lateral - 1.0) * mesh.nodes[:, 1], atol=1e-6)
    force, _ = problem.reactions(state.dofs, state.mu, "x_max")
    assert force[0] == pytest.approx(stress, rel=1e-6)
    fields = problem.recovery.at_nodes(state.dofs, state.mu, ("first_piola_kirchhoff", "stress"))
    np.testing.assert_allclose(fields["first_piola_kirchhoff"][:, 0], stress, rtol=2e-6)
    np.testing.assert_allclose(fields["von_mises"], stress / lateral**2, rtol=3e-6)


def test_uniaxial_traction_is_the_inverse_of_stretch() -> None:
    symbols = load_parameter(share=0.0)
    mesh = block((1.0, 1.0, 1.0), (2, 1, 1), "hex8")
    load = DeadTraction("x_max", (1.075843e6 * symbols["share"], 0.0, 0.0))
    problem = SolidProblem(mesh, {"all": RUBBER}, ROLLERS, [load], symbols)
    state = solved(problem, 1.0)
    at_end = problem.nodal_displacement(state.dofs)[mesh.set_nodes("x_max"), 0]
    np.testing.assert_allclose(at_end, 0.5, rtol=2e-6)


def test_simple_shear() -> None:
    symbols = load_parameter(shear=0.0)
    gradient = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    mesh = distorted(block((1.0, 1.0, 1.0), (2, 2, 2), "hex8"), 0.1)
    supports = [AffineSupport(face, gradient, symbols["shear"]) for face in FACES]
    problem = SolidProblem(mesh, {"all": RUBBER}, supports, parameters=symbols)
    state = solved(problem, 0.5)
    fields = problem.recovery.at_nodes(state.dofs, state.mu, ("deformation_gradient", "stress"))
    F = fields["deformation_gradient"].reshape(-1, 3, 3)
    np.testing.assert_allclose(np.linalg.det(F), 1.0, rtol=1e-10)
    xx, yy, zz, yz, xz, xy = fields["stress"].T / 1e6
    np.testing.assert_allclose(xy, 0.517241, atol=1e-6)
    np.testing.assert_allclose(xx, 0.258621, atol=1e-6)
    np.testing.assert_allclose([yy, zz, yz, xz], 0.0, atol=1e-9)


def test_strain_energy_is_the_work_of_the_load() -> None:
    symbols = load_parameter(pull=0.0)
    supports = [*ROLLERS, PrescribedDisplacement("x_max", x=symbols["pull"])]
    mesh = block((1.0, 1.0, 1.0), (1, 1, 1), "hex20")
    problem = SolidProblem(mesh, {"all": RUBBER}, supports, parameters=symbols)
    points, weights = np.polynomial.legendre.leggauss(6)
    states = [solved(problem, 0.25 * (1.0 + p)) for p in points]
    forces = [problem.reactions(s.dofs, s.mu, "x_max")[0][0] for s in states]
    end = solved(problem, 0.5)
    assert problem.strain_energy(end.dofs, end.mu) == pytest.approx(0.25 * weights @ forces, rel=1e-7)


#: g_inf = 0.4, g_1 = 0.6, tau = 2 s.
LAW = NeoHookean(young=3e6, poisson=0.45, prony=Prony((0.6,), (2.0,)))


@pytest.mark.parametrize("cell_type", ["hex8", "tet10", "prism15"])
def test_relaxation(cell_type: str) -> None:
    symbols = load_parameter(pull=0.0, time=0.0)
    supports = [*ROLLERS, PrescribedDisplacement("x_max", x=symbols["pull"])]
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
