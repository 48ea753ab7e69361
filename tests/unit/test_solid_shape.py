"""Shape parameters: a morphed problem is the problem on the morphed mesh; radius and thickness fields."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.kinematics import ShapeField
from morph_dslam.mechanics.loads import BodyForce, DeadTraction, FollowerPressure, MovingPatch
from morph_dslam.mechanics.morphing import radius_field, thickness_field
from morph_dslam.mechanics.solid import SolidOptions, SolidProblem
from morph_dslam.mechanics.supports import ElasticFoundation, RigidRotation, fixed
from morph_dslam.meshing.generators import block, tube
from tests.support.meshes import cell_volumes
from tests.support.solids import RUBBER, load_parameter, solved


@pytest.mark.parametrize(
    ("cell_type", "mixed", "bend"),
    # A mixed element's pressures are linear in the mesh's points: the same where the shape stays straight.
    [("hex8", False, 1.0), ("hex27", False, 1.0), ("hex20", True, 0.0), ("tet10", False, 1.0)],
)
def test_a_shape_parameter_moves_the_mesh(cell_type: str, mixed: bool, bend: float) -> None:
    mesh = block((1.0, 0.5, 0.5), (2, 1, 1), cell_type)
    field = np.column_stack([bend * mesh.nodes[:, 1] ** 2, 0.2 * mesh.nodes[:, 0], 0.5 * mesh.nodes[:, 2]])
    supports = [
        fixed("x_min"),
        RigidRotation("x_max", (0.0, 1.0, 0.0), 0.3),
        ElasticFoundation("y_min", 1e6, normal_only=True),
    ]
    loads = [
        FollowerPressure("z_max", 5e4),
        DeadTraction("y_max", (1e4, 0.0, 2e4)),
        BodyForce((0.0, 0.0, 1e4)),
        MovingPatch("z_max", (0.0, 0.0, -1e3), (0.5, 0.25, 0.5), 0.3),
    ]
    symbols = load_parameter(a=0.0)
    options = SolidOptions(mixed=mixed)
    morphed = SolidProblem(mesh, {"all": RUBBER}, supports, loads, symbols, options, [ShapeField(symbols["a"], field)])
    moved = replace(mesh, nodes=mesh.nodes + 0.3 * field)
    plain = SolidProblem(moved, {"all": RUBBER}, supports, loads, options=options)
    one, other = solved(morphed, 0.3), solved(plain)
    u, expected = morphed.nodal_displacement(one.dofs), plain.nodal_displacement(other.dofs)
    tolerance = 1e-7
    np.testing.assert_allclose(u, expected, atol=tolerance * np.abs(expected).max())
    for name in ("x_min", "x_max"):
        for a, b in zip(
            morphed.reactions(one.dofs, one.mu, name), plain.reactions(other.dofs, other.mu, name), strict=True
        ):
            np.testing.assert_allclose(a, b, atol=tolerance * np.abs(b).max())
    energy = plain.strain_energy(other.dofs, other.mu)
    assert morphed.strain_energy(one.dofs, one.mu) == pytest.approx(energy, rel=tolerance)


@pytest.mark.parametrize("cell_type", ["hex8", "hex20"])
def test_thickness_moves_the_outer_wall_only(cell_type: str) -> None:
    mesh = tube(0.02, 0.03, 0.04, (2, 2, 32), cell_type=cell_type)
    field = thickness_field(mesh, "outer", "inner")
    radii = np.linalg.norm(mesh.nodes[:, :2], axis=1)
    np.testing.assert_allclose(field[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(field[mesh.surface_nodes("inner")], 0.0, atol=1e-12)
    outer = mesh.surface_nodes("outer")
    np.testing.assert_allclose(field[outer, :2], mesh.nodes[outer, :2] / radii[outer, None], atol=1e-3)
    # Between two cylinders the harmonic share is that of the radius' logarithm.
    share = np.log(radii / 0.02) / np.log(1.5)
    np.testing.assert_allclose(np.linalg.norm(field, axis=1), share, atol=0.01)


def test_radius_keeps_the_wall() -> None:
    mesh = tube(0.02, 0.03, 0.04, (1, 1, 64), cell_type="hex20")
    field = radius_field(mesh.nodes, np.zeros(3), np.array([0.0, 0.0, 2.0]))
    wider = replace(mesh, nodes=mesh.nodes + 0.005 * field)
    np.testing.assert_allclose(cell_volumes(wider).sum(), np.pi * (0.035**2 - 0.025**2) * 0.04, rtol=1e-4)
    with pytest.raises(StudyError, match="no direction"):
        radius_field(mesh.nodes, np.zeros(3), np.zeros(3))


def test_a_thickness_lies_between_two_surfaces() -> None:
    mesh = block((1.0, 1.0, 1.0), (1, 1, 1), "hex8")
    with pytest.raises(StudyError, match="share 2 nodes"):
        thickness_field(mesh, "x_max", "z_min")
