"""Tangents, and derivatives of solutions and fields by every kind of parameter, against differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from morph_dslam.mechanics.contact import RigidCylinder, RigidPlane, RigidSphere
from morph_dslam.mechanics.kinematics import ShapeField
from morph_dslam.mechanics.loads import (
    BodyForce,
    DeadTraction,
    FollowerPressure,
    Gravity,
    MovingLine,
    MovingPatch,
    PointLoad,
)
from morph_dslam.mechanics.materials.anisotropic import HolzapfelGasserOgden, Orthotropic, turned_direction
from morph_dslam.mechanics.materials.isotropic import Hyperfoam, NeoHookean, Ogden
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.rigid_mesh import RigidMesh
from morph_dslam.mechanics.solid import SolidOptions, SolidProblem
from morph_dslam.mechanics.solvers.continuation import advance, loaded_state
from morph_dslam.mechanics.solvers.linear_solver import default_engine
from morph_dslam.mechanics.solvers.newton import State, sensitivities, solve
from morph_dslam.mechanics.supports import ElasticFoundation, PrescribedDisplacement, RigidRotation, fixed
from morph_dslam.meshing.generators import block
from tests.support.solids import RUBBER, distorted, load_parameter

EXACT = 1e-13
MESH = distorted(block((1.0, 0.5, 0.5), (3, 2, 2), "hex8"), 0.04)
DOWN = (0.0, 0.0, -2e4)


def by_rotation(mu: ParameterSymbols) -> SolidProblem:
    turn = RigidRotation("x_max", (0.2, 1.0, 0.3), mu["p"], translation=(0.1 * mu["p"], 0.0, 0.0))
    return SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min"), turn], parameters=mu)


def by_displacement(mu: ParameterSymbols) -> SolidProblem:
    push = PrescribedDisplacement("x_max", x=-0.2 * mu["p"], z=0.3 * mu["p"] * mu["p"])
    return SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min"), push], parameters=mu)


def by_dead_loads(mu: ParameterSymbols) -> SolidProblem:
    p = 1e5 * mu["p"]
    loads = [
        DeadTraction("x_max", (0.0, p, 0.2 * p)),
        BodyForce((0.0, p, 0.0)),
        PointLoad("x_max", (0.1 * p, 0.0, -0.1 * p)),
    ]
    return SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min")], loads, mu)


def by_pressure(mu: ParameterSymbols) -> SolidProblem:
    load = FollowerPressure("z_max", 1e5 * mu["p"])
    return SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min")], [load], mu)


def by_patch_position(mu: ParameterSymbols) -> SolidProblem:
    load = MovingPatch("z_max", (0.0, 0.0, -1e4), (0.8 * mu["p"] + 0.3, 0.25, 0.5), 0.15)
    return SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min")], [load], mu)


def by_line_position(mu: ParameterSymbols) -> SolidProblem:
    load = MovingLine("z_max", DOWN, (0.8 * mu["p"] + 0.3, 0.0, 0.5), (0.0, 1.0, 0.0), 0.15)
    return SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min")], [load], mu)


def by_material_constant(mu: ParameterSymbols) -> SolidProblem:
    material = NeoHookean(young=3e6 * mu["p"], poisson=0.4 + 0.1 * mu["p"], density=1200.0)
    loads = [DeadTraction("x_max", (0.0, 0.0, 3e4)), Gravity()]
    return SolidProblem(MESH, {"all": material}, [fixed("x_min")], loads, mu)


def by_one_of_two_laws(mu: ParameterSymbols) -> SolidProblem:
    """Of which one has a volumetric part and the other none."""
    young, poisson, shear = 2e6 * mu["p"] + 1e6, 0.3, 8e5
    other = Orthotropic(
        young_1=young,
        young_2=1e6,
        young_3=1e6,
        poisson_12=poisson,
        poisson_13=poisson,
        poisson_23=poisson,
        shear_12=shear,
        shear_13=shear,
        shear_23=shear,
    )
    mesh = replace(MESH, cell_sets={"other": np.arange(0, MESH.n_cells, 2)})
    nearly = NeoHookean(young=2e6 * mu["p"] + 1e6, poisson=0.499)
    load = DeadTraction("x_max", (5e4, 0.0, 2e4))
    return SolidProblem(mesh, {"all": nearly, "other": other}, [fixed("x_min")], [load], mu)


def by_pressure_unknowns(mu: ParameterSymbols) -> SolidProblem:
    material = NeoHookean(young=3e6 * (1.0 + mu["p"]), poisson=0.4999)
    load = FollowerPressure("z_max", 1e5)
    mesh = block((1.0, 0.5, 0.5), (2, 1, 1), "hex20")
    return SolidProblem(mesh, {"all": material}, [fixed("x_min")], [load], mu, options=SolidOptions(mixed=True))


def by_fibre_angle(mu: ParameterSymbols) -> SolidProblem:
    fibre = turned_direction(mu["p"], (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    material = HolzapfelGasserOgden(shear=1e6, bulk=5e6, k1=2e6, k2=0.5, dispersion=0.1, fibre=fibre)
    load = DeadTraction("x_max", (2e5, 0.0, 0.0))
    return SolidProblem(MESH, {"all": material}, [fixed("x_min")], [load], mu)


def by_principal_stretches(mu: ParameterSymbols) -> SolidProblem:
    """Rubber and foam whose energies are sums of powers of stretches, in the cells that are default for hex8."""
    rubber = Ogden(moduli=(1e6 * (1.0 + mu["p"]), 1e5), exponents=(1.3, -2.0 - mu["p"]), bulk=1e7)
    foam = Hyperfoam(moduli=(5e5,), exponents=(4.0,), poissons=(0.3 * mu["p"],))
    mesh = block((1.0, 0.5, 0.5), (2, 1, 1), "hex8")
    mesh = replace(mesh, cell_sets={"foam": np.array([1])})
    return SolidProblem(mesh, {"all": rubber, "foam": foam}, [fixed("x_min")], [DeadTraction("x_max", DOWN)], mu)


def by_foundation(mu: ParameterSymbols) -> SolidProblem:
    supports = [ElasticFoundation("z_min", 1e6 * mu["p"]), ElasticFoundation("y_min", 1e6, normal_only=True)]
    return SolidProblem(MESH, {"all": RUBBER}, supports, [DeadTraction("x_max", DOWN)], mu)


def by_shape(mu: ParameterSymbols) -> SolidProblem:
    thicker = MESH.nodes * [0.0, 0.3, 1.0] + 0.1 * np.sin(2.0 * MESH.nodes)
    loads = [FollowerPressure("z_max", 3e4), DeadTraction("y_max", (0.0, 1e4, 0.0)), BodyForce((0, 0, 1e4))]
    supports = [
        fixed("x_min"),
        RigidRotation("x_max", (0.0, 1.0, 0.0), 0.2),
        ElasticFoundation("z_min", 1e6, normal_only=True),
    ]
    return SolidProblem(MESH, {"all": RUBBER}, supports, loads, mu, shape=[ShapeField(mu["p"] - 0.1, thicker)])


def by_contact(mu: ParameterSymbols) -> SolidProblem:
    down = 0.1 * mu["p"]
    contacts = [
        RigidSphere("z_max", (0.4 + 0.3 * mu["p"], 0.25, 0.9 - down), 0.4 - 0.2 * down),
        RigidCylinder("y_max", (0.8, 1.0 - down, 0.0), (0.1, 0.0, 1.0), 0.4),
        RigidPlane("z_min", (0.0, 0.0, -0.02 + down), (0.2, 0.0, 1.0)),
    ]
    return SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min")], [], mu, contacts=contacts)


def by_shape_in_contact(mu: ParameterSymbols) -> SolidProblem:
    thicker = ShapeField(mu["p"], MESH.nodes * [0.0, 0.0, 0.5])
    sphere = RigidSphere("x_max", (0.5, 0.25, 0.25), 0.62, inside=True)
    plane = RigidPlane("z_max", (0.0, 0.0, 0.52), (0.1, 0.0, -1.0))
    return SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min")], [], mu, shape=[thicker], contacts=[plane, sphere])


def by_contact_with_a_mesh(mu: ParameterSymbols) -> SolidProblem:
    """A hexagonal rod with edges, whose distance is smooth all the same."""
    rod = trimesh.creation.cylinder(0.3, 0.8, sections=6)
    place = (0.5 + 0.1 * mu["p"], 0.25, 0.9 - 0.2 * mu["p"])
    contact = RigidMesh("z_max", np.array(rod.vertices), np.array(rod.faces), place, spacing=0.05)
    return SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min")], [], mu, contacts=[contact])


MAKERS = [value for name, value in sorted(globals().items()) if name.startswith("by_")]


@pytest.mark.slow
@pytest.mark.parametrize("make", MAKERS, ids=lambda make: make.__name__[3:])
def test_derivatives_by_a_parameter(make: Callable[[ParameterSymbols], SolidProblem]) -> None:
    from_rest = make in (by_rotation, by_displacement, by_contact, by_contact_with_a_mesh, by_shape_in_contact)
    problem = make(load_parameter(p=0.0 if from_rest else 0.3))
    start = problem.initial_state()
    mu = np.array([0.3])
    state = solve(problem, mu, advance(problem, start, mu)[-1], EXACT)
    slopes = sensitivities(problem, state)
    fields = problem.sample_slopes(state.dofs, state.mu, slopes)
    step = 1e-4
    sides = [solve(problem, mu + h, state, EXACT) for h in (-2 * step, -step, step, 2 * step)]

    def difference(values: list) -> np.ndarray:
        return (values[0] - 8.0 * values[1] + 8.0 * values[2] - values[3]) / (12.0 * step)

    expected = difference([s.dofs for s in sides])
    assert np.abs(expected).max() > 0.0
    np.testing.assert_allclose(slopes[0], expected, atol=1e-6 * np.abs(expected).max())
    samples = [problem.sample(s.dofs, s.mu) for s in sides]
    for name in ("displacement", "strain", "stress"):
        expected = difference([s[name] for s in samples])
        np.testing.assert_allclose(fields[name][0], expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("make", [by_pressure, by_pressure_unknowns, by_foundation, by_shape, by_one_of_two_laws])
def test_tangent(make: Callable[[ParameterSymbols], SolidProblem]) -> None:
    problem = make(load_parameter(p=0.3))
    rng = np.random.default_rng(1)
    x = rng.uniform(-0.02, 0.02, problem.n_dofs)
    direction = rng.uniform(-1.0, 1.0, problem.n_dofs)
    mu, step = np.array([0.3]), 1e-5
    sides = [problem.residual(x + h * direction, mu) for h in (-2 * step, -step, step, 2 * step)]
    expected = (sides[0] - 8.0 * sides[1] + 8.0 * sides[2] - sides[3]) / (12.0 * step)
    linearisation = problem.linearise(x, mu)
    np.testing.assert_allclose(linearisation.apply(direction), expected, atol=1e-8 * np.abs(expected).max())
    right = np.where(problem.free, expected, 0.0)
    solution = linearisation.solve(right)
    back = np.where(problem.free, linearisation.apply(solution), 0.0)
    np.testing.assert_allclose(back, right, atol=1e-9 * np.abs(right).max())


def test_tangent_of_contact_with_obstacles() -> None:
    problem = by_contact(load_parameter(p=0.0))
    problem.symbols.set(np.array([0.3]))
    rng, n, step = np.random.default_rng(1), 3 * problem.displacements.n_scalar, 1e-7
    x, direction = rng.uniform(-0.02, 0.02, n), rng.uniform(-1.0, 1.0, n)
    assert problem.contact is not None
    expected = (problem.contact.residual(x + step * direction) - problem.contact.residual(x - step * direction)) / 2e-7
    found = problem.contact.tangent(x, limited=False) @ direction
    assert np.abs(expected).max() > 0.0
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_pressures_do_not_count_as_instability() -> None:
    """Taylor and Hood's pressures each add a negative pivot that says nothing of the solid."""
    material = NeoHookean(young=3e6, poisson=0.4999)
    for cell_type in ("tet10", "hex27"):
        problem = SolidProblem(
            block((1.0, 1.0, 1.0), (1, 1, 1), cell_type),
            {"all": material},
            [fixed("x_min")],
            options=SolidOptions(mixed=True),
        )
        linearisation = problem.linearise(np.zeros(problem.n_dofs), np.zeros(0))
        # Without PARDISO so many negative pivots cannot be counted.
        assert linearisation.negative_pivots in ((0,) if default_engine() == "pardiso" else (0, None))


@pytest.mark.parametrize("cell_type", ["tet10", "hex20"])
def test_a_block_that_widens_as_it_is_pulled_is_stable_in_mixed_elements(cell_type: str) -> None:
    """Of a negative Poisson's ratio; Lame's lambda is negative, and pressures would count as so many minima less."""
    mesh = block((1.0, 1.0, 1.0), (1, 1, 1), cell_type)
    loads = [DeadTraction("z_max", (0.0, 0.0, 1e4))]
    law = NeoHookean(young=1e6, poisson=-0.2)
    problem = SolidProblem(mesh, {"all": law}, [fixed("z_min")], loads, options=SolidOptions(mixed=True))
    assert loaded_state(problem, np.zeros(0)).negative_pivots == 0


def test_follower_pressure_makes_the_tangent_unsymmetric() -> None:
    assert not by_pressure(load_parameter(p=0.3)).assembly.symmetric
    assert by_dead_loads(load_parameter(p=0.3)).assembly.symmetric


def test_an_earlier_linearisation_survives_a_later_one() -> None:
    problem = by_pressure_unknowns(load_parameter(p=0.3))
    mu, right = np.array([0.3]), np.ones(problem.n_dofs)
    earlier = problem.linearise(np.zeros(problem.n_dofs), mu)
    expected = earlier.solve(right)
    other = np.random.default_rng(2).uniform(-0.01, 0.01, problem.n_dofs)
    problem.linearise(other, mu).solve(right)
    np.testing.assert_allclose(earlier.solve(right), expected, rtol=1e-10)


def test_reactions_balance_the_loads() -> None:
    """Forces and moments about any point, of supports and of the pressure on the deformed surface."""
    mu = load_parameter(p=0.3)
    loads = [DeadTraction("y_max", (1e4, 2e4, -5e3))]
    supports = [fixed("x_min"), RigidRotation("x_max", (0.0, 0.0, 1.0), mu["p"])]
    problem = SolidProblem(MESH, {"all": RUBBER}, supports, loads, mu)
    state = advance(problem, problem.initial_state(), np.array([0.3]))[-1]
    about = np.array([0.3, -0.2, 0.7])
    reactions = [problem.reactions(state.dofs, state.mu, name, about) for name in ("x_min", "x_max")]
    applied = 0.5 * np.array([1e4, 2e4, -5e3])  # the face is 1 m by 0.5 m
    np.testing.assert_allclose(sum(force for force, _ in reactions), -applied, rtol=1e-8)
    faces = MESH.face_nodes(MESH.surface("y_max"))
    corners = (MESH.nodes + problem.nodal_displacement(state.dofs))[faces]
    areas = np.linalg.norm(np.cross(*(MESH.nodes[faces[:, i]] - MESH.nodes[faces[:, 0]] for i in (1, 3))), axis=1)
    moment = np.cross(areas @ corners.mean(axis=1) / 0.5 - about, applied)
    np.testing.assert_allclose(sum(moment for _, moment in reactions), -moment, rtol=1e-8)


@pytest.mark.parametrize("problem_of", [by_rotation, by_pressure, by_dead_loads, by_foundation, by_shape])
def test_reactions_have_derivatives(problem_of: Callable[[ParameterSymbols], SolidProblem]) -> None:
    """Forces and moments about the origin, of supports that stay and that move, against central differences."""
    problem = problem_of(load_parameter(p=0.3))
    states = [solve(problem, np.array([p]), problem.initial_state()) for p in (0.3 - 1e-4, 0.3, 0.3 + 1e-4)]
    before, now, after = (reactions_about_origin(problem, state) for state in states)
    tangent = problem.linearise(states[1].dofs, states[1].mu)
    slopes = sensitivities(problem, states[1], tangent)
    of_forces = tangent.apply(slopes) + problem.residual_slopes(states[1].dofs, states[1].mu)
    for support, parts in now.items():
        found = problem.reaction_slopes(states[1].dofs, states[1].mu, slopes, of_forces, support, np.zeros(3))
        for index, slope in enumerate(found):
            expected = (after[support][index] - before[support][index]) / 2e-4
            np.testing.assert_allclose(slope[0], expected, atol=1e-6 * np.linalg.norm(parts[index]))


def reactions_about_origin(problem: SolidProblem, state: State) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    names = [support.on for support in problem.supports]
    return {name: problem.reactions(state.dofs, state.mu, name, np.zeros(3)) for name in names}
