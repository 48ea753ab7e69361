"""Meshes: surfaces, sets, conversion between orders, repair, and lookup of faces."""

from dataclasses import replace
from math import factorial

import numpy as np
import pytest
import trimesh

from morph_dslam.errors import StudyError
from morph_dslam.meshing.generators import SOLIDS, block, tube
from morph_dslam.meshing.mesh_checks import check_mesh
from morph_dslam.meshing.mesh_repair import reoriented, without_collapsed_cells
from morph_dslam.meshing.mesh_summary import faces_figures
from morph_dslam.meshing.meshes import CellBlock, Mesh, find_faces, with_found_surfaces
from morph_dslam.meshing.second_order import FIRST_ORDER, to_second_order
from morph_dslam.model.cell_types import cell_type
from tests.support.meshes import SHEET, cell_volumes


def enclosed_volume(mesh):
    """By the divergence theorem over the triangles of the outer surface."""
    a, b, c = np.moveaxis(mesh.nodes[mesh.surface_triangles()], 1, 0)
    return np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0


def mixed():
    """A hexahedron with a prism on its x_max face, each a set."""
    cube = block((1.0, 1.0, 1.0), (1, 1, 1), "hex8")
    nodes = np.vstack([cube.nodes, [[2.0, 0.0, 0.0], [2.0, 0.0, 1.0]]])
    at = {tuple(point): i for i, point in enumerate(nodes.tolist())}
    corners = [(1, 0, 0), (2, 0, 0), (1, 1, 0), (1, 0, 1), (2, 0, 1), (1, 1, 1)]
    prism = np.array([[at[corner] for corner in corners]])
    return Mesh(nodes, (*cube.blocks, CellBlock("prism6", prism)), cell_sets={"tip": np.array([1])})


@pytest.mark.parametrize("name", SOLIDS)
def test_the_triangles_of_the_surface_face_outwards_and_enclose_the_volume(name):
    assert enclosed_volume(block((1.0, 2.0, 3.0), (2, 1, 2), name)) == pytest.approx(6.0, rel=1e-12)


def test_cells_of_two_types_share_a_face_and_enclose_one_volume():
    mesh = mixed()
    check_mesh(mesh, regions=("tip", "all"))
    assert (mesh.n_cells, len(mesh.boundary_faces())) == (2, 5 + 4)
    assert enclosed_volume(mesh) == pytest.approx(1.5, rel=1e-14)
    np.testing.assert_allclose(cell_volumes(mesh), [1.0, 0.5])
    refined = to_second_order(mesh, "hex27", "prism18")
    assert [part.cell_type for part in refined.blocks] == ["hex27", "prism18"]
    # 27 and 18 nodes less the 9 that they share.
    assert refined.n_nodes == 36
    assert enclosed_volume(refined) == pytest.approx(1.5, rel=1e-14)


def test_faces_have_their_nodes_and_shorter_ones_end_in_minus_one():
    mesh = mixed()
    nodes = mesh.face_nodes(np.array([[0, 3], [1, 0]]))
    np.testing.assert_allclose(mesh.nodes[nodes[0]][:, 0], 1.0)
    assert nodes[1, 3] == -1
    np.testing.assert_allclose(mesh.nodes[nodes[1, :3]][:, 2], 0.0)


def test_faces_are_found_by_their_corners_in_any_order():
    mesh = mixed()
    faces = mesh.all_faces()
    corners = mesh.face_nodes(faces, corners_only=True)
    found = find_faces(mesh, corners[:, [2, 0, 3, 1]])
    np.testing.assert_array_equal(np.sort(mesh.face_nodes(found, corners_only=True)), np.sort(corners))
    np.testing.assert_array_equal(find_faces(mesh, np.array([[0, 1, 9]])), [[-1, -1]])


@pytest.mark.parametrize("name", sorted(set(FIRST_ORDER) & set(SOLIDS)))
def test_second_order_cells_made_from_first_order_ones_are_the_generators_own(name):
    linear = block((1.0, 2.0, 3.0), (2, 1, 2), FIRST_ORDER[name])
    refined, direct = to_second_order(linear, name), block((1.0, 2.0, 3.0), (2, 1, 2), name)
    check_mesh(refined)
    for mesh in (refined, direct):
        for face in mesh.surfaces:
            np.testing.assert_array_equal(mesh.set_nodes(face), mesh.surface_nodes(face))
    np.testing.assert_allclose(np.sort(refined.nodes, axis=0), np.sort(direct.nodes, axis=0))
    np.testing.assert_array_equal(refined.nodes[: linear.n_nodes], linear.nodes)


def test_a_set_takes_in_the_middle_nodes_between_its_members_alone():
    linear = replace(block((1.0, 1.0, 1.0), (2, 2, 2), "hex8"), surfaces={})
    edge = np.flatnonzero((linear.nodes[:, 0] == 0) & (linear.nodes[:, 1] == 0))
    refined = to_second_order(replace(linear, node_sets={"edge": edge}), "hex20")
    points = refined.nodes[refined.set_nodes("edge")]
    np.testing.assert_allclose(np.sort(points[:, 2]), [0, 0.25, 0.5, 0.75, 1])
    np.testing.assert_allclose(points[:, :2], 0.0)


def test_cells_of_second_order_get_no_more_nodes():
    with pytest.raises(StudyError, match="quad9 cells cannot be given middle nodes"):
        to_second_order(to_second_order(SHEET))


def fan(surface):
    """Tetrahedra between the triangles of a closed convex surface and its middle."""
    nodes = np.vstack([surface.vertices, np.mean(surface.vertices, axis=0)])
    middle = np.full(len(surface.faces), len(nodes) - 1)
    return Mesh(nodes, (CellBlock("tet4", np.column_stack([surface.faces, middle])),))


def test_a_flat_end_is_one_surface_though_single_precision_and_decimation_leave_it_uneven():
    drawn = trimesh.creation.box((0.1, 0.08, 0.04)).subdivide().subdivide()
    uneven = np.random.default_rng(0).uniform(-1e-6, 1e-6, drawn.vertices.shape)
    mesh = with_found_surfaces(fan(trimesh.Trimesh(drawn.vertices + uneven, drawn.faces, process=False)))
    areas = {"x": 0.08 * 0.04, "y": 0.1 * 0.04, "z": 0.1 * 0.08}
    found = {name: faces_figures(mesh, faces)[0] for name, faces in mesh.surfaces.items()}
    assert found == pytest.approx({f"{axis}_{end}": areas[axis] for axis in "xyz" for end in ("min", "max")}, rel=1e-4)


def test_curved_surfaces_have_no_flat_ends_however_fine():
    """A pole's next nodes are 2e-5 of the sphere's diameter away from its end, the side's 8e-5 of the cylinder's."""
    assert not with_found_surfaces(fan(trimesh.creation.uv_sphere(0.05, count=(360, 40)))).surfaces
    upright = with_found_surfaces(fan(trimesh.creation.cylinder(0.05, 0.1, sections=360)))
    assert upright.surfaces.keys() == {"z_min", "z_max"}
    side = np.pi * 0.05**2
    assert faces_figures(upright, upright.surfaces["z_min"])[0] == pytest.approx(side, rel=1e-4)


def test_unknown_names_are_refused_with_the_known_ones():
    mesh = mixed()
    with pytest.raises(StudyError, match="no cell set 'tipp'; it has: tip"):
        mesh.cells("tipp")
    with pytest.raises(StudyError, match="no node set or surface 'x_min'; it has: none"):
        mesh.set_nodes("x_min")


def test_nodes_without_cells_go_and_sets_are_renumbered():
    cube = block((1.0, 1.0, 1.0), (1, 1, 1), "hex8")
    padded = Mesh(
        np.vstack([[[9.0, 9.0, 9.0]], cube.nodes]),
        (CellBlock("hex8", cube.blocks[0].connectivity + 1),),
        node_sets={"all_and_more": np.arange(9)},
    )
    mesh = padded.without_unused_nodes()
    np.testing.assert_array_equal(mesh.nodes, cube.nodes)
    np.testing.assert_array_equal(mesh.node_sets["all_and_more"], np.arange(8))


@pytest.mark.parametrize("name", SOLIDS)
def test_mirrored_cells_are_turned_round_and_keep_their_surfaces(name):
    mesh = block((1.0, 2.0, 3.0), (2, 1, 2), name)
    mirrored = replace(mesh, nodes=mesh.nodes * [1.0, 1.0, -1.0])
    mended = reoriented(mirrored)
    check_mesh(mended)
    assert cell_volumes(mended).sum() == pytest.approx(6.0, rel=1e-12)
    for surface in mesh.surfaces:
        np.testing.assert_array_equal(mended.surface_nodes(surface), mesh.surface_nodes(surface))
    assert reoriented(mesh) is mesh


@pytest.mark.parametrize("axis", [0, 1])
def test_hexahedra_collapsed_onto_an_axis_become_prisms(axis):
    # A tube squeezed until its inner wall is a line: the innermost cells are wedges of a pie.
    pipe = tube(0.02, 0.03, 0.1, (3, 2, 16), "hex8")
    inner = np.hypot(pipe.nodes[:, 0], pipe.nodes[:, 1]) < 0.0201
    nodes = pipe.nodes.copy()
    nodes[inner, :2] = 0.0
    nodes, merged = np.unique(nodes.round(9), axis=0, return_inverse=True)
    mesh = Mesh(nodes, (CellBlock("hex8", merged.ravel()[pipe.blocks[0].connectivity]),),
                cell_sets={"first": np.arange(5)}, surfaces=dict(pipe.surfaces))  # fmt: skip
    if axis:  # the same with the cells' own axes interchanged
        order = [0, 3, 7, 4, 1, 2, 6, 5]
        turned = CellBlock("hex8", mesh.blocks[0].connectivity[:, order])
        mesh = replace(mesh, blocks=(turned,), surfaces={"outer": find_faces(
            replace(mesh, blocks=(turned,)), mesh.face_nodes(mesh.surface("outer")))})  # fmt: skip
    with pytest.raises(StudyError, match="48 hex8 cells use a node twice"):
        check_mesh(mesh)
    mended = reoriented(without_collapsed_cells(mesh))
    check_mesh(mended)
    assert [(part.cell_type, len(part.connectivity)) for part in mended.blocks] == [("hex8", 48), ("prism6", 48)]
    # 16-sided polygon of radius 30 mm, 0.1 m long.
    assert cell_volumes(mended).sum() == pytest.approx(8 * np.sin(np.pi / 8) * 0.03**2 * 0.1, rel=1e-6)
    np.testing.assert_allclose(np.hypot(*mended.nodes[mended.set_nodes("outer"), :2].T), 0.03, rtol=1e-6)
    centres = [sorted(_centre(m, cell) for cell in m.cells("first")) for m in (mesh, mended)]
    assert centres[0] == centres[1]


@pytest.mark.parametrize("face", cell_type("hex8").faces)
@pytest.mark.parametrize("start", [0, 1])
def test_a_cube_two_of_whose_edges_vanish_is_half_of_it(face, start):
    nodes, cell = cell_type("hex8").nodes, np.arange(8)
    a, b, c, d = np.roll(face, start)
    cell[b], cell[c] = a, d
    mesh = Mesh(nodes, (CellBlock("hex8", cell[None]),)).without_unused_nodes()
    mended = without_collapsed_cells(mesh)
    assert [block.cell_type for block in mended.blocks] == ["prism6"]
    assert cell_volumes(mended) == pytest.approx([0.5])


def _centre(mesh, cell):
    starts = mesh.block_starts()
    i = int(np.searchsorted(starts, cell, side="right")) - 1
    corners = np.unique(mesh.blocks[i].connectivity[cell - starts[i]])
    return tuple(mesh.nodes[corners].mean(axis=0).round(9))


VOLUMES = {"tri": 1 / 2, "quad": 1.0, "tet": 1 / 6, "prism": 1 / 2, "hex": 1.0}
CELL_TYPES = (*SOLIDS, "tri3", "quad4")


@pytest.mark.parametrize("name", CELL_TYPES)
def test_each_shape_function_is_one_at_its_node_and_nought_at_the_others(name):
    kind = cell_type(name)
    np.testing.assert_allclose(kind.shape_functions(kind.nodes), np.eye(len(kind.nodes)), atol=1e-12)


@pytest.mark.parametrize("name", CELL_TYPES)
def test_gradients_are_the_slopes_of_the_shape_functions(name):
    kind = cell_type(name)
    point, step = np.full((1, kind.dimension), 0.21), 1e-6
    for axis in range(kind.dimension):
        shift = step * np.eye(kind.dimension)[axis]
        slopes = (kind.shape_functions(point + shift) - kind.shape_functions(point - shift)) / (2 * step)
        np.testing.assert_allclose(kind.shape_gradients(point)[:, :, axis], slopes, atol=1e-8)


@pytest.mark.parametrize("name", CELL_TYPES)
def test_quadrature_integrates_the_volume_and_the_square_of_a_coordinate(name):
    kind = cell_type(name)
    points, weights = kind.quadrature()
    assert weights.sum() == pytest.approx(VOLUMES[kind.shape], rel=1e-13)
    # Of x^2: 2! / (2 + dim)! over a simplex (Dirichlet), 1/3 over a cube; a prism has its triangle's.
    simplex = {"tri": 2 / factorial(4), "prism": 2 / factorial(4), "tet": 2 / factorial(5)}
    assert weights @ points[:, 0] ** 2 == pytest.approx(simplex.get(kind.shape, 1 / 3), rel=1e-12)


@pytest.mark.parametrize("name", SOLIDS)
def test_faces_turn_anticlockwise_seen_from_outside_and_lie_in_planes(name):
    kind = cell_type(name)
    for face in kind.faces:
        corners = kind.nodes[list(face)]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        assert normal @ (corners[0] - kind.nodes.mean(axis=0)) > 0
        np.testing.assert_allclose((corners - corners[0]) @ normal, 0.0, atol=1e-15)


@pytest.mark.parametrize("name", [name for name in SOLIDS if cell_type(name).order == 2])
def test_middle_nodes_of_faces_lie_between_the_corners_before_and_after(name):
    kind = cell_type(name)
    for face in kind.faces:
        corners = [node for node in face if node < kind.corners]
        n = len(corners)
        for i, node in enumerate(face[n : 2 * n]):
            middle = 0.5 * (kind.nodes[corners[i]] + kind.nodes[corners[(i + 1) % n]])
            np.testing.assert_allclose(kind.nodes[node], middle)
        for node in face[2 * n :]:
            np.testing.assert_allclose(kind.nodes[node], kind.nodes[corners].mean(axis=0))
