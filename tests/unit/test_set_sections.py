"""Sets that a study makes by their place: areas, volumes and numbers in closed form, and what cannot be."""

from dataclasses import replace

import meshio
import netgen.occ as occ
import numpy as np
import pytest
import trimesh

from morph_dslam.errors import StudyError
from morph_dslam.meshing.mesh_files import load_mesh
from morph_dslam.meshing.mesh_summary import faces_figures
from morph_dslam.studies.provenance import study_warnings
from morph_dslam.studies.solid_sections import mesh_fingerprint
from morph_dslam.studies.study import make_study

#: A block of 40 x 20 x 10 mm in cells of 5 mm, held and loaded by sets of its own.
BLOCK = {
    "name": "block",
    "mesh": {"generator": "block", "size": ["40 mm", "20 mm", "10 mm"], "divisions": [8, 4, 2], "cells": "hex20"},
    "materials": {"rubber": {"law": "neo_hookean", "young": "1 MPa", "poisson": "0.4"}},
    "supports": [{"kind": "fixed", "on": "x_min"}],
    "loads": [{"kind": "pressure", "on": "z_max", "pressure": "p"}],
    "parameters": {"p": {"range": ["0 kPa", "10 kPa"]}},
}


def mm(*values):
    return [f"{value} mm" for value in values]


def mesh_with(**section):
    return make_study(BLOCK | {"sets": {"chosen": section}}).solid_mesh()


def area(mesh, name="chosen"):
    return faces_figures(mesh, mesh.surface(name))[0]


def warnings_of(radius, divisions, near=(20, 10, 10), on="chosen", **section):
    """What is said of a ball about a point of the block's top, which a load is on."""
    mesh = BLOCK["mesh"] | {"divisions": divisions}
    sets = {"chosen": {"near": mm(*near), "radius": f"{radius} mm"} | section}
    loads = [{"kind": "pressure", "on": on, "pressure": "p"}]
    return study_warnings(make_study(BLOCK | {"mesh": mesh, "sets": sets, "loads": loads}))


def test_a_ball_of_which_coarse_cells_leave_little_is_named():
    """A ball about the middle of a square of 5 mm holds this alone, of pi 7^2 = 154 mm2."""
    (said,) = warnings_of(7, [8, 4, 2], near=(22.5, 12.5, 10))
    assert said.startswith("sets.chosen: its whole faces cover 25 of the 154 mm2 of the surface that lie in the ball")


def test_a_ball_that_cells_fill_is_not_named():
    assert not warnings_of(8, [40, 20, 2])
    assert not warnings_of(7.2, [8, 4, 2]), "four squares of 5 mm are 0.61 of the circle"
    assert not warnings_of(12, [8, 4, 2]), "the ball reaches the bottom and the sides too"
    assert not warnings_of(4, [8, 4, 2], near=(20, 10, 7), on="z_max"), "no support or load is on it"
    assert not warnings_of(7, [8, 4, 2], near=(22.5, 12.5, 10), facing=[0, 0, 1]), "faces are chosen otherwise too"


def test_a_box_holds_nodes_faces_and_cells():
    mesh = mesh_with(box=[mm(-1, -1, -1), mm(10, 21, 11)])
    # Two of eight slices: all sides of the first 10 mm but for the cut.
    assert area(mesh) == pytest.approx(1e-6 * (20 * 10 + 2 * 10 * 20 + 2 * 10 * 10))
    assert len(mesh.cells("chosen")) == 2 * 4 * 2
    np.testing.assert_array_equal(mesh.set_nodes("chosen"), np.flatnonzero(mesh.nodes[:, 0] < 0.0101))


def test_the_corners_of_a_box_may_come_in_any_order():
    first, second = (mesh_with(box=box) for box in ([mm(0, 0, 0), mm(10, 20, 10)], [mm(10, 0, 10), mm(0, 20, 0)]))
    np.testing.assert_array_equal(first.set_nodes("chosen"), second.set_nodes("chosen"))


def test_a_ball_holds_what_is_within_its_radius():
    centre = np.array([0.02, 0.01, 0.01])
    mesh = mesh_with(near=mm(20, 10, 10), radius="7.2 mm", of="z_max")
    # Of the 5 mm squares of the top, the four that meet at the centre: their far corners are 7.07 mm away.
    assert area(mesh) == pytest.approx(1e-4)
    assert np.linalg.norm(mesh.nodes[mesh.set_nodes("chosen")] - centre, axis=1).max() == pytest.approx(0.005 * 2**0.5)
    assert "chosen" not in mesh.cell_sets


@pytest.mark.parametrize(("angle", "sides"), [("1 deg", ["x_max"]), ("46 deg", ["x_max", "z_max"])])
def test_faces_that_face_a_direction(angle, sides):
    """(1, 0, 0.9) is 42 degrees from x and 48 from z; turned to (1, 0, 1) it is 45 from both."""
    direction = [1, 0, 0] if len(sides) == 1 else [1, 0, 1]
    mesh = mesh_with(facing=direction, angle=angle)
    assert area(mesh) == pytest.approx(sum(area(mesh, side) for side in sides))


def test_a_share_of_a_cylinder_faces_a_direction():
    tube = {"generator": "tube", "inner_radius": "8 mm", "outer_radius": "10 mm", "length": "30 mm"}
    tube |= {"divisions": [3, 1, 72], "cells": "hex20"}
    content = BLOCK | {"mesh": tube, "supports": [{"kind": "fixed", "on": "bottom"}]}
    content["loads"] = [{"kind": "pressure", "on": "window", "pressure": "p"}]
    sets = {"window": {"facing": [0, 1, 0], "angle": "30.1 deg", "of": "outer"}}
    mesh = make_study(content | {"sets": sets}).solid_mesh()
    # 60 of 360 degrees of the outer wall, in whole faces of 5 degrees.
    assert area(mesh, "window") == pytest.approx(2 * np.pi * 0.01 * 0.03 / 6, rel=2e-3)


def test_of_takes_earlier_sets_and_several():
    sets = {
        "half": {"box": [mm(0, 0, 0), mm(20, 20, 10)]},
        "quarter": {"of": ["half"], "box": [mm(0, 0, 0), mm(20, 10, 10)], "facing": [0, 0, 1]},
        "ends": {"of": ["x_min", "x_max"]},
    }
    mesh = make_study(BLOCK | {"sets": sets}).solid_mesh()
    assert area(mesh, "quarter") == pytest.approx(2e-4)
    assert area(mesh, "ends") == pytest.approx(4e-4)


def test_loads_supports_and_materials_take_them():
    soft = {"law": "neo_hookean", "young": "0.1 MPa", "poisson": "0.4", "on": "core"}
    content = BLOCK | {
        "sets": {"core": {"near": mm(20, 10, 5), "radius": "8 mm"}, "held": {"box": [mm(0, 0, 0), mm(4, 20, 10)]}},
        "materials": BLOCK["materials"] | {"soft": soft},
        "supports": [{"kind": "fixed", "on": "held"}],
    }
    study = make_study(content)
    # The middles of 5 mm cells that are within 8 mm of the centre: (2.5, 2.5, 2.5) and (7.5, 2.5, 2.5) is 8.29 away.
    assert len(study.solid_mesh().cells("core")) == 8


def test_solutions_stay_what_they_are_until_a_set_that_they_depend_on_changes():
    held = {"held": {"box": [mm(0, 0, 0), mm(4, 20, 10)]}}
    supports = [{"kind": "fixed", "on": "held"}]
    turned = {"kind": "rotation", "on": "x_max", "axis": [1, 0, 0], "angle": "1 deg", "centre": "pivot"}

    def fingerprint(sets, **changes):
        return make_study(BLOCK | {"supports": supports, "sets": held | sets} | changes).fingerprint()

    of_all = fingerprint({})
    for name, section in (("top", {"of": "z_max"}), ("part", {"box": [mm(0, 0, 0), mm(20, 20, 10)]})):
        assert fingerprint({name: section}) == of_all, "nothing names it"
    loads = {"unknown_loads": {"on": ["z_min", "y_min"], "modes": 5}}
    assert fingerprint({}, **loads) == of_all, "unknown loads act on solutions that are there"
    assert fingerprint({"held": {"box": [mm(0, 0, 0), mm(6, 20, 10)]}}) != of_all
    joint = [{"kind": "pressure", "on": ["z_max", "y_max"], "pressure": "p"}]
    assert fingerprint({}, loads=joint) != of_all
    pivots = [fingerprint({"pivot": {"nearest": mm(40, y, 0)}}, supports=[*supports, turned]) for y in (0, 20)]
    assert len({*pivots, of_all}) == 3, "the centre of a rotation may be a set"


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({}, "sets.chosen: give either nearest, or a region"),
        ({"nearest": mm(0, 0, 0), "box": [mm(0, 0, 0), mm(1, 1, 1)]}, "give either nearest, or a region"),
        ({"near": mm(0, 0, 0)}, "near and radius belong together"),
        ({"of": "z_max", "angle": "10 deg"}, "give facing too"),
        ({"facing": [0, 0, 0]}, "facing has no length"),
        ({"facing": [0, 0, 1], "angle": "0 deg"}, "greater than 0"),
        ({"box": [mm(0, 0, 20), mm(1, 1, 30)]}, "no node of the mesh lies in it; .* z 0 to 10 mm"),
        ({"near": mm(20, 10, 25), "radius": "7 mm"}, "is 15 mm away from near"),
        ({"facing": [0, 0, 1], "box": [mm(1, 1, 0), mm(39, 19, 5)]}, "no outer face of the mesh has all its nodes"),
        ({"of": "z_top"}, "sets.chosen: the mesh has no surface 'z_top'"),
        ({"nearest": ["20 m", "0 m", "0 m"]}, "nearest is .* mm away from the mesh"),
    ],
)
def test_sets_that_cannot_be(section, message):
    with pytest.raises(StudyError, match=message):
        mesh_with(**section)


@pytest.mark.parametrize("name", ["z_max", "all"])
def test_a_name_that_the_mesh_has(name):
    with pytest.raises(StudyError, match=f"sets.{name}: the mesh has a set of this name"):
        make_study(BLOCK | {"sets": {name: {"of": "z_min"}}}).solid_mesh()


def test_a_load_on_a_set_without_a_whole_face():
    content = BLOCK | {"sets": {"spot": {"nearest": mm(20, 10, 10)}}}
    content["loads"] = [{"kind": "pressure", "on": "spot", "pressure": "p"}]
    with pytest.raises(StudyError, match="load 1: on: 'spot' is a node set that holds no whole face"):
        make_study(content).solid_mesh()


def test_closed_cavities_are_surfaces(tmp_path):
    """A box with two balls in it, of which the smaller lies at the smaller x."""
    balls = [trimesh.creation.icosphere(2, radius) for radius in (3.0, 4.0)]
    for ball, x in zip(balls, (7.0, 22.0), strict=True):
        ball.apply_translation([x, 5.0, 5.0])
        ball.invert()
    box = trimesh.creation.box([30.0, 10.0, 10.0])
    box.apply_translation([15.0, 5.0, 5.0])
    trimesh.util.concatenate([box.subdivide().subdivide(), *balls]).export(tmp_path / "hollow.stl")
    mesh = load_mesh(tmp_path / "hollow.stl", "mm")
    for name, ball in (("cavity_1", balls[0]), ("cavity_2", balls[1])):
        size, centre, _ = faces_figures(mesh, mesh.surface(name))
        assert size == pytest.approx(1e-6 * ball.area, rel=1e-6)
        np.testing.assert_allclose(centre, 1e-3 * ball.centroid, atol=1e-6)
    assert "cavity_3" not in mesh.surfaces


def test_a_body_without_cavities_has_none(tmp_path):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [5, 0, 0], [6, 0, 0], [5, 1, 0], [5, 0, 1.0]])
    meshio.Mesh(points, [("tetra", np.arange(8).reshape(2, 4))]).write(tmp_path / "two.vtu")
    assert not [name for name in load_mesh(tmp_path / "two.vtu", "mm").surfaces if name.startswith("cavity")]


def test_surfaces_that_a_file_does_not_name_neither_change_its_solutions_nor_take_names(tmp_path):
    """A study's own set of the name of an end takes its place; one that uses the end is no other mesh."""
    block = make_study(BLOCK).solid_mesh()
    content = BLOCK | {"mesh": {"file": str(tmp_path / "block.vtu"), "unit": "m"}}
    meshio.Mesh(block.nodes, [("hexahedron20", block.blocks[0].connectivity)]).write(tmp_path / "block.vtu")
    study = make_study(content)
    assert area(study.solid_mesh(), "z_max") == pytest.approx(8e-4)
    kept = mesh_fingerprint(study.solid_mesh())
    assert kept == mesh_fingerprint(replace(study.solid_mesh(), surfaces={}, found=frozenset()))
    own = make_study(content | {"sets": {"z_max": {"box": [mm(-1, -1, 9), mm(20, 21, 11)]}}})
    assert area(own.solid_mesh(), "z_max") == pytest.approx(4e-4)
    assert mesh_fingerprint(own.solid_mesh()) != kept


def test_a_shell_has_cells_for_faces():
    shell = {
        "name": "dome",
        "mesh": {"generator": "sphere", "radius": "50 mm", "polar_angles": ["0 deg", "90 deg"], "divisions": [18, 36]},
        "shell": {"thickness": "1 mm"},
        "material": {"young": "1 MPa", "poisson": 0.3},
        "sets": {"cap": {"facing": [0, 0, 1], "angle": "30.1 deg"}, "side": {"box": [mm(0, -51, 0), mm(51, 51, 51)]}},
        "supports": [{"kind": "clamped", "on": "rim"}],
        "loads": [{"kind": "pressure", "on": "cap", "pressure": "p"}],
        "parameters": {"p": {"range": ["0 Pa", "10 Pa"]}},
    }
    mesh = make_study(shell).shell_mesh()
    sizes = {name: np.column_stack([mesh.cells(name), np.zeros_like(mesh.cells(name))]) for name in ("cap", "side")}
    # Caps of a sphere: 2 pi R^2 (1 - cos 30 degrees); half of the hemisphere.
    assert faces_figures(mesh, sizes["cap"])[0] == pytest.approx(
        2 * np.pi * 0.05**2 * (1 - np.cos(np.pi / 6)), rel=0.01
    )
    assert faces_figures(mesh, sizes["side"])[0] == pytest.approx(np.pi * 0.05**2, rel=0.03)


#: A bellows: chambers of 12 x 9 x 11.5 mm in walls of 2 mm, 2 mm apart, joined by a channel of 4 x 1.5 mm in the base.
CHAMBERS = 3 * 2 * (12 * 9 + 12 * 11.5 + 9 * 11.5)
#: The channel is 20 mm long besides: four walls on the way, and two ends of 1 mm; its mouths into chambers are open.
CHANNEL = (1 + 6 + 6 + 1) * 2 * (4 + 1.5) - 4 * 4 * 1.5


def bellows(path, inlet):
    """A STEP file of the bellows, with an inlet of 1.4 mm diameter and 5 mm length where there is to be one."""
    body, air = occ.Box((0, 0, 0), (60, 14, 6)), occ.Box((5, 5, 2.5), (55, 9, 4))
    for x in (4, 22, 40):
        body += occ.Box((x, 0, 4.5), (x + 16, 14, 16))
        air += occ.Box((x + 2, 2.5, 2.5), (x + 14, 11.5, 14))
    if inlet:
        air += occ.Cylinder((-1, 7, 3.25), occ.X, r=0.7, h=8)
    (body - air).WriteStep(str(path))


def bellows_with(path, **section):
    content = BLOCK | {"mesh": {"file": str(path), "unit": "mm", "size": "4 mm"}, "sets": {"chosen": section}}
    content["loads"] = [{"kind": "pressure", "on": "chosen", "pressure": "p"}]
    return make_study(content).solid_mesh()


@pytest.mark.slow
@pytest.mark.parametrize("inlet", [False, True])
@pytest.mark.parametrize("point", [(12, 7, 8), (47, 4, 12), (21, 7, 3.2)])
def test_the_wall_of_a_hollow_is_all_of_its_chambers_and_no_gap_between_them(tmp_path, inlet, point):
    bellows(tmp_path / "bellows.step", inlet)
    mesh = bellows_with(tmp_path / "bellows.step", hollow=mm(*point))
    assert ("cavity_1" in mesh.surfaces) != inlet
    mouth, wall = (np.pi * 0.7**2, 2 * np.pi * 0.7 * 5) if inlet else (0.0, 0.0)
    # The inlet's own wall counts up to somewhere near the outside.
    least, most = CHAMBERS + CHANNEL - mouth, CHAMBERS + CHANNEL - mouth + wall
    assert 0.9995 * least < 1e6 * area(mesh) < 1.0005 * most
    middles = 1e3 * mesh.nodes[mesh.face_nodes(mesh.surface("chosen"), corners_only=True)].mean(axis=1)
    assert ((middles[:, 1:] > [2.4, 2.4]) & (middles[:, 1:] < [11.6, 14.1])).all()
    assert not ((middles[:, 2] > 4.6) & ((middles[:, 0] - 4) % 18 > 14.1)).any(), "a wall of a gap"


@pytest.mark.slow
def test_hollows_that_are_none(tmp_path):
    bellows(tmp_path / "bellows.step", inlet=True)
    for point, message in (
        ((12, 7, 1), "the point lies in the material"),
        ((12, 7, 100), "the point lies outside of the solid"),
        ((21, 7, 10), "so open that its wall has no clear end"),
    ):
        with pytest.raises(StudyError, match=f"sets.chosen: .*{message}"):
            bellows_with(tmp_path / "bellows.step", hollow=mm(*point))
    content = BLOCK | {"mesh": {"file": str(tmp_path / "bellows.step"), "unit": "mm"}}
    content["loads"] = [{"kind": "pressure", "on": "cavity_1", "pressure": "p"}]
    with pytest.raises(StudyError, match=r"no surface 'cavity_1'.* Only a hollow that is closed .* by hollow"):
        make_study(content).solid_mesh()


def cubes(path, kept):
    """A VTK file of the cubes of 1 mm that are ``kept`` of a grid, their nodes where they touch the same."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    points, cells = np.unique((np.argwhere(kept)[:, None] + corners).reshape(-1, 3), axis=0, return_inverse=True)
    meshio.Mesh(points.astype(float), {"hexahedron": cells.reshape(-1, 8)}).write(path)


def test_the_wall_of_a_hollow_in_hexahedra(tmp_path):
    """A cube of 8 mm with a hollow of 4 mm and an inlet of 1 x 1 mm, 2 mm long."""
    kept = np.ones((8, 8, 8), dtype=bool)
    kept[2:6, 2:6, 2:6] = kept[:2, 3, 3] = False
    cubes(tmp_path / "box.vtk", kept)
    content = BLOCK | {"mesh": {"file": str(tmp_path / "box.vtk"), "unit": "mm"}}
    content |= {"loads": [{"kind": "pressure", "on": "air", "pressure": "p"}], "sets": {"air": {"hollow": mm(4, 4, 4)}}}
    mesh = make_study(content).solid_mesh()
    # Faces of 1 mm2: those of the hollow, and of the inlet's four sides either the inner ones alone or all.
    assert 1e6 * area(mesh, "air") in (pytest.approx(6 * 16 - 1 + 4), pytest.approx(6 * 16 - 1 + 8))
    content["sets"]["air"] |= {"facing": [1, 0, 0], "angle": "1 deg"}
    assert 1e6 * area(make_study(content).solid_mesh(), "air") == pytest.approx(15.0)


def test_a_cup_is_no_hollow(tmp_path):
    kept = np.ones((8, 8, 8), dtype=bool)
    kept[2:6, 2:6, 2:] = False
    cubes(tmp_path / "cup.vtk", kept)
    content = BLOCK | {"mesh": {"file": str(tmp_path / "cup.vtk"), "unit": "mm"}}
    content |= {"loads": [{"kind": "pressure", "on": "air", "pressure": "p"}], "sets": {"air": {"hollow": mm(4, 4, 4)}}}
    with pytest.raises(StudyError, match="so open that its wall has no clear end"):
        make_study(content).solid_mesh()
