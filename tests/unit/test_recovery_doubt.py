"""When the few points that agree may be off together: against the spread of frames in which they were not."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from morph_dslam.online.recovery import Recovery


def attempt(share, sigma_px, prior=None) -> Any:
    inliers = np.arange(200) < 200 * share
    return SimpleNamespace(inliers=inliers, estimate=SimpleNamespace(sigma_px=sigma_px), prior=prior)


def new() -> Recovery:
    anything: Any = None
    return Recovery(anything, anything, anything, anything, anything)


@pytest.fixture
def recovery():
    found = new()
    for _ in range(3):
        found.learn(attempt(0.9, 0.3))
    return found


def test_a_frame_before_anything_was_followed_is_not_doubted():
    assert new().doubt(attempt(0.2, 2.0)) == 0.0


@pytest.mark.parametrize(("share", "sigma_px"), [(0.6, 2.0), (0.3, 0.44)])
def test_most_points_or_close_ones_are_not_doubted(recovery, share, sigma_px):
    assert recovery.doubt(attempt(share, sigma_px)) == 0.0


def test_few_points_that_agree_less_closely_are_doubted_by_what_is_unusual(recovery):
    assert recovery.doubt(attempt(0.3, 0.5)) == pytest.approx(0.4)  # 0.5² = 0.3² + 0.4²


def test_a_pose_from_the_map_is_judged_by_other_limits(recovery):
    assert recovery.doubt(attempt(0.3, 2.0, prior=object())) == 0.0
