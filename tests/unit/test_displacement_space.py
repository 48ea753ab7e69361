"""The mesh in NGSolve's hands: numbering, regions, curved cells, and where points lie."""

from __future__ import annotations

from dataclasses import replace

import ngsolve as ngs
import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.loads import DeadTraction
from morph_dslam.mechanics.materials.isotropic import NeoHookean
from morph_dslam.mechanics.ngsolve_mesh import NgsolveMesh, reference_points
from morph_dslam.mechanics.solid import SolidOptions, SolidProblem
from morph_dslam.mechanics.solvers.newton import solve
from morph_dslam.mechanics.spaces import DisplacementSpace
from morph_dslam.mechanics.supports import fixed
from morph_dslam.meshing.generators import block, tube
from morph_dslam.meshing.meshes import CellBlock, Mesh
from morph_dslam.model.point_location import material_points
from tests.support.meshes import cell_volumes
from tests.support.solids import SOLID_CELLS, distorted


@pytest.mark.parametrize("cell_type", SOLID_CELLS)
def test_fields_are_the_cells_own_interpolation(cell_type: str) -> None:
    """NGSolve's field of given nodal values is the cells' shape functions times these values."""
    mesh = distorted(block((1.0, 1.0, 1.0), (2, 2, 2), cell_type), 0.05)
    space = DisplacementSpace(NgsolveMesh(mesh))
    values = np.random.default_rng(0).uniform(-1.0, 1.0, (mesh.n_nodes, 3))
    coefficients = space.coefficients @ values
    np.testing.assert_allclose(space.node_values @ coefficients, values, atol=1e-13)
    volume = ngs.Integrate(ngs.CF(1.0), space.geometry.ngs, order=6)
    assert volume == pytest.approx(cell_volumes(mesh).sum(), rel=1e-9)
    field = ngs.GridFunction(space.vector)
    field.vec.FV().NumPy()[:] = coefficients.T.ravel()
    cells = mesh.blocks[0]
    reference, _ = cells.type.quadrature()
    weights = cells.type.shape_functions(reference)
    expected = np.einsum("pk,mka->mpa", weights, values[cells.connectivity]).reshape(-1, 3)
    places = np.einsum("pk,mka->mpa", weights, mesh.nodes[cells.connectivity]).reshape(-1, 3)
    points = space.geometry.mesh_points(
        np.repeat(space.geometry.element_of_cell, len(reference)),
        np.tile(reference_points(cells.type.shape, reference), (mesh.n_cells, 1)),
    )
    np.testing.assert_allclose(field(points), expected, atol=1e-12)
    np.testing.assert_allclose(ngs.CF((ngs.x, ngs.y, ngs.z))(points), places, atol=1e-12)


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("cell_type", SOLID_CELLS)
def test_higher_orders_contain_lower_ones(cell_type: str, order: int) -> None:
    """The same field at any point; and what a face's nodes hold is all that does not vanish on the face."""
    mesh = distorted(block((1.0, 1.0, 1.0), (2, 2, 2), cell_type), 0.05)
    low, high = DisplacementSpace(NgsolveMesh(mesh)), DisplacementSpace(NgsolveMesh(mesh), order)
    random = np.random.default_rng(0)
    given = random.uniform(-1.0, 1.0, 3 * low.n_scalar)
    elements, places = np.arange(mesh.n_cells), random.uniform(0.05, 0.3, (mesh.n_cells, 3))
    values = []
    for space, dofs in ((low, given), (high, high.embedded(low, given))):
        field = ngs.GridFunction(space.vector)
        field.vec.FV().NumPy()[:] = dofs
        values.append(np.asarray(field(space.geometry.mesh_points(elements, places))))
    assert np.abs(values[0]).max() > 0.1
    np.testing.assert_allclose(values[1], values[0], atol=1e-12)
    held, face = high.dofs_on(mesh.set_nodes("x_min")), high.geometry.boundary("x_min")
    free = random.uniform(1.0, 2.0, high.n_scalar)
    free[held] = 0.0
    left = ngs.GridFunction(high.scalar)
    left.vec.FV().NumPy()[:] = free
    assert ngs.Integrate(ngs.CF(left) ** 2, high.geometry.ngs, ngs.BND, definedon=face) < 1e-24
    on_face = {d for e in face.Elements() for d in high.scalar.GetDofNrs(ngs.ElementId(e))}
    assert set(held) == {d for d in on_face if d >= 0}


@pytest.mark.parametrize("cell_type", SOLID_CELLS)
def test_a_set_holds_its_own_nodes(cell_type: str) -> None:
    mesh = block((1.0, 1.0, 1.0), (2, 2, 2), cell_type)
    space = DisplacementSpace(NgsolveMesh(mesh))
    nodes = mesh.set_nodes("x_min")
    held = space.dofs_on(nodes)
    assert len(held) == len(nodes)
    free_function = np.ones(space.n_scalar)
    free_function[held] = 0.0
    np.testing.assert_allclose((space.node_values @ free_function)[nodes], 0.0, atol=1e-15)


def test_higher_order_on_straight_cells_holds_the_whole_face() -> None:
    mesh = block((1.0, 1.0, 1.0), (2, 2, 2), "hex8")
    space = DisplacementSpace(NgsolveMesh(mesh), order=2)
    assert space.n_scalar == 5**3
    assert len(space.dofs_on(mesh.set_nodes("x_min"))) == 5**2


def test_order_2_on_hex8_is_hex27() -> None:
    solutions = []
    for cell_type, order in (("hex8", 2), ("hex27", None)):
        mesh = block((1.0, 0.2, 0.2), (3, 1, 1), cell_type)
        problem = SolidProblem(
            mesh,
            {"all": NeoHookean(young=1e6, poisson=0.3)},
            [fixed("x_min")],
            [DeadTraction("x_max", (0.0, 0.0, 100.0))],
            options=SolidOptions(order=order),
        )
        state = solve(problem, np.zeros(0), problem.initial_state())
        corners = [n for n in mesh.set_nodes("x_max") if not (mesh.nodes[n, 1:] % 0.2).round(9).any()]
        solutions.append(problem.nodal_displacement(state.dofs)[corners])
    np.testing.assert_allclose(solutions[0], solutions[1], rtol=1e-9, atol=1e-12)


def test_overlapping_sets_become_regions() -> None:
    mesh = block((3.0, 1.0, 1.0), (3, 1, 1), "hex8")
    faces = mesh.surfaces["z_max"]
    mesh = replace(
        mesh, cell_sets={"a": np.array([0, 1]), "b": np.array([1, 2])}, surfaces={**mesh.surfaces, "part": faces[:1]}
    )
    geometry = NgsolveMesh(mesh)
    for name, volume in (("a", 2.0), ("b", 2.0), ("all", 3.0)):
        assert ngs.Integrate(ngs.CF(1.0) * ngs.dx(geometry.region(name)), geometry.ngs) == pytest.approx(volume)
    for name, area in (("part", 1.0), ("z_max", 3.0), ("x_min", 1.0)):
        assert ngs.Integrate(ngs.CF(1.0) * ngs.ds(geometry.boundary(name)), geometry.ngs) == pytest.approx(area)
    numbers = geometry.cell_field(np.array([1.0, 10.0, 100.0]))
    found = [ngs.Integrate(numbers, geometry.ngs, definedon=geometry.region(name)) for name in "ab"]
    assert found == pytest.approx([11.0, 110.0])


def test_normals_point_out_of_curved_cells() -> None:
    mesh = tube(0.02, 0.03, 0.05, (1, 1, 24), cell_type="hex20")
    space = DisplacementSpace(NgsolveMesh(mesh))
    outward = ngs.specialcf.normal(3) * ngs.CF((ngs.x, ngs.y, 0.0))
    for name, flux in (("outer", 0.03**2), ("inner", -(0.02**2))):
        found = ngs.Integrate(outward * ngs.ds(space.geometry.boundary(name)), space.geometry.ngs)
        assert found == pytest.approx(2.0 * np.pi * flux * 0.05, rel=2e-4)


@pytest.mark.parametrize("cell_type", ["hex20", "tet10", "prism18"])
def test_points_are_found_in_curved_cells(cell_type: str) -> None:
    mesh = distorted(block((1.0, 1.0, 1.0), (3, 3, 3), cell_type), 0.03)
    points = np.random.default_rng(3).uniform(0.01, 0.99, (200, 3))
    found = material_points(mesh.nodes, {cell_type: mesh.blocks[0].connectivity}, points)
    back = np.einsum("pk,pka->pa", found.weights, mesh.nodes[found.corners])
    np.testing.assert_allclose(back, points, atol=1e-10)


def test_cells_that_do_not_go_together_are_refused() -> None:
    one, two = block((1.0, 1.0, 1.0), (1, 1, 1), "hex8"), block((1.0, 1.0, 1.0), (1, 1, 1), "hex20")
    nodes = np.concatenate([one.nodes, two.nodes])
    second = CellBlock("hex20", two.blocks[0].connectivity + len(one.nodes))
    with pytest.raises(StudyError, match="first- and second-order cells meet"):
        DisplacementSpace(NgsolveMesh(Mesh(nodes, (one.blocks[0], second))))
