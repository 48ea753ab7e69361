"""Distances to a surface against closed forms."""

import numpy as np
import pytest

from morph_dslam.evaluation.depth import distances_to_surface

TRIANGLE = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 4.0, 0.0]])


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((1.0, 1.0, 2.0), 2.0),  # above the face
        ((-3.0, -4.0, 0.0), 5.0),  # nearest to a corner
        ((1.5, -2.0, 0.0), 2.0),  # nearest to an edge
        ((3.0, 4.0, 0.0), 12.0 / 5.0),  # the far corner of the rectangle, off the hypotenuse
        ((1.0, 1.0, 0.0), 0.0),
    ],
)
def test_distance_to_one_triangle_is_the_closed_form(point, distance):
    found = distances_to_surface(np.array([point]), TRIANGLE, np.array([[0, 1, 2]]))
    assert found[0] == pytest.approx(distance, abs=1e-12)


def test_distances_are_those_to_the_nearest_of_all_triangles():
    rng = np.random.default_rng(3)
    nodes = rng.normal(size=(60, 3))
    triangles = np.array([rng.choice(60, 3, replace=False) for _ in range(90)])
    points = 2.0 * rng.normal(size=(200, 3))
    alone = [distances_to_surface(points, nodes, triangle[None]) for triangle in triangles]
    found = distances_to_surface(points, nodes, triangles)
    assert np.allclose(found, np.min(alone, axis=0), atol=1e-12)


def test_distance_to_a_fine_sphere_is_the_difference_of_radii():
    polar, around = np.meshgrid(np.linspace(0.02, np.pi - 0.02, 60), np.linspace(0.0, 2.0 * np.pi, 120))
    nodes = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1)
    index = np.arange(60 * 120).reshape(120, 60)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    triangles = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions = directions[np.abs(directions[:, 2]) < 0.9 * np.linalg.norm(directions, axis=1)]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = distances_to_surface(1.7 * directions, nodes.reshape(-1, 3), triangles)
    assert np.allclose(found, 0.7, atol=2e-3)
