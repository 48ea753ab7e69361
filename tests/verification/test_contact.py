"""Contact with rigid obstacles against closed forms: a uniform pressure, and Hertz's line and point contacts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from morph_dslam.mechanics.contact import RigidCylinder, RigidObstacle, RigidPlane, RigidSphere
from morph_dslam.mechanics.coupled_solid import CoupledSolid
from morph_dslam.mechanics.couplings import Coupling
from morph_dslam.mechanics.loads import DeadTraction
from morph_dslam.mechanics.materials.isotropic import LinearElastic, StVenantKirchhoff
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.continuation import advance
from morph_dslam.mechanics.solvers.newton import sensitivities
from morph_dslam.mechanics.supports import PrescribedDisplacement, fixed
from morph_dslam.meshing.generators import block
from morph_dslam.meshing.meshes import Mesh
from tests.support.solids import ROLLERS, distorted, load_parameter, solved

YOUNG, POISSON = 1e6, 0.3
PLANE_STRAIN = YOUNG / (1.0 - POISSON**2)
RADIUS = 1.0


@pytest.mark.parametrize("cell_type", ["hex8", "hex20", "tet10", "tet4"])
def test_patch(cell_type: str) -> None:
    """Pushed on a plane by a tenth of its height, a distorted block has one stress: P = l E (l^2 - 1) / 2."""
    symbols = load_parameter(push=0.0)
    mesh = distorted(block((1.0, 1.0, 1.0), (3, 3, 3), cell_type), 0.05, corners_only=True)
    plane = RigidPlane("z_min", (0.0, 0.0, 0.0), (0.0, 0.0, 2.0))
    push = PrescribedDisplacement("z_max", z=-symbols["push"])
    problem = SolidProblem(
        mesh,
        {"all": StVenantKirchhoff(young=YOUNG, poisson=POISSON)},
        [*ROLLERS[:2], push],
        [],
        symbols,
        contacts=[plane],
    )
    state = solved(problem, 0.1)
    below = problem.nodal_displacement(state.dofs)[mesh.set_nodes("z_min"), 2]
    stretch = 0.9 - below.mean()
    expected = stretch * YOUNG * (stretch**2 - 1.0) / 2.0
    # The surface gives way by a small part of a face's width, evenly.
    assert -2e-3 < below.min() < 0.0
    force, _ = problem.reactions(state.dofs, state.mu, "z_max")
    assert force[2] == pytest.approx(expected, rel=1e-3)
    stress = problem.recovery.at_nodes(state.dofs, state.mu, ("first_piola_kirchhoff",))["first_piola_kirchhoff"]
    np.testing.assert_allclose(stress[:, 8], expected, rtol=1e-3)


def graded(divisions: tuple[int, int, int], cell_type: str, width: float, axes: str) -> Mesh:
    """A block of 1 m with cells that are small, about ``width``, near x = y = 0 below its top."""
    mesh = block((1.0, 1.0, 1.0), divisions, cell_type)
    nodes = mesh.nodes.copy()
    for axis in axes:
        share = nodes[:, "xyz".index(axis)] if axis != "z" else 1.0 - nodes[:, 2]
        place = width * np.sinh(np.arcsinh(1.0 / width) * share)
        nodes[:, "xyz".index(axis)] = place if axis != "z" else 1.0 - place
    return replace(mesh, nodes=nodes)


@dataclass(frozen=True)
class Pressed:
    """What a block with symmetry planes does under an obstacle.

    Attributes
    ----------
    force : on its base, N.
    peak : pressure at x = y = 0, Pa.
    square : mean of x^2 over the contact, weighted with the pressure, m2.
    """

    force: float
    peak: float
    square: float


def pressed(mesh: Mesh, obstacle: RigidObstacle, symbols: ParameterSymbols) -> Pressed:
    """The block under an obstacle that has come down by 2.5 mm."""
    supports = [fixed("z_min"), *ROLLERS[:2], PrescribedDisplacement("y_max", y=0.0)]
    solid = {"all": LinearElastic(young=YOUNG, poisson=POISSON)}
    problem = SolidProblem(mesh, solid, supports, [], symbols, contacts=[obstacle])
    state = solved(problem, 0.05**2 / RADIUS)
    below = problem.reactions(state.dofs, state.mu, "z_min")[0][2]
    forces = -problem.contact_forces(state.dofs, state.mu, 0)[2]
    assert forces.sum() == pytest.approx(below, rel=1e-4)
    moment = forces @ (problem.displacements.coefficients @ mesh.nodes[:, 0] ** 2)
    centre = np.argmin(np.linalg.norm(mesh.nodes - [0.0, 0.0, 1.0], axis=1))
    return Pressed(below, -problem.sample(state.dofs, state.mu)["stress"][centre, 2], moment / forces.sum())


def test_line_contact_of_hertz() -> None:
    """Johnson, Contact Mechanics, 1985, section 4.2: a^2 = 4 P R / (pi E*), p0 = 2 P / (pi a), mean x^2 = a^2 / 4."""
    symbols = load_parameter(depth=0.0)
    mesh = graded((60, 1, 40), "hex8", 0.01, "xz")
    centre = (0.0, 0.0, 1.0 + RADIUS - symbols["depth"])
    found = pressed(mesh, RigidCylinder("z_max", centre, (0.0, 1.0, 0.0), RADIUS), symbols)
    load = 2.0 * found.force  # of both halves; the block is 1 m thick
    radius = np.sqrt(4.0 * load * RADIUS / (np.pi * PLANE_STRAIN))
    assert 2.0 * np.sqrt(found.square) == pytest.approx(radius, rel=0.02)
    assert found.peak == pytest.approx(2.0 * load / (np.pi * radius), rel=0.02)


def test_point_contact_of_hertz() -> None:
    """Johnson, section 4.2: a^3 = 3 P R / (4 E*), p0 = 3 P / (2 pi a^2), mean x^2 = a^2 / 5."""
    symbols = load_parameter(depth=0.0)
    mesh = graded((12, 12, 10), "hex8", 0.015, "xyz")
    centre = (0.0, 0.0, 1.0 + RADIUS - symbols["depth"])
    found = pressed(mesh, RigidSphere("z_max", centre, RADIUS), symbols)
    load = 4.0 * found.force  # of all quarters
    radius = (3.0 * load * RADIUS / (4.0 * PLANE_STRAIN)) ** (1.0 / 3.0)
    assert np.sqrt(5.0 * found.square) == pytest.approx(radius, rel=0.02)
    assert found.peak == pytest.approx(3.0 * load / (2.0 * np.pi * radius**2), rel=0.02)


CONFINED = StVenantKirchhoff(young=YOUNG, poisson=0.4998)


@pytest.mark.parametrize("pushed", ["support", "obstacle", "load"])
@pytest.mark.parametrize("cell_type", ["hex8", "tet10"])
def test_confined_block(cell_type: str, pushed: str) -> None:
    """Without room to bulge, P = l (K + 4 G / 3) (l^2 - 1) / 2: 800 times as stiff as with it.

    Two of six walls are planes; with one more where the block is pushed by an obstacle. Derivatives are compared with
    differences.
    """
    symbols = load_parameter(push=0.0)
    mesh = block((0.2, 1.0, 0.2), (3, 4, 3), cell_type)
    confined = YOUNG * (1.0 - 0.4998) / ((1.0 + 0.4998) * (1.0 - 2.0 * 0.4998))
    push, stretch = 2e-3, 0.99
    pressure = -stretch * confined * (stretch**2 - 1.0) / 2.0
    walls: list[RigidObstacle] = [
        RigidPlane("x_max", (0.2, 0.0, 0.0), (-1.0, 0.0, 0.0)),
        RigidPlane("y_max", (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)),
    ]
    supports, loads = list(ROLLERS), []
    if pushed == "support":
        supports.append(PrescribedDisplacement("z_max", z=-symbols["push"]))
    elif pushed == "obstacle":
        walls.append(RigidPlane("z_max", (0.0, 0.0, 0.2 - symbols["push"]), (0.0, 0.0, -1.0)))
    else:
        loads.append(DeadTraction("z_max", (0.0, 0.0, -symbols["push"] / push * pressure)))
    problem = SolidProblem(mesh, {"all": CONFINED}, supports, loads, symbols, contacts=walls)
    state = solved(problem, push)
    below = problem.reactions(state.dofs, state.mu, "z_min")[0][2]
    down = -problem.nodal_displacement(state.dofs)[mesh.set_nodes("z_max"), 2].mean()
    assert below == pytest.approx(0.2 * pressure, rel=0.02)
    assert down == pytest.approx(push, rel=0.02)
    other = advance(problem, state, np.array([1.02 * push]))[-1]
    differences = (other.dofs - state.dofs) / (0.02 * push)
    slopes = sensitivities(problem, state)[0]
    np.testing.assert_allclose(slopes, differences, atol=1e-3 * np.abs(slopes).max())


def test_confined_block_under_a_plate() -> None:
    """The same under a rigid plate that a force presses down, between four planes."""
    symbols = load_parameter(push=0.0)
    mesh = block((0.2, 1.0, 0.2), (3, 4, 3), "hex8")
    confined = YOUNG * (1.0 - 0.4998) / ((1.0 + 0.4998) * (1.0 - 2.0 * 0.4998))
    force = -0.2 * 0.99 * confined * (0.99**2 - 1.0) / 2.0
    walls = [RigidPlane(f"{axis}_min", (0.0, 0.0, 0.0), unit) for axis, unit in (("x", (1, 0, 0)), ("y", (0, 1, 0)))]
    walls += [RigidPlane("x_max", (0.2, 0.0, 0.0), (-1, 0, 0)), RigidPlane("y_max", (0.0, 1.0, 0.0), (0, -1, 0))]
    plate = Coupling("z_max", force=(0.0, 0.0, -symbols["push"]), held=("x", "y", "rx", "ry", "rz"))
    problem = CoupledSolid([plate], mesh, {"all": CONFINED}, [fixed("z_min")], [], symbols, contacts=walls)
    state = solved(problem, force)
    assert -problem.motions(state.dofs)[0, 2] == pytest.approx(2e-3, rel=0.02)
