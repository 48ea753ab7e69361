"""The filter of what is one per sequence, against the errors of simulated measurements."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import scipy.sparse

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import SurfacePoints
from morph_dslam.registration.registration import PosePrior, Registration
from morph_dslam.sources import Frame
from morph_dslam.tracking.estimator import BoundPoints, Estimator, Prior, State, moved
from morph_dslam.tracking.noise import block_diagonal, window_correlation
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.sequence_filter import PointChange, SequenceFilter
from morph_dslam.tracking.still import held
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points, measured
from tests.support.rendered_sequence import CAMERA, SheetFilm

MODEL = bent_sheet_model(22, 16)
ESTIMATOR = Estimator(MODEL, CAMERA)
TWIST = 2
SIGMA = 0.4
bound = partial(bound_points, MODEL)


def truth(number, twist_deg=5.0):
    """Arch and position change from frame to frame, the twist does not."""
    turn = rotation_exp(np.array([0.1 * np.sin(0.2 * number), 0.2, 0.05 * number]))
    pose = RigidTransform(turn @ np.diag([1.0, -1.0, -1.0]), np.array([0.01 * np.sin(number), 0.0, 0.6]))
    return State(np.array([0.03 * np.cos(0.1 * number), 0.1, np.radians(twist_deg)]), pose)


def fused(filtered, points, errors, states, correlation):
    """The estimates of frames whose pixels are off by ``errors`` (f, p, 2)."""
    estimates = []
    for state, error in zip(states, errors, strict=True):
        pixels, weights = CAMERA.project(points.in_camera(state)) + error, np.ones(len(points))
        alone = ESTIMATOR.estimate(points, pixels, weights, state)
        estimates.append(filtered.fuse(measured(points, pixels, weights, correlation), alone))
    return estimates


def twist_errors(estimates, states):
    error = [e.state.parameters[TWIST] - s.parameters[TWIST] for e, s in zip(estimates, states, strict=True)]
    return np.array(error), np.array([e.parameter_std[TWIST] for e in estimates])


def runs(draw, frames=25, repeats=20, count=60):
    """Errors and stated deviations (repeats, frames) of the twist when the noise is drawn by ``draw``."""
    points, states = bound(count), [truth(number) for number in range(frames)]
    found = []
    for seed in range(repeats):
        errors = draw(np.random.default_rng(seed), (frames, count, 2))
        estimates = fused(SequenceFilter(ESTIMATOR, [TWIST]), points, errors, states, np.eye(count))
        found.append(twist_errors(estimates, states))
    return np.array(found).transpose(1, 0, 2)


def test_noise_that_is_new_in_every_frame_averages_out():
    errors, deviations = runs(lambda rng, shape: SIGMA * rng.standard_normal(shape))
    ratio = np.median(deviations[:, -1] / deviations[:, 0])
    assert ratio == pytest.approx(1.0 / np.sqrt(25), rel=0.35)
    rms = np.sqrt(np.mean(errors**2, axis=0))
    assert rms[-8:].mean() < 0.35 * rms[0]
    assert 0.6 < np.sqrt(np.mean((errors / deviations)[:, 10:] ** 2)) < 1.4


def test_noise_that_stays_with_the_points_does_not_and_is_not_said_to():
    errors, deviations = runs(lambda rng, shape: np.tile(SIGMA * rng.standard_normal(shape[1:]), (25, 1, 1)))
    assert np.median(deviations[:, -1] / deviations[:, 0]) > 0.7
    assert 0.6 < np.sqrt(np.mean((errors / deviations)[:, 10:] ** 2)) < 1.4


def runs_with_known_poses(lasting, anew, frames=8, repeats=24, count=40):
    """Errors and stated deviations (repeats, frames) of the arch when the pose is known with errors.

    ``lasting`` (6, 6) is drawn once a run and ``anew`` (6, 6) in every frame. Only the middle of the sheet is
    seen, where a higher arch looks like a nearer sheet.
    """
    middle = np.abs(MODEL.nodes[MODEL.triangles, 0]).max(axis=1) < 0.06
    rng = np.random.default_rng(5)
    surface = SurfacePoints(rng.choice(np.flatnonzero(middle), count), rng.dirichlet(np.ones(3), count))
    points = BoundPoints.from_surface(MODEL, surface)
    states = [State(np.array([0.03, 0.1, 0.0]), truth(number).camera_from_object) for number in range(frames)]
    information = SIGMA**2 * np.linalg.inv(lasting @ lasting.T + anew @ anew.T)
    found = []
    for seed in range(repeats):
        rng = np.random.default_rng(seed)
        filtered, stays = SequenceFilter(ESTIMATOR, [0]), rng.standard_normal(6)
        for state in states:
            error = lasting @ stays + anew @ rng.standard_normal(6)
            pose = moved(state, np.concatenate([np.zeros(3), -error])).camera_from_object
            known = Prior(np.zeros(3), np.zeros((3, 3)), pose, information, lasting, SIGMA**2)
            pixels = CAMERA.project(points.in_camera(state)) + SIGMA * rng.standard_normal((count, 2))
            seen = measured(points, pixels)
            fused = filtered.fuse(seen, ESTIMATOR.fit(seen, state, known), known)
            found.append((fused.state.parameters[0] - state.parameters[0], fused.parameter_std[0]))
    return np.array(found).reshape(repeats, frames, 2).transpose(2, 0, 1)


def test_errors_of_a_known_pose_are_stated_and_those_that_last_do_not_average_out():
    large = np.diag([5e-3, 5e-3, 5e-3, 1e-3, 1e-3, 3e-3])
    lasting, stated_lasting = runs_with_known_poses(large, 0.1 * large)
    anew, stated_anew = runs_with_known_poses(0.1 * large, large)
    for errors, stated in ((lasting, stated_lasting), (anew, stated_anew)):
        assert 0.6 < np.sqrt(np.mean((errors / stated)[:, 3:] ** 2)) < 1.5
    assert np.median(stated_lasting[:, -1] / stated_lasting[:, 0]) > 0.8
    assert np.median(stated_anew[:, -1] / stated_anew[:, 0]) < 0.6
    assert np.sqrt(np.mean(anew[:, -1] ** 2)) < 0.7 * np.sqrt(np.mean(lasting[:, -1] ** 2))


def test_pose_that_is_held_is_not_said_to_be_better_known():
    points, state, rng = bound(60), truth(0), np.random.default_rng(0)
    lasting, anew = np.diag([5e-3, 4e-3, 3e-3, 1e-3, 2e-3, 3e-3]), 1e-3 * np.eye(6)
    known = PosePrior(state.camera_from_object, anew @ anew.T, lasting).prior(3, SIGMA**2, 1e6)
    pixels = CAMERA.project(points.in_camera(state)) + SIGMA * rng.standard_normal((60, 2))
    seen, filtered = measured(points, pixels), SequenceFilter(ESTIMATOR, [TWIST])
    for _ in range(3):
        fused = filtered.fuse(seen, ESTIMATOR.fit(seen, state, known), known)
        np.testing.assert_allclose(fused.state.camera_from_object.matrix, state.camera_from_object.matrix, atol=1e-5)
        np.testing.assert_allclose(fused.pose_std, np.sqrt(np.diag(lasting**2 + anew**2)), rtol=0.01)
        assert np.linalg.eigvalsh(fused.covariance)[0] > -1e-12


@pytest.mark.parametrize("known", [True, False])
def test_the_error_of_a_pose_that_stays_is_the_one_that_it_is_said_to_have(known):
    """Held exactly, parameters have the covariance of the points' noise alone: the inverse of their own Hessian."""
    points, state, rng = bound(60), truth(0), np.random.default_rng(0)
    lasting = None if known else np.diag([5e-3, 4e-3, 3e-3, 1e-3, 2e-3, 3e-3])
    stays = replace(held(state, ESTIMATOR), lasting=lasting)
    pixels = CAMERA.project(points.in_camera(state)) + 0.05 * rng.standard_normal((60, 2))
    seen = measured(points, pixels)
    alone = ESTIMATOR.fit(seen, state, stays)
    found = SequenceFilter(ESTIMATOR, []).fuse(seen, alone, stays)
    if lasting is not None:
        np.testing.assert_allclose(found.pose_std, np.diag(lasting), rtol=0.1)
        return
    jacobian = ESTIMATOR.linear(seen, alone).weighted_jacobian[:, :, :3].reshape(-1, 3)
    variance = np.sum(alone.residuals**2) / (120 - 3)
    expected = np.sqrt(variance * np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    np.testing.assert_allclose(found.parameter_std, expected, rtol=0.1)


def test_walking_parameter_is_smoothed_as_much_as_its_step_says():
    """The twist changes by 0.2 degrees a frame at random; its deviation is that of a scalar Kalman filter."""
    points, step, frames = bound(40), np.radians(0.2), 30
    raw, smooth, stated = [], [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        twists = np.degrees(0.05 + np.cumsum(step * rng.standard_normal(frames)))
        states = [truth(number, twist) for number, twist in enumerate(twists)]
        errors = SIGMA * rng.standard_normal((frames, 40, 2))
        for found, steps in ((raw, None), (smooth, {TWIST: step})):
            estimates = fused(SequenceFilter(ESTIMATOR, [], steps), points, errors, states, np.eye(40))
            found.append(twist_errors(estimates, states))
            if steps:
                stated.append([np.sqrt(e.measured_covariance[TWIST, TWIST]) for e in estimates[5:]])
    raw, smooth = (np.array(found)[:, :, 10:] for found in (raw, smooth))
    own = np.median(raw[:, 1])
    expected = np.sqrt(0.5 * (np.sqrt(step**4 + 4.0 * step**2 * own**2) - step**2))
    assert np.median(smooth[:, 1]) == pytest.approx(expected, rel=0.2)
    assert np.sqrt(np.mean(smooth[:, 0] ** 2)) < 0.75 * np.sqrt(np.mean(raw[:, 0] ** 2))
    assert 0.7 < np.sqrt(np.mean((smooth[:, 0] / smooth[:, 1]) ** 2)) < 1.4
    # What the frame alone tells is kept beside it.
    assert np.median(stated) == pytest.approx(own, rel=0.2)


def test_a_parameter_walks_on_while_the_object_is_lost_and_frames_are_dropped():
    """As in a scalar Kalman filter, by the deviation of a frame alone and that before the loss."""
    film, state, step = SheetFilm(MODEL), truth(0), 1e-4
    first, blank = film.frame(state), film.blank()
    seen = [film.frame(state, noise=12.0) for _ in range(8)]

    def deviations(n_blank=0, n_without=0, n_dropped=0, steps=()):
        """Of the twist before and after so many frames without the object, and frames that are known to lack or not."""
        options = TrackerOptions(random_walk=steps)
        tracker = Tracker(MODEL, CAMERA, Registration(MODEL, state), options, reference=first)
        before = [tracker.track(Frame(k, k / 30.0, frame)) for k, frame in enumerate(seen[:-1])][-1]
        number = len(seen) - 1
        for k in range(n_blank):
            assert tracker.track(Frame(number + k, (number + k) / 30.0, blank)).status == "lost"
        assert all(tracker.pass_over(None).status == "lost" for _ in range(n_without))
        number += n_blank + n_without + n_dropped
        after = tracker.track(Frame(number, number / 30.0, seen[-1]))
        return [result.estimate.parameter_std[TWIST] for result in (before, after)]

    own = deviations(n_without=1)[1]
    for n_blank, n_without, n_dropped in ((3, 0, 0), (0, 20, 0), (0, 0, 12), (0, 10, 10)):
        before, after = deviations(n_blank, n_without, n_dropped, (("twist", step),))
        predicted = before**2 + (n_blank + n_without + n_dropped + 1) * step**2
        assert after == pytest.approx(np.sqrt(1.0 / (1.0 / own**2 + 1.0 / predicted)), rel=0.03)


def test_wrong_early_value_is_given_up():
    points, rng = bound(60), np.random.default_rng(0)
    states = [truth(n, -8.0) for n in range(6)] + [truth(n) for n in range(6, 16)]
    errors = SIGMA * rng.standard_normal((16, 60, 2))
    estimates = fused(SequenceFilter(ESTIMATOR, [TWIST]), points, errors, states, np.eye(60))
    # A frame that contradicts the past stands by itself.
    found = np.degrees([estimate.state.parameters[TWIST] for estimate in estimates])
    np.testing.assert_allclose(found[:6], -8.0, atol=1.0)
    np.testing.assert_allclose(found[6:], 5.0, atol=1.0)
    deviations = [estimate.parameter_std[TWIST] for estimate in estimates]
    assert deviations[5] < deviations[6] > deviations[15]


def test_frame_that_knows_little_does_not_overrule_many_that_know_much():
    """Twelve frames see the sheet's twist of 5 degrees well; the next its middle, as of -18 degrees."""
    points, rng = bound(120), np.random.default_rng(2)
    in_middle = np.abs(points.rest[:, :2]).max(axis=1) < 0.09
    filtered = SequenceFilter(ESTIMATOR, [TWIST])
    for number in range(14):
        is_odd = number == 12
        state = truth(number, -18.0 if is_odd else 5.0)
        pixels = CAMERA.project(points.in_camera(state)) + SIGMA * rng.standard_normal((120, 2))
        weights = in_middle.astype(float) if is_odd else np.ones(120)
        seen = measured(points, pixels, weights)
        alone = ESTIMATOR.fit(seen, state)
        twists = np.degrees([e.state.parameters[TWIST] for e in (alone, filtered.fuse(seen, alone))])
        if is_odd:
            assert twists[0] < -10.0
        assert abs(twists[1] - 5.0) < 1.0


def test_covariance_of_one_frame_is_that_of_repeated_measurements_with_overlapping_windows():
    points, state = bound(150, seed=3), truth(0)
    rng = np.random.default_rng(1)
    pixels = CAMERA.project(points.in_camera(state))
    correlation = window_correlation(pixels, 60)
    root = np.linalg.cholesky(correlation.toarray() + 1e-12 * np.eye(150))
    found, stated = [], []
    for _ in range(150):
        errors = SIGMA * np.einsum("ij,jc->ic", root, rng.standard_normal((150, 2)))
        (estimate,) = fused(SequenceFilter(ESTIMATOR, []), points, [errors], [state], correlation)
        found.append(np.concatenate([estimate.state.parameters, estimate.state.camera_from_object.translation]))
        stated.append(np.concatenate([estimate.parameter_std, estimate.pose_std[3:]]))
    spread = np.std(found, axis=0)
    # Residuals are smaller than the errors by what the estimate takes up of these.
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(stated), axis=0)), spread, rtol=0.3)
    independent = ESTIMATOR.estimate(points, pixels + errors, np.ones(150), state)
    assert (independent.parameter_std < 0.75 * spread[:3]).all()


def test_windows_correlate_by_what_they_share():
    pixels = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 5.0], [30.0, 0.0]])
    expected = np.array([1.0, 6 / 10, 6 / 10 * 5 / 10, 0.0])
    np.testing.assert_allclose(window_correlation(pixels, 10).toarray()[0], expected)
    many = np.random.default_rng(0).uniform(0.0, 60.0, (40, 2))
    shared = np.clip(1.0 - np.abs(many[:, None] - many) / 17, 0.0, None).prod(axis=2)
    np.testing.assert_allclose(window_correlation(many, 17).toarray(), shared, atol=1e-12)
    pixels[1] = np.nan
    np.testing.assert_array_equal(window_correlation(pixels, 10).toarray()[1], np.eye(4)[1])


def test_matrices_along_a_diagonal_are_those_of_scipy():
    rng = np.random.default_rng(0)
    blocks = [window_correlation(rng.uniform(0.0, 60.0, (count, 2)), 17) for count in (5, 0, 30, 1)]
    np.testing.assert_array_equal(block_diagonal(blocks).toarray(), scipy.sparse.block_diag(blocks).toarray())


def test_points_measured_less_exactly_count_by_their_weights():
    """Two kinds of points, one ten times as exact: the deviations of a weighted estimate are its errors'."""
    points, state = bound(150), truth(3)
    rng, sigma = np.random.default_rng(5), np.where(np.arange(150) % 2, 0.1, 1.0)
    weights, pixels = 0.1**2 / sigma**2, CAMERA.project(points.in_camera(state))
    found, stated, alike = [], [], []
    for _ in range(60):
        seen = pixels + sigma[:, None] * rng.standard_normal((150, 2))
        alone = ESTIMATOR.estimate(points, seen, weights, state)
        estimate = SequenceFilter(ESTIMATOR, []).fuse(measured(points, seen, weights), alone)
        found.append(estimate.state.parameters)
        stated.append(estimate.parameter_std)
        alike.append(ESTIMATOR.estimate(points, seen, np.ones(150), state).state.parameters)
        assert alone.sigma_px == pytest.approx(0.1, rel=0.3)
    spread = np.std(found, axis=0)
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(stated), axis=0)), spread, rtol=0.3)
    assert (spread < 0.35 * np.std(alike, axis=0)).all()


def test_noise_is_not_taken_for_smaller_where_an_estimate_takes_up_much_of_it():
    """Few points whose errors are alike for neighbours: residuals hold only two thirds of the variance."""
    points, state, rng = bound(60), truth(3), np.random.default_rng(11)
    pixels = CAMERA.project(points.in_camera(state))
    correlation = window_correlation(pixels, 110)
    root, ones = np.linalg.cholesky(correlation + 1e-9 * np.eye(60)), np.ones(60)
    stated, found, left = [], [], []
    for _ in range(200):
        seen = pixels + SIGMA * root @ rng.standard_normal((60, 2))
        alone = ESTIMATOR.estimate(points, seen, ones, state)
        estimate = SequenceFilter(ESTIMATOR, []).fuse(measured(points, seen, correlation=correlation), alone)
        stated.append(estimate.parameter_std)
        found.append(estimate.state.parameters)
        left.append(np.mean(alone.residuals**2))
    assert np.mean(left) < 0.75 * SIGMA**2
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(stated), axis=0)), np.std(found, axis=0), rtol=0.12)


def test_parameter_that_nothing_tells_has_a_large_deviation():
    """One point seen four times tells of three directions at most."""
    points = bound(1)
    same = BoundPoints(points.surface.take(np.zeros(8, dtype=int)), np.repeat(points.rest, 8, axis=0),
                       points.field.with_modes(np.repeat(points.field.modes, 8, axis=1)))  # fmt: skip
    errors = SIGMA * np.random.default_rng(0).standard_normal((1, 8, 2))
    (estimate,) = fused(SequenceFilter(ESTIMATOR, []), same, errors, [truth(0)], np.eye(8))
    assert estimate.parameter_std.max() > np.ptp([MODEL.lower[TWIST], MODEL.upper[TWIST]])


COUNT = 60
VIEWS = [bound(COUNT, seed) for seed in (0, 1)]
NOTHING = np.zeros((9, 9))


def change(left, taken, kept=(0, 1), besides=NOTHING):
    return PointChange(left, taken, np.eye(COUNT), COUNT, kept, besides)


def followed(seed, views, lasting=0.8):
    """Twist errors and stated deviations when frames are compared with these ``views``, by number.

    ``lasting`` is the part of the error's variance that stays with each point of each view.
    """
    rng = np.random.default_rng(seed)
    of_points = np.sqrt(lasting) * SIGMA * rng.standard_normal((2, COUNT, 2))
    filtered, estimates, states = SequenceFilter(ESTIMATOR, [TWIST]), [], []
    for number, view in enumerate(views):
        if number and view != views[number - 1]:
            filtered.change_points(change(views[number - 1], view))
        state, points = truth(number), VIEWS[view]
        error = of_points[view] + np.sqrt(1.0 - lasting) * SIGMA * rng.standard_normal((COUNT, 2))
        seen = measured(points, CAMERA.project(points.in_camera(state)) + error)
        estimates.append(filtered.fuse(seen, ESTIMATOR.fit(seen, state)))
        states.append(state)
    return (*twist_errors(estimates, states), filtered)


@pytest.mark.slow
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
        alone = ESTIMATOR.estimate(points, pixels + 0.3, np.ones(COUNT), state)
        stated.append(filtered.fuse(measured(points, pixels), alone).covariance)
    np.testing.assert_allclose(stated[1], stated[0], rtol=1e-9)


def test_errors_that_the_filter_does_not_know_of_are_added_to_the_past():
    *_, filtered = followed(5, [0] * 6)
    own = filtered._past.covariance[0, 0]
    besides = np.zeros((9, 9))
    besides[TWIST, TWIST] = 4.0 * own
    filtered.change_points(change(0, 1, besides=besides))
    assert filtered._past.covariance[0, 0] == pytest.approx(5.0 * own)
