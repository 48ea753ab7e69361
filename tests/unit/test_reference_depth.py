"""The reference state from landmarks and depth, on a sheet whose state is known."""

import numpy as np
import pytest

from morph_dslam.errors import RegistrationError
from morph_dslam.tracking.estimator import Estimator
from morph_dslam.tracking.refinement import refine_by_depth
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import CAMERA, sheet_depth, sheet_state

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
    before, after = [], []
    for seed in range(4):
        landmarks, pixels, start = by_landmarks(seed)
        image = sheet_depth(MODEL, TRUTH, np.random.default_rng(seed))
        found = refine_by_depth(Estimator(MODEL, CAMERA), landmarks, pixels, start.state, 1.5, image)
        before.append(along_the_sight_line(start.state))
        after.append(along_the_sight_line(found.state))
        assert (found.pose_std < start.pose_std).all()
    assert np.mean(before) > 1e-3
    assert np.mean(after) < 0.3e-3


def test_depth_of_something_else_is_refused():
    landmarks, pixels, start = by_landmarks(0)
    image = sheet_depth(MODEL, TRUTH, np.random.default_rng(0)) + np.float32(0.3)
    with pytest.raises(RegistrationError, match="is the depth registered to this camera"):
        refine_by_depth(Estimator(MODEL, CAMERA), landmarks, pixels, start.state, 1.5, image)
