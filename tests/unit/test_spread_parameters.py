"""Samples spread over a model's box."""

import numpy as np
import pytest
from scipy.stats import qmc

from tests.support.bent_sheet import bent_sheet_model
from tests.support.staged_scenes import bending_wedge


@pytest.mark.parametrize(("model", "count"), [(bending_wedge(), 60), (bent_sheet_model(), 100)])
def test_samples_fill_the_box_more_evenly_than_random_ones(model, count):
    samples = model.spread_parameters(count)
    np.testing.assert_array_equal(samples[0], model.default)
    shares = (samples[1:] - model.lower) / (model.upper - model.lower)
    assert shares.min() >= 0.0
    assert shares.max() <= 1.0
    random = [qmc.discrepancy(np.random.default_rng(seed).random(shares.shape)) for seed in range(20)]
    assert shares.shape == (count, len(model.parameters))
    assert qmc.discrepancy(shares) < 0.5 * np.min(random)
