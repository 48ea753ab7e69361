"""What the sequence filter knows after its points have changed, against simulated errors."""

import numpy as np
import pytest

from morph_dslam.tracking.noise import Observations
from morph_dslam.tracking.sequence_filter import PointChange, SequenceFilter
from tests.unit.test_sequence_filter import CAMERA, ESTIMATOR, SIGMA, TWIST, bound, truth, twist_errors

COUNT = 60
VIEWS = [bound(COUNT, seed) for seed in (0, 1)]
NOTHING = np.zeros((9, 9))


def change(left, taken, kept=(0, 1), besides=NOTHING):
    return PointChange(left, taken, np.eye(COUNT), COUNT, kept, besides)


def followed(seed, views, lasting=0.8):
    """Twist errors and stated deviations when frames are compared with these ``views``, by number.

    ``lasting`` : the part of the error's variance that stays with each point of each view.
    """
    rng = np.random.default_rng(seed)
    of_points = np.sqrt(lasting) * SIGMA * rng.standard_normal((2, COUNT, 2))
    filtered, estimates, states = SequenceFilter(ESTIMATOR, [TWIST]), [], []
    for number, view in enumerate(views):
        if number and view != views[number - 1]:
            filtered.change_points(change(views[number - 1], view))
        state, points = truth(number), VIEWS[view]
        error = of_points[view] + np.sqrt(1.0 - lasting) * SIGMA * rng.standard_normal((COUNT, 2))
        pixels, weights = CAMERA.project(points.in_camera(state)) + error, np.ones(COUNT)
        alone = ESTIMATOR.estimate(points, pixels, weights, state)
        measured = Observations(points, pixels, weights, np.zeros_like(pixels), np.eye(COUNT))
        estimates.append(filtered.fuse(measured, alone))
        states.append(state)
    return (*twist_errors(estimates, states), filtered)


def test_deviations_are_of_the_size_of_the_errors_after_leaving_a_view_and_coming_back():
    views = [0] * 10 + [1] * 10 + [0] * 10
    found = np.array([followed(seed, views)[:2] for seed in range(30)])
    errors, stated = found[:, 0], found[:, 1]
    for frame in (9, 19, 29):
        ratio = np.sqrt(np.mean((errors[:, frame] / stated[:, frame]) ** 2))
        assert 0.65 < ratio < 1.35, frame
    # The second view's points err otherwise than the first one's, so both together tell more.
    assert stated[:, 19].mean() < 0.85 * stated[:, 9].mean()
    assert stated[:, 29].mean() < 1.05 * stated[:, 19].mean()


def test_coming_back_at_once_changes_nothing():
    *_, filtered = followed(0, [0] * 6)
    before = filtered._past
    filtered.change_points(change(0, 1))
    between = filtered._past
    np.testing.assert_allclose(between.covariance, before.covariance)
    assert not between.by_point.any()
    filtered.change_points(change(1, 0))
    np.testing.assert_allclose(filtered._past.by_point, before.by_point)
    np.testing.assert_allclose(filtered._past.covariance, before.covariance)


def test_points_of_a_view_that_cannot_come_back_keep_their_part_of_the_covariance():
    stated = []
    for still_there in ((0, 1), (1,)):
        *_, filtered = followed(3, [0] * 6)
        filtered.change_points(change(0, 1, still_there))
        state, points = truth(6), VIEWS[1]
        pixels = CAMERA.project(points.in_camera(state))
        measured = Observations(points, pixels, np.ones(COUNT), np.zeros_like(pixels), np.eye(COUNT))
        alone = ESTIMATOR.estimate(points, pixels + 0.3, np.ones(COUNT), state)
        stated.append(filtered.fuse(measured, alone).covariance)
    np.testing.assert_allclose(stated[1], stated[0], rtol=1e-9)


def test_errors_that_the_filter_does_not_know_of_are_added_to_the_past():
    *_, filtered = followed(5, [0] * 6)
    own = filtered._past.covariance[0, 0]
    besides = np.zeros((9, 9))
    besides[TWIST, TWIST] = 4.0 * own
    filtered.change_points(change(0, 1, besides=besides))
    assert filtered._past.covariance[0, 0] == pytest.approx(5.0 * own)
