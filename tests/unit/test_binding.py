"""Binding positions and pixels to the mesh, and which side of it is seen."""

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import ConvexHull

from morph_dslam.geometry import RigidTransform
from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.tracking.binding import DrawnSurface, bind_pixels, draw_view, facing, nearest_surface_points, view_of
from morph_dslam.tracking.estimator import BoundPoints, State
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA

STATE = State(np.array([0.03, 0.2, 0.1]), RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6])))


def test_nearest_surface_point_agrees_with_a_minimiser():
    """One triangle; scipy minimises the distance over barycentric weights."""
    rng = np.random.default_rng(0)
    nodes, triangles = rng.standard_normal((3, 3)), np.array([[0, 1, 2]])
    positions = 2.0 * rng.standard_normal((40, 3))
    points, distances = nearest_surface_points(nodes, triangles, positions)
    for row, position in enumerate(positions):

        def squared(w, target=position):
            return np.sum(((np.array([1 - w[0] - w[1], w[0], w[1]]) @ nodes) - target) ** 2)

        inside = {"type": "ineq", "fun": lambda w: [w[0], w[1], 1 - w[0] - w[1]]}
        best = minimize(squared, [0.3, 0.3], constraints=inside, method="SLSQP", options={"ftol": 1e-14})
        assert abs(distances[row] ** 2 - best.fun) < 1e-5
        assert abs(points.weights[row].sum() - 1.0) < 1e-12
        assert points.weights[row].min() >= 0.0


def test_nearest_point_of_the_sheet_is_the_foot_of_the_normal():
    model = bent_sheet_model(22, 16)
    points, distances = nearest_surface_points(
        model.nodes, model.triangles, np.array([[0.05, -0.03, 0.004], [0.3, 0.0, 0.0]])
    )
    np.testing.assert_allclose(model.rest_positions(points), [[0.05, -0.03, 0.0], [0.21, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(distances, [0.004, 0.09], atol=1e-12)


def test_bound_pixels_project_back_onto_themselves():
    model = bent_sheet_model(22, 16)
    pixels = np.array([[300.25, 200.75], [320.0, 240.0], [405.5, 150.1], [5.0, 5.0]])
    points, met = bind_pixels(model, CAMERA, view_of(model, CAMERA, STATE), pixels)
    assert met.tolist() == [True, True, True, False]
    bound = BoundPoints.from_surface(model, points)
    np.testing.assert_allclose(CAMERA.project(bound.in_camera(STATE)), pixels[:3], atol=1e-9)


def test_facing_flips_when_the_object_is_turned_over():
    model = bent_sheet_model(22, 16)
    front = facing(view_of(model, CAMERA, STATE), model.triangles)
    turned = RigidTransform(np.diag([-1.0, -1.0, 1.0]), STATE.camera_from_object.translation)
    back = facing(view_of(model, CAMERA, State(STATE.parameters, turned)), model.triangles)
    assert not front.any()
    assert back.all()


def test_drawn_view_covers_the_projected_rectangle():
    model = bent_sheet_model(22, 16)
    flat = State(np.zeros(3), STATE.camera_from_object)
    covered = draw_view(view_of(model, CAMERA, flat), model.triangles, CAMERA).covered
    expected = 0.420 * 0.297 * (528.0 / 0.6) ** 2
    assert abs(covered.sum() - expected) < 0.01 * expected


def test_drawn_surface_of_a_solid_is_the_whole_surface_and_is_known_to_be_closed():
    """A cube of six tetrahedra about a node inside, and the cube without its lid."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    nodes = np.concatenate([[[0.5, 0.5, 0.5]], corners])
    triangles = 1 + ConvexHull(corners).simplices.astype(np.int64)
    a, b, c = (nodes[triangles[:, k]] for k in range(3))
    inwards = np.einsum("mx,mx->m", np.cross(b - a, c - a), a - nodes[0]) < 0.0
    triangles[inwards] = triangles[inwards][:, ::-1]
    rng = np.random.default_rng(0)
    functions = bent_sheet_model(6, 5).displacement.functions
    field = SeparatedField(0.1 * rng.standard_normal((functions.n_functions, 9, 3)), functions)
    parameters = bent_sheet_model(6, 5).parameters
    solid = ReducedModel("cube", nodes, triangles, parameters, field)
    drawn = DrawnSurface.of(solid)
    assert drawn.closed
    mu = np.array([0.03, 0.2, 0.1])
    moved, expected = drawn.model.positions(mu)[drawn.model.triangles], solid.positions(mu)[triangles]
    assert len(drawn.model.nodes) == 8
    np.testing.assert_allclose(moved, expected, rtol=1e-6, atol=1e-9)
    for other in (triangles[:-2], triangles[:, ::-1], np.concatenate([triangles[:1, ::-1], triangles[1:]])):
        assert not DrawnSurface.of(replace(solid, triangles=other)).closed
    assert not DrawnSurface.of(bent_sheet_model(6, 5)).closed
