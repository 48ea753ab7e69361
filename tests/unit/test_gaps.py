"""Which intervals between frames are gaps."""

import numpy as np
import pytest

from morph_dslam.tracking.gaps import FrameGaps


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
