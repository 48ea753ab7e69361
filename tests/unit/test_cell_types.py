"""Reference cells: shape functions, quadrature and faces against their definitions."""

from math import factorial

import numpy as np
import pytest

from morph_dslam.meshing.cell_types import cell_type
from morph_dslam.meshing.generators import SOLIDS

VOLUMES = {"tri": 1 / 2, "quad": 1.0, "tet": 1 / 6, "prism": 1 / 2, "hex": 1.0}
CELL_TYPES = (*SOLIDS, "tri3", "quad4")


@pytest.mark.parametrize("name", CELL_TYPES)
def test_each_shape_function_is_one_at_its_node_and_nought_at_the_others(name):
    kind = cell_type(name)
    np.testing.assert_allclose(kind.shape_functions(kind.nodes), np.eye(len(kind.nodes)), atol=1e-12)


@pytest.mark.parametrize("name", CELL_TYPES)
def test_gradients_are_the_slopes_of_the_shape_functions(name):
    kind = cell_type(name)
    point, step = np.full((1, kind.dimension), 0.21), 1e-6
    for axis in range(kind.dimension):
        shift = step * np.eye(kind.dimension)[axis]
        slopes = (kind.shape_functions(point + shift) - kind.shape_functions(point - shift)) / (2 * step)
        np.testing.assert_allclose(kind.shape_gradients(point)[:, :, axis], slopes, atol=1e-8)


@pytest.mark.parametrize("name", CELL_TYPES)
def test_quadrature_integrates_the_volume_and_the_square_of_a_coordinate(name):
    kind = cell_type(name)
    points, weights = kind.quadrature()
    assert weights.sum() == pytest.approx(VOLUMES[kind.shape], rel=1e-13)
    # Of x^2: 2! / (2 + dim)! over a simplex (Dirichlet), 1/3 over a cube; a prism has its triangle's.
    simplex = {"tri": 2 / factorial(4), "prism": 2 / factorial(4), "tet": 2 / factorial(5)}
    assert weights @ points[:, 0] ** 2 == pytest.approx(simplex.get(kind.shape, 1 / 3), rel=1e-12)


@pytest.mark.parametrize("name", SOLIDS)
def test_faces_turn_anticlockwise_seen_from_outside_and_lie_in_planes(name):
    kind = cell_type(name)
    for face in kind.faces:
        corners = kind.nodes[list(face)]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        assert normal @ (corners[0] - kind.nodes.mean(axis=0)) > 0
        np.testing.assert_allclose((corners - corners[0]) @ normal, 0.0, atol=1e-15)


@pytest.mark.parametrize("name", [name for name in SOLIDS if cell_type(name).order == 2])
def test_middle_nodes_of_faces_lie_between_the_corners_before_and_after(name):
    kind = cell_type(name)
    for face in kind.faces:
        corners = [node for node in face if node < kind.corners]
        n = len(corners)
        for i, node in enumerate(face[n : 2 * n]):
            middle = 0.5 * (kind.nodes[corners[i]] + kind.nodes[corners[(i + 1) % n]])
            np.testing.assert_allclose(kind.nodes[node], middle)
        for node in face[2 * n :]:
            np.testing.assert_allclose(kind.nodes[node], kind.nodes[corners].mean(axis=0))
