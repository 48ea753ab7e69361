"""Deviations of what is one over the sequence: an error changes by no more than the estimate does."""

import numpy as np

from morph_dslam.diagnostics.statements import BestTold
from morph_dslam.geometry import RigidTransform
from morph_dslam.tracking.estimator import Estimate, State


def estimate(value, deviation):
    """Of two parameters and a pose: the first is as given, the other unknowns have the deviation 1."""
    pose = RigidTransform(np.eye(3), np.zeros(3))
    covariance = np.diag(np.concatenate([[deviation**2], np.ones(7)]))
    covariance[0, 1] = covariance[1, 0] = 0.5 * deviation
    state = State(np.array([value, 0.0]), pose)
    return Estimate(state, 0.0, np.empty((0, 2)), 0.0, covariance, np.zeros(2, dtype=bool), 1, True)


def told(best, value, deviation, unobservable=False):
    found = best.stated(estimate(value, deviation), np.array([unobservable])).covariance
    # Others' deviations, and the correlations, stay as they are.
    np.testing.assert_allclose(np.diag(found)[1:], 1.0)
    np.testing.assert_allclose(found[0, 1], 0.5 * np.sqrt(found[0, 0]))
    return np.sqrt(found[0, 0])


def test_a_frame_that_tells_little_states_what_the_best_one_did_and_the_change_since():
    best = BestTold(np.array([0]))
    found = [told(best, 2.0, 0.3), told(best, 2.1, 0.1), told(best, 2.15, 5.0), told(best, 1.9, 0.2)]
    np.testing.assert_allclose(found, [0.3, 0.1, 0.15, 0.2])


def test_a_small_deviation_of_a_frame_that_tells_nothing_is_not_kept():
    best = BestTold(np.array([0]))
    found = [told(best, 2.0, 0.3), told(best, 2.0, 0.01, unobservable=True), told(best, 2.0, 4.0)]
    np.testing.assert_allclose(found, [0.3, 0.01, 0.3])


def test_without_such_parameters_nothing_changes():
    given = estimate(1.0, 2.0)
    assert BestTold(np.empty(0, dtype=np.int64)).stated(given, np.empty(0, dtype=bool)) is given
