"""Where a frame's estimate starts: against local minima, at constant velocity, and by what frames have in common."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.errors import TrackingError
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model.revolution import with_revolution_angle
from morph_dslam.registration.registration import PosePrior
from morph_dslam.registration.starts import shape_starts
from morph_dslam.tracking.estimator import Estimate, EstimationOptions, Estimator, State
from morph_dslam.tracking.frame_starts import (
    ShapeSearch,
    a_turn_back,
    at_constant_velocity,
    new_filter,
    next_start,
    temporal_facts,
    with_unobservable_at_default,
)
from morph_dslam.tracking.load_prior import LoadOptions
from morph_dslam.tracking.options import TrackerOptions
from tests.support.bent_sheet import PARAMETERS, bent_sheet_model
from tests.support.bent_tube import bent_tube
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import CAMERA

POSE = RigidTransform(rotation_exp(np.array([0.3, -0.2, 0.0])) @ np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))


def determined(model):
    """An estimate of all parameters, at no bound."""
    state, none = State(model.default, POSE), np.zeros(len(model.parameters), dtype=bool)
    return Estimate(state, 0.0, np.empty((0, 2)), 0.1, np.zeros((9, 9)), none, 1, True)


def test_every_shape_is_handed_out_once_before_any_is_repeated():
    model = bent_sheet_model(22, 16)
    search, estimate = ShapeSearch(model, 3), determined(model)
    count = len(shape_starts(model))
    given = [state.parameters for _ in range(count) for state in search.spread(estimate, 3)]
    np.testing.assert_array_equal(given[0], model.default)
    assert len(np.unique(np.round(given[:count], 9), axis=0)) == len(np.unique(shape_starts(model), axis=0))
    np.testing.assert_array_equal(given[:count], given[count : 2 * count])


def test_a_mirrored_bend_is_left_by_way_of_another_start():
    """From the wrong sign of the arch in the pose that hides it best, other starts find the right one."""
    model = bent_sheet_model(22, 16)
    points = bound_points(model, 150)
    truth = State(np.array([0.03, 0.2, 0.05]), POSE)
    pixels, weights = CAMERA.project(points.in_camera(truth)), np.ones(150)
    estimator = Estimator(model, CAMERA, EstimationOptions(max_iterations=10, tolerance=1e-3))
    starts = ShapeSearch(model, 4).spread(determined(model), 4)
    best = estimator.estimate_from(points, pixels, weights, starts)[0]
    np.testing.assert_allclose(best.state.parameters, truth.parameters, atol=5e-3)


def test_only_undetermined_parameters_return_to_their_default():
    """Without an arch the skew has no effect; its estimate is dropped, the twist's is kept."""
    model = bent_sheet_model(22, 16)
    rng = np.random.default_rng(1)
    points = bound_points(model, 150, rng)
    truth = State(np.array([0.0, 0.0, 0.2]), POSE)
    pixels = CAMERA.project(points.in_camera(truth)) + 0.1 * rng.standard_normal((150, 2))
    start = State(np.array([0.001, 0.5, 0.2]), POSE)
    found = Estimator(model, CAMERA).estimate(points, pixels, np.ones(150), start)
    kept = with_unobservable_at_default(model, found)
    assert kept.parameters[1] == 0.0
    np.testing.assert_array_equal(kept.parameters[[0, 2]], found.state.parameters[[0, 2]])


def test_an_angle_about_the_axis_that_ends_at_a_bound_starts_a_turn_back():
    model = bent_sheet_model(22, 16)
    name = PARAMETERS[1].name
    estimate = replace(determined(model), at_bound=np.array([True, True, False]))
    start = State(np.array([0.02, 2.0 * np.pi - 0.01, 0.3]), POSE)
    back = a_turn_back(model, start, estimate, (name,))
    np.testing.assert_allclose(back.parameters, [0.02, -0.01, 0.3], atol=1e-12)
    again = a_turn_back(model, replace(start, parameters=-start.parameters), estimate, (name,))
    np.testing.assert_allclose(again.parameters, [-0.02, 0.01, -0.3], atol=1e-12)
    # One inside its range, and what is no such angle, stay.
    assert a_turn_back(model, start, determined(model), (name,)).parameters[1] == start.parameters[1]
    assert a_turn_back(model, start, estimate, ()).parameters[1] == start.parameters[1]


def test_an_estimate_leaves_a_bound_that_it_reached_on_the_wrong_side():
    """A tube that is bent away from where its load is sought looks as if the load were less than none."""
    model = with_revolution_angle(bent_tube(), np.array([0.0, 0.0, 1.0]))
    rng = np.random.default_rng(2)
    points, weights = bound_points(model, 80, rng), np.ones(80)
    truth = State(np.array([0.5, np.pi - 0.1]), RigidTransform(POSE.rotation, np.array([0.0, 0.0, 0.4])))
    pixels = CAMERA.project(points.in_camera(truth)) + 0.1 * rng.standard_normal((80, 2))
    known = PosePrior(truth.camera_from_object, 1e-8 * np.eye(6), np.zeros((6, 0))).prior(2, 0.01)
    estimator, search = Estimator(model, CAMERA), ShapeSearch(model, 2)
    start = State(np.array([0.1, 0.0]), truth.camera_from_object)
    stuck = estimator.estimate(points, pixels, weights, start, prior=known)
    assert stuck.at_bound[0]
    assert stuck.state.parameters[0] < 1e-3
    for _ in range(3):
        starts = search.off_bound(stuck)
        assert len(starts) == 2
        found = [estimator.estimate(points, pixels, weights, s, prior=known) for s in starts]
        best = min(found, key=lambda estimate: estimate.cost)
        if best.cost < 0.5 * stuck.cost:
            break
    load, side = best.state.parameters
    assert abs(load - truth.parameters[0]) < 0.01
    assert np.cos(side - truth.parameters[1]) > np.cos(0.02)
    assert search.off_bound(best) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"per_sequence": ("bend",)}, "'bend' cannot be a per-sequence parameter: the model's parameters are arch"),
        ({"random_walk": (("bend", 1.0),)}, "'bend' cannot walk"),
        ({"random_walk": (("skew", 1.0),), "per_sequence": ("skew",)}, "leave out one of both"),
        ({"random_walk": (("skew", 0.0),)}, "must be a positive number"),
    ],
)
def test_what_cannot_be_is_refused(options, message):
    with pytest.raises(TrackingError, match=message):
        new_filter(Estimator(bent_sheet_model(22, 16), CAMERA), TrackerOptions(**options))


def test_constant_velocity_repeats_the_last_motion():
    """A turn of 0.1 rad about a fixed axis, a shift, and a parameter that grows."""

    def state(time):
        pose = RigidTransform(rotation_exp(np.array([0.0, 0.1 * time, 0.0])), np.array([0.0, 0.02 * time, 0.6]))
        return State(np.array([0.01 * time, 0.0, 0.1]), pose)

    # The turn is about the camera, so only the part across its axis goes on in a straight line.
    found = at_constant_velocity(state(1.0), state(2.0))
    np.testing.assert_allclose(found.parameters, state(3.0).parameters)
    np.testing.assert_allclose(found.camera_from_object.rotation, state(3.0).camera_from_object.rotation, atol=1e-12)
    assert found.camera_from_object.translation[1] == pytest.approx(0.06)


def test_neither_a_turn_back_nor_a_step_to_the_default_is_a_velocity():
    """The angle grew by 0.1 to its bound, and the arch by a millimetre; nothing shows the twist."""
    model, name = bent_sheet_model(22, 16), PARAMETERS[1].name
    covariance = np.diag([1e-8, 1e-8, 1.0, *[1e-8] * 6])
    last = State(np.array([0.020, 2.0 * np.pi, 0.1]), POSE)
    estimate = replace(determined(model), state=last, covariance=covariance, at_bound=np.array([False, True, False]))
    before = State(np.array([0.019, 2.0 * np.pi - 0.1, 0.0]), POSE)
    ahead = next_start(estimate, before, model, TrackerOptions(start="constant-velocity"), (name,))
    np.testing.assert_allclose(ahead.parameters, [0.021, 0.1, model.default[2]], atol=1e-12)
    there = next_start(estimate, before, model, TrackerOptions(), (name,))
    np.testing.assert_allclose(there.parameters, [0.020, 0.0, model.default[2]], atol=1e-12)


def test_constant_velocity_keeps_rotations_rotations():
    """Rounding in a product of three would be doubled in each of these frames, 2^60 times in all."""
    before, last = (
        State(np.zeros(3), RigidTransform(rotation_exp(np.array([0.3, -0.02 * k, 0.1])), np.array([0.0, 0.0, 0.6])))
        for k in range(2)
    )
    for _ in range(60):
        before, last = last, at_constant_velocity(before, last)
    rotation = last.camera_from_object.rotation
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)


def test_facts_name_what_is_used_and_nothing_by_default():
    assert temporal_facts(PARAMETERS, TrackerOptions())["temporal_prior"] == "none"
    options = TrackerOptions(
        per_sequence=("skew",), random_walk=(("twist", np.radians(0.5)),), start="constant-velocity"
    )
    facts = temporal_facts(PARAMETERS, options)
    assert facts["temporal_prior"] == (
        "per-sequence parameters, from all frames so far: skew; random walk, standard deviation of the change "
        "from frame to frame: twist by 0.5 deg; none on the others"
    )
    assert facts["start_of_each_frame"] == "the state that the last two lead to at constant velocity"


def test_facts_name_unknown_loads_that_go_on_from_the_frame_before():
    """With a stated work each frame stands by itself."""
    stated = EstimationOptions(loads=LoadOptions(work=1e-3))
    found = {"temporal_prior": "unknown loads, from the frame before; none on the others"}
    assert temporal_facts([], TrackerOptions(use_unknown_loads=True)).items() >= found.items()
    assert temporal_facts([], TrackerOptions(use_unknown_loads=True, estimation=stated))["temporal_prior"] == "none"
