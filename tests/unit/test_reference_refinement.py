"""The reference state refined by other frames and by depth, against the truth."""

import re

import numpy as np
import pytest

from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform, rotation_exp, rotation_log
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.registration.landmarks import register_landmarks
from morph_dslam.tracking.binding import nearest_surface_points
from morph_dslam.tracking.depth_registration import refine_by_depth
from morph_dslam.tracking.estimator import BoundPoints, Estimator, State
from morph_dslam.tracking.known_state import LandmarkTerm
from morph_dslam.tracking.refinement import Keyframe, choose_keyframes, minimum, refine_reference, relied_on
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import CAMERA, mean_error, sheet_depth, sheet_state


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
    refined, _ = refine_reference(
        Estimator(model, CAMERA),
        LandmarkTerm(landmarks, clicked, 1.5),
        CAMERA.project(points.in_camera(truth)),
        registered,
        keyframes,
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
    refined, _ = refine_reference(Estimator(model, CAMERA), LandmarkTerm(points, pixels, 0.5), pixels, truth, keyframes)
    assert mean_error(model, refined, truth) < 1e-5


def test_a_refined_reference_is_off_by_what_is_stated():
    """Landmarks a pixel off, and points read off the reference view 0.4 px beside their places, alike in all frames."""
    model, truth, off = bent_sheet_model(22, 16), sheet_state(0.0), []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        points = bound_points(model, 120, rng)
        keyframes = [keyframe(points, sheet_state(time), rng, noise=0.1) for time in np.linspace(0.1, 0.9, 5)]
        marked = bound_points(model, 8, rng)
        clicked = CAMERA.project(marked.in_camera(truth)) + rng.standard_normal((8, 2))
        pixels = CAMERA.project(points.in_camera(truth)) + 0.4 * rng.standard_normal((120, 2))
        estimator = Estimator(model, CAMERA)
        refined, covariance = refine_reference(estimator, LandmarkTerm(marked, clicked, 1.0), pixels, truth, keyframes)
        pose, true = refined.camera_from_object, truth.camera_from_object
        errors = [*(refined.parameters - truth.parameters), *rotation_log(pose.rotation @ true.rotation.T)]
        errors += [*(pose.translation - true.translation)]
        off.append(errors / np.sqrt(np.diag(covariance)))
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.5
    assert np.mean(np.abs(off) < 2.6) > 0.95


def test_keyframes_are_spread_over_the_sequence():
    assert choose_keyframes([], 5) == []
    assert choose_keyframes(list(range(3)), 5) == [0, 1, 2]
    assert choose_keyframes(list(range(101)), 5) == [0, 25, 50, 75, 100]


@pytest.mark.parametrize(
    ("mistaken", "end", "expected"),
    [((), np.inf, "abcd"), ((3,), np.inf, "acd"), ((3, 9), 8, "ac"), ((0, 3, 7), 8, "abc"), ((), 0, "")],
    ids=["all", "without mistaken ones", "before it opens", "mistaken ones alone", "none"],
)
def test_frames_that_explain_no_pose_do_not_count_for_it_if_others_do(mistaken, end, expected):
    assert "".join(relied_on([(0, "a"), (3, "b"), (7, "c"), (9, "d")], frozenset(mistaken), end)) == expected


MODEL = bent_sheet_model(22, 16)
TRUTH = sheet_state(0.3)


def along_the_sight_line(state):
    """Mean distance of the nodes from where they truly are, along the optical axis, metres."""
    here, there = (s.camera_from_object.apply(MODEL.positions(s.parameters)) for s in (state, TRUTH))
    return np.abs(here - there)[:, 2].mean()


def by_landmarks(seed, sigma_px=1.5):
    """Landmarks that a hand has set, and the state they give."""
    rng = np.random.default_rng(seed)
    landmarks = bound_points(MODEL, 14, rng)
    pixels = CAMERA.project(landmarks.in_camera(TRUTH)) + sigma_px * rng.standard_normal((14, 2))
    estimate = Estimator(MODEL, CAMERA).estimate(landmarks, pixels, np.ones(14), TRUTH)
    return landmarks, pixels, estimate


def test_depth_places_the_object_along_the_sight_line():
    """Of a depth camera whose scale is known."""
    before, after = [], []
    for seed in range(4):
        landmarks, pixels, start = by_landmarks(seed)
        image = sheet_depth(MODEL, TRUTH, np.random.default_rng(seed))
        asked = Estimator(MODEL, CAMERA), landmarks, pixels, start.state, 1.5, image
        found = refine_by_depth(*asked, scale_std=0.0).estimate
        before.append(along_the_sight_line(start.state))
        after.append(along_the_sight_line(found.state))
        assert (found.pose_std < start.pose_std).all()
        # One factor of all depths is a further unknown: landmarks know the distance no better by them.
        assert (refine_by_depth(*asked).estimate.pose_std[:3] < start.pose_std[:3]).all()
    assert np.mean(before) > 1e-3
    assert np.mean(after) < 0.3e-3


@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_depths_that_are_all_off_by_a_factor_move_it_by_their_share_in_what_is_known(factor):
    """With the same noise, so that only the scale differs: in distance, and in all that changes with it.

    Of two normal measurements of one distance, each counts by its inverse variance: depths whose scale has the variance
    s^2 have the share v / s^2 in an estimate of the variance v.
    """
    landmarks, pixels, start = by_landmarks(0)
    image = sheet_depth(MODEL, TRUTH, np.random.default_rng(0))
    right, wrong = (
        refine_by_depth(
            Estimator(MODEL, CAMERA), landmarks, pixels, start.state, 1.5, np.float32(scale) * image
        ).estimate
        for scale in (1.0, factor)
    )
    distance = right.state.camera_from_object.translation[2]
    share = (right.pose_std[-1] / (0.01 * distance)) ** 2
    assert 0.0 < share < 0.5
    there = wrong.state.camera_from_object
    turned = rotation_log(there.rotation @ right.state.camera_from_object.rotation.T)
    shifted = there.translation - right.state.camera_from_object.translation
    assert shifted[2] == pytest.approx(share * (factor - 1.0) * distance, rel=0.3)
    off = np.concatenate([wrong.state.parameters - right.state.parameters, turned, shifted])
    assert (np.abs(off) < 1.2 * np.sqrt(np.diag(right.covariance))).all()


def test_depth_of_something_else_is_refused():
    landmarks, pixels, start = by_landmarks(0)
    image = sheet_depth(MODEL, TRUTH, np.random.default_rng(0)) + np.float32(0.3)
    with pytest.raises(RegistrationError, match="Is the depth registered to this camera"):
        refine_by_depth(Estimator(MODEL, CAMERA), landmarks, pixels, start.state, 1.5, image)


def test_depth_in_another_unit_is_refused_with_its_factor():
    """Millimetres that are read as 5000 values a metre are a fifth of the distance."""
    landmarks, pixels, start = by_landmarks(0)
    image = sheet_depth(MODEL, TRUTH, np.random.default_rng(0)) * np.float32(0.2)
    with pytest.raises(RegistrationError, match=r"are 0\.\d+ times those.* correct --depth-per-metre") as refusal:
        refine_by_depth(Estimator(MODEL, CAMERA), landmarks, pixels, start.state, 1.5, image)
    assert float(re.search(r"are (\S+) times", str(refusal.value))[1]) == pytest.approx(0.2, rel=0.02)


def test_residuals_that_are_known_to_few_digits_have_their_minimum_found():
    """Linear ones, rounded as an inner search leaves them: against the normal equations of the exact ones."""
    rng = np.random.default_rng(3)
    matrix, right = rng.standard_normal((40, 5)), 0.5 * rng.standard_normal(40)
    bounds = np.full(5, -np.inf), np.full(5, np.inf)
    found = minimum(lambda x: np.round(matrix @ x - right, 5), np.zeros(5), bounds, 10)
    np.testing.assert_allclose(found.x, np.linalg.lstsq(matrix, right, rcond=None)[0], atol=1e-3)
    np.testing.assert_allclose(found.jac, matrix, atol=2e-3)
