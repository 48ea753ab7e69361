"""Meshes that would make a solution wrong are refused with what, where and how to mend it."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.meshing.generators import block
from morph_dslam.meshing.mesh_checks import check_mesh
from morph_dslam.meshing.meshes import CellBlock, Mesh
from tests.support.meshes import SHEET


def cube(name="hex8", size=0.1):
    return block((size, size, size), (2, 2, 2), name)


def with_cells(mesh, connectivity):
    return replace(mesh, blocks=(CellBlock(mesh.blocks[0].cell_type, connectivity),))


def two_parts():
    one, gap = cube(), np.array([0.3, 0.0, 0.0])
    cells = one.blocks[0].connectivity
    return Mesh(
        np.vstack([one.nodes, one.nodes[:] + gap]), (CellBlock("hex8", np.vstack([cells, cells + one.n_nodes])),)
    )


def with_inverted_cell(name):
    mesh = cube(name)
    cells = mesh.blocks[0].connectivity.copy()
    cells[3, [0, 1]] = cells[3, [1, 0]]
    return with_cells(mesh, cells)


def with_flat_cell():
    mesh = cube("tet4")
    corners = mesh.blocks[0].connectivity[5]
    nodes = mesh.nodes.copy()
    nodes[corners[0]] = nodes[corners[1:]].mean(axis=0)
    return replace(mesh, nodes=nodes)


def with_middle_node_astray():
    mesh = cube("tet10")
    nodes = mesh.nodes.copy()
    nodes[mesh.blocks[0].connectivity[0, 4]] += 0.2
    return replace(mesh, nodes=nodes)


def with_sheet_cell():
    return replace(cube(), blocks=(*cube().blocks, CellBlock("quad4", np.array([[0, 1, 4, 3]]))))


def with_loose_node():
    return replace(cube(), nodes=np.vstack([cube().nodes, [[0.05, 0.05, 0.01]]]))


def with_node_missing():
    nodes = cube().nodes.copy()
    nodes[4] = np.nan
    return replace(cube(), nodes=nodes)


def with_three_cells_on_a_face():
    """Two unit tetrahedra on both sides of a triangle, and a taller one over one of them."""
    nodes = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [0, 0, 2]]
    cells = [[0, 1, 2, 3], [0, 2, 1, 4], [0, 1, 2, 5]]
    return Mesh(0.1 * np.array(nodes), (CellBlock("tet4", np.array(cells)),))


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (Mesh(np.empty((0, 3)), ()), "0 nodes and 0 cells"),
        (with_node_missing(), "first at index 4"),
        (with_cells(cube(), cube().blocks[0].connectivity + 1), "'hex8' refer to index 27, but there are 27"),
        (replace(cube(), node_sets={"grip": np.array([99])}), "'grip' refer to index 99"),
        (cube(size=40.0), r"40 x 40 x 40 m, which is hardly meant.*such as mm"),
        (cube(size=4e-5), r"4e-05 x 4e-05 x 4e-05 m, which is hardly meant.*such as m\)"),
        (with_inverted_cell("hex8"), r"1 of 8 hex8 cells are inverted or folded, the first cell 3 around \("),
        (with_inverted_cell("tet4"), "1 of 48 tet4 cells are inverted or folded, the first cell 3"),
        (with_middle_node_astray(), "tet10 cells are inverted or folded"),
        (with_flat_cell(), "tet4 cells are (flat|inverted or folded), the first cell"),
        (replace(cube(), nodes=cube().nodes * [1, 1, -1]), "every hex8 cell is inverted.*mirrored order"),
        (with_cells(cube(), cube().blocks[0].connectivity[[0, *range(8)]]), "more than once.*remove"),
        (with_three_cells_on_a_face(), "faces have more than two cells"),
        (two_parts(), r"falls into 2 parts .* second largest has 27 nodes around \(350, 50, 50\) mm"),
        (with_loose_node(), r"at \(50, 50, 10\) mm; remove"),
        (with_sheet_cell(), "mixes solid and sheet"),
    ],
)  # fmt: skip
def test_a_wrong_mesh_is_refused(mesh, message):
    with pytest.raises(StudyError, match=message):
        check_mesh(mesh)


@pytest.mark.parametrize("mesh", [cube("hex27"), cube("prism15"), SHEET, cube(size=2.5)])
def test_a_sound_mesh_passes(mesh):
    check_mesh(mesh, sets=("x_min",), regions=("all",))


def test_sets_that_a_study_names_must_be_there_and_hold_something():
    mesh = replace(cube(), node_sets={"grip": np.array([], dtype=int)}, surfaces={})
    with pytest.raises(StudyError, match="no node set or surface 'x_min'; it has: grip"):
        check_mesh(mesh, sets=("x_min",))
    with pytest.raises(StudyError, match="'grip' is empty"):
        check_mesh(mesh, sets=("grip",))
    with pytest.raises(StudyError, match="no cell set 'rubber'"):
        check_mesh(mesh, regions=("rubber",))
