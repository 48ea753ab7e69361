"""The error of a rig's reference state in the covariance, against what it does to estimates."""

from dataclasses import replace
from functools import reduce
from types import SimpleNamespace

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.tracking.binding import bind_pixels, view_of
from morph_dslam.tracking.covariance import BoundPart
from morph_dslam.tracking.estimator import BoundPoints, EstimationOptions
from morph_dslam.tracking.multi_camera import RigCamera, RigEstimator, RigReference
from morph_dslam.tracking.noise import RigObservations
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.state import moved
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import measured
from tests.support.rendered_sequence import CAMERA, sheet_state

REFERENCE, ANOTHER, LATER = sheet_state(0.1), sheet_state(0.3), sheet_state(0.6)
TURN = rotation_exp(np.array([0.02, 0.4, -0.05]))
RIG = (
    RigCamera(CAMERA, RigidTransform.identity()),
    RigCamera(
        Camera(640, 480, 500.0, 505.0, 330.0, 236.0),
        RigidTransform(TURN, np.array([0.0, 0.0, 0.6]) - TURN @ np.array([0.0, 0.0, 0.6])),
    ),
)
#: Errors of the reference state's three parameters, rotation vector and translation, one after the other.
STEPS = np.diag([2e-4, 2e-3, 5e-4, 3e-4, 3e-4, 3e-4, 2e-4, 2e-4, 5e-4])


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model(43, 31)


def pixels_of(model, part, reference):
    """Places of corners in a camera's picture of the sheet in this state, on it with a margin."""
    nodes = np.random.default_rng(0).choice(len(model.nodes), 200, replace=False)
    inside = np.abs(model.nodes[nodes]) < [0.18, 0.12, 1.0]
    seen = part.seen(reference).camera_from_object.apply(model.positions(reference.parameters))[nodes]
    return part.camera.project(seen[inside.all(axis=1)])


def bound(model, part, reference, state):
    """The points that those corners are if the object is in another state, in the rig's frame."""
    view = view_of(model, part.camera, part.seen(state))
    surface, met = bind_pixels(model, part.camera, view, pixels_of(model, part, reference))
    assert met.all()
    return BoundPoints.from_surface(model, surface)


def estimated(model, pictures):
    """What exact measurements of a later frame lead to, and by what.

    ``pictures`` : in each, the reference state, what it was taken for, and the error_factors (9, c) of that
        error.
    """
    views, trackers = [], []
    estimator = RigEstimator(model, RIG, EstimationOptions(huber_px=50.0, max_iterations=50, tolerance=1e-9))
    for part, single in zip(RIG, estimator._single, strict=True):
        every_true = [bound(model, part, true, true) for true, _, _ in pictures]
        every = [bound(model, part, true, taken) for true, taken, _ in pictures]
        true_points, points = (reduce(BoundPoints.joined, parts) for parts in (every_true, every))
        pixels = part.camera.project(true_points.in_camera(part.seen(LATER)))
        views.append(measured(points, pixels))
        ends, parts = np.cumsum([len(own) for own in every]), []
        for own, end, (_, taken, error_factors) in zip(every, ends, pictures, strict=True):
            seen = None if error_factors is None else part.chain(len(model.parameters)) @ error_factors
            parts.append(BoundPart(slice(end - len(own), end), part.seen(taken), seen))
        reference = SimpleNamespace(points=points, parts=parts)
        trackers.append(SimpleNamespace(estimator=single, reference=reference, options=TrackerOptions()))
    seen = RigObservations(tuple(views))
    return estimator.fit(seen, LATER), seen, trackers


def check_prediction(model, pictures):
    found, seen, trackers = estimated(model, pictures)
    plain = replace(found, covariance=np.zeros((9, 9)))
    stated = RigReference(trackers, RIG).added(plain, seen, None).covariance
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


@pytest.mark.parametrize("step", STEPS)
def test_an_error_of_the_reference_moves_later_estimates_as_predicted(model, step):
    check_prediction(model, [(REFERENCE, moved(REFERENCE, step), step[:, None])])


@pytest.mark.parametrize("step", STEPS)
def test_of_two_pictures_each_is_off_in_its_own_way_by_the_same_cause(model, step):
    other = np.roll(STEPS, 4, axis=0)[np.argmax(step)]
    pictures = [(REFERENCE, step), (ANOTHER, other)]
    check_prediction(model, [(true, moved(true, own), own[:, None]) for true, own in pictures])


def test_nothing_is_added_where_nothing_is_known(model):
    found, seen, trackers = estimated(model, [(REFERENCE, REFERENCE, None)])
    assert RigReference(trackers, RIG).added(found, seen, None) is found
