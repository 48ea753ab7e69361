"""The mirrored tilt of a flat object far away: how often it is the right one, against what is stated."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.estimator import EstimationOptions, Estimator, State
from morph_dslam.tracking.frame_estimation import FrameEstimation
from morph_dslam.tracking.hypothesis import PoseHypothesis
from morph_dslam.tracking.measurement import Measurement
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.other_tilt import LIKELIER, OtherTilt, find_other_tilt, mirrored_tilt
from morph_dslam.tracking.outcomes import FoundBy, TiltAmbiguous
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import CAMERA, UPRIGHT, SheetFilm

MODEL = bent_sheet_model(8, 6)
FLAT = np.zeros(3)
NOISE_PX, COUNT = 0.3, 40


def rigid_estimator():
    """It stays flat."""
    estimator = Estimator(MODEL, CAMERA, EstimationOptions(max_iterations=40, tolerance=1e-8))
    return estimator.within(replace(estimator.box, lower=FLAT, upper=FLAT))


def seen_frame(rng, distance, tilt):
    """The truth of a frame, its points, its cost, and what finds that cost's minimum from a start."""
    points, estimator = bound_points(MODEL, COUNT, rng), rigid_estimator()
    turn = rotation_exp(np.array([0.05, tilt, 0.1])) @ UPRIGHT
    truth = State(FLAT, RigidTransform(turn, np.array([0.1, -0.05, distance])))
    pixels = CAMERA.project(points.in_camera(truth)) + NOISE_PX * rng.standard_normal((COUNT, 2))
    measured = points, pixels, np.ones(COUNT)
    of_cost = lambda state: estimator.evaluate(*measured, state)[0], lambda start: estimator.minimum(*measured, start)
    return truth, points, of_cost


def tilts(rng, distance, tilt):
    """The truth, the estimate from one of both tilts at random, and the other one."""
    truth, points, (cost, minimum) = seen_frame(rng, distance, tilt)
    start = truth
    if rng.random() < 0.5:
        start = replace(truth, camera_from_object=mirrored_tilt(MODEL.nodes, truth.camera_from_object))
    found = minimum(start).state
    return truth, found, find_other_tilt(cost, minimum, points, found, 2 * COUNT, 1.0)


def angle(one, other):
    turned = one.camera_from_object.rotation @ other.camera_from_object.rotation.T
    return np.arccos(np.clip((np.trace(turned) - 1.0) / 2.0, -1.0, 1.0))


@pytest.mark.parametrize("seed", range(5))
def test_flat_points_in_the_mirrored_tilt_look_alike_from_afar(seed):
    """Depths beside the mean are reversed, which a camera far away on the sight line to the mean does not see."""
    rng = np.random.default_rng(seed)
    flat = RigidTransform(rotation_exp(rng.standard_normal(3)), rng.standard_normal(3))
    points = flat.apply(np.column_stack([rng.uniform(-0.1, 0.1, (20, 2)), np.zeros(20)]))
    pose = RigidTransform(rotation_exp(rng.standard_normal(3)), np.array([0.2, -0.3, 1.0]) + rng.standard_normal(3))
    other = mirrored_tilt(points, pose)
    assert np.linalg.det(other.rotation) == pytest.approx(1.0)
    before, after = pose.apply(points), other.apply(points)
    centre = before.mean(axis=0)
    sight = centre / np.linalg.norm(centre)
    np.testing.assert_allclose((after - centre) @ sight, -(before - centre) @ sight, atol=1e-12)
    across = np.eye(3) - np.outer(sight, sight)
    np.testing.assert_allclose((after - centre) @ across, (before - centre) @ across, atol=1e-12)
    np.testing.assert_allclose(mirrored_tilt(points, other).matrix, pose.matrix, atol=1e-9)


@pytest.mark.parametrize(("distance", "share"), [(3.0, 0.0), (6.0, 0.1), (9.0, 0.75)])
def test_the_other_tilt_is_as_often_the_right_one_as_stated(distance, share):
    """``share`` is about how often neither is likely enough to rely on."""
    rng, stated, right = np.random.default_rng(int(distance)), [], []
    for _ in range(200):
        truth, found, other = tilts(rng, distance, rng.uniform(0.3, 0.6))
        stated.append(other.probability)
        right.append(angle(other.state, truth) < angle(found, truth))
    stated, right = np.array(stated), np.array(right)
    # One in a thousand is off by more than 3.3 of the binomial's deviations; 1 % for what is not Gaussian.
    spread = np.sqrt(np.sum(stated * (1.0 - stated))) / len(stated)
    assert right.mean() == pytest.approx(stated.mean(), abs=3.3 * spread + 0.01)
    unsure = np.mean((stated > 0.05) & (stated < 0.95))
    assert unsure == pytest.approx(share, abs=0.1)


def test_from_near_one_of_both_is_excluded():
    rng = np.random.default_rng(0)
    for _ in range(20):
        truth, found, other = tilts(rng, 1.0, rng.uniform(0.3, 0.6))
        assert other.is_excluded == (angle(found, truth) < angle(other.state, truth) or other.angle < np.radians(2.0))
    far = [tilts(rng, 12.0, rng.uniform(0.3, 0.6))[2].is_excluded for _ in range(20)]
    assert np.mean(far) < 0.2


def test_what_is_added_is_the_mean_square_error_of_an_estimate_in_one_of_two_modes():
    """The truth is at 0, where the estimate is, or at d, with probabilities 1 - p and p."""
    apart = np.array([0.0, 0.3, -0.2, 0.1, 0.01, 0.0, 0.02])
    for odds in (3.0, 1.0 / 3.0):
        other = OtherTilt(State(np.zeros(1), RigidTransform.identity()), apart, ratio=2.0 * np.log(odds))
        p = 1.0 / (1.0 + odds)
        assert other.probability == pytest.approx(p)
        errors = np.random.default_rng(0).choice([0.0, 1.0], 100_000, p=[1.0 - p, p])[:, None] * apart
        np.testing.assert_allclose(other.spread, errors.T @ errors / len(errors), atol=2e-3)
    assert other.angle == pytest.approx(np.linalg.norm(apart[1:4]))
    assert replace(other, ratio=1e5).spread.max() < 1e-100


@pytest.mark.parametrize("likelier", [False, True])
def test_an_estimate_is_as_far_off_as_stated_whichever_of_both_tilts_is_likelier(likelier):
    """It stayed below half of it where the other tilt was the likelier one, and not clear enough to be taken."""
    rng, stated, squared = np.random.default_rng(11), [], []
    while len(stated) < 120:
        truth, found, other = tilts(rng, 9.0, rng.uniform(0.3, 0.6))
        if (other.probability > 0.5) != likelier or other.is_excluded or other.ratio < -(LIKELIER**2):
            continue
        stated.append(np.trace(other.spread[-6:-3, -6:-3]))
        squared.append(other.angle**2 if angle(other.state, truth) < angle(found, truth) else 0.0)
    # Both ways of 120: the mean of what is there or not is known to 15 %.
    assert np.sqrt(np.mean(stated) / np.mean(squared)) == pytest.approx(1.0, abs=0.2)


def by_pixels_and_depth(rng, distance, depth_std):
    """The truth, and attempts at a frame from one of both tilts at random: by its pixels, and with their depths."""
    points, estimator, every = bound_points(MODEL, COUNT, rng), Estimator(MODEL, CAMERA), np.ones(COUNT)
    turn = rotation_exp(np.array([0.05, rng.uniform(0.3, 0.6), 0.1])) @ UPRIGHT
    truth = State(FLAT, RigidTransform(turn, np.array([0.1, -0.05, distance])))
    pixels = CAMERA.project(points.in_camera(truth)) + NOISE_PX * rng.standard_normal((COUNT, 2))
    start = truth
    if rng.random() < 0.5:
        start = replace(truth, camera_from_object=mirrored_tilt(MODEL.nodes, truth.camera_from_object))
    view = SimpleNamespace(points=points, all_points=points, redundancy=1.0)
    estimation = FrameEstimation(estimator, view, TrackerOptions())  # type: ignore[arg-type]
    measurement = Measurement(pixels, pixels, every > 0.0, every > 0.0, every)
    followed = PoseHypothesis(estimator.estimate(points, pixels, every, start), every > 0.0, measurement, every)
    attempt = estimation.in_likelier_tilt(followed)
    far = points.in_camera(truth)[:, 2] + depth_std * rng.standard_normal(COUNT)
    depths = PointDepths(far, np.full(COUNT, NOISE_PX / depth_std), NOISE_PX**2, 2.0 * NOISE_PX)
    found = estimator.estimate(points, pixels, every, attempt.estimate.state, depths=depths)
    return truth, attempt, estimation.with_other_tilt(replace(attempt, estimate=found, depths=depths))


def test_depth_that_contradicts_a_tilt_ends_it():
    """It moved the estimate within its tilt, the wrong one in a third of the frames, and stated as certain."""
    rng, before, after, stated = np.random.default_rng(3), [], [], []
    for _ in range(60):
        truth, by_pixels, with_depth = by_pixels_and_depth(rng, 6.0, 0.1)
        before.append(angle(by_pixels.estimate.state, truth) > np.radians(12.0))
        after.append(angle(with_depth.estimate.state, truth) > np.radians(12.0))
        stated.append(0.0 if with_depth.other_tilt is None else with_depth.other_tilt.probability)
    assert np.sum(before) > 15
    assert np.sum(after) < 0.25 * np.sum(before)
    stated = np.array(stated)
    assert np.sum(after) == pytest.approx(stated.sum(), abs=3.3 * np.sqrt(np.sum(stated * (1.0 - stated))) + 0.6)


def test_a_tilt_that_is_left_is_the_other_one_of_what_is_taken():
    """As it is found from there."""
    rng = np.random.default_rng(4)
    for _ in range(10):
        truth, points, (cost, minimum) = seen_frame(rng, 7.0, rng.uniform(0.3, 0.6))
        here = minimum(truth).state
        other = find_other_tilt(cost, minimum, points, here, 2 * COUNT, 1.0)
        from_there, left = find_other_tilt(cost, minimum, points, other.state, 2 * COUNT, 1.0), other.left(here)
        assert left.ratio == pytest.approx(from_there.ratio, abs=1e-3)
        assert left.probability == pytest.approx(1.0 - other.probability)
        np.testing.assert_allclose(left.apart, from_there.apart, atol=1e-3)
        assert angle(left.state, from_there.state) < 1e-3


@pytest.mark.parametrize(("distance", "n_minima"), [(1.0, 1), (9.0, 2)])
def test_a_tilt_that_is_clearly_wrong_takes_one_minimisation(distance, n_minima):
    """Beside the true state's own cost, which is no less than that of the minimum near it; an open one takes both."""
    rng, starts = np.random.default_rng(5), []
    for _ in range(10):
        truth, points, (cost, minimum) = seen_frame(rng, distance, rng.uniform(0.4, 0.6))

        def counted(start, minimum=minimum):
            starts.append(start)
            return minimum(start)

        other = find_other_tilt(cost, counted, points, truth, 2 * COUNT, 1.0)
        assert other.is_excluded == (n_minima == 1)
        # No likelier than both minima say.
        difference = minimum(other.state).cost - minimum(truth).cost
        freedom = 2 * COUNT - 9
        assert other.ratio <= 2.0 * difference / (2.0 * minimum(truth).cost / freedom) * (1.0 + 1e-6)
    assert len(starts) == 10 * n_minima


@pytest.mark.parametrize("tilt", [0.1, 0.15])
def test_an_object_that_is_found_again_may_be_tilted_to_the_other_side_too(tilt):
    """Where features found it, the other tilt was not asked for, though frames after this one leave it open."""
    model = bent_sheet_model(22, 16)
    film = SheetFilm(model)

    def state(number, aside=0.0):
        turn = rotation_exp(np.array([0.05, tilt + 0.01 * number, 0.05 * number])) @ UPRIGHT
        return State(FLAT, RigidTransform(turn, np.array([aside, 0.0, 3.2])))

    known = Registration(model, state(0))
    tracker = Tracker(model, CAMERA, known, TrackerOptions(new_views=False), reference=film.frame(state(0)))
    tracker.track(film.frame(state(1)))
    assert tracker.track(film.blank()).status == "lost"
    result = tracker.track(film.frame(state(3, aside=0.5)))
    assert (result.status, result.found_by) == ("tracked", FoundBy.FEATURES)
    assert result.warning(TiltAmbiguous) is not None
