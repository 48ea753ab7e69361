"""Meshes in files of other programs, against the boxes that they were written from."""

import meshio
import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.meshing.generators import block
from morph_dslam.meshing.mesh_checks import check_mesh
from morph_dslam.studies.external_mesh import mesh_of
from morph_dslam.studies.solution_files import read_solution
from tests.support.meshes import cell_volumes

SIZE = (0.02, 0.02, 0.04)


def read(path, points, cells):
    meshio.Mesh(1e3 * points, cells).write(path)
    return mesh_of(read_solution(path), "mm", path)


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4, 5], [0, 2, 1, 3, 5, 4]], ids=["Abaqus", "VTK"])
def test_linear_prisms_are_read_in_both_orders_in_use(tmp_path, order):
    mesh = block(SIZE, (2, 2, 4), "prism6")
    found = read(tmp_path / "prisms.vtu", mesh.nodes, [("wedge", mesh.blocks[0].connectivity[:, order])])
    check_mesh(found)
    assert cell_volumes(found) == pytest.approx(np.full(32, np.prod(SIZE) / 32), rel=1e-9)


@pytest.mark.parametrize(
    ("cell", "name", "face", "count"), [("tet10", "tetra10", "triangle6", 6), ("hex20", "hexahedron20", "quad8", 8)]
)
def test_second_order_faces_beside_solids_do_not_matter(tmp_path, cell, name, face, count):
    mesh = block(SIZE, (1, 1, 2), cell)
    faces = mesh.face_nodes(mesh.boundary_faces())[:, :count]
    found = read(tmp_path / "solid.vtu", mesh.nodes, [(name, mesh.blocks[0].connectivity), (face, faces)])
    assert [each.cell_type for each in found.blocks] == [cell]
    assert cell_volumes(found).sum() == pytest.approx(np.prod(SIZE), rel=1e-9)


@pytest.mark.parametrize(("cell", "number", "nodes"), [("hex8", 11, 8), ("prism15", 26, 15)])
def test_cells_that_cannot_be_read_are_refused_and_points_alone_are_read(tmp_path, cell, number, nodes):
    """Half of the cells are voxels (VTK's type 11), or all are prisms of 15 nodes (26)."""
    mesh = block(SIZE, (1, 1, 2), cell)
    cells = mesh.blocks[0].connectivity
    types = np.full(len(cells), number) if number == 26 else [12, number]

    def array(name, kind, values):
        text = " ".join(map(str, np.ravel(values).tolist()))
        return (
            f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{3 if name == "p" else 1}">{text}</DataArray>'
        )

    path = tmp_path / "cells.vtu"
    path.write_text(
        '<?xml version="1.0"?><VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian">'
        f'<UnstructuredGrid><Piece NumberOfPoints="{mesh.n_nodes}" NumberOfCells="{len(cells)}">'
        f"<Points>{array('p', 'Float64', mesh.nodes)}</Points><Cells>{array('connectivity', 'Int64', cells)}"
        f"{array('offsets', 'Int64', nodes * np.arange(1, len(cells) + 1))}{array('types', 'UInt8', types)}"
        "</Cells></Piece></UnstructuredGrid></VTKFile>"
    )
    path.write_text(path.read_text().replace("<DataArray type", '<DataArray format="ascii" type'))
    with pytest.raises(StudyError, match="cells that are not known" if number == 11 else "15 nodes"):
        read_solution(path)
    if number == 11:
        assert read_solution(path, whole=False).points == pytest.approx(mesh.nodes)
