"""How exact the texture is that an outline is weighed against."""

import numpy as np
import pytest

from morph_dslam.tracking.outline_weight import mean_square


def test_an_estimate_errs_by_the_mean_square_of_its_points_not_by_their_median():
    """Every tenth point is off ten times as far as the others: the error of a fit over many draws, and what is said."""
    rng, said, off = np.random.default_rng(2), [], []
    rows = rng.standard_normal((40, 3))
    sizes = np.where(np.arange(40) % 20 < 2, 0.5, 0.05)
    weights, gain = np.ones(20), np.linalg.pinv(rows)
    for _ in range(400):
        residuals = rng.permutation(sizes) * rng.standard_normal(40)
        off.append(gain @ residuals)
        said.append(mean_square((residuals - rows @ off[-1]).reshape(-1, 2), weights, 3))
    expected = np.mean(said) * np.trace(gain @ gain.T)
    assert np.mean(np.sum(np.square(off), axis=1)) == pytest.approx(expected, rel=0.1)
