"""Surfaces that touch each other, and themselves, against rigid planes in their place, and against CalculiX."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.peers.calculix_ring import REFERENCE, half_ring, study

from morph_dslam import make_study
from morph_dslam.mechanics.contact import RigidPlane, SurfaceContact
from morph_dslam.mechanics.kinematics import ShapeField
from morph_dslam.mechanics.materials.isotropic import StVenantKirchhoff
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.continuation import advance
from morph_dslam.mechanics.solvers.newton import State, sensitivities, solve
from morph_dslam.mechanics.supports import PrescribedDisplacement
from morph_dslam.meshing.generators import block, tube
from morph_dslam.meshing.inp_writing import save_mesh
from morph_dslam.meshing.meshes import CellBlock, Mesh
from morph_dslam.studies.solid_study import SolidStudy
from tests.support.solids import RUBBER, load_parameter

INNER, OUTER = 8e-3, 10e-3


def ring(half: bool, symbols: ParameterSymbols) -> SolidProblem:
    """A ring between planes that come nearer: its half x > 0, touching itself, or a quarter, y > 0, on a plane.

    A second parameter, if there is one, makes it wider than it is high.
    """
    lower, cells = (-np.pi / 2.0, 32) if half else (0.0, 16)
    mesh = tube(INNER, OUTER, 2e-3, (1, 2, cells), "hex8", (lower, np.pi / 2.0))
    flat = {"flat": np.flatnonzero(np.abs(mesh.nodes[:, 1]) < 1e-9), "sides": np.arange(mesh.n_nodes)}
    mesh = replace(mesh, node_sets={**mesh.node_sets, **flat})
    cut = {"x": 0.0}
    supports = [
        PrescribedDisplacement("sides", z=0.0),
        PrescribedDisplacement("flat", y=0.0),
        PrescribedDisplacement("end", **cut),
    ]
    down = OUTER - 1e-3 * symbols["push"]
    planes = [RigidPlane("outer", (0.0, down, 0.0), (0.0, -1.0, 0.0))]
    if half:
        supports.append(PrescribedDisplacement("start", **cut))
        planes.append(RigidPlane("outer", (0.0, -down, 0.0), (0.0, 1.0, 0.0)))
        touching = SurfaceContact("inner", "inner")
    else:
        touching = RigidPlane("inner", (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    wider = [ShapeField(p, mesh.nodes * [1.0, 0.0, 0.0]) for p in (symbols[q.name] for q in symbols.parameters[1:])]
    return SolidProblem(mesh, {"all": RUBBER}, supports, [], symbols, shape=wider, contacts=[*planes, touching])


def flattened(half: bool, push: float) -> tuple[SolidProblem, State]:
    problem = ring(half, load_parameter(push=0.0))
    return problem, advance(problem, problem.initial_state(), np.array([push]))[-1]


def test_a_ring_that_is_flattened_until_it_touches_itself() -> None:
    """Its halves meet at their plane of symmetry, as a quarter meets a rigid plane there."""
    (half, state), (quarter, reference) = flattened(True, 8.3), flattened(False, 8.3)
    force = half.contact_forces(state.dofs, state.mu, 0)[1].sum()
    expected = quarter.contact_forces(reference.dofs, reference.mu, 0)[1].sum()
    assert force == pytest.approx(expected, rel=0.015)
    deformed = half.mesh.nodes + half.nodal_displacement(state.dofs)
    upper = np.intersect1d(half.mesh.set_nodes("inner"), np.flatnonzero(half.mesh.nodes[:, 1] > 1e-9))
    # Without contact they would have passed by a third of a millimetre.
    assert -5e-6 < deformed[upper, 1].min() < 0.0
    # What the surface does to itself adds up to nothing.
    np.testing.assert_allclose(half.contact_forces(state.dofs, state.mu, 2).sum(axis=1), 0.0, atol=1e-9 * abs(force))


@pytest.mark.slow
def test_a_bent_ring_that_touches_itself_has_the_force_of_calculix(tmp_path: Path) -> None:
    """Before its walls meet at 18 mm, soon after and far beyond, as a study; on the same mesh, with other contact."""
    save_mesh(tmp_path / "ring.inp", half_ring(), "mm")
    made = make_study(study(tmp_path / "ring.inp"))
    assert isinstance(made, SolidStudy)
    problem = made.problem()
    state = problem.initial_state()
    for push, expected in [REFERENCE[0], REFERENCE[2], REFERENCE[-1]]:
        state = advance(problem, state, np.array([push / 1e3]))[-1]
        assert -problem.reactions(state.dofs, state.mu, "end")[0][1] == pytest.approx(expected, rel=5e-3)


def stacked() -> Mesh:
    """Two cubes, one on the other, of 2 x 2 x 2 and 3 x 3 x 3 cells; surfaces below and above where they meet."""
    lower, upper = block((1.0, 1.0, 1.0), (2, 2, 2), "hex8"), block((1.0, 1.0, 1.0), (3, 3, 3), "hex8")
    nodes = np.vstack([lower.nodes, upper.nodes + np.array([0.0, 0.0, 1.0])])
    cells = [lower.blocks[0].connectivity, upper.blocks[0].connectivity + lower.n_nodes]
    surfaces = {"below": lower.surface("z_max"), "above": upper.surface("z_min") + np.array([lower.n_cells, 0])}
    sets = {f"{axis}_min": np.flatnonzero(nodes[:, i] == 0.0) for i, axis in enumerate("xyz")} | {
        "z_max": np.flatnonzero(nodes[:, 2] == 2.0)
    }
    return Mesh(nodes, (CellBlock("hex8", np.vstack(cells)),), sets, {}, surfaces)


def two_blocks() -> SolidProblem:
    """The upper block pushed down by a parameter."""
    symbols = load_parameter(push=0.0)
    supports = [PrescribedDisplacement(f"{axis}_min", **{axis: 0.0}) for axis in "xyz"]
    supports.append(PrescribedDisplacement("z_max", z=-symbols["push"]))
    material = StVenantKirchhoff(young=1e6, poisson=0.3)
    contacts = [SurfaceContact("below", "above")]
    return SolidProblem(stacked(), {"all": material}, supports, [], symbols, contacts=contacts)


def test_patch_of_two_blocks() -> None:
    """Pushed by a tenth, blocks whose cells do not match have nearly one stress, P = l E (l^2 - 1) / 2."""
    problem = two_blocks()
    state = advance(problem, problem.initial_state(), np.array([0.2]))[-1]
    expected = 0.9 * 1e6 * (0.9**2 - 1.0) / 2.0
    assert problem.reactions(state.dofs, state.mu, "z_max")[0][2] == pytest.approx(expected, rel=1e-3)
    stress = problem.recovery.at_nodes(state.dofs, state.mu, ("first_piola_kirchhoff",))["first_piola_kirchhoff"]
    np.testing.assert_allclose(stress[:, 8], expected, rtol=0.01)


def test_derivatives_of_two_blocks() -> None:
    """The surfaces are bent, so that normals turn as points slide; forces that are not balanced make no difference."""
    problem = two_blocks()
    state = advance(problem, problem.initial_state(), np.array([0.1]))[-1]
    n, rng = 3 * problem.displacements.n_scalar, np.random.default_rng(0)
    x = state.dofs[:n] + rng.uniform(-5e-3, 5e-3, n)
    direction, step = rng.uniform(-1.0, 1.0, n), 1e-7
    assert problem.contact is not None
    sides = [problem.contact.residual(x + h * direction) for h in (-step, step)]
    expected = (sides[1] - sides[0]) / (2.0 * step)
    found = problem.contact.tangent(x, limited=False) @ direction
    assert np.abs(expected).max() > 0.0
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1], ids=["a motion", "the shape"])
def test_derivatives_of_a_ring_that_touches_itself(number: int) -> None:
    """Of displacements and reactions, with plane and self-contact, against differences of full solutions."""
    problem = ring(True, load_parameter(push=0.0, wider=0.0))
    mu, step = np.array([8.3, 0.0]), np.eye(2)[number] * [1e-4, 1e-5][number]
    state = solve(problem, mu, advance(problem, problem.initial_state(), mu)[-1], 1e-12)
    assert np.abs(problem.contact_forces(state.dofs, mu, 2)).max() > 0.1
    tangent = problem.linearise(state.dofs, mu)
    slopes = sensitivities(problem, state, tangent)
    of_forces = tangent.apply(slopes) + problem.residual_slopes(state.dofs, mu)
    about = np.zeros(3)
    found = problem.reaction_slopes(state.dofs, mu, slopes, of_forces, "end", about)
    before, after = (solve(problem, mu + h, state, 1e-12) for h in (-step, step))
    expected = (after.dofs - before.dofs) / (2.0 * step.max())
    assert np.linalg.norm(slopes[number] - expected) < 1e-4 * np.linalg.norm(expected)
    sides = [problem.reactions(s.dofs, s.mu, "end", about) for s in (before, after)]
    for slope, low, high in zip(found, *sides, strict=True):
        reaction = (high - low) / (2.0 * step.max())
        np.testing.assert_allclose(slope[number], reaction, atol=1e-4 * float(np.linalg.norm(reaction)))
