"""Which intervals between frames are gaps, and what a tracker does after one."""

import numpy as np
import pytest

from morph_dslam.registration.registration import Registration
from morph_dslam.sources import Frame
from morph_dslam.tracking.frame_starts import FrameGaps
from morph_dslam.tracking.outcomes import Status
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, SheetFilm, mean_error, sheet_state


@pytest.mark.parametrize(
    ("interval", "gap", "is_gap"),
    [
        (1 / 30, 3.0, True),
        (1 / 30, 0.4, False),  # a dozen dropped frames
        (0.2, 0.9, False),  # slow, but no longer than five intervals
        (60.0, 240.0, False),  # a frame a minute
        (60.0, 600.0, True),
        (0.0, 0.4, False),  # all frames have one time
        (1 / 30, -2.0, False),  # the clock was put back
    ],
)
def test_a_gap_is_long_in_seconds_and_in_intervals(interval, gap, is_gap):
    gaps = FrameGaps()
    times = (np.arange(12) * interval).tolist()
    assert not any(gaps.after_gap(time) for time in times)
    assert gaps.after_gap(times[-1] + gap) is is_gap
    assert not gaps.after_gap(times[-1] + gap + interval)


def test_nothing_is_a_gap_before_an_interval_is_known():
    gaps = FrameGaps()
    assert not gaps.after_gap(0.0)
    assert not gaps.after_gap(100.0)


class Loads:
    """Stands for the prior of unknown loads, of which there are none: how many frames tell what is known of them."""

    def __init__(self):
        self.squared_px, self.n_frames = 0.25, 0

    def terms(self, parameters):
        return 0.0, np.zeros((0, 0)), np.zeros(0)

    def learn(self, parameters, covariance, sigma_px):
        self.n_frames += 1

    def forget(self):
        self.n_frames = 0


@pytest.fixture(scope="module")
def film():
    return SheetFilm(bent_sheet_model(22, 16))


def test_any_loads_may_act_after_a_gap(film):
    """They are known from frame to frame, as they change slowly: not after seconds, or an instant without a picture."""
    state = sheet_state(0.0)
    image = film.frame(state)
    tracker = Tracker(film.model, CAMERA, Registration(film.model, state), reference=image)
    tracker.estimator.loads = loads = Loads()

    def known_after(number, time):
        assert tracker.track(Frame(number, time, image)).tracked
        return loads.n_frames

    assert [known_after(number, number / 30) for number in range(3)] == [1, 2, 3]
    assert known_after(600, 20.0) == 1
    assert known_after(601, 20.03) == 2
    tracker.pass_over(20.06)
    assert known_after(603, 20.1) == 1


def test_an_instant_without_a_picture_may_be_the_first(film):
    """The next frame is the reference all the same."""
    tracker = Tracker(film.model, CAMERA, Registration(film.model, sheet_state(0.1)))
    assert tracker.pass_over(0.0).status is Status.LOST
    result = tracker.track(Frame(1, 1 / 30, film.frame(sheet_state(0.1))))
    assert result.estimate is not None
    assert not result.recovered
    assert mean_error(film.model, result.estimate.state, sheet_state(0.1)) < 1e-4
