"""The refined reference state against the truth, on exact and on noisy projections."""

import numpy as np

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.registration.landmarks import register_landmarks
from morph_dslam.tracking.binding import nearest_surface_points
from morph_dslam.tracking.estimator import BoundPoints, Estimator, State
from morph_dslam.tracking.refinement import Keyframe, choose_keyframes, refine_reference
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import mean_error, sheet_state

CAMERA = Camera(640, 480, 528.0, 528.0, 320.0, 240.0)


def keyframe(points, state, rng, noise=0.1):
    pixels = CAMERA.project(points.in_camera(state)) + noise * rng.standard_normal((len(points), 2))
    return Keyframe(pixels, np.ones(len(points)), state, noise)


def test_other_frames_correct_a_reference_that_bad_landmarks_spoiled():
    model = bent_sheet_model(22, 16)
    rng = np.random.default_rng(0)
    truth = sheet_state(0.0)
    points = bound_points(model, 120, rng)
    keyframes = [keyframe(points, sheet_state(time), rng) for time in np.linspace(0.1, 0.9, 8)]
    # Ten landmarks, each a pixel and a half off.
    object_points = model.nodes[rng.choice(len(model.nodes), 10, replace=False)]
    landmarks = BoundPoints.from_surface(model, nearest_surface_points(model.nodes, model.triangles, object_points)[0])
    clicked = CAMERA.project(landmarks.in_camera(truth)) + 1.5 * rng.standard_normal((10, 2))
    registered = register_landmarks(model, CAMERA, Landmarks(object_points, clicked)).state
    refined = refine_reference(
        Estimator(model, CAMERA),
        landmarks,
        clicked,
        CAMERA.project(points.in_camera(truth)),
        registered,
        keyframes,
        landmark_px=1.5,
    )
    before, after = mean_error(model, registered, truth), mean_error(model, refined, truth)
    assert before > 2e-3
    assert after < 0.5 * before


def test_a_right_reference_is_left_where_it_is():
    model = bent_sheet_model(22, 16)
    rng = np.random.default_rng(1)
    truth = State(
        np.array([0.02, 0.1, 0.05]),
        RigidTransform(rotation_exp(np.array([0.2, 0.1, 0.0])) @ np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 0.6])),
    )
    points = bound_points(model, 80, rng)
    keyframes = [keyframe(points, sheet_state(time), rng, noise=0.0) for time in (0.2, 0.5)]
    pixels = CAMERA.project(points.in_camera(truth))
    refined = refine_reference(Estimator(model, CAMERA), points, pixels, pixels, truth, keyframes)
    assert mean_error(model, refined, truth) < 1e-5


def test_keyframes_are_spread_over_the_sequence():
    assert choose_keyframes([], 5) == []
    assert choose_keyframes(list(range(3)), 5) == [0, 1, 2]
    assert choose_keyframes(list(range(101)), 5) == [0, 25, 50, 75, 100]
