import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from morph_dslam.geometry import SimilarityTransform
from morph_dslam.registration.icp import Surface
from morph_dslam.registration.scene import MapPoints
from morph_dslam.registration.surface_search import laid, nearest_facing

#: An L of three different arms has no symmetry.
BOXES = (
    ([0.10, 0.02, 0.02], [0.05, 0.0, 0.0]),
    ([0.02, 0.07, 0.02], [0.0, 0.035, 0.0]),
    ([0.02, 0.02, 0.04], [0, 0, 0.03]),
)
TRUE = SimilarityTransform(2.5, Rotation.from_rotvec([0.3, -0.5, 1.1]).as_matrix(), np.array([0.4, -0.2, 3.0]))


def body():
    parts = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in BOXES]
    mesh = trimesh.util.concatenate(parts)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64)


@pytest.mark.parametrize("ratio", [0.78, 0.83, 0.87])
def test_the_axis_of_a_can_whose_moments_are_nearly_equal_is_found(ratio):
    """At 0.83 to 0.84 the moments about its axis and across it are the same."""
    can = trimesh.creation.cylinder(0.035, 0.07 * ratio, sections=96).subdivide_to_size(0.01)
    surface = Surface.of_mesh(can.vertices @ TRUE.rotation.T, np.asarray(can.faces, dtype=np.int64))
    assert surface.axis_of_revolution is not None
    assert abs(surface.axis_of_revolution.direction @ TRUE.rotation[:, 2]) > 1.0 - 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("metric", [False, True])
def test_the_start_nearest_to_the_truth_ends_there_and_comes_first(metric):
    nodes, triangles = body()
    seen = Surface.of_mesh(nodes, triangles, 400)
    eyes = seen.points + 0.5 * seen.normals
    points = MapPoints(TRUE.apply(seen.points)[::4], TRUE.apply(eyes)[::4])
    starts = []
    for angle in (0.0, 1.2, 2.4, 3.6, 4.8):
        turn = SimilarityTransform(
            1.0 if metric else 1.1, Rotation.from_rotvec([0, angle + 0.15, 0]).as_matrix(), np.full(3, 3e-3)
        )
        starts.append(TRUE @ turn)
    found = laid(points, Surface.of_mesh(nodes, triangles, 1500), starts, np.linspace(0.3, 0.04, 12), metric)
    assert len(found) == len(starts)
    off = np.linalg.norm((TRUE.inverse @ found[0]).apply(nodes) - nodes, axis=1)
    assert off.mean() < 4e-3  # samples lie 4 mm apart; the start is over 10 mm off
    if metric:
        assert all(place.scale == pytest.approx(2.5) for place in found)


def test_of_a_thin_wall_the_side_that_was_seen_counts():
    wall = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1e-3]])
    normals = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    point, above, below = np.array([[0.0, 0.0, 4e-4]]), np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, -1.0]])
    for eye, expected in ((above, 1), (below, 0)):
        nearest = nearest_facing(point, eye, wall, normals, True, 2e-3)
        assert nearest[0] == expected
    nearest = nearest_facing(point, above, wall, normals, False, 2e-3)  # an open surface has no sides
    assert nearest[0] == 0
    nearest = nearest_facing(point, above, wall, normals, True, 1e-4)  # farther than any wall is thick
    assert nearest[0] == 0
