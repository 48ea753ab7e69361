"""The rasteriser, texturing and picking against closed forms."""

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import SurfacePoints
from morph_dslam.render.picking import nearest_on_outline, pick_surface
from morph_dslam.render.rasteriser import rasterise, visible_points
from morph_dslam.render.texture import paint_textured, render_textured
from tests.support.bent_sheet import bent_sheet_model

CAMERA = Camera(96, 72, 80.0, 82.0, 47.0, 36.5)
SIZE = (CAMERA.height, CAMERA.width)


def tilted_square():
    """A square in the plane n·x = n·p, larger than the view, as two triangles."""
    normal, point = np.array([0.3, -0.4, -1.0]), np.array([0.0, 0.0, 0.5])
    xy = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * 0.7
    z = (normal @ point - xy @ normal[:2]) / normal[2]
    return np.column_stack([xy, z]), np.array([[0, 1, 2], [0, 2, 3]]), normal, point


def draw(points, triangles):
    return rasterise(CAMERA.project(points), points[:, 2], triangles, *SIZE)


def pixel_grid():
    rows, columns = np.indices(SIZE)
    return np.column_stack([columns.ravel(), rows.ravel()]).astype(float)


def test_depth_of_a_plane_is_the_ray_plane_intersection():
    points, triangles, normal, point = tilted_square()
    buffers = draw(points, triangles)
    expected = (normal @ point) / (CAMERA.rays(pixel_grid()) @ normal)
    assert buffers.covered.all()
    np.testing.assert_allclose(buffers.depth.ravel(), expected, rtol=1e-6)


def test_weights_are_perspective_correct():
    points, triangles, normal, point = tilted_square()
    buffers = draw(points, triangles)
    rays = CAMERA.rays(pixel_grid())
    expected = rays * ((normal @ point) / (rays @ normal))[:, None]
    corners = points[triangles[buffers.triangle_ids.ravel()]]
    found = np.einsum("kc,kcx->kx", buffers.weights.reshape(-1, 3), corners)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_single_triangle_covers_exactly_the_pixels_inside_it():
    pixels = np.array([[10.0, 10.0], [30.0, 10.0], [10.0, 20.0]])
    triangle = np.array([[0, 1, 2]])
    rows, columns = np.indices(SIZE)
    inside = (columns >= 10) & (rows >= 10) & ((columns - 10) / 20 + (rows - 10) / 10 <= 1)
    for order in ([0, 1, 2], [0, 2, 1]):
        buffers = rasterise(pixels, np.ones(3), triangle[:, order], *SIZE)
        np.testing.assert_array_equal(buffers.covered, inside)


def test_nearer_triangle_wins_whatever_the_order():
    pixels = np.array([[5.0, 5.0], [60.0, 5.0], [5.0, 60.0]] * 2)
    depths = np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
    for triangles in ([[0, 1, 2], [3, 4, 5]], [[3, 4, 5], [0, 1, 2]]):
        buffers = rasterise(pixels, depths, np.array(triangles), *SIZE)
        assert set(buffers.depth[buffers.covered]) == {1.0}


def test_triangles_that_reach_behind_the_camera_are_left_out():
    points = np.array([[0.0, 0.0, 1.0], [0.2, 0.0, 1.0], [0.0, 0.2, -1.0], [0.0, 0.2, 1.0]])
    buffers = draw(points, np.array([[0, 1, 2]]))
    assert not buffers.covered.any()
    assert np.isinf(buffers.depth).all()
    assert set(np.unique(draw(points, np.array([[0, 1, 2], [0, 1, 3]])).triangle_ids)) == {-1, 1}


def test_corner_almost_in_the_camera_plane_does_not_overflow():
    points = np.array([[0.0, 0.0, 1.0], [0.2, 0.0, 1.0], [0.5, 0.2, 1e-300], [0.1, 0.3, 1e-12]])
    buffers = draw(points, np.array([[0, 1, 2], [0, 1, 3]]))
    assert np.isfinite(buffers.weights).all()


def test_mesh_is_watertight():
    model = bent_sheet_model()
    points = model.nodes + np.array([0.0, 0.0, 0.15])  # fills the view
    assert draw(points, model.triangles).covered.all()


def test_texture_that_is_a_ramp_reads_back_the_coordinates():
    points, triangles, normal, point = tilted_square()
    buffers = draw(points, triangles)
    rows, columns = np.indices((150, 200), dtype=np.uint8)
    coordinates = (points[:, :2] / 0.7 + 1.0) / 2.0 * [199, 149]
    rays = CAMERA.rays(pixel_grid())
    place = (rays[:, :2] * ((normal @ point) / (rays @ normal))[:, None] / 0.7 + 1.0) / 2.0 * [199, 149]
    image = render_textured(buffers, triangles, coordinates, np.dstack([columns, rows, 255 - columns]))
    expected = np.column_stack([place, 255 - place[:, 0]])
    assert np.abs(image.reshape(-1, 3) - expected).max() <= 0.5 + 1e-4
    np.testing.assert_array_equal(render_textured(buffers, triangles, coordinates, columns), image[:, :, 0])
    buffers.triangle_ids[:10] = -1
    assert not render_textured(buffers, triangles, coordinates, columns + np.uint8(1))[:10].any()
    behind = np.full((*SIZE, 3), 17, dtype=np.uint8)
    paint_textured(behind, buffers, triangles, coordinates, np.dstack([columns, rows, 255 - columns]))
    assert (behind[:10] == 17).all()
    np.testing.assert_array_equal(behind[10:], image[10:])


def test_points_behind_a_nearer_square_are_hidden():
    near = np.array([[-0.1, -0.1, 0.5], [0.1, -0.1, 0.5], [0.1, 0.1, 0.5], [-0.1, 0.1, 0.5]])
    buffers = draw(near, np.array([[0, 1, 2], [0, 2, 3]]))
    points = np.array([[0.0, 0.0, 0.8], [0.0, 0.0, 0.5], [0.3, 0.0, 0.8], [5.0, 0.0, 0.8], [0.0, 0.0, -1.0]])
    seen = visible_points(CAMERA.project(points), points[:, 2], buffers.depth, tolerance=0.01)
    assert seen.tolist() == [False, True, True, False, False]


def tetrahedron(turned):
    """A tetrahedron before the camera, its triangles anticlockwise seen from outside."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) - 0.25
    triangles = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    return 0.2 * points @ rotation_exp(turned).T + np.array([0.0, 0.0, 0.6]), triangles


@pytest.mark.parametrize("turned", [(0.3, 0.2, 0.1), (2.0, -0.4, 0.7), (-0.9, 2.5, 0.0)])
def test_back_faces_of_a_closed_surface_are_left_out_without_a_difference(turned):
    points, triangles = tetrahedron(np.array(turned))
    pixels = CAMERA.project(points)
    all_faces = rasterise(pixels, points[:, 2], triangles, *SIZE)
    outer = rasterise(pixels, points[:, 2], triangles, *SIZE, closed=True)
    np.testing.assert_array_equal(outer.depth, all_faces.depth)
    np.testing.assert_array_equal(outer.triangle_ids, all_faces.triangle_ids)
    # With its triangles the other way round the surface would be seen from inside.
    inner = rasterise(pixels, points[:, 2], triangles[:, ::-1], *SIZE, closed=True)
    both = outer.covered & inner.covered
    assert both.sum() > 100
    assert (inner.depth[both] > outer.depth[both]).mean() > 0.95


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


def test_of_many_triangles_that_is_picked_which_a_ray_meets_first():
    """By a linear system for each triangle and ray; some triangles are behind the camera or reach there."""
    rng = np.random.default_rng(5)
    nodes, rays = rng.normal((0.0, 0.0, 1.5), 1.0, (300, 3)), rng.normal(size=(400, 3))
    triangles = np.array([rng.choice(300, 3, replace=False) for _ in range(80)])
    corners = nodes[triangles].transpose(0, 2, 1)
    shares = np.linalg.solve(corners[:, None], rays[None, :, :, None])[..., 0]
    met = (shares > 0.0).all(axis=2) & (corners[:, 2] > 0.0).all(axis=1)[:, None]
    nearest = np.where(met, shares.sum(axis=2), 0.0).argmax(axis=0)
    picked = pick_surface(nodes, triangles, rays)
    np.testing.assert_array_equal(picked.triangles, np.where(met.any(axis=0), nearest, -1))
    assert 50 < np.count_nonzero(picked.triangles >= 0) < 350


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
