"""Generated meshes against closed forms: volumes, areas, centroids, and nodes on their surfaces."""

from math import pi, sqrt

import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.meshing.generators import SOLIDS, Collar, block, revolution, tube
from morph_dslam.meshing.mesh_checks import check_mesh
from tests.support.meshes import cell_volumes, centroid, surface_area

#: A boot of a gear lever: cuff, four round folds, neck; radius and height in millimetres.
BOOT = [
    (46, 0), (46, 4.7), (46, 9.3), (46, 14), (47, 16.8), (49, 19.1), (50.7, 21.5), (50.5, 24.4), (48.2, 26.1),
    (45.2, 26), (42.2, 25.9), (39.8, 27.6), (39.7, 30.5), (41.4, 33), (43.1, 35.4), (42.9, 38.3), (40.6, 40),
    (37.6, 39.9), (34.6, 39.9), (32.2, 41.5), (32.1, 44.4), (33.8, 46.9), (35.5, 49.4), (35.4, 52.3),
    (33, 53.9), (30, 53.8), (27, 53.8), (24.7, 55.4), (24.5, 58.3), (26.2, 60.8), (27.9, 63.3), (27.8, 66.2),
    (25.4, 67.8), (22.4, 67.8), (19.5, 68), (18, 70.4), (18, 74.7), (18, 79), (18, 83.4),
]  # fmt: skip


@pytest.mark.parametrize("name", SOLIDS)
def test_a_block_has_its_volume_centroid_and_face_areas(name):
    mesh = block((0.1, 0.2, 0.3), (2, 3, 2), name)
    check_mesh(mesh)
    assert cell_volumes(mesh).sum() == pytest.approx(0.006, rel=1e-12)
    np.testing.assert_allclose(centroid(mesh), [0.05, 0.1, 0.15], rtol=1e-12)
    areas = {"x_min": 0.06, "x_max": 0.06, "y_min": 0.03, "y_max": 0.03, "z_min": 0.02, "z_max": 0.02}
    assert set(mesh.surfaces) == set(mesh.node_sets) == set(areas)
    for axis, side in ((axis, side) for axis in "xyz" for side in ("min", "max")):
        face = f"{axis}_{side}"
        assert surface_area(mesh, face) == pytest.approx(areas[face], rel=1e-12)
        np.testing.assert_array_equal(np.sort(mesh.node_sets[face]), _on_plane(mesh, axis, side))


def _on_plane(mesh, axis, side):
    i = "xyz".index(axis)
    value = 0.0 if side == "min" else (0.1, 0.2, 0.3)[i]
    return np.flatnonzero(np.abs(mesh.nodes[:, i] - value) < 1e-12)


@pytest.mark.parametrize(("name", "nodes"), [("hex8", 36), ("hex27", 175), ("hex20", 111), ("tet10", 175)])
def test_second_order_nodes_are_as_many_as_the_grid_of_half_steps_holds(name, nodes):
    # (2+1)(3+1)(2+1) corners; (5)(7)(5) half steps; hex20 leaves out 52 faces' and 12 cells' centres.
    assert block((1.0, 1.0, 1.0), (2, 3, 2), name).n_nodes == nodes


@pytest.mark.parametrize(("name", "around", "tolerance"), [
    ("hex8", 64, 2e-3), ("hex20", 12, 1e-3), ("hex27", 12, 1e-3), ("tet10", 12, 5e-3), ("prism15", 12, 5e-3),
    ("prism18", 12, 5e-3),
])  # fmt: skip
def test_a_tube_has_its_volume_and_areas(name, around, tolerance):
    mesh = tube(0.02, 0.03, 0.1, (4, 2, around), name)
    check_mesh(mesh)
    assert cell_volumes(mesh).sum() == pytest.approx(pi * (0.03**2 - 0.02**2) * 0.1, rel=tolerance)
    np.testing.assert_allclose(centroid(mesh), [0, 0, 0.05], atol=1e-9)
    for surface, radius in (("inner", 0.02), ("outer", 0.03)):
        nodes = mesh.nodes[mesh.node_sets[surface]]
        np.testing.assert_allclose(np.hypot(nodes[:, 0], nodes[:, 1]), radius, rtol=1e-12)
        assert surface_area(mesh, surface) == pytest.approx(2 * pi * radius * 0.1, rel=0.02)
    assert "start" not in mesh.surfaces


def test_the_volume_of_curved_second_order_cells_converges_with_the_fourth_power():
    exact = pi * (0.03**2 - 0.02**2) * 0.1
    errors = [abs(cell_volumes(tube(0.02, 0.03, 0.1, (1, 1, n), "hex27")).sum() - exact) for n in (8, 16)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.1)


def test_part_of_a_turn_has_ends_and_starts_where_it_is_told():
    mesh = tube(0.02, 0.03, 0.1, (2, 2, 8), "hex20", angles=(pi / 2, pi))
    check_mesh(mesh)
    np.testing.assert_allclose(mesh.nodes[mesh.node_sets["start"], 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(mesh.nodes[mesh.node_sets["end"], 1], 0.0, atol=1e-12)
    assert surface_area(mesh, "start") == pytest.approx(0.001, rel=1e-9)


def test_a_cone_follows_pappus_and_its_slant_height():
    mesh = revolution([(0.05, 0.0), (0.02, 0.04)], 0.002, (10, 2, 200), "hex20")
    check_mesh(mesh)
    # Pappus: the wall's area times the way of its centroid.
    assert cell_volumes(mesh).sum() == pytest.approx(0.05 * 0.002 * 2 * pi * 0.035, rel=1e-6)
    side = mesh.nodes[mesh.node_sets["outer"]]
    # The outer wall lies 1 mm outside the line through the profile.
    r, z = np.hypot(side[:, 0], side[:, 1]), side[:, 2]
    np.testing.assert_allclose(((r - 0.05) * 0.04 + z * 0.03) / 0.05, 0.001, atol=1e-12)


def test_a_wall_of_varying_thickness_follows_its_profile():
    mesh = revolution([(0.03, 0.0), (0.03, 0.04)], (0.002, 0.004), (4, 2, 60), "hex20")
    top = np.hypot(*mesh.nodes[mesh.node_sets["top"], :2].T)
    bottom = np.hypot(*mesh.nodes[mesh.node_sets["bottom"], :2].T)
    assert (np.ptp(bottom), np.ptp(top)) == pytest.approx((0.002, 0.004), rel=1e-9)


def test_a_fold_through_points_on_an_arc_stays_on_it():
    angles = np.linspace(-1.2, 1.2, 41)
    mesh = revolution(np.column_stack([0.05 + 0.01 * np.cos(angles), 0.01 * np.sin(angles)]), 0.002,
                      (12, 2, 40), "hex20")  # fmt: skip
    check_mesh(mesh)
    r, z = np.hypot(mesh.nodes[:, 0], mesh.nodes[:, 1]) - 0.05, mesh.nodes[:, 2]
    for surface, radius in (("outer", 0.011), ("inner", 0.009)):
        nodes = mesh.node_sets[surface]
        np.testing.assert_allclose(np.hypot(r[nodes], z[nodes]), radius, rtol=2e-4)


@pytest.mark.parametrize(("name", "nodes"), [("hex8", 25795), pytest.param("hex20", 95711, marks=pytest.mark.slow)])
def test_the_boot_seal_has_the_papers_nodes_and_cells(name, nodes):
    mesh = revolution(
        1e-3 * np.array(BOOT), 1.5e-3, (91, 2, 77), name,
        collars=(Collar(0.0, 36 / 91, 0.75e-3), Collar(70 / 91, 1.0, 0.75e-3)),
    )  # fmt: skip
    check_mesh(mesh, sets=("top", "bottom", "inner", "outer"))
    # Each of 77 slices has 335 nodes, 239 squares and so, by Euler, 573 edges in its section; at second order
    # there is a node more on each of those edges and on each of the 335 edges to the next slice.
    assert nodes in (77 * 335, 77 * (335 + 573 + 335))
    assert (mesh.n_nodes, mesh.n_cells) == (nodes, 18403)
    # The hole through it makes the surface a torus: V - E + F = 0, with 2 E = 4 F for quadrilaterals.
    faces = mesh.boundary_faces()
    assert len(np.unique(mesh.face_nodes(faces, corners_only=True))) == len(faces)
    assert sum(len(surface) for surface in mesh.surfaces.values()) == len(faces)


def test_a_collar_adds_its_ring_of_material():
    plain = revolution([(0.03, 0.0), (0.03, 0.04)], 0.002, (8, 2, 60), "hex20")
    cuffed = revolution([(0.03, 0.0), (0.03, 0.04)], 0.002, (8, 2, 60), "hex20", collars=[Collar(0.0, 0.25, 0.001, 2)])
    check_mesh(cuffed)
    added = cell_volumes(cuffed).sum() - cell_volumes(plain).sum()
    assert added == pytest.approx(pi * (0.032**2 - 0.031**2) * 0.01, rel=1e-5)
    assert cuffed.n_cells - plain.n_cells == 2 * 2 * 60


def test_a_half_sphere_shell_has_its_volume_though_its_poles_are_cut_off():
    angles = np.linspace(-pi / 3, pi / 3, 61)
    mesh = revolution(0.05 * np.column_stack([np.cos(angles), np.sin(angles)]), 0.01, (20, 1, 60), "hex27")
    check_mesh(mesh)
    # Between two cones of half-angle 30 degrees: 4/3 pi (b^3 - a^3) sin 60.
    assert cell_volumes(mesh).sum() == pytest.approx(4 / 3 * pi * (0.055**3 - 0.045**3) * sqrt(3) / 2, rel=1e-4)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: block((1, 1, 0), (1, 1, 1)), "three positive lengths"),
        (lambda: block((1, 1, 1), (1, 0, 1)), "divisions"),
        (lambda: block((1, 1, 1), (1, 1, 1), "pyramid5"), "'pyramid5' is not a cell type"),
        (lambda: tube(0.03, 0.02, 1, (1, 1, 8)), "0 < inner_radius < outer_radius"),
        (lambda: tube(0.02, 0.03, 1, (1, 1, 2)), "3 cells or more"),
        (lambda: revolution([(0.03, 0)], 0.001, (1, 1, 8)), "two points"),
        (lambda: revolution([(0.03, 0), (0.03, 0)], 0.001, (1, 1, 8)), "coincide"),
        (lambda: revolution([(0.03, 0.1), (0.03, 0)], 0.001, (1, 1, 8)), "downwards"),
        (lambda: revolution([(0.003, 0), (0.003, 1)], 0.01, (1, 1, 8)), "past the axis"),
        (lambda: revolution([(0.03, 0), (0.03, 1)], (1, 2, 3), (1, 1, 8)), "3 values for a profile of 2"),
        (lambda: revolution([(0.03, 0), (0.03, 1)], -0.001, (1, 1, 8)), "thickness positive"),
        (lambda: revolution([(0.03, 0), (0.03, 1)], 0.001, (4, 1, 8), collars=[Collar(0.5, 0.5, 0.1)]), "start < stop"),
        (
            lambda: revolution(
                [(0.03, 0), (0.03, 1)], 0.001, (4, 1, 8), collars=[Collar(0, 0.5, 0.1), Collar(0.5, 1, 0.1)]
            ),
            "touches another",
        ),
    ],
)
def test_what_cannot_be_is_refused_with_what_to_do(make, message):
    with pytest.raises(StudyError, match=message):
        make()


def test_a_wall_thicker_than_its_bend_allows_is_found_by_the_checks():
    with pytest.raises(StudyError, match="inverted or folded"):
        check_mesh(revolution(1e-3 * np.array(BOOT), 9e-3, (91, 2, 40), "hex8"))
