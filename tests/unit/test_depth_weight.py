"""What depths are worth that are off by noise, or in common: against variances of their mean."""

import numpy as np
import pytest

from morph_dslam.tracking.beside_texture import weighed_by_residuals
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.refinement import EFFECTIVE_POINTS

COUNT, PER_METRE, SIGMA_PX = 300, 500.0, 0.4


def share(residuals, rng):
    """Of what they would count by their noise, by residuals in its deviations."""
    depths = PointDepths(np.full(COUNT, 0.5), np.full(COUNT, PER_METRE), SIGMA_PX**2, 2.0 * SIGMA_PX)
    pixels = rng.uniform(0.0, 300.0, (COUNT, 2))
    found = weighed_by_residuals(depths, SIGMA_PX * residuals, pixels)
    np.testing.assert_allclose(found.huber_px / depths.huber_px, found.weights / depths.weights)
    return (found.weights[0] / PER_METRE) ** 2


def test_noise_counts_as_noise():
    rng = np.random.default_rng(0)
    shares = [share(rng.standard_normal(COUNT), rng) for _ in range(100)]
    assert max(shares) <= 1.0
    assert np.mean(shares) > 0.75


def test_what_all_are_off_by_counts_as_often_as_a_keyframe_s_points():
    """The variance of their mean is then that of so many, and not of all."""
    rng, off = np.random.default_rng(1), 1.5
    assert share(np.full(COUNT, off), rng) == pytest.approx(EFFECTIVE_POINTS / COUNT / off**2)


def test_larger_noise_counts_for_less():
    rng = np.random.default_rng(2)
    alternating = 1.5 * np.sign(rng.standard_normal(COUNT))
    assert share(alternating, rng) == pytest.approx(1.0 / 1.5**2, rel=0.4)
