"""The error of a rig's reference state in the covariance, against what it does to estimates."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from morph_dslam.camera import PinholeCamera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.online.estimation.estimator import BoundPoints, EstimationOptions
from morph_dslam.online.estimation.state import moved
from morph_dslam.online.measuring.binding import bind_pixels, view_of
from morph_dslam.online.several.rig import RigCamera, RigEstimator
from morph_dslam.online.several.rig_reference import RigReference
from morph_dslam.online.tracker_options import TrackerOptions
from morph_dslam.online.uncertainty.measurement_noise import Measured, RigMeasured
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, sheet_state

REFERENCE, LATER = sheet_state(0.1), sheet_state(0.6)
TURN = rotation_exp(np.array([0.02, 0.4, -0.05]))
RIG = (
    RigCamera(CAMERA, RigidTransform.identity()),
    RigCamera(
        PinholeCamera(640, 480, 500.0, 505.0, 330.0, 236.0),
        RigidTransform(TURN, np.array([0.0, 0.0, 0.6]) - TURN @ np.array([0.0, 0.0, 0.6])),
    ),
)
#: Errors of the reference state's three parameters, rotation vector and translation, one after the other.
STEPS = np.diag([2e-4, 2e-3, 5e-4, 3e-4, 3e-4, 3e-4, 2e-4, 2e-4, 5e-4])


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model(43, 31)


def pixels_of(model, part):
    """Places of corners in a camera's reference view, on the sheet with a margin."""
    nodes = np.random.default_rng(0).choice(len(model.nodes), 200, replace=False)
    inside = np.abs(model.nodes[nodes]) < [0.18, 0.12, 1.0]
    seen = part.seen(REFERENCE).camera_from_object.apply(model.positions(REFERENCE.parameters))[nodes]
    return part.camera.project(seen[inside.all(axis=1)])


def bound(model, part, state):
    """The points that those corners are if the object is in this state, in the rig's frame."""
    view = view_of(model, part.camera, part.seen(state))
    surface, met = bind_pixels(model, part.camera, view, pixels_of(model, part))
    assert met.all()
    return BoundPoints.from_surface(model, surface)


def estimated(model, state):
    """What exact measurements of a later frame lead to if the reference state was this one, and by what."""
    views, trackers = [], []
    estimator = RigEstimator(model, RIG, EstimationOptions(huber_px=50.0))
    for part, single in zip(RIG, estimator._single, strict=True):
        true_points, points = bound(model, part, REFERENCE), bound(model, part, state)
        count, options = len(points), TrackerOptions()
        pixels = part.camera.project(true_points.in_camera(part.seen(LATER)))
        views.append(Measured(points, pixels, np.ones(count), np.zeros((count, 2)), np.eye(count)))
        reference = SimpleNamespace(points=points, state=part.seen(state))
        trackers.append(SimpleNamespace(estimator=single, reference=reference, options=options))
    measured = RigMeasured(tuple(views))
    return estimator.fit(measured, LATER), measured, trackers


@pytest.mark.parametrize("step", STEPS)
def test_an_error_of_the_reference_moves_later_estimates_as_predicted(model, step):
    found, measured, trackers = estimated(model, moved(REFERENCE, step))
    plain = replace(found, covariance=np.zeros((9, 9)))
    stated = RigReference(trackers, RIG, np.outer(step, step)).added(plain, measured, None).covariance
    pose, true = found.state.camera_from_object, LATER.camera_from_object
    turn = pose.rotation @ true.rotation.T
    away = np.concatenate(
        [
            found.state.parameters - LATER.parameters,
            0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]),
            pose.translation - true.translation,
        ]
    )
    scale = trackers[0].estimator.scale
    away, deviations = away / scale, np.sqrt(np.diag(stated)) / scale
    assert np.linalg.norm(away) > 1e-4
    np.testing.assert_allclose(deviations, np.abs(away), atol=0.1 * np.linalg.norm(away))


def test_nothing_is_added_where_nothing_is_known(model):
    found, measured, trackers = estimated(model, REFERENCE)
    assert RigReference(trackers, RIG, None).added(found, measured, None) is found
