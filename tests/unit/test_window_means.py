"""What windows miss of a motion, against its mean over them."""

import numpy as np
import pytest

from morph_dslam.tracking.patches import FLOW_WINDOW
from morph_dslam.tracking.window_means import WindowMeans

SCALE = 1000.0  # pixels a metre


def scattered(count, rng, is_flat=True):
    """Points (p, 3) on a sheet of 0.2 m, metres."""
    points = rng.uniform(-0.1, 0.1, (count, 3))
    points[:, 2] = 0.0 if is_flat else 0.02 * np.cos(20.0 * points[:, 0])
    return points


@pytest.mark.parametrize("is_flat", [True, False])
def test_windows_show_a_linear_motion_whole(is_flat):
    rng = np.random.default_rng(0)
    points = scattered(200, rng, is_flat)
    motions = points @ rng.standard_normal((3, 2)) + [3.0, -2.0]
    assert np.abs(WindowMeans(points).missed(motions, SCALE)).max() < 1e-9


@pytest.mark.parametrize(
    ("wavelength_px", "scale"), [(60.0, SCALE), (120.0, SCALE), (60.0, 0.7 * SCALE), (120.0, 1.4 * SCALE)]
)
def test_windows_miss_a_share_of_a_ripple(wavelength_px, scale):
    """The mean of a sine over a window is sin(w/2) / (w/2) of it, w in radians; also farther off and nearer."""
    rng = np.random.default_rng(1)
    points = scattered(600, rng)
    across = np.sin(2.0 * np.pi * scale * points[:, 0] / wavelength_px)
    half = np.pi * FLOW_WINDOW / wavelength_px
    missed = WindowMeans(points).missed(np.column_stack([across, np.zeros(600)]), scale)
    share = -missed[:, 0] @ across / (across @ across)
    assert share == pytest.approx(1.0 - np.sin(half) / half, rel=0.3)
    assert not missed[:, 1].any()


def test_motions_that_are_not_known_miss_nothing():
    points = scattered(40, np.random.default_rng(2))
    motions = np.full((40, 2), np.nan)
    assert not WindowMeans(points).missed(motions, SCALE).any()
    assert WindowMeans(points[:2]).missed(np.zeros((2, 2)), SCALE).shape == (2, 2)
