"""Registration from landmarks: exact recovery, and every way in which it can be wrong."""

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import SurfacePoints
from morph_dslam.registration.landmarks import register, shape_starts, solve_pnp
from morph_dslam.tracking.estimator import BoundPoints, State
from tests.support.bent_sheet import bent_sheet_model

CAMERA = Camera(640, 480, 528.0, 528.0, 320.0, 240.0)
POSE = RigidTransform(
    rotation_exp(np.array([0.25, -0.3, 0.1])) @ np.diag([1.0, -1.0, -1.0]), np.array([0.02, -0.01, 0.6])
)
BENT = State(np.array([0.040, 0.25, -0.12]), POSE)


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model(22, 16)


def landmarks(model, state, nodes, noise=0.0):
    """Object points at mesh nodes and their pixels in ``state``."""
    positions = state.camera_from_object.apply(model.positions(state.parameters))[nodes]
    pixels = CAMERA.project(positions)
    return model.nodes[nodes], pixels + noise * np.random.default_rng(0).standard_normal(pixels.shape)


def spread_nodes(model, count=14, seed=1):
    return np.random.default_rng(seed).choice(len(model.nodes), count, replace=False)


def test_bent_object_is_found_exactly_without_a_start(model):
    found = register(model, CAMERA, *landmarks(model, BENT, spread_nodes(model)))
    np.testing.assert_allclose(found.state.parameters, BENT.parameters, atol=1e-6)
    np.testing.assert_allclose(found.state.camera_from_object.matrix, POSE.matrix, atol=1e-6)
    assert found.residual_rms_px < 1e-4
    assert found.flags == ()


def test_bend_the_other_way_is_told_apart(model):
    other = State(BENT.parameters * [-1, 1, 1], POSE)
    found = register(model, CAMERA, *landmarks(model, other, spread_nodes(model), noise=0.3))
    assert found.state.parameters[0] == pytest.approx(-0.040, abs=3e-3)


def test_distorted_pixels_are_undistorted(model):
    lens = Camera(640, 480, 528.0, 528.0, 320.0, 240.0, (-0.2, 0.05, 0.0, 0.0))
    points, pixels = landmarks(model, BENT, spread_nodes(model))
    x, y = ((pixels - [320.0, 240.0]) / 528.0).T
    r2 = x**2 + y**2
    bent = 1 - 0.2 * r2 + 0.05 * r2**2
    recorded = np.column_stack([x * bent, y * bent]) * 528.0 + [320.0, 240.0]
    found = register(model, lens, points, recorded)
    np.testing.assert_allclose(found.state.parameters, BENT.parameters, atol=1e-4)


def test_landmark_off_the_object_is_named(model):
    points, pixels = landmarks(model, BENT, spread_nodes(model))
    points = points.copy()
    points[4, 2] += 0.020
    with pytest.raises(RegistrationError, match=r"landmark 5 at .* is 20.0 mm off the object"):
        register(model, CAMERA, points, pixels)


def test_pixel_outside_the_image_is_named(model):
    points, pixels = landmarks(model, BENT, spread_nodes(model))
    pixels[2] = [700.0, 100.0]
    with pytest.raises(RegistrationError, match=r"landmark 3 has the pixel \(700, 100\), outside the 640x480"):
        register(model, CAMERA, points, pixels)


def test_landmarks_in_the_wrong_order_do_not_fit(model):
    points, pixels = landmarks(model, BENT, spread_nodes(model))
    with pytest.raises(RegistrationError, match=r"do not fit the object: their residual is|no pose"):
        register(model, CAMERA, points, pixels[::-1])


def test_too_few_landmarks_are_refused_and_barely_enough_are_flagged(model):
    points, pixels = landmarks(model, BENT, spread_nodes(model))
    with pytest.raises(RegistrationError, match="3 landmarks are too few"):
        register(model, CAMERA, points[:3], pixels[:3])
    found = register(model, CAMERA, points[:4], pixels[:4])
    assert any("underdetermined: 4 landmarks give 8 numbers for 9 unknowns" in flag for flag in found.flags)
    assert found.residual_rms_px < 0.1


def test_shape_beyond_the_range_is_flagged(model):
    beyond = State(np.array([0.068, 0.25, -0.12]), POSE)
    found = register(model, CAMERA, *landmarks(model, beyond, spread_nodes(model)))
    assert any("'arch' is at a bound" in flag for flag in found.flags)


def test_bend_that_landmarks_cannot_tell_is_flagged_as_ambiguous(model):
    """A long way off the image of a shallow arch is nearly the same for both signs of a mirrored pose."""
    far = Camera(640, 480, 9000.0, 9000.0, 320.0, 240.0)
    pose = RigidTransform(POSE.rotation, np.array([0.0, 0.0, 12.0]))
    positions = pose.apply(model.positions(np.array([0.02, 0.0, 0.0])))
    nodes = spread_nodes(model, 9)
    found = register(model, far, model.nodes[nodes], far.project(positions[nodes]))
    assert found.alternatives
    assert any("ambiguous" in flag for flag in found.flags)


def test_start_shapes_cover_the_box(model):
    shapes = np.array(shape_starts(model))
    assert len(shapes) == 1 + 3**3
    np.testing.assert_allclose(shapes[0], model.default)
    np.testing.assert_allclose(shapes.min(axis=0), model.lower + (model.upper - model.lower) / 6)
    assert len(shape_starts(model, largest=5)) == 1 + 2 * 3


def test_pnp_returns_the_pose_of_a_flat_and_of_a_bent_shape(model):
    nodes = spread_nodes(model, 8)
    for parameters in (np.zeros(3), BENT.parameters):
        points = model.positions(parameters)[nodes]
        poses = solve_pnp(points, CAMERA.project(POSE.apply(points)), CAMERA)
        assert min(np.abs(pose.matrix - POSE.matrix).max() for pose in poses) < 1e-4


def test_landmarks_between_nodes_are_bound_to_their_triangle(model):
    rng = np.random.default_rng(2)
    surface = SurfacePoints(rng.integers(0, len(model.triangles), 12), rng.dirichlet(np.ones(3), 12))
    bound = BoundPoints.from_surface(model, surface)
    found = register(model, CAMERA, bound.rest, CAMERA.project(bound.in_camera(BENT)))
    np.testing.assert_allclose(found.state.parameters, BENT.parameters, atol=1e-6)
