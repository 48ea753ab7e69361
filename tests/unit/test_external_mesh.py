"""Meshes in files of other programs, against the boxes that they were written from."""

import base64
import re
from pathlib import Path

import meshio
import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.meshing.generators import block
from morph_dslam.meshing.mesh_checks import check_mesh
from morph_dslam.meshing.mesh_files import load_mesh
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
    with pytest.raises(StudyError, match="save hexahedra" if number == 11 else "save prisms of 18 or 6"):
        read_solution(path)
    if number == 11:
        assert read_solution(path, whole=False).points == pytest.approx(mesh.nodes)


def write_with_types(path, kind, types):
    """Two hexahedra side by side, with other numbers in the place of VTK's number 12 of their type."""
    mesh = block(SIZE, (1, 1, 2), "hex8")
    content = meshio.Mesh(1e3 * mesh.nodes, [("hexahedron", mesh.blocks[0].connectivity)])
    number = np.array(types, dtype=">i4" if "vtk" in kind else "<i8")
    if kind == "ascii vtu":
        meshio.vtu.write(path, content, binary=False)
        old, new = rb'(Name="types"[^>]*>)[\s\d]*', " ".join(map(str, types)).encode()
    elif kind == "vtu":
        meshio.vtu.write(path, content, compression=None)
        coded = base64.b64encode(np.uint32(number.nbytes).tobytes() + number.tobytes())
        old, new = rb'(Name="types"[^>]*>)[^<]*', coded
    else:
        meshio.vtk.write(path, content, fmt_version="5.1", binary=kind == "vtk")
        old = rb"(CELL_TYPES 2\n)" + (rb"[\d ]*\n12" if kind == "ascii vtk" else rb".{8}")
        new = b" ".join(str(each).encode() for each in types) if kind == "ascii vtk" else number.tobytes()
    text, count = re.subn(old, lambda found: found[1] + new, path.read_bytes(), flags=re.DOTALL)
    assert count == 1
    path.write_bytes(text)


@pytest.mark.parametrize("kind", ["vtu", "ascii vtu", "vtk", "ascii vtk"])
@pytest.mark.parametrize("columns", [20, 26, 50, 200])
def test_voxels_are_refused_and_polylines_left_out_at_every_width_of_the_terminal(
    tmp_path, monkeypatch, capfd, kind, columns
):
    monkeypatch.setenv("COLUMNS", str(columns))
    path = tmp_path / f"solution.{kind[-3:]}"
    write_with_types(path, kind, [12, 11])
    with pytest.raises(StudyError, match="holds voxels, which cannot be read: save hexahedra in their place"):
        read_solution(path)
    with pytest.raises(StudyError, match="holds voxels, which cannot be read: save hexahedra in their place"):
        load_mesh(path, "mm")
    write_with_types(path, kind, [12, 4])
    capfd.readouterr()  # meshio warns of text files that it writes
    for mesh in (mesh_of(read_solution(path), "mm", path), load_mesh(path, "mm")):
        assert cell_volumes(mesh) == pytest.approx([np.prod(SIZE) / 2])
    assert not any(capfd.readouterr())


def write_legacy(path, version, *others):
    """A hexahedron and ``others``, (VTK's type, number of nodes) of each, in VTK's legacy format."""
    nodes, types = [8, *(count for _, count in others)], [12, *(number for number, _ in others)]
    points = "\n".join(f"{x} {y} {z}" for z in (0, 1) for y in (0, 1) for x in (0, 1))
    lists = ["0 1 3 2 4 5 7 6", *(" ".join(str(k % 8) for k in range(count)) for count in nodes[1:])]
    cells = f"CELLS {len(nodes)} {sum(nodes) + len(nodes)}\n"
    cells += "\n".join(f"{count} {each}" for count, each in zip(nodes, lists, strict=True))
    if version == "5.1":
        offsets = " ".join(map(str, np.cumsum([0, *nodes])))
        cells = f"CELLS {len(nodes) + 1} {sum(nodes)}\nOFFSETS vtktypeint64\n{offsets}\nCONNECTIVITY vtktypeint64\n"
        cells += " ".join(lists)
    path.write_text(
        f"# vtk DataFile Version {version}\nname\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 8 double\n{points}\n"
        f"{cells}\nCELL_TYPES {len(types)}\n" + "\n".join(map(str, types)) + "\n"
    )


def refusals(path):
    """What is said of a file as a solution and as a mesh."""
    with pytest.raises(StudyError) as of_solution:
        read_solution(path)
    with pytest.raises(StudyError) as of_mesh:
        load_mesh(path, "mm")
    return str(of_solution.value), str(of_mesh.value)


@pytest.mark.parametrize(
    ("version", "other", "said"),
    [
        ("3.0", (4, 4), "holds polylines, which cannot be read: save lines"),
        ("3.0", (8, 4), "holds pixels, which cannot be read: save quadrilaterals"),
        ("5.1", (8, 4), "holds pixels, which cannot be read: save quadrilaterals"),
        ("3.0", (11, 8), "holds voxels, which cannot be read: save hexahedra"),
        ("3.0", (99, 4), "holds cells of VTK's type 99, which cannot be read"),
        ("3.0", (24, 8), "its cells have other numbers of nodes than cells of their types"),
    ],
)
def test_cells_that_end_meshio_in_an_error_are_named(tmp_path, version, other, said):
    write_legacy(tmp_path / "solution.vtk", version, other)
    for refusal in refusals(tmp_path / "solution.vtk"):
        assert said in refusal


@pytest.mark.parametrize("harmless", [(4, 3), (7, 4)], ids=["polyline", "polygon"])
def test_cells_that_may_be_there_are_not_blamed_for_what_is_cut_short(tmp_path, harmless):
    path = tmp_path / "solution.vtk"
    write_legacy(path, "5.1", harmless)
    assert read_solution(path).cells[0].type == "hexahedron"
    path.write_text(path.read_text() + "POINT_DATA 8\nVECTORS u double\n1 2 3\n4 5\n")
    for refusal in refusals(path):
        assert "is damaged, cut short" in refusal


def write_vtu(path, cells, pieces=1):
    """Cells, (VTK's type, nodes) of each, of the corners of a unit cube, the same in each piece."""
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
    nodes = [each for _, each in cells]
    arrays = [("connectivity", [k for each in nodes for k in each]), ("offsets", np.cumsum([len(n) for n in nodes]))]
    arrays += [("types", [number for number, _ in cells])]

    def array(name, values, components=1):
        text = " ".join(map(str, np.ravel(values).astype(int).tolist()))
        kind = "Float64" if components == 3 else "Int64"
        return f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{components}">{text}</DataArray>'

    piece = f'<Piece NumberOfPoints="8" NumberOfCells="{len(cells)}"><Points>{array("p", corners, 3)}</Points><Cells>'
    piece += "".join(array(*each) for each in arrays) + "</Cells></Piece>"
    path.write_text(
        '<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian"><UnstructuredGrid>'
        f"{pieces * piece}</UnstructuredGrid></VTKFile>"
    )


CUBE = [0, 1, 3, 2, 4, 5, 7, 6]


@pytest.mark.parametrize(
    ("cells", "pieces", "said"),
    [
        ([(12, CUBE), (4, [0, 1, 3]), (11, range(8))], 1, "holds voxels, which cannot be read: save hexahedra in"),
        ([(12, CUBE), (42, range(8))], 1, "holds polyhedra, which cannot be read: save tetrahedra in"),
        ([(12, CUBE), (30, range(6))], 1, "holds quadrilaterals of 6 nodes, which cannot be read"),
        ([(12, CUBE), (34, range(7))], 1, "holds triangles of 7 nodes, which cannot be read"),
        ([(4, [0, 1, 3])], 1, "holds polylines, which cannot be read: save lines in"),
        ([], 1, "holds no cells: save the mesh with its cells"),
        ([(12, CUBE)], 2, "holds several pieces, of which only the last is read: merge them"),
    ],
)
def test_only_what_is_wrong_with_a_vtu_file_is_named(tmp_path, cells, pieces, said):
    write_vtu(tmp_path / "solution.vtu", cells, pieces)
    for refusal in refusals(tmp_path / "solution.vtu"):
        assert said in refusal


def test_a_step_that_a_series_lacks_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with meshio.xdmf.TimeSeriesWriter("s.xdmf") as series:
        series.write_points_cells(np.eye(4)[:, :3], [("tetra", np.arange(4)[None])])
        series.write_data(0.0, point_data={"u": np.ones((4, 3))})
    assert read_solution(Path("s.xdmf"), "0").point_data["u"] == pytest.approx(np.ones((4, 3)))
    with pytest.raises(StudyError, match="has no step 1: its steps are 0 to 0"):
        read_solution(Path("s.xdmf"), "1")


def test_prisms_of_15_nodes_in_xdmf_are_named(tmp_path):
    content = meshio.Mesh(np.random.default_rng(0).uniform(size=(18, 3)), [("wedge18", np.arange(18)[None])])
    meshio.xdmf.write(tmp_path / "s.xdmf", content, data_format="XML")
    text = (tmp_path / "s.xdmf").read_text()
    (tmp_path / "s.xdmf").write_text(text.replace("Wedge_18", "Wedge_15"))
    with pytest.raises(StudyError, match="holds prisms of 15 nodes, which cannot be read: save prisms of 18 or 6"):
        read_solution(tmp_path / "s.xdmf")
