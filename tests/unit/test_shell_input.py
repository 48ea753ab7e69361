"""What a shell's study refuses, what its mesh generators make, and what it reads from files."""

import re
import tomllib

import meshio
import numpy as np
import pytest

from morph_dslam.cli import app as cli
from morph_dslam.errors import StudyError
from morph_dslam.meshing import surface_generators
from morph_dslam.meshing.mesh_checks import check_mesh
from morph_dslam.meshing.mesh_files import load_surface_mesh
from morph_dslam.meshing.meshes import CellBlock, Mesh, jacobian_determinants
from morph_dslam.meshing.second_order import to_second_order
from morph_dslam.meshing.surface_checks import check_surface
from morph_dslam.studies.study import make_study
from tests.support.shells import shell_study

STRIP = """
mesh = { generator = "plate", size = ["40 mm", "20 mm"], divisions = [2, 1] }
shell = { thickness = "1 mm" }
supports = [{ kind = "clamped", on = "x_min" }]
material = { young = "1 GPa", poisson = 0.3 }
"""
SQUARES = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [1, 1, 0], [2, 1, 0], [1, 0, 1], [1, 1, 1]]) * 0.01


def surface(*cells):
    corners = np.array(cells)
    return Mesh(SQUARES, (CellBlock("quad4" if corners.shape[1] == 4 else "tri3", corners),)).without_unused_nodes()


def test_a_third_cell_at_an_edge_is_refused():
    with pytest.raises(StudyError, match=r"1 edges .* more than two cells \(a T-junction\).*\(10, 5, 0\) mm"):
        check_surface(surface([0, 1, 4, 3], [1, 2, 5, 4], [1, 6, 7, 4]))


def test_a_corner_in_the_middle_of_an_edge_is_refused():
    with pytest.raises(StudyError, match=r"node 1 .*\(10, 0, 0\) mm lies in the middle of an edge"):
        check_surface(surface([0, 5, 3], [0, 2, 5], [1, 2, 6]))


def test_cells_that_turn_differently_are_refused():
    with pytest.raises(StudyError, match=r"opposite sides up at 1 edges.*\(10, 5, 0\) mm between cells 0 and 1"):
        check_surface(surface([0, 1, 4, 3], [1, 4, 5, 2]))


def test_a_study_of_a_surface_with_a_branch_ends_with_one_message(tmp_path, capsys):
    mesh = surface([0, 1, 4, 3], [1, 2, 5, 4], [1, 6, 7, 4])
    meshio.Mesh(mesh.nodes, [("quad", mesh.blocks[0].connectivity)]).write(tmp_path / "branch.vtu")
    (tmp_path / "study.toml").write_text("""
        name = "branch"
        mesh = { file = "branch.vtu", unit = "m" }
        shell = { thickness = "0.1 mm" }
        material = { young = "1 GPa", poisson = 0.3 }
        sets = { held = { box = [["0 mm", "0 mm", "0 mm"], ["0 mm", "10 mm", "0 mm"]] } }
        supports = [{ kind = "clamped", on = "held" }]
        loads = [{ kind = "pressure", pressure = "load" }]
        parameters = { load = { range = ["0 Pa", "1 Pa"] } }
    """)
    command = ["build", tmp_path / "study.toml", "-o", tmp_path / "branch.morph"]
    assert cli.main([str(argument) for argument in command]) == 2
    assert "T-junction" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"material": {"poisson": 0.3}}, "give young and poisson, or young_fibre"),
        ({"material": {"young": "1 GPa", "young_fibre": "1 GPa", "poisson": 0.3}}, "leave it out"),
        ({"material": {"young_fibre": "1 GPa", "young_cross": "1 GPa", "shear": "1 GPa", "poisson": 1.2}}, "unstable"),
        ({"material": {"young": "0 Pa", "poisson": 0.2}}, "must be positive"),
        ({"material": {"young": "1 GPa", "poisson": 0.3, "fibre": [0, 0, 0]}}, "no direction"),
        (
            {"material": {"young": "1 GPa", "poisson": 0.3, "density": "-1 g/cm3"}},
            "density = -1000 must not be negative",
        ),
        ({"supports": [{"kind": "clamped", "on": "x_min"}, {"kind": "displacement", "on": "x_max"}]}, "holds nothing"),
        ({"loads": [{"kind": "gravity"}]}, "gravity needs the material's density"),
        ({"loads": [{"kind": "edge", "on": "x_max", "force": ["1 N", "0 N/m", "0 N/m"]}]}, "not a unit of force per"),
        ({"sets": {"tip": {}}}, "either nearest, or a region"),
        ({"mesh": {"file": "sheet.vtu", "unit": "m", "size": "1 mm"}}, "size"),
        ({"shell": {"thickness": "1 mm * part"}}, "part"),
        ({"shell": {"thickness": 1.5}}, 'write 1.5 with its unit, "1.5 mm" for example'),
        ({"shell": {"thickness": "1 mm * a"}}, "thickness = 0 mm must be positive where a = 0: change its range"),
        ({"shell": {"thickness": "1 mm - 2 mm * a"}}, "thickness = -1 mm must be positive where a = 1"),
    ],
)
def test_sections_that_say_what_cannot_be(change, message):
    content = tomllib.loads(STRIP) | {"name": "strip", "parameters": {"a": {"range": [0.0, 1.0]}}}
    with pytest.raises(StudyError, match=message):
        make_study(content | change)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ('sets = { tip = { box = [["1 m", "0 m", "0 m"], ["2 m", "0 m", "0 m"]] } }', "no node of the mesh lies in"),
        ('sets = { x_max = { nearest = ["1 m", "0 m", "0 m"] } }', "a set of this name"),
        ('loads = [{ kind = "edge", on = "rim", force = ["1 N/m", "0 N/m", "0 N/m"] }]', "no node set .*'rim'"),
        (
            """
            sets = { tip = { nearest = ["40 mm", "0 m", "0 m"] } }
            loads = [{ kind = "edge", on = "tip", force = ["1 N/m", "0 N/m", "0 N/m"] }]
            """,
            "no edge of the mesh has all of its nodes in the set 'tip'",
        ),
    ],
)
def test_sets_that_hold_nothing(more, message):
    with pytest.raises(StudyError, match=message):
        shell_study(STRIP + more).problem()


def test_a_shell_that_can_turn_is_refused():
    text = STRIP.replace('kind = "clamped"', 'kind = "fixed"')
    with pytest.raises(StudyError, match="turn about y"):
        shell_study(text).problem()


def test_a_shell_that_falls_is_refused():
    text = STRIP.replace('kind = "clamped", on = "x_min"', 'kind = "displacement", on = "x_min", x = "0 m", z = "0 m"')
    text = text.replace("poisson = 0.3", 'poisson = 0.3, density = "1 g/cm3"') + 'loads = [{ kind = "gravity" }]'
    with pytest.raises(StudyError, match="free to move along y: fix a set"):
        shell_study(text).problem()


@pytest.mark.parametrize("cells", surface_generators.SURFACES)
@pytest.mark.parametrize("slit", [False, True])
def test_generators_make_the_true_area(cells, slit):
    straight = cells in ("tri3", "quad4")
    meshes = {
        "plate": (surface_generators.plate((0.2, 0.1), (4, 3), cells), 0.02),
        "cylinder": (surface_generators.cylinder(0.1, 0.3, (3, 48), cells, slit=slit), 2 * np.pi * 0.03),
        "hemisphere": (surface_generators.sphere(0.1, (0.0, np.pi / 2), (12, 48), cells, slit=slit), 2 * np.pi * 0.01),
        "ring": (surface_generators.annulus(0.06, 0.1, (2, 48), cells, slit=slit), np.pi * 0.0064),
    }
    for mesh, area in meshes.values():
        check_mesh(mesh)
        check_surface(mesh)
        sizes = [jacobian_determinants(mesh, block) @ block.type.quadrature()[1] for block in mesh.blocks]
        assert sum(part.sum() for part in sizes) == pytest.approx(area, rel=5e-3 if straight else 2e-5)
        for name, nodes in mesh.node_sets.items():
            assert len(nodes), name
    assert ("start" in meshes["ring"][0].node_sets) == slit
    assert set(meshes["cylinder"][0].node_sets) >= {"bottom", "top"}


@pytest.mark.parametrize("kind", ["triangle6", "quad8", "quad9"])
def test_second_order_surfaces_are_read(kind, tmp_path):
    cells = kind.replace("triangle", "tri")
    made = surface_generators.cylinder(0.1, 0.3, (2, 8), cells)
    meshio.Mesh(made.nodes, [(kind, made.blocks[0].connectivity)]).write(tmp_path / "cylinder.vtu")
    read = load_surface_mesh(tmp_path / "cylinder.vtu", "m")
    np.testing.assert_array_equal(read.blocks[0].connectivity, made.blocks[0].connectivity)
    np.testing.assert_allclose(read.nodes, made.nodes)


def sector(angles, radii):
    """Points (n, 2) on a ring by degrees and radius."""
    turns = np.radians(np.array(angles))
    return np.array(radii)[:, None] * np.column_stack([np.cos(turns), np.sin(turns)])


@pytest.mark.parametrize(
    ("element", "cells", "points", "area"),
    [
        # Corners, then the middles of the edges 1-2, 2-3 and so on: two sectors, whose curved sides are exact to 1e-5.
        ("STRI65", "tri6", sector([0, 0, 30, 0, 15, 30], [0, 2, 2, 1, 2, 1]), np.pi / 3),
        ("S6", "tri6", sector([0, 0, 30, 0, 15, 30], [0, 2, 2, 1, 2, 1]), np.pi / 3),
        ("S8", "quad8", sector([0, 0, 30, 30, 0, 15, 30, 15], [1, 2, 2, 1, 1.5, 2, 1.5, 1]), np.pi / 4),
        ("S8R", "quad8", sector([0, 0, 30, 30, 0, 15, 30, 15], [1, 2, 2, 1, 1.5, 2, 1.5, 1]), np.pi / 4),
        ("S8R5", "quad8", sector([0, 0, 30, 30, 0, 15, 30, 15], [1, 2, 2, 1, 1.5, 2, 1.5, 1]), np.pi / 4),
    ],
)
def test_abaqus_shells_of_second_order_are_read(tmp_path, element, cells, points, area):
    labels = ", ".join(str(i + 1) for i in range(len(points)))
    nodes = "".join(f"{i + 1}, {x!r}, {y!r}, 0.\n" for i, (x, y) in enumerate(points.tolist()))
    (tmp_path / "part.inp").write_text(f"*NODE\n{nodes}*ELEMENT, TYPE={element}\n7, {labels}\n")
    mesh = load_surface_mesh(tmp_path / "part.inp", "m")
    (block,) = mesh.blocks
    assert block.cell_type == cells
    assert (jacobian_determinants(mesh, block) @ block.type.quadrature()[1]).sum() == pytest.approx(area, rel=3e-4)


PANEL = """
mesh = { generator = "cylinder", radius = "60 mm", length = "20 mm", angles = ["0 deg", "90 deg"], divisions = [1, 8] }
shell = { thickness = "1 mm" }
material = { young_fibre = "8 GPa", young_cross = "3 GPa", poisson = 0.3, shear = "1 GPa", fibre = [0, 1, 0] }
supports = [{ kind = "clamped", on = "start" }]
"""


def test_fibres_that_turn_abruptly_are_warned_of():
    """The normal is within asin(0.1) = 5.74 degrees of y on 6.4 % of a quarter of a cylinder."""
    (sentence,) = shell_study(PANEL).doubts()
    said = re.search(
        r"fibre = \[0.0, 1.0, 0.0\] is within 6 degrees of the normal on ([\d.]+) % of the shell", sentence
    )
    assert said is not None
    assert float(said[1]) == pytest.approx(6.4, abs=0.5)
    assert "run along z there" in sentence
    for fibre in ("[0, 0, 1]", "[0, 1, 1]"):
        assert not shell_study(PANEL.replace("[0, 1, 0]", fibre)).doubts()
    assert not shell_study(STRIP.replace("poisson = 0.3", "poisson = 0.3, fibre = [0, 0, 1]")).doubts()


@pytest.mark.parametrize(("most", "said"), [("0.1 N/mm", None), ("9.5 N/mm", None), ("15 N/mm", 29)])
def test_loads_far_too_large_for_a_shell_are_asked_about(most, said):
    """The tip of a strip moves by 4 q l^3 / (E t^3), 20 times its size of 44.7 mm for 10.3 N/mm."""
    edge = '{ kind = "edge", on = "x_max", force = ["0 N/m", "0 N/m", "push"] }'
    text = STRIP.replace("0.3", "0.0").replace('"1 mm"', '"1.432 mm"') + f"loads = [{edge}]\n"
    study = shell_study(text + f'parameters = {{ push = {{ range = ["0 N/mm", "{most}"] }} }}')
    assert ("are their units" in study.advice) == (said is not None)
    assert said is None or f"push = {most} would move the shell by {said} times its size" in study.advice


def test_an_open_stl_is_a_surface(tmp_path):
    mesh = surface([0, 1, 4], [0, 4, 3])
    meshio.Mesh(1e3 * mesh.nodes, [("triangle", mesh.blocks[0].connectivity)]).write(tmp_path / "open.stl")
    read = load_surface_mesh(tmp_path / "open.stl", "mm")
    assert sum(len(block.connectivity) for block in read.blocks) == 2
    np.testing.assert_allclose(np.ptp(read.nodes, axis=0), [0.01, 0.01, 0.0])


def test_a_solid_is_no_shell(tmp_path):
    (tmp_path / "part.step").write_text("")
    with pytest.raises(StudyError, match="middle surface"):
        load_surface_mesh(tmp_path / "part.step", "mm")


def test_middle_nodes_of_surface_cells():
    mesh = to_second_order(surface([0, 1, 4, 3]), "quad9")
    np.testing.assert_allclose(mesh.nodes[mesh.blocks[0].connectivity[0, 8]], [0.005, 0.005, 0.0])
