"""Deviations that the derivatives put beyond a parameter's range, against draws from Gaussians cut off at its ends."""

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.registration.registration import Registration
from morph_dslam.sources import Frame
from morph_dslam.tracking.estimator import Estimate, State
from morph_dslam.tracking.frame_results import within_ranges
from morph_dslam.tracking.multi_camera import RigTracker
from morph_dslam.tracking.observability import covariance_of_parameters, unobservable
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outcomes import Status
from morph_dslam.tracking.range_limits import cut_down, mean_squares_in_ranges
from morph_dslam.tracking.result import FrameResult
from morph_dslam.tracking.rig import RigCamera
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, UPRIGHT, SheetFilm

MODEL = bent_sheet_model(22, 16)
ARCH, SKEW, TWIST = range(3)
RANGES = MODEL.upper - MODEL.lower
POSE = RigidTransform(rotation_exp(np.array([0.1, 0.3, 0.0])) @ UPRIGHT, np.array([0.0, 0.0, 0.6]))
TURN = rotation_exp(np.array([0.02, -0.3, -0.05]))
ASIDE = RigidTransform(TURN, np.array([0.0, 0.0, 0.6]) - TURN @ np.array([0.0, 0.0, 0.6]))


def coupled(skew_std):
    """The sheet's covariance (9, 9) where arch and twist err with the skew, and by errors of their own."""
    by_skew = np.zeros(9)
    by_skew[[ARCH, SKEW, TWIST, 5]] = [1e-3, 1.0, -4e-3, 2e-3]
    own = np.diag(np.array([2e-4, 0.0, 1e-3, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4]) ** 2)
    return own + skew_std**2 * np.outer(by_skew, by_skew)


def of_frame(parameters, covariance, **others):
    state = State(np.array(parameters), POSE)
    estimate = Estimate(state, 0.0, np.zeros((30, 2)), 0.3, covariance, np.zeros(3, dtype=bool), 1, True, **others)
    return FrameResult(MODEL, Status.TRACKED, estimate)


@pytest.mark.parametrize("skew", [0.0, 0.3, 0.6])
def test_values_that_are_all_alike_in_a_range_are_so_far_from_an_estimate(skew):
    values = np.linspace(MODEL.lower[SKEW], MODEL.upper[SKEW], 100001)
    found = mean_squares_in_ranges(MODEL, np.array([0.0, skew, 0.0]))
    assert found[SKEW] == pytest.approx(np.mean((values - skew) ** 2), rel=1e-4)


@pytest.mark.parametrize(("skew", "deviation"), [(0.0, 0.5), (0.0, 3.0), (0.4, 3.0), (0.6, 2.0), (0.6, 100.0)])
def test_a_deviation_beyond_the_range_is_no_less_than_a_gaussian_cut_off_at_its_ends(skew, deviation):
    """Both it and what errs with it, and the more exactly so the less is known of it."""
    before = coupled(deviation)
    after = cut_down(before, mean_squares_in_ranges(MODEL, np.array([0.0, skew, 0.0])))
    errors = np.random.default_rng(0).multivariate_normal(np.zeros(9), before, 400000)
    inside = errors[(np.abs(skew + errors[:, SKEW]) < MODEL.upper[SKEW])]
    drawn = np.mean(inside**2, axis=0)
    found = np.diag(after)
    rel = 5.0 / np.sqrt(len(inside))
    assert (found > (1.0 - rel) * drawn).all()
    if deviation > 1.0:
        assert np.sqrt(found) == pytest.approx(np.sqrt(drawn), rel=0.08 + rel)
    assert np.linalg.eigvalsh(after / np.sqrt(np.outer(found, found)))[0] > 0.0


def test_what_is_known_within_its_range_stays_as_it_is():
    limits = mean_squares_in_ranges(MODEL, np.zeros(3))
    for known in (coupled(0.02), coupled(0.9 * RANGES[SKEW] / np.sqrt(12.0)), np.full((9, 9), np.inf)):
        assert np.array_equal(cut_down(known, limits), known)
    # What is independent of a parameter that nothing tells, too.
    apart = np.diag(np.array([1e-3, 50.0, 2e-3, *np.full(6, 1e-4)]) ** 2)
    after = np.sqrt(np.diag(cut_down(apart, limits)))
    assert after[SKEW] == pytest.approx(RANGES[SKEW] / np.sqrt(12.0))
    assert after[[ARCH, TWIST]] == pytest.approx([1e-3, 2e-3], rel=1e-12)


def test_a_combination_that_is_known_stays_known():
    """Skew and twist can be anywhere, their sum in ranges is known to 0.01: along a diagonal of the box."""
    shares = np.zeros((9, 9))
    shares[SKEW, SKEW] = shares[TWIST, TWIST] = 1e4 + 0.005**2
    shares[SKEW, TWIST] = shares[TWIST, SKEW] = -1e4 + 0.005**2
    scale = np.concatenate([RANGES, np.ones(6)])
    after = cut_down(shares * np.outer(scale, scale), mean_squares_in_ranges(MODEL, np.zeros(3)))
    along = np.zeros(9)
    along[[SKEW, TWIST]] = 1.0 / RANGES[[SKEW, TWIST]]
    assert np.sqrt(along @ after @ along) == pytest.approx(0.01, rel=1e-3)
    assert np.sqrt(np.diag(after)[[SKEW, TWIST]]) == pytest.approx(RANGES[[SKEW, TWIST]] / np.sqrt(12.0), rel=1e-3)


def test_a_frame_states_no_more_than_ranges_and_what_is_unobservable_stays_so():
    before = of_frame([0.01, 0.3, 0.0], coupled(40.0), of_shape=coupled(30.0))
    after = within_ranges(before)
    largest = np.sqrt(RANGES[SKEW] ** 2 / 12.0 + 0.3**2)
    assert after.estimate.parameter_std[SKEW] == pytest.approx(largest)
    assert after.estimate.parameter_std[ARCH] == pytest.approx(np.hypot(1e-3 * largest, 2e-4), rel=1e-3)
    assert after.estimate.image_covariance[SKEW, SKEW] == pytest.approx(largest**2)
    stated = [unobservable(covariance_of_parameters(one.estimate), RANGES) for one in (before, after)]
    assert [part.indices for part in stated[0]] == [part.indices for part in stated[1]] == [(SKEW,)]
    lost = FrameResult(MODEL, Status.LOST)
    assert within_ranges(lost) is lost


def test_a_flat_side_reaches_no_farther_than_the_range():
    """From the end of its range, a parameter that changes nothing is anywhere in it."""
    flat = np.array([0.0, RANGES[SKEW] ** 2 / 3.0, 0.0])
    after = within_ranges(of_frame([0.01, MODEL.lower[SKEW], 0.0], coupled(0.2), flat=flat))
    assert after.estimate.parameter_std[SKEW] == pytest.approx(RANGES[SKEW] / np.sqrt(3.0))
    assert after.estimate.covariance[SKEW, SKEW] == pytest.approx(0.2**2)


def tracker_of_flat_sheet(per_sequence, is_rig):
    """What tracks the next picture of a sheet at rest, by one camera or by two."""
    film, flat = SheetFilm(MODEL), State(np.zeros(3), POSE)
    known = Registration(MODEL, flat, covariance=np.diag([1e-4, 1.0, 1e-3, *np.full(6, 1e-4)]) ** 2)
    options = TrackerOptions(per_sequence=per_sequence)
    if not is_rig:
        alone = Tracker(MODEL, CAMERA, known, options, reference=film.frame(flat))
        return lambda: alone.track(film.frame(flat))
    seen = [RigCamera(CAMERA, RigidTransform.identity()), RigCamera(CAMERA, ASIDE)]
    rig = RigTracker(MODEL, seen, known, options, references=[film.frame(part.seen(flat)) for part in seen])
    return lambda: rig.track([Frame(0, 0.0, film.frame(part.seen(flat))) for part in seen])


@pytest.mark.parametrize(("per_sequence", "is_rig"), [((), False), (("skew",), False), (("skew",), True)])
def test_what_no_frame_shows_yet_has_a_deviation_in_its_range(per_sequence, is_rig):
    """Of a sheet that is not bent the lean of its arch moves nothing; by derivatives it may be many ranges off."""
    track = tracker_of_flat_sheet(per_sequence, is_rig)
    for _ in range(2):
        estimate = track().estimate
        assert estimate is not None
        largest = np.hypot(RANGES[SKEW] / np.sqrt(12.0), estimate.state.parameters[SKEW])
        assert 0.25 * RANGES[SKEW] < estimate.parameter_std[SKEW] <= largest * (1.0 + 1e-9)
        assert estimate.parameter_std[ARCH] < 0.01 * RANGES[ARCH]
        assert (SKEW,) in [part.indices for part in unobservable(covariance_of_parameters(estimate), RANGES)]
