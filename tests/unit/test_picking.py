"""Picking against rays made from known surface points, and the outline against a closed form."""

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import SurfacePoints
from morph_dslam.render.picking import nearest_on_outline, pick_surface
from tests.support.bent_sheet import bent_sheet_model

CAMERA = Camera(640, 480, 528.0, 527.0, 320.3, 239.1)
POSE = RigidTransform(rotation_exp(np.array([np.pi + 0.2, 0.1, -0.3])), np.array([0.02, -0.01, 0.6]))


def positions(model, nodes, points):
    return np.einsum("pc,pcx->px", points.weights, nodes[model.triangles[points.triangles]])


def test_pick_finds_the_point_that_the_ray_was_made_from():
    model = bent_sheet_model()
    nodes = POSE.apply(model.positions(np.array([0.02, 0.2, 0.1])))
    rng = np.random.default_rng(3)
    points = SurfacePoints(rng.integers(len(model.triangles), size=500), rng.dirichlet(np.ones(3), 500))
    target = positions(model, nodes, points)
    picked = pick_surface(nodes, model.triangles, target * rng.uniform(0.3, 3.0, (500, 1)))
    assert np.array_equal(picked.triangles, points.triangles)
    np.testing.assert_allclose(picked.weights, points.weights, atol=1e-9)


def test_pick_takes_the_nearer_of_two_sheets_and_survives_edge_on_and_hidden_triangles():
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    z = np.array([0.0, 0.0, 1.0])
    nodes = np.vstack([square + 5 * z, square + 3 * z, square - 2 * z, np.outer([1.0, 2, 4], z)])
    pair = np.array([[0, 1, 2], [0, 2, 3]])
    triangles = np.vstack([pair, pair + 4, pair + 8, [[12, 13, 14]]])
    rays = np.array([[0.1, 0.05, 1.0], [0.0, 0.0, 1.0], [0.9, 0.0, 1.0], [np.nan] * 3])
    picked = pick_surface(nodes, triangles, rays)
    assert picked.triangles[0] == 2
    assert picked.triangles[1] in (2, 3)  # through the shared edge
    assert picked.triangles[2:].tolist() == [-1, -1]
    assert np.isnan(picked.weights[2:]).all()
    met = np.einsum("pc,pcx->px", picked.weights[:2], nodes[triangles[picked.triangles[:2]]])
    np.testing.assert_allclose(met, 3.0 * rays[:2], atol=1e-12)


def test_pick_without_any_triangle_in_front():
    picked = pick_surface(-np.eye(3), np.array([[0, 1, 2]]), np.array([[0.0, 0.0, 1.0]]))
    assert picked.triangles.tolist() == [-1]


@pytest.mark.parametrize("overshoot", [0.5, 4.0])
def test_outline_point_lies_at_the_foot_of_the_perpendicular(overshoot):
    # A tilted square: its right edge is the image line from (u0, v0) to (u1, v1), receding in depth.
    nodes = np.array([[-1.0, -1, 4], [1, -1, 4], [1.5, 1.5, 6], [-1.5, 1.5, 6]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    pixels = CAMERA.project(nodes)
    direction = (pixels[2] - pixels[1]) / np.linalg.norm(pixels[2] - pixels[1])
    normal = np.array([-direction[1], direction[0]])
    normal *= np.sign(normal[0])
    foot = pixels[1] + 0.3 * (pixels[2] - pixels[1])
    points, distance = nearest_on_outline(nodes, pixels, triangles, (foot + overshoot * normal)[None])
    met = np.einsum("pc,pcx->px", points.weights, nodes[triangles[points.triangles]])
    np.testing.assert_allclose(distance, overshoot, atol=1e-9)
    np.testing.assert_allclose(CAMERA.project(met)[0], foot, atol=1e-9)
    np.testing.assert_allclose(np.cross(met[0] - nodes[1], nodes[2] - nodes[1]), 0.0, atol=1e-9)
