import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from morph_dslam.registration.mesh_edges import MOST_TRIANGLES, simplified


def finely(mesh: trimesh.Trimesh, least: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Nodes and triangles of a mesh whose triangles are divided until there are so many."""
    while len(mesh.faces) < least:
        mesh = mesh.subdivide()
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64)


@pytest.mark.parametrize("radius", [0.03, 40.0])
def test_a_fine_sphere_stays_closed_and_round(radius: float) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=6, radius=radius)  # 81 920 triangles
    nodes, triangles = simplified(np.asarray(sphere.vertices), np.asarray(sphere.faces, dtype=np.int64))
    found = trimesh.Trimesh(nodes, triangles, process=False)
    assert len(triangles) <= MOST_TRIANGLES
    assert found.is_watertight
    assert found.is_winding_consistent
    assert found.volume == pytest.approx(4.0 / 3.0 * np.pi * radius**3, rel=2e-3)
    np.testing.assert_allclose(np.linalg.norm(nodes, axis=1), radius, rtol=2e-3)


def test_a_box_of_many_triangles_keeps_its_corners_and_faces() -> None:
    sides = np.array([0.1, 0.06, 0.04])
    nodes, triangles = finely(trimesh.creation.box(sides), 4 * MOST_TRIANGLES)
    nodes, triangles = simplified(np.vstack([nodes, [9.0, 9.0, 9.0]]), triangles)  # one node of no triangle
    found = trimesh.Trimesh(nodes, triangles, process=False)
    assert len(triangles) <= MOST_TRIANGLES
    assert found.volume == pytest.approx(sides.prod(), rel=1e-9)
    assert found.area == pytest.approx(2.0 * (sides[0] * sides[1] + sides[1] * sides[2] + sides[2] * sides[0]))
    np.testing.assert_allclose(found.bounds, [-sides / 2, sides / 2], atol=1e-12)


def test_a_surface_of_few_triangles_is_not_touched() -> None:
    box = trimesh.creation.box([1.0, 1.0, 1.0])
    nodes, triangles = np.asarray(box.vertices), np.asarray(box.faces, dtype=np.int64)
    found = simplified(nodes, triangles)
    assert found[0] is nodes
    assert found[1] is triangles
