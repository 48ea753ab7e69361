"""Times of frames against the true ones, which a receiver sees late by a random delay."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam.sources.live import SteadyTimes


def smoothed(received: np.ndarray) -> np.ndarray:
    times = SteadyTimes()
    return np.array([times.add(float(time)) for time in received])


def received_at(true: np.ndarray, seed: int, late: float = 4e-3) -> np.ndarray:
    """Each up to twice ``late`` seconds after the true time."""
    return true + np.random.default_rng(seed).uniform(0.0, 2.0 * late, len(true))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("rate", [15.0, 30.0, 60.0])
def test_intervals_are_those_of_the_camera(rate: float, seed: int) -> None:
    true = np.arange(300) / rate
    received = received_at(true, seed)
    settled = slice(100, None)
    jitter, left = (np.std(np.diff(times)[settled] - 1.0 / rate) for times in (received, smoothed(received)))
    assert left < 0.25 * jitter
    # The mean delay stays.
    assert np.mean((smoothed(received) - true)[settled]) == pytest.approx(4e-3, abs=1.5e-3)


def test_dropped_frames_leave_gaps() -> None:
    true = np.delete(np.arange(300) / 30.0, [150, 200, 201, 202])
    found = smoothed(received_at(true, 3))
    gaps = np.diff(found)[[149, 198]]
    assert gaps == pytest.approx([2.0 / 30.0, 4.0 / 30.0], abs=2e-3)


def test_another_rate_is_followed() -> None:
    """Automatic exposure in a dark room: from 30 frames a second to 24."""
    true = np.concatenate([np.arange(200) / 30.0, 200 / 30.0 + np.arange(200) / 24.0])
    found = smoothed(received_at(true, 4))
    assert np.abs(found - true - 4e-3).max() < 0.5 / 24.0
    assert np.std(np.diff(found)[-100:] - 1.0 / 24.0) < 1.5e-3


def every(kept: tuple[int, ...], of: int) -> np.ndarray:
    """Times of those frames at 30 a second whose number, modulo ``of``, is kept."""
    numbers = np.arange(1500)
    return numbers[np.isin(numbers % of, kept)] / 30.0


def at_rates(before: float, after: float) -> np.ndarray:
    return np.concatenate([np.arange(200) / before, 200 / before + np.arange(200) / after])


UNEVEN = {
    **{f"{share:.0%} dropped": share for share in (0.1, 0.3, 0.5)},
    **{f"{kept} of {of}": every(kept, of) for kept, of in (((0, 1), 3), ((0, 1, 3), 5), ((0, 2), 5), ((0,), 2))},
    **{f"{b} to {a} fps": at_rates(b, a) for b, a in ((30, 10), (10, 30), (30, 20), (30, 24), (25, 20), (15, 30))},
    "a gap of 5 s": np.arange(400) / 30.0 + np.where(np.arange(400) > 200, 5.013, 0.0),
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("what", UNEVEN)
def test_times_are_not_worse_than_those_at_which_frames_are_received(what: str, seed: int) -> None:
    """Delays of 0 to 4 ms. Where frames were dropped or the rate changed times were off by up to 166 ms."""
    rng, true = np.random.default_rng(seed), UNEVEN[what]
    if isinstance(true, float):
        true = (np.arange(1500) / 30.0)[rng.random(1500) > true]
    received = true + rng.uniform(0.0, 4e-3, len(true))
    before, after = received - true, smoothed(received) - true
    assert np.std(after) < 1.1 * np.std(before)
    assert np.std(np.diff(after)) < 1.1 * np.std(np.diff(before))
    assert np.abs(after - 2e-3).max() < np.abs(before - 2e-3).max() + 3e-3


@pytest.mark.parametrize("delay", [2e-3, 5e-3, 20e-3])
def test_nor_where_delays_have_a_long_tail(delay: float) -> None:
    rng, true = np.random.default_rng(1), np.arange(1000) / 30.0
    received = np.maximum.accumulate(true + rng.exponential(delay, len(true)))
    assert np.std(smoothed(received) - true) < 1.1 * np.std(received - true)


@pytest.mark.parametrize("seed", range(5))
def test_a_frame_that_is_late_by_most_of_an_interval_is_not_the_next_but_one(seed: int) -> None:
    """22 ms of 33: such frames were given a time a whole interval late, and the next one the same time."""
    rng, true = np.random.default_rng(seed), np.arange(1000) / 30.0
    received = true + np.abs(rng.normal(0.0, 3e-3, len(true)))
    late = rng.choice(np.arange(50, len(true)), 15, replace=False)
    received[late] += 22e-3
    found = smoothed(received)
    # No later than they were received, and no frame has the time of another.
    assert (found - received)[late].max() <= 6e-3
    assert np.std(found - true) < np.std(received - true)
    assert np.diff(found).min() > 3e-3


def test_times_never_run_backwards() -> None:
    """A camera on the network, whose frames come in bunches."""
    true = np.arange(200) / 25.0
    received = np.ceil(true / 0.2) * 0.2
    assert (np.diff(smoothed(received)) > 0.0).all()
    received = np.array([0.0, 0.04, 0.08, 0.08, 0.08, 0.2])
    assert (np.diff(smoothed(received)) > 0.0).all()
