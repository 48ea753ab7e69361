"""Flat parts with notches and holes: areas, lengths and volumes of figures."""

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.errors import StudyError
from morph_dslam.meshing.extrusion import Hole, extrusion
from morph_dslam.meshing.mesh_checks import check_mesh

#: A strip of 48 x 24 mm with a notch of 0.5 x 3.6 mm in its lower side, clockwise; the corner at its tip is fine.
STRIP = 1e-3 * np.array(
    [[-24, -12], [-24, 12], [24, 12], [24, -12], [0.25, -12], [0.25, -8.94], [0, -8.4], [-0.25, -8.94], [-0.25, -12]]
)
SIZES = np.where(np.arange(len(STRIP)) == 6, 0.15e-3, 1.0)
HOLE = Hole((10e-3, 0.0), 6e-3)
#: In mm^2: the sheet, less the slot, its tip, and the hole.
AREA = 48.0 * 24.0 - 0.5 * 3.06 - 0.5 * 0.5 * 0.54 - np.pi * 3.0**2


def area(mesh, surface):
    """Of a surface, by the triangles over its faces, m^2."""
    points = mesh.nodes[mesh.face_triangles(mesh.surface(surface))]
    return 0.5 * np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1).sum()


@pytest.fixture(scope="module")
def strip():
    return extrusion(STRIP, 2.5e-3, 1.6e-3, layers=2, holes=[HOLE], sizes=SIZES)


def test_a_notched_strip_with_a_hole_has_its_sides(strip):
    check_mesh(strip)
    assert np.ptp(strip.nodes, axis=0) == pytest.approx([48e-3, 24e-3, 2.5e-3])
    for name in ("z_min", "z_max"):
        assert 1e6 * area(strip, name) == pytest.approx(AREA, rel=2e-4)  # chords of half a cell around the hole
    assert 1e6 * area(strip, "hole_1") == pytest.approx(np.pi * 6.0 * 2.5, rel=2e-3)
    assert strip.nodes[strip.node_sets["x_min"], 0] == pytest.approx(-24e-3)
    lengths = [24.0, 48.0, 24.0, 23.75, 3.06, np.hypot(0.25, 0.54), np.hypot(0.25, 0.54), 3.06, 23.75]
    for number, length in enumerate(lengths, 1):
        assert 1e6 * area(strip, f"side_{number}") == pytest.approx(2.5 * length, rel=1e-9)
    assert np.array_equal(strip.surface("x_max"), strip.surface("side_3"))
    assert 1e6 * area(strip, "y_min") == pytest.approx(2.5 * 2 * 23.75, rel=1e-9)


def test_cells_are_fine_at_the_tip_and_curved_on_the_hole(strip):
    wall = strip.nodes[strip.node_sets["hole_1"], :2] - HOLE.centre
    assert np.linalg.norm(wall, axis=1) == pytest.approx(3e-3, rel=1e-12)
    from_tip = np.linalg.norm(strip.nodes[:, :2] - STRIP[6], axis=1)
    assert (from_tip < 0.15e-3).sum() > 10
    longest = max(
        np.linalg.norm(np.diff(strip.nodes[edge, :2], axis=0)) for edge in strip.blocks[0].connectivity[:, :2]
    )
    assert longest < 2.0 * 1.6e-3


def test_volumes_by_cells_of_first_order():
    mesh = extrusion([[0, 0], [30e-3, 0], [0, 40e-3]], 3e-3, 5e-3, "prism6", layers=3)
    a, b, c = (mesh.nodes[mesh.blocks[0].connectivity[:, k], :2] for k in range(3))
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert (areas > 0.0).all()
    assert areas.sum() * 1e-3 == pytest.approx(0.5 * 30e-3 * 40e-3 * 3e-3)
    assert 1e6 * area(mesh, "side_2") == pytest.approx(3.0 * 50.0)
    assert "x_max" not in mesh.surfaces


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"outline": [[0, 0], [1e-2, 1e-2], [1e-2, 0], [0, 1e-2]]}, "sides 1 and 3 of the outline cross"),
        ({"outline": [[0, 0], [1e-2, 0], [1e-2, 1e-2], [5e-3, 0], [0, 1e-2]]}, "sides 1 and 3 of the outline cross or"),
        ({"outline": [[0, 0], [1e-2, 0], [1e-2, 0], [0, 1e-2]]}, r"corners 2 and 3 .* coincide at \(10, 0\) mm"),
        ({"outline": [[0, 0], [1e-2, 0]]}, "three corners"),
        ({"holes": [Hole((9e-3, 5e-3), 4e-3)]}, r"hole 1 at \(9, 5\) mm is not inside"),
        ({"holes": [Hole((5e-2, 5e-3), 4e-3)]}, "hole 1 .* is not inside"),
        ({"holes": [Hole((3e-3, 5e-3), 4e-3), Hole((6e-3, 5e-3), 3e-3)]}, "holes 1 and 2 touch or overlap"),
        ({"holes": [Hole((3e-3, 5e-3), -4e-3)]}, "hole 1 has the diameter"),
        ({"size": 1e-6}, "2e\\+08 cells"),
        ({"thickness": 0.0}, "give positive ones"),
        ({"cell_type": "hex8"}, "not a cell type of this generator"),
    ],
)
def test_what_is_no_part_is_refused(change, message):
    given = {"outline": [[0, 0], [1e-2, 0], [1e-2, 1e-2], [0, 1e-2]], "thickness": 1e-3, "size": 2e-3}
    with pytest.raises(StudyError, match=message):
        extrusion(**given | change)


def test_a_study_names_it():
    study = md.make_study(
        {
            "name": "strip",
            "mesh": {
                "generator": "extrusion", "unit": "mm", "thickness": "2.5 mm", "size": "1.6 mm", "layers": 2,
                "outline": [[*1e3 * corner, *([0.15] if n == 6 else [])] for n, corner in enumerate(STRIP)],
                "holes": [{"centre": [10, 0], "diameter": "6 mm"}],
            },
            "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.4}},
            "supports": [{"kind": "fixed", "on": "x_min"}, {"kind": "displacement", "on": "x_max", "x": "pull"}],
            "parameters": {"pull": {"range": ["0 mm", "10 mm"]}},
        }
    )  # fmt: skip
    mesh, expected = study.mesh.make(), extrusion(STRIP, 2.5e-3, 1.6e-3, layers=2, holes=[HOLE], sizes=SIZES)
    assert mesh.nodes == pytest.approx(expected.nodes)
    assert mesh.surfaces.keys() == expected.surfaces.keys()
