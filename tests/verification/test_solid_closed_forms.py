"""Homogeneous deformations of a block of rubber against closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest

from morph_dslam.mechanics.loads import BodyForce, DeadTraction
from morph_dslam.mechanics.materials.base import Material
from morph_dslam.mechanics.materials.isotropic import NeoHookean, StVenantKirchhoff
from morph_dslam.mechanics.solid import SolidOptions, SolidProblem
from morph_dslam.mechanics.solvers.newton import sensitivities, solve
from morph_dslam.mechanics.supports import PrescribedDisplacement, fixed
from morph_dslam.meshing.extrusion import Hole, extrusion
from morph_dslam.meshing.generators import block
from morph_dslam.meshing.mesh_files import load_mesh
from tests.support.solids import FACES, ROLLERS, RUBBER, AffineSupport, distorted, load_parameter, solved

#: Lame's constants 4 and 1 (MPa): Poisson's ratio lambda / 2(lambda + mu), E = 2 mu (1 + nu).
STIFF = NeoHookean(young=2.8e6, poisson=0.4)
#: Hooke's law in the Green-Lagrange strain: l_2^2 = 1 - nu (l^2 - 1) and P = l E (l^2 - 1) / 2.
HOOKE = StVenantKirchhoff(young=3e6, poisson=0.3)
#: Without Poisson's effect P = E (l - 1 / l) / 2.
CORK = NeoHookean(young=3e6, poisson=0.0)


@pytest.mark.parametrize(
    ("material", "lateral", "stress"),
    [(RUBBER, 0.830679, 1.075843e6), (STIFF, 0.846028, 1.022825e6), (HOOKE, 0.625**0.5, 2.8125e6), (CORK, 1.0, 1.25e6)],
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


@pytest.mark.parametrize("cell_type", ["hex8", "hex20", "tet10"])
@pytest.mark.parametrize("soft_first", [True, False])
def test_stress_where_materials_meet_is_that_of_the_stiffer_one(cell_type: str, soft_first: bool) -> None:
    """Layers stretched along their plane; without Poisson's effect the Cauchy stress is E (l - 1 / l) / 2 in each."""
    young = (1e5, 1e6) if soft_first else (1e6, 1e5)
    mesh = block((1.0, 1.0, 1.0), (1, 1, 4), cell_type)
    heights = np.concatenate([mesh.nodes[part.connectivity, 2].mean(axis=1) for part in mesh.blocks])
    mesh = replace(mesh, cell_sets={"low": np.flatnonzero(heights < 0.5), "high": np.flatnonzero(heights > 0.5)})
    symbols = load_parameter(pull=0.0)
    supports = [*ROLLERS, PrescribedDisplacement("x_max", x=symbols["pull"])]
    materials = {name: NeoHookean(young=E, poisson=0.0) for name, E in zip(("low", "high"), young, strict=True)}
    problem = SolidProblem(mesh, materials, supports, parameters=symbols)
    state = solved(problem, 0.3)
    stretched = 0.5 * (1.3 - 1.0 / 1.3)
    z = mesh.nodes[:, 2]
    expected = stretched * np.where(np.abs(z - 0.5) < 1e-9, max(young), np.where(z < 0.5, *young))
    fields = problem.recovery.at_nodes(state.dofs, state.mu)
    np.testing.assert_allclose(fields["stress"][:, 0], expected, rtol=1e-6)
    # By d/dl (l - 1 / l) / 2, with l = 1 + pull.
    slopes = problem.recovery.slopes_at_nodes(state.dofs, state.mu, sensitivities(problem, state))["stress"][0, :, 0]
    np.testing.assert_allclose(slopes, expected / stretched * 0.5 * (1.0 + 1.3**-2), rtol=1e-6)


def test_uniaxial_traction_is_the_inverse_of_stretch() -> None:
    symbols = load_parameter(share=0.0)
    mesh = block((1.0, 1.0, 1.0), (2, 1, 1), "hex8")
    load = DeadTraction("x_max", (1.075843e6 * symbols["share"], 0.0, 0.0))
    problem = SolidProblem(mesh, {"all": RUBBER}, ROLLERS, [load], symbols)
    state = solved(problem, 1.0)
    at_end = problem.nodal_displacement(state.dofs)[mesh.set_nodes("x_max"), 0]
    np.testing.assert_allclose(at_end, 0.5, rtol=2e-6)


def test_the_stress_at_a_hole_is_that_of_the_table() -> None:
    """A plate 40 mm wide with a hole of 20 mm under tension: 2.16 of the net stress (Howland 1930; Peterson's fit)."""
    corners = 1e-3 * np.array([[-60.0, -20.0], [60.0, -20.0], [60.0, 20.0], [-60.0, 20.0]])
    mesh = extrusion(corners, 1e-3, 2e-3, holes=[Hole((0.0, 0.0), 20e-3)])
    symbols = load_parameter(pull=0.0)
    gross = 1e3  # small against the modulus, so that the plate keeps its shape
    load = DeadTraction("x_max", (gross * symbols["pull"], 0.0, 0.0))
    problem = SolidProblem(mesh, {"all": HOOKE}, [fixed("x_min")], [load], symbols)
    state = solved(problem, 1.0)
    fields = problem.recovery.at_nodes(state.dofs, state.mu, ("stress",))
    beside = np.abs(mesh.nodes[:, 0]) + np.abs(np.abs(mesh.nodes[:, 1]) - 10e-3) < 1e-6
    assert beside.any()
    share = 0.5
    expected = (3.0 - 3.13 * share + 3.66 * share**2 - 1.53 * share**3) / (1.0 - share)
    assert fields["von_mises"][beside].mean() / gross == pytest.approx(expected, rel=0.03)


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


@pytest.mark.slow
@pytest.mark.parametrize("poisson", [0.45, 0.4999])
def test_a_bar_from_a_surface_file_sags_as_a_beam(poisson: float, tmp_path: Path) -> None:
    """Under so little of its weight that it stays linear: Timoshenko's cantilever, shear factor 5/6.

    The clamped end, which cannot contract, makes the solid 3 % stiffer than the beam.
    """
    length, side, young, load = 0.2, 0.02, 200e3, 10.0
    box = block((length, side, side), (1, 1, 1), "hex8")
    meshio.Mesh(1e3 * box.nodes, [("triangle", box.surface_triangles())]).write(tmp_path / "bar.stl")
    mesh = load_mesh(tmp_path / "bar.stl", "mm", 0.01)
    mesh = replace(mesh, node_sets={"root": np.flatnonzero(mesh.nodes[:, 0] < 1e-9)})
    material = NeoHookean(young=young, poisson=poisson)
    problem = SolidProblem(mesh, {"all": material}, [fixed("root")], [BodyForce((0.0, 0.0, -load))])
    state = solve(problem, np.zeros(0), problem.initial_state())
    tip = -problem.nodal_displacement(state.dofs)[:, 2].min()
    area, inertia, shear = side**2, side**4 / 12.0, young / (2.0 * (1.0 + poisson))
    weight = load * area
    beam = weight * length**4 / (8.0 * young * inertia) + weight * length**2 / (2.0 * 5.0 / 6.0 * shear * area)
    assert tip == pytest.approx(beam, rel=0.05)
