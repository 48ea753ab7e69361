"""A frame is compared again where windows miss a part of the change, unless that would lose the object."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform
from morph_dslam.registration.registration import Registration
from morph_dslam.sources import Frame
from morph_dslam.tracking.estimator import Estimator, State
from morph_dslam.tracking.frame_estimation import FrameEstimation
from morph_dslam.tracking.hypothesis import Image, PoseHypothesis, reject
from morph_dslam.tracking.measurement import Measurement
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.recovery import Recovery
from morph_dslam.tracking.tracker import Tracker
from morph_dslam.tracking.window_means import WindowMeans
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import CAMERA, SheetFilm, sheet_state

MODEL, COUNT, NOISE_PX = bent_sheet_model(22, 16), 200, 0.05
POSE = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
BEFORE, TRUTH = (State(np.array([arch, 0.0, 0.0]), POSE) for arch in (0.0, 0.05))
POINTS = bound_points(MODEL, COUNT)


def comparisons(shares: list[float], rng: np.random.Generator, noises: list[float]) -> Iterator[Measurement]:
    """One after the other, in which these shares of the points are found, each drawn in the state before."""
    for share, noise in zip(shares, noises, strict=True):
        pixels = CAMERA.project(POINTS.in_camera(TRUTH)) + noise * rng.standard_normal((COUNT, 2))
        every, found = np.ones(COUNT, dtype=bool), np.arange(COUNT) < share * COUNT
        drawing: Any = SimpleNamespace(state=BEFORE)
        yield Measurement(pixels, pixels, found, every, np.ones(COUNT), drawing)


def compared(rest: Iterator[Measurement], estimator: Estimator) -> tuple[FrameEstimation, PoseHypothesis]:
    """What is kept of a comparison and those that follow it."""
    reference: Any = SimpleNamespace(
        points=POINTS,
        all_points=POINTS,
        redundancy=1.0,
        window_means=WindowMeans(POINTS.rest),
        projected=lambda state: CAMERA.project(POINTS.in_camera(state)),
        measure=lambda picture, state, offsets: next(rest),
    )
    estimation, grey = FrameEstimation(estimator, reference, TrackerOptions()), np.zeros((4, 4), np.uint8)
    picture = Image(grey, grey)
    first = estimation.correct(picture, BEFORE, None, None)
    return estimation, estimation.correct_shape(picture, first)


@pytest.mark.parametrize(("shares", "found"), [([0.6, 0.9, 0.9], 0.9), ([0.6, 0.05, 0.9], 0.6)])
def test_a_comparison_in_which_the_object_is_lost_does_not_take_the_place_of_one_in_which_it_is_not(shares, found):
    rest = comparisons(shares, np.random.default_rng(0), [NOISE_PX] * len(shares))
    _, attempt = compared(rest, Estimator(MODEL, CAMERA))
    assert reject(attempt, TrackerOptions()) is None
    assert int(attempt.inliers.sum()) == pytest.approx(found * COUNT, abs=2)
    assert attempt.estimate.state.parameters[0] == pytest.approx(0.05, abs=1e-3)


def test_a_sensor_is_weighed_by_the_comparison_that_is_kept():
    """The second one, of few points and loose, is thrown away; the sensor is off by one of its deviations."""
    rest = comparisons([0.6, 0.06], np.random.default_rng(0), [0.3, 4.0])
    estimator = Estimator(MODEL, CAMERA)
    estimator.known.tell({"arch": (0.048, 2e-3)})
    estimation, attempt = compared(rest, estimator)
    assert int(attempt.inliers.sum()) == pytest.approx(0.6 * COUNT, abs=2)
    again = estimator.fit(estimation.beside.measured(attempt), attempt.estimate.state, attempt.prior)
    assert abs(again.state.parameters[0] - 0.05) < 3.0 * np.sqrt(again.covariance[0, 0])


def test_what_is_thrown_away_elsewhere_in_a_frame_does_not_weigh_a_sensor(monkeypatch):
    """Candidates of a search for features are far looser than what is followed."""

    def found(elsewhere: bool) -> float:
        film = SheetFilm(MODEL)
        first, second = film.frame(sheet_state(0.1)), film.frame(sheet_state(0.11))
        start = Registration(MODEL, sheet_state(0.1), covariance=np.diag([2e-3, 2e-2, 5e-3] + [3e-3] * 6) ** 2)
        tracker = Tracker(MODEL, CAMERA, start, TrackerOptions(use_outline=True), reference=first)
        tracker.know({"arch": (sheet_state(0.11).parameters[0] - 0.002, 2e-3)})
        with monkeypatch.context() as patched:
            if elsewhere:
                patched.setattr(Recovery, "jumped_to", lambda *_: tracker.estimator.known.learn(5.0))
            result = tracker.track(Frame(1, 0.03, second))
        assert result.estimate is not None
        return float(result.estimate.state.parameters[0])

    assert found(elsewhere=True) == pytest.approx(found(elsewhere=False), abs=1e-9)
