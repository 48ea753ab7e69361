"""Whether what was found in a frame is taken for the object."""

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform
from morph_dslam.tracking.estimator import Estimate
from morph_dslam.tracking.hypothesis import PoseHypothesis, reject
from morph_dslam.tracking.measurement import PATCH_WINDOW, Measurement
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outcomes import RejectionReason
from morph_dslam.tracking.state import State


def found_at(pixels, residuals, n_points, spread):
    """The first of all points were found and agree to some pixels."""
    missing = n_points - len(pixels)
    agreeing = np.arange(n_points) < len(pixels)
    places = np.concatenate([pixels, np.full((missing, 2), np.nan)])
    left = np.concatenate([residuals, np.full((missing, 2), np.nan)])
    state = State(np.zeros(1), RigidTransform.identity())
    none = np.zeros(1, dtype=bool)
    estimate = Estimate(state, 1.0, left, spread, np.eye(7), none, 1, True)
    measurement = Measurement(places, places, agreeing, np.ones(n_points, dtype=bool), np.ones(n_points))
    return PoseHypothesis(estimate, agreeing, measurement, agreeing.astype(float))


@pytest.mark.parametrize("seed", range(5))
def test_points_whose_windows_overlap_do_not_bear_each_other_out(seed):
    """Each dozen neighbouring points found the same other texture, so that they err alike; no two dozens do."""
    rng = np.random.default_rng(seed)
    corners = rng.permutation(np.stack(np.meshgrid(np.arange(6), np.arange(6)), axis=-1).reshape(-1, 2))[:10]
    clusters = 4.0 * PATCH_WINDOW * corners + 100.0
    pixels = np.concatenate([centre + rng.uniform(0.0, 0.5 * PATCH_WINDOW, (12, 2)) for centre in clusters])
    residuals = np.repeat(4.0 * rng.standard_normal((10, 2)), 12, axis=0) + 0.1 * rng.standard_normal((120, 2))
    rejection = reject(found_at(pixels, residuals, 640, 4.0), TrackerOptions())
    assert rejection is not None
    assert rejection.reason is RejectionReason.LOOSE_AGREEMENT


@pytest.mark.parametrize("seed", range(5))
def test_points_of_an_object_that_the_model_does_not_quite_describe_do(seed):
    """Something hides most of a body that bends otherwise than the model: its points err by 4 px, and smoothly."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(100.0, 350.0, (120, 2))
    bend = 8.0 * np.cos(pixels / 80.0 + rng.uniform(0.0, 6.0, 2)) / np.sqrt(2.0)
    assert reject(found_at(pixels, bend + 0.2 * rng.standard_normal((120, 2)), 640, 4.0), TrackerOptions()) is None
