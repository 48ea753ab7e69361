"""Mesh files of every kind, written here or by other libraries, give metres, cells and named sets."""

import re
from dataclasses import replace
from math import pi
from pathlib import Path

import meshio
import netgen.occ as occ
import numpy as np
import pytest

from morph_dslam.cli import app as cli
from morph_dslam.errors import StudyError
from morph_dslam.meshing.generators import block
from morph_dslam.meshing.inp_writing import save_mesh
from morph_dslam.meshing.mesh_checks import check_mesh
from morph_dslam.meshing.mesh_files import load_mesh
from tests.support.meshes import cell_volumes, surface_area
from tests.support.real_data import real_data

ABAQUS = {
    "hex8": "C3D8", "hex20": "C3D20R", "hex27": "C3D27", "tet4": "C3D4", "tet10": "C3D10M",
    "prism6": "C3D6", "prism15": "C3D15",
}  # fmt: skip
MESHIO = {
    "hex8": "hexahedron", "hex20": "hexahedron20", "hex27": "hexahedron27", "tet4": "tetra",
    "tet10": "tetra10", "prism6": "wedge", "prism18": "wedge18",
}  # fmt: skip
FILE_KINDS = ("inp", "msh", "vtk", "vtu", "stl", "obj", "step")
#: Gmsh 2.2: a bar of two hexahedra of 10 mm, its left half "soft", its right end "grip", a line "edge".
GMSH = """$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
4
1 4 "edge"
2 3 "grip"
3 1 "soft"
3 2 "hard"
$EndPhysicalNames
$Nodes
12
1 0 0 0
2 10 0 0
3 20 0 0
4 0 10 0
5 10 10 0
6 20 10 0
7 0 0 10
8 10 0 10
9 20 0 10
10 0 10 10
11 10 10 10
12 20 10 10
$EndNodes
$Elements
4
1 1 2 4 1 1 2
2 3 2 3 1 3 6 12 9
3 5 2 1 1 1 2 5 4 7 8 11 10
4 5 2 2 2 2 3 6 5 8 9 12 11
$EndElements
"""

#: Corners of the faces of a tetrahedron, seen from outside in their order.
TET_FACES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3))


def inp_text(name):
    """A block of 20 x 20 x 30 mm as an input file; its nodes are numbered from 5 in steps of 3."""
    mesh = block((20.0, 20.0, 30.0), (1, 2, 2), name)
    cells = mesh.blocks[0].connectivity
    if name == "hex27":  # Abaqus: the centre, then faces S1 to S6 (z-, z+, y-, x+, y+, x-)
        cells = cells[:, [*range(20), 26, 24, 25, 22, 21, 23, 20]]
    lines = ["*NODE"] + [f"{5 + 3 * i}, {x}, {y}, {z}" for i, (x, y, z) in enumerate(mesh.nodes.tolist())]
    lines.append(f"*ELEMENT, TYPE={ABAQUS[name]}, ELSET=body")
    for i, cell in enumerate(cells.tolist()):
        row = [str(7 + 2 * i), *(str(5 + 3 * node) for node in cell)]
        lines += [", ".join(row[k : k + 12]) + ("," if k + 12 < len(row) else "") for k in range(0, len(row), 12)]
    for surface, faces in mesh.surfaces.items():
        lines += [f"*SURFACE, NAME={surface}", *(f"{7 + 2 * c}, S{f + 1}" for c, f in faces.tolist())]
    return "\n".join([*lines, "*SURFACE, NAME=skin", "body,", ""]), mesh


@pytest.mark.parametrize("name", ABAQUS)
def test_an_input_file_gives_the_block_that_was_written_in_metres(tmp_path, name):
    text, drawn = inp_text(name)
    (tmp_path / "block.inp").write_text(text)
    mesh = load_mesh(tmp_path / "block.inp", "mm")
    check_mesh(mesh, sets=("x_min", "skin"), regions=("body",))
    np.testing.assert_allclose(mesh.nodes, drawn.nodes * 1e-3, rtol=1e-12)
    np.testing.assert_array_equal(mesh.blocks[0].connectivity, drawn.blocks[0].connectivity)
    assert cell_volumes(mesh).sum() == pytest.approx(12e-6, rel=1e-12)
    areas = [surface_area(mesh, s) for s in ("x_max", "y_min", "z_max", "skin")]
    assert areas == pytest.approx([6e-4, 6e-4, 4e-4, 32e-4], rel=1e-12)
    np.testing.assert_allclose(mesh.nodes[mesh.surface_nodes("z_max"), 2], 0.03)


def test_the_documented_program_reads_a_mesh(tmp_path, monkeypatch):
    page = Path(__file__).parents[2] / "docs" / "meshes.md"
    (program,) = re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL)
    text, drawn = inp_text("hex20")
    sets = "*ELSET, ELSET=rubber\nbody\n*NSET, NSET=grip, ELSET=rubber\n"
    (tmp_path / "mount.inp").write_text(text + sets)
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(program, names)
    assert len(names["mesh"].set_nodes("grip")) == drawn.n_nodes


def test_a_face_that_an_element_does_not_have_is_named_with_its_line(tmp_path):
    text, _ = inp_text("tet4")
    (tmp_path / "block.inp").write_text(text + "*SURFACE, NAME=wrong\nbody, S6\n")
    with pytest.raises(StudyError, match=r"block\.inp, line \d+: a tet4 element has no face S6; use S1, S2, S3, S4"):
        load_mesh(tmp_path / "block.inp", "mm")


@pytest.mark.parametrize("name", MESHIO)
@pytest.mark.parametrize("kind", ["vtk", "vtu", "msh"])
def test_meshes_written_by_meshio_are_read_back(tmp_path, name, kind):
    drawn = block((2.0, 2.0, 3.0), (1, 2, 2), name)
    regions = [np.arange(drawn.n_cells) % 2]
    data = {"gmsh:physical": regions, "gmsh:geometrical": regions} if kind == "msh" else {"part": regions}
    content = meshio.Mesh(
        drawn.nodes,
        [(MESHIO[name], drawn.blocks[0].connectivity)],
        cell_data=data,
        point_data={} if kind == "msh" else {"held": (drawn.nodes[:, 0] == 0).astype(int)},
        field_data={"part_0": np.array([0, 3]), "part_1": np.array([1, 3])} if kind == "msh" else {},
    )
    path = tmp_path / f"block.{kind}"
    content.write(path, **({"file_format": "gmsh22"} if kind == "msh" else {}))
    mesh = load_mesh(path, "cm")
    check_mesh(mesh, regions=("part_0", "part_1"))
    np.testing.assert_allclose(mesh.nodes, drawn.nodes * 1e-2, rtol=1e-12)
    np.testing.assert_array_equal(mesh.blocks[0].connectivity, drawn.blocks[0].connectivity)
    np.testing.assert_array_equal(mesh.cells("part_1"), np.arange(1, drawn.n_cells, 2))
    if kind != "msh":
        np.testing.assert_array_equal(mesh.set_nodes("held_1"), np.flatnonzero(drawn.nodes[:, 0] == 0))


def test_the_physical_groups_of_gmsh_become_sets_by_their_dimension(tmp_path):
    (tmp_path / "bar.msh").write_text(GMSH)
    mesh = load_mesh(tmp_path / "bar.msh", "mm")
    check_mesh(mesh)
    assert cell_volumes(mesh) == pytest.approx([1e-6, 1e-6], rel=1e-12)
    assert {name: cells.tolist() for name, cells in mesh.cell_sets.items()} == {"soft": [0], "hard": [1]}
    assert mesh.surfaces.keys() - mesh.found == {"grip"}
    assert surface_area(mesh, "grip") == pytest.approx(1e-4, rel=1e-12)
    np.testing.assert_allclose(mesh.nodes[mesh.surface_nodes("grip"), 0], 0.02)
    np.testing.assert_allclose(mesh.nodes[mesh.set_nodes("edge")], [[0, 0, 0], [0.01, 0, 0]])


def gmsh_4_text(first_groups):
    """The bar of `GMSH` as version 4.1, the first hexahedron's entity in the groups given by "count tags"."""
    nodes = GMSH[GMSH.index("$Nodes") :].splitlines()[2:14]
    lines = [
        "$MeshFormat", "4.1 0 8", "$EndMeshFormat",
        "$PhysicalNames", "3", '2 3 "grip"', '3 1 "all_of_it"', '3 2 "hard"', "$EndPhysicalNames",
        "$Entities", "0 0 1 2",
        "5 20 0 0 20 10 10 1 3 0",
        f"1 0 0 0 10 10 10 {first_groups} 0",
        "2 10 0 0 20 10 10 2 1 2 0",
        "$EndEntities",
        "$Nodes", "1 12 1 12", "3 1 0 12", *(line.split()[0] for line in nodes),
        *(" ".join(line.split()[1:]) for line in nodes), "$EndNodes",
        "$Elements", "3 3 1 3",
        "2 5 3 1", "1 3 6 12 9", "3 1 5 1", "2 1 2 5 4 7 8 11 10", "3 2 5 1", "3 2 3 6 5 8 9 12 11",
        "$EndElements", "",
    ]  # fmt: skip
    return "\n".join(lines)


def test_gmsh_4_files_keep_every_group_of_an_entity(tmp_path):
    (tmp_path / "bar.msh").write_text(gmsh_4_text(first_groups="1 1"))
    mesh = load_mesh(tmp_path / "bar.msh", "mm")
    check_mesh(mesh)
    sets = {name: cells.tolist() for name, cells in mesh.cell_sets.items()}
    assert sets == {"all_of_it": [0, 1], "hard": [1]}
    assert surface_area(mesh, "grip") == pytest.approx(1e-4, rel=1e-12)


def test_gmsh_4_cells_of_no_group_beside_grouped_ones_are_refused_with_the_remedy(tmp_path):
    (tmp_path / "bar.msh").write_text(gmsh_4_text(first_groups="0"))
    with pytest.raises(StudyError, match="cells of no physical group beside cells of some; put every entity"):
        load_mesh(tmp_path / "bar.msh", "mm")


def test_vtk_prisms_of_15_nodes_which_meshio_cannot_read_are_refused(tmp_path):
    (tmp_path / "cell.vtk").write_text(
        "# vtk DataFile Version 2.0\ncell\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 15 double\n"
        + "0 0 0\n" * 15 + "CELLS 1 16\n15 " + " ".join(map(str, range(15))) + "\nCELL_TYPES 1\n26\n"
    )  # fmt: skip
    with pytest.raises(StudyError, match=r"prisms of 15 nodes; save it as \.inp"):
        load_mesh(tmp_path / "cell.vtk", "mm")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GMSH[: GMSH.index("$EndElements")], r"line 26: the section \$Elements is not closed; the file is cut"),
        (GMSH[:200], r"the section \$Nodes is not closed"),
        (GMSH.replace("3 6 12 9", "1 6 12 9"), "1 faces of group 'grip' are faces of no solid cell"),
        (GMSH.replace("4 5 2 2 2 2 3 6 5 8 9 12 11", "4 7 2 2 2 2 3 6 5 8"), "pyramid cells, which are not known"),
        (GMSH.replace("4 5 2 2 2 2 3", "4 5 2 2 2 2 77"), "damaged, cut short|nodes which it does not hold"),
        ("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n", "holds no solid or sheet cells"),
        ("not a mesh", "damaged, cut short, or no .msh file"),
    ],
)
def test_damaged_gmsh_files_are_refused(tmp_path, text, message):
    (tmp_path / "bar.msh").write_text(text)
    with pytest.raises(StudyError, match=f"bar.msh.*({message})"):
        load_mesh(tmp_path / "bar.msh", "mm")


def test_an_ansys_file_which_meshio_writes_by_default_is_named(tmp_path):
    drawn = block((2.0, 2.0, 3.0), (1, 2, 2), "hex8")
    content = meshio.Mesh(drawn.nodes, [("hexahedron", drawn.blocks[0].connectivity)])
    content.write(tmp_path / "block.msh")
    with pytest.raises(StudyError, match=r'is an ANSYS mesh file.*file_format="gmsh"'):
        load_mesh(tmp_path / "block.msh", "mm")
    content.write(tmp_path / "block.msh", file_format="gmsh")
    assert load_mesh(tmp_path / "block.msh", "mm").n_cells == 4


def test_info_prints_the_sets_of_a_mesh(tmp_path, capsys):
    drawn = block((0.02, 0.03, 0.06), (1, 1, 2), "hex8")
    surfaces = {"face_10": drawn.surface("z_max"), "face_2": drawn.surface("x_min"), "skin": drawn.boundary_faces()}
    mesh = replace(drawn, surfaces=surfaces, node_sets={"floor": drawn.set_nodes("z_min")})
    save_mesh(tmp_path / "block.inp", replace(mesh, cell_sets={"part": np.array([0])}), "cm")
    assert cli.main(["info", str(tmp_path / "block.inp"), "--unit", "cm"]) == 0
    title, _, *rows = capsys.readouterr().out.splitlines()
    assert title.endswith("20 x 30 x 60 mm, 2 hex8, 12 nodes")
    named = [" ".join(row.split()) for row in rows if row.split()[0][1:] not in ("_min", "_max")]
    assert named == [
        "face_2 faces 2 1800 0 15 30 -1.00 0.00 0.00",
        "face_10 faces 1 600 10 15 60 0.00 0.00 1.00",
        "skin faces 10 7200 10 15 30 none",
        "part cells 1",
        "floor nodes 4 10 15 0",
    ]


def test_vtk_files_that_are_cut_short_are_refused(tmp_path):
    drawn = block((2.0, 2.0, 3.0), (1, 2, 2), "hex8")
    content = meshio.Mesh(drawn.nodes, [("hexahedron", drawn.blocks[0].connectivity)])
    for kind in ("vtk", "vtu"):
        path = tmp_path / f"block.{kind}"
        content.write(path)
        whole = path.read_bytes()
        for part in (0, len(whole) // 5, len(whole) // 2, len(whole) - 40):
            path.write_bytes(whole[:part])
            with pytest.raises(StudyError, match=rf"block\.{kind} is damaged, cut short"):
                load_mesh(path, "mm")


def test_sets_of_a_vtk_file_that_states_its_one_component_are_read(tmp_path):
    """`SCALARS name int 1`, as many scripts write it; meshio returns such data as a column."""
    drawn = block((2.0, 2.0, 3.0), (1, 1, 2), "hex8")
    held = (drawn.nodes[:, 2] == 0).astype(int)
    lines = ["# vtk DataFile Version 3.0", "block", "ASCII", "DATASET UNSTRUCTURED_GRID"]
    lines += [f"POINTS {len(drawn.nodes)} double", *(" ".join(map(str, node)) for node in drawn.nodes)]
    lines += ["CELLS 2 18", *("8 " + " ".join(map(str, cell)) for cell in drawn.blocks[0].connectivity)]
    lines += ["CELL_TYPES 2", "12", "12"]
    lines += ["CELL_DATA 2", "SCALARS part int 1", "LOOKUP_TABLE default", "0", "1"]
    lines += [f"POINT_DATA {len(held)}", "SCALARS held int 1", "LOOKUP_TABLE default", *map(str, held)]
    (tmp_path / "block.vtk").write_text("\n".join(lines) + "\n")
    mesh = load_mesh(tmp_path / "block.vtk", "mm")
    np.testing.assert_array_equal(mesh.set_nodes("held_1"), np.flatnonzero(held))
    np.testing.assert_array_equal(mesh.cells("part_1"), [1])


def icosphere(refinements):
    """Triangles on the unit sphere: an octahedron, each triangle cut in four, pushed out to the sphere."""
    points = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    points = np.array(points, dtype=float)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(refinements):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        edges, number = np.unique(edges, axis=0, return_inverse=True)
        middle = points[edges].mean(axis=1)
        d, e, f = number.reshape(3, -1) + len(points)
        points = np.vstack([points, middle / np.linalg.norm(middle, axis=1)[:, None]])
        a, b, c = faces.T
        faces = np.concatenate([np.stack(t, axis=1) for t in ((a, d, f), (d, b, e), (f, e, c), (d, e, f))])
    return points, faces


def polyhedron_volume(points, faces):
    a, b, c = np.moveaxis(points[faces], 1, 0)
    return np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0


@pytest.mark.parametrize("kind", ["stl", "obj", "ply"])
def test_a_sphere_is_filled_to_its_volume(tmp_path, kind):
    points, faces = icosphere(2)
    path = tmp_path / f"sphere.{kind}"
    meshio.Mesh(20.0 * points, [("triangle", faces)]).write(path)
    mesh = load_mesh(path, "mm")
    check_mesh(mesh)
    assert mesh.blocks[0].cell_type == "tet4"
    inscribed = 0.02**3 * polyhedron_volume(points, faces)
    assert cell_volumes(mesh).sum() == pytest.approx(inscribed, rel=1e-6)
    # Triangles of edge h on a sphere cut off about (h / r)^2 / 4 of it.
    assert inscribed == pytest.approx(4 / 3 * pi * 0.02**3, rel=0.1)
    outer = mesh.nodes[mesh.surface_nodes("face_1")]
    np.testing.assert_allclose(np.linalg.norm(outer, axis=1), 0.02, rtol=1e-6)


def test_a_cube_of_twelve_triangles_is_meshed_anew_where_a_cell_size_is_given(tmp_path):
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    squares = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = "".join("f " + " ".join(str(i + 1) for i in square) + "\n" for square in squares)
    path = tmp_path / "cube.obj"
    path.write_text("".join("v {} {} {}\n".format(*corner) for corner in corners) + faces)
    mesh = load_mesh(path, "cm", size=0.004)
    check_mesh(mesh)
    assert cell_volumes(mesh).sum() == pytest.approx(1e-6, rel=1e-6)
    assert mesh.n_nodes > 30
    assert [surface_area(mesh, f"face_{i + 1}") for i in range(6)] == pytest.approx([1e-4] * 6, rel=1e-6)


def write_obj(path, points, faces):
    text = "".join("v {} {} {}\n".format(*point) for point in points)
    path.write_text(text + "".join("f {} {} {}\n".format(*(face + 1)) for face in faces))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda faces: faces[:24], "not watertight: 8 edges have a triangle on one side only"),
        (lambda faces: faces[:0], "holds no faces"),
        (lambda faces: faces + 1, "refer to points which it does not hold"),
    ],
)
def test_surfaces_that_bound_no_volume_are_refused(tmp_path, change, message):
    points, faces = icosphere(1)
    # By the octant that a face lies in: without the last two the hole is a quarter of the surface.
    octants = (points[faces].mean(axis=1) > 0) @ [1, 2, 4]
    path = tmp_path / "sphere.obj"
    write_obj(path, points, change(faces[np.argsort(octants, kind="stable")]))
    with pytest.raises(StudyError, match=message):
        load_mesh(path, "mm")


def test_cubes_that_share_an_edge_bound_no_volume(tmp_path):
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    squares = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    cube = np.concatenate([squares[:, [0, 1, 2]], squares[:, [0, 2, 3]]])
    points = np.concatenate([corners, corners + np.array([1, 1, 0])])
    write_obj(tmp_path / "cubes.obj", points, np.concatenate([cube, cube + 8]))
    with pytest.raises(StudyError, match="bounds no volume: 1 edges have more than two triangles"):
        load_mesh(tmp_path / "cubes.obj", "mm")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "repair"),
    [
        (lambda faces: faces[1:], "1 hole closed"),
        (lambda faces: np.vstack([faces, faces[:1]]), "1 double face removed"),
        (lambda faces: np.vstack([faces[:1, ::-1], faces[1:]]), "1 face turned"),
        (lambda faces: faces[:, ::-1], "1 part turned inside out"),
    ],
)
def test_flawed_surfaces_are_filled_to_the_volume_of_sound_ones_and_info_says_so(tmp_path, capsys, change, repair):
    points, faces = icosphere(2)
    path = tmp_path / "sphere.obj"
    write_obj(path, 20.0 * points, change(faces))
    mesh = load_mesh(path, "mm")
    check_mesh(mesh)
    assert cell_volumes(mesh).sum() == pytest.approx(0.02**3 * polyhedron_volume(points, faces), rel=1e-9)
    assert cli.main(["info", str(path)]) == 0
    assert f"note: the surface of sphere.obj was repaired: {repair}\n" in capsys.readouterr().out


@pytest.mark.slow
def test_info_says_how_far_a_coarse_mesh_is_from_its_surface(tmp_path, capsys):
    """A tetrahedral ball of few cells lies inside the sphere, its volume as its triangles have it."""
    points, faces = icosphere(4)
    path = tmp_path / "ball.obj"
    write_obj(path, 20.0 * points, faces)
    assert cli.main(["info", str(path)]) == 0
    assert "note" not in capsys.readouterr().out, "the file's own triangles are kept"
    assert cli.main(["info", str(path), "--size", "12"]) == 0
    smaller, away = re.search(
        r"note: the mesh is (\S+) % smaller .* up to (\S+) mm away", capsys.readouterr().out
    ).groups()
    mesh = load_mesh(path, "mm", 0.012)
    volume, whole = cell_volumes(mesh).sum(), 0.02**3 * polyhedron_volume(points, faces)
    assert float(smaller) == pytest.approx(100.0 * (1.0 - volume / whole), rel=0.06)
    # The deepest point of a triangle inscribed in a sphere is the foot of the centre, if that is within.
    a, b, c = np.moveaxis(mesh.nodes[mesh.surface_triangles()], 1, 0)
    normals = np.cross(b - a, c - a)
    depth = 0.02 - np.abs(np.einsum("ti,ti->t", a, normals)) / np.linalg.norm(normals, axis=1)
    assert float(away) == pytest.approx(1e3 * depth.max(), rel=0.1)


def test_a_surface_of_a_few_tenths_of_a_millimetre_may_have_another_unit(tmp_path, capsys):
    points, faces = icosphere(1)
    write_obj(tmp_path / "ball.obj", 0.06 * points, faces)
    assert cli.main(["info", str(tmp_path / "ball.obj")]) == 0
    assert "measures 0.12 x 0.12 x 0.12 mm; if that is not so, 'mm' is not the unit" in capsys.readouterr().out
    assert cli.main(["info", str(tmp_path / "ball.obj"), "--unit", "m"]) == 0
    assert "note" not in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["inp", "vtu"])
def test_files_without_surfaces_get_their_flat_ends(tmp_path, kind):
    drawn = replace(block((0.02, 0.03, 0.06), (2, 2, 3), "hex8"), surfaces={}, node_sets={})
    path = tmp_path / f"block.{kind}"
    if kind == "inp":
        save_mesh(path, replace(drawn, node_sets={"z_min": np.array([0, 1])}), "mm")
    else:
        meshio.Mesh(1e3 * drawn.nodes, [("hexahedron", drawn.blocks[0].connectivity)]).write(path)
    mesh = load_mesh(path, "mm")
    areas = {"x_min": 18e-4, "x_max": 18e-4, "y_min": 12e-4, "y_max": 12e-4, "z_max": 6e-4}
    areas |= {} if kind == "inp" else {"z_min": 6e-4}
    assert mesh.surfaces.keys() == areas.keys(), "a name that the file has stays what it is"
    assert {name: surface_area(mesh, name) for name in areas} == pytest.approx(areas)


def test_a_damaged_surface_file_is_refused(tmp_path):
    points, faces = icosphere(1)
    for kind in ("stl", "ply"):
        path = tmp_path / f"sphere.{kind}"
        meshio.Mesh(points, [("triangle", faces)]).write(path, binary=True)
        path.write_bytes(path.read_bytes()[:-30])
        with pytest.raises(StudyError, match=f"sphere.{kind} is damaged, cut short"):
            load_mesh(path, "mm")
    (tmp_path / "a.obj").write_text("v 1 2\n")
    with pytest.raises(StudyError, match=r"a\.obj, line 1: 'v 1 2' is no vertex or face"):
        load_mesh(tmp_path / "a.obj", "mm")


def test_a_step_solid_is_meshed_and_its_unit_checked(tmp_path):
    path = tmp_path / "plate.step"
    plate = occ.Box((0, 0, 0), (40, 20, 10)) - occ.Cylinder((20, 10, 0), occ.Z, r=5, h=10)
    plate.WriteStep(str(path))
    mesh = load_mesh(path, "mm", size=0.004)
    check_mesh(mesh)
    assert cell_volumes(mesh).sum() == pytest.approx(8e-6 - pi * 25e-6 * 0.01, rel=5e-3)
    by_number = {name: faces for name, faces in mesh.surfaces.items() if name.startswith("face_")}
    assert len(by_number) == 7
    assert sum(len(faces) for faces in by_number.values()) == len(mesh.boundary_faces())
    ends = {"x_min": (0, 0.0), "x_max": (0, 0.04), "y_min": (1, 0.0), "y_max": (1, 0.02)}
    for name, (axis, end) in (ends | {"z_min": (2, 0.0), "z_max": (2, 0.01)}).items():
        assert mesh.nodes[mesh.surface_nodes(name), axis] == pytest.approx(end, abs=1e-9)
        assert any(len(faces) == len(mesh.surface(name)) for faces in by_number.values())
    assert len(mesh.surfaces) == 13
    with pytest.raises(StudyError, match="states that its unit of length is mm, but 'm' is declared"):
        load_mesh(path, "m")
    path.write_text(path.read_text()[:2000])
    with pytest.raises(StudyError, match="is cut short"):
        load_mesh(path, "mm")


def write_solids(path, **boxes):
    """A STEP file of boxes, each (low corner, high corner) in mm, by the names of the solids."""
    solids = []
    for name, (low, high) in boxes.items():
        (solid,) = occ.Box(low, high).solids
        solid.name = name
        solids.append(solid)
    occ.Compound(solids).WriteStep(str(path))


def test_touching_solids_of_a_step_file_are_one_mesh_with_a_set_each(tmp_path):
    """A narrow box on a wide one: their common face is listed once, and its cells are the wide box's."""
    write_solids(tmp_path / "two.step", soft=((0, 0, 0), (20, 10, 10)), stiff=((20, 2, 2), (30, 8, 8)))
    mesh = load_mesh(tmp_path / "two.step", "mm", size=0.005)
    check_mesh(mesh, regions=("soft", "stiff"))
    volumes = cell_volumes(mesh)
    assert volumes[mesh.cells("soft")].sum() == pytest.approx(2e-6, rel=1e-9)
    assert volumes[mesh.cells("stiff")].sum() == pytest.approx(3.6e-7, rel=1e-9)
    areas = sorted(round(1e6 * surface_area(mesh, name), 6) for name in mesh.surfaces if name.startswith("face_"))
    assert areas == [36, 36, 60, 60, 60, 60, 64, 100, 200, 200, 200, 200]
    outer = {tuple(face) for face in mesh.boundary_faces().tolist()}
    (between,) = (faces for faces in mesh.surfaces.values() if not outer & {tuple(face) for face in faces.tolist()})
    assert np.isin(between[:, 0], mesh.cells("soft")).all()
    assert mesh.nodes[np.unique(mesh.face_nodes(between)), 0] == pytest.approx(0.02, abs=1e-9)


def test_solids_of_a_step_file_that_lie_apart_or_overlap_are_refused(tmp_path):
    write_solids(tmp_path / "apart.step", soft=((0, 0, 0), (20, 10, 10)), stiff=((21, 0, 0), (30, 10, 10)))
    with pytest.raises(StudyError, match="the mesh falls into 2 parts that share no node"):
        check_mesh(load_mesh(tmp_path / "apart.step", "mm", size=0.005))
    write_solids(tmp_path / "overlap.step", soft=((0, 0, 0), (20, 10, 10)), stiff=((18, 0, 0), (30, 10, 10)))
    with pytest.raises(StudyError, match=r"the 2 solids of .*overlap\.step overlap by 200 mm3, .*: cut one out"):
        load_mesh(tmp_path / "overlap.step", "mm", size=0.005)


def test_a_ply_file_that_ends_in_its_header_is_refused(tmp_path):
    """meshio would read on for ever."""
    (tmp_path / "cut.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 8\nproperty float x\n")
    with pytest.raises(StudyError, match="its header has no end_header"):
        load_mesh(tmp_path / "cut.ply", "mm", 10.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["inp", "msh", "vtk", "vtu", "ply", "obj", "stl", "binary stl", "step"])
@pytest.mark.parametrize("name", ["cube.stl", "cube.vtk", "cube"])
def test_a_mesh_is_read_whatever_its_name(tmp_path, kind, name):
    written, box = tmp_path / f"written.{kind.split()[-1]}", block((30.0, 20.0, 20.0), (1, 1, 1), "tet4")
    if kind == "step":
        occ.Box((0, 0, 0), (30, 20, 20)).WriteStep(str(written))
    elif kind == "inp":
        written.write_text("** a cube\n" + inp_text("hex8")[0])
    else:
        faces = box.boundary_faces()
        triangles = np.array([box.blocks[0].connectivity[c][list(TET_FACES[f])] for c, f in faces.tolist()])
        is_surface = kind in ("ply", "obj", "stl", "binary stl")
        cells = [("triangle", triangles)] if is_surface else [("tetra", box.blocks[0].connectivity)]
        options = {"binary": True} if kind == "binary stl" else {"file_format": "gmsh22"} if kind == "msh" else {}
        meshio.Mesh(box.nodes, cells).write(written, **options)
    path = written.rename(tmp_path / name)
    assert cell_volumes(load_mesh(path, "mm")).sum() == pytest.approx(12e-6, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "unit", "size", "message"),
    [
        ("a.xyz", "mm", None, r"a\.xyz is no mesh file that is read; use \.inp, "),
        ("a.inp", "inch", None, "'inch' is not a unit of length"),
        ("a.vtk", "mm", 0.1, "is meshed already"),
        ("a.stl", "mm", -1.0, "a cell size of -1"),
        *((f"a.{kind}", "mm", None, "cannot read the") for kind in FILE_KINDS),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused(tmp_path, name, unit, size, message):
    with pytest.raises(StudyError, match=message):
        load_mesh(tmp_path / name, unit, size)


def test_the_rubber_spring_is_mended_and_sound():
    path = real_data("fem_reference") / "felupe" / "ex06_rubber-metal-spring_mesh.vtk"
    mesh = load_mesh(path, "mm")
    check_mesh(mesh)
    # Its cells around the axis are hexahedra collapsed to prisms, and all are mirrored.
    content = meshio.vtk.read(path)
    assert [b.cell_type for b in mesh.blocks] == ["hex8", "prism6"]
    assert mesh.n_cells == len(content.cells[0].data)
    np.testing.assert_allclose(np.ptp(mesh.nodes, axis=0), 1e-3 * np.ptp(content.points, axis=0))
    triangles = mesh.nodes[mesh.surface_triangles()]
    assert cell_volumes(mesh).sum() == pytest.approx(
        np.einsum("ti,ti->", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6, rel=1e-3
    )
    with pytest.raises(StudyError, match="240 x 120 x 120 m, which is hardly meant"):
        check_mesh(load_mesh(path, "m"))


def test_the_engine_mounts_loose_rings_are_reported():
    path = real_data("fem_reference") / "felupe" / "ex07_engine-mount_mesh-metal.vtk"
    mesh = load_mesh(path, "mm")
    assert [b.cell_type for b in mesh.blocks] == ["quad4"]
    with pytest.raises(StudyError, match="falls into 2 parts"):
        check_mesh(mesh)


def test_the_liver_is_read_and_its_sculpted_surface_refused():
    folder = real_data("fem_reference") / "sofa_mor"
    mesh = load_mesh(folder / "liverFine.vtu", "cm")
    check_mesh(mesh)
    assert (mesh.n_nodes, mesh.n_cells) == (4293, 22019)
    with pytest.raises(StudyError, match="cuts through itself"):
        load_mesh(folder / "liver-smoothUV.obj", "cm")


def test_gmsh_2_cells_of_two_groups_are_one_cell_in_both(tmp_path):
    """Gmsh 2 writes the second hexahedron of the bar once for each of its groups."""
    text = GMSH.replace("$PhysicalNames\n4", '$PhysicalNames\n5\n3 7 "core"').replace("$Elements\n4", "$Elements\n5")
    text = text.replace("$EndElements", "5 5 2 7 2 2 3 6 5 8 9 12 11\n$EndElements")
    (tmp_path / "bar.msh").write_text(text)
    mesh = load_mesh(tmp_path / "bar.msh", "mm")
    check_mesh(mesh)
    assert cell_volumes(mesh) == pytest.approx([1e-6, 1e-6], rel=1e-12)
    assert {name: cells.tolist() for name, cells in mesh.cell_sets.items()} == {"soft": [0], "hard": [1], "core": [1]}
    assert surface_area(mesh, "grip") == pytest.approx(1e-4, rel=1e-12)


def test_gmsh_4_0_which_keeps_one_group_of_an_entity_is_refused(tmp_path):
    (tmp_path / "bar.msh").write_text(gmsh_4_text(first_groups="1 1").replace("4.1 0 8", "4 0 8"))
    with pytest.raises(StudyError, match=r"version 4\.0"):
        load_mesh(tmp_path / "bar.msh", "mm")
