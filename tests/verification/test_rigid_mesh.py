"""Rigid bodies from files of triangles as obstacles, against bodies whose distance is known in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.contact import RigidObstacle, RigidSphere
from morph_dslam.mechanics.materials.isotropic import NeoHookean
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.rigid_mesh import RigidMesh
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.continuation import advance
from morph_dslam.mechanics.supports import fixed
from morph_dslam.meshing.generators import block
from morph_dslam.meshing.mesh_files import load_closed_surface
from tests.support.solids import load_parameter

RADIUS = 15e-3
BALL = trimesh.creation.icosphere(5, radius=RADIUS)


def body(mesh: trimesh.Trimesh, **others: object) -> RigidMesh:
    return RigidMesh("z_max", np.array(mesh.vertices), np.array(mesh.faces), **others)  # type: ignore[arg-type]


def test_distance_from_a_box() -> None:
    """To a hundredth of the spacing, and to a quarter of it near edges, which are rounded; what is outside stays so."""
    half, rng = np.array([1.0, 0.5, 0.25]), np.random.default_rng(0)
    box = body(trimesh.creation.box(2.0 * half), spacing=0.04)
    points = rng.uniform(-1.2, 1.2, (20000, 3)) * half
    beyond = np.abs(points) - half
    expected = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
    found = box.touch(ParameterSymbols(), points).gap
    assert (found[expected > box.tolerance] > 0.0).all()
    near = (expected < -box.tolerance) & (expected > -0.04)
    assert near.sum() > 1000
    assert np.abs(found - expected)[near].max() < 0.25 * 0.04
    # Far from edges there is nothing to round.
    inner = near & (np.sort(beyond, axis=1)[:, 1] < -4 * 0.04)
    np.testing.assert_allclose(found[inner], expected[inner], atol=0.01 * 0.04)


def test_distance_from_a_ring_is_that_of_its_circle() -> None:
    """Of a shape with a hole: depth, normal and curvature; triangles are off by what their arcs rise above them."""
    torus = body(trimesh.creation.torus(1.0, 0.3, major_sections=128, minor_sections=64), place=(0.1, 0.0, 0.0))
    rng = np.random.default_rng(1)
    turn, around = rng.uniform(0.0, 2.0 * np.pi, (2, 2000))
    depth = rng.uniform(0.005, 0.1, 2000)
    out = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(2000)])
    normal = np.cos(around)[:, None] * out + np.sin(around)[:, None] * [0.0, 0.0, 1.0]
    touch = torus.touch(ParameterSymbols(), [0.1, 0.0, 0.0] + out + (0.3 - depth)[:, None] * normal)
    np.testing.assert_allclose(touch.gap, -depth, atol=1e-3)
    np.testing.assert_allclose(touch.normal, normal, atol=0.05)


def pressed(obstacle: RigidObstacle, symbols: ParameterSymbols) -> tuple[np.ndarray, float]:
    """Displacements of a soft block under an obstacle that has come down by 3 mm, and the force on its base."""
    mesh = block((40e-3, 40e-3, 20e-3), (10, 10, 4), "hex8")
    rubber = {"all": NeoHookean(young=1e6, poisson=0.4)}
    problem = SolidProblem(mesh, rubber, [fixed("z_min")], [], symbols, contacts=[obstacle])
    state = advance(problem, problem.initial_state(), np.array([3.0]))[-1]
    return problem.nodal_displacement(state.dofs), problem.reactions(state.dofs, state.mu, "z_min")[0][2]


def test_a_ball_of_triangles_presses_as_a_sphere() -> None:
    symbols = load_parameter(depth=0.0)
    centre = (20e-3, 20e-3, 20e-3 + RADIUS - 1e-3 * symbols["depth"])
    expected, force = pressed(RigidSphere("z_max", centre, RADIUS), symbols)
    found, found_force = pressed(body(BALL, place=centre, spacing=RADIUS / 20.0), symbols)
    assert force > 1.0
    assert found_force == pytest.approx(force, rel=5e-3)
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())


def test_a_ball_that_overlaps_at_rest_is_refused() -> None:
    with pytest.raises(StudyError, match=r"the mesh reaches 1 mm into the undeformed surface 'z_max'"):
        pressed(body(BALL, place=(20e-3, 20e-3, 19e-3 + RADIUS), spacing=1e-3), load_parameter(depth=0.0))


def test_surfaces_that_bound_no_body_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "ball.stl"
    for faces, message in {
        "open": (BALL.faces[1:], "not watertight: 3 edges"),
        "inside out": (BALL.faces[:, ::-1], "face inwards"),
        "mixed": (np.vstack([BALL.faces[:1, ::-1], BALL.faces[1:]]), "do not all turn the same way"),
    }.values():
        trimesh.Trimesh(BALL.vertices, faces, process=False).export(file)
        with pytest.raises(StudyError, match=message):
            load_closed_surface(file, "m")
    with pytest.raises(StudyError, match=r"cannot read the surface .*none\.stl"):
        load_closed_surface(tmp_path / "none.stl", "m")


@pytest.mark.slow
def test_meshes_whose_inside_is_not_one_are_refused() -> None:
    """A part that is turned inwards is a cavity of the body around it, and refused nowhere."""
    point, inner = np.zeros((1, 3)), BALL.copy().apply_scale(0.5)
    for other in (BALL.copy().apply_translation([1.2 * RADIUS, 0.0, 0.0]), inner):
        with pytest.raises(StudyError, match="passes through itself, or has a part within another"):
            body(trimesh.util.concatenate([BALL, other]), spacing=1e-3).touch(ParameterSymbols(), point)
    inner.invert()
    shell = body(trimesh.util.concatenate([BALL, inner]), spacing=1e-3)
    depths = -shell.touch(ParameterSymbols(), np.array([[0.0, 0.0, 0.6 * RADIUS], [0.0, 0.0, 0.0]])).gap
    np.testing.assert_allclose(depths, [0.1 * RADIUS, -0.5 * RADIUS], atol=0.02 * RADIUS)
    with pytest.raises(StudyError, match="give a smaller spacing"):
        body(trimesh.creation.box([40e-3, 40e-3, 0.5e-3]), spacing=1e-3).touch(ParameterSymbols(), point)


def test_grids_that_cannot_be_are_refused() -> None:
    ball = body(BALL)
    with pytest.raises(StudyError, match="must be positive"):
        replace(ball, spacing=-1e-3)
    with pytest.raises(StudyError, match="take a larger spacing"):
        replace(ball, spacing=1e-4)
