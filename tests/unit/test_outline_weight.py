"""How exact texture and an outline are that are weighed against each other."""

import numpy as np
import pytest

from morph_dslam.model import SurfacePoints
from morph_dslam.tracking.estimator import BoundPoints
from morph_dslam.tracking.outline import OutlineMeasurement
from morph_dslam.tracking.outline_weight import OutlineBalance, mean_square
from tests.support.bent_sheet import bent_sheet_model

#: How many points an outline has.
N_OUTLINE = 200


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


@pytest.fixture(scope="module")
def circle():
    """An outline that is a circle, all of which was found."""
    angles = np.linspace(0.0, 2.0 * np.pi, N_OUTLINE, endpoint=False)
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    surface = SurfacePoints(np.zeros(N_OUTLINE, np.int64), np.tile([1.0, 0.0, 0.0], (N_OUTLINE, 1)))
    points = BoundPoints.from_surface(bent_sheet_model(5, 4), surface)
    pixels = 320.0 + 150.0 * normals
    return OutlineMeasurement(points, pixels, normals, np.ones(N_OUTLINE, dtype=bool), np.ones(N_OUTLINE))


@pytest.mark.parametrize(("spread", "expected"), [(1.5, 1.5), (0.4, 0.4), (0.02, 0.1)])
def test_an_outline_may_be_off_as_a_whole_by_as_much_as_its_points_are(circle, spread, expected):
    """By a tenth of a pixel at least; points that are off independently show their deviation to some per cent."""
    balance = OutlineBalance()
    assert balance.common_px == 0.1
    off = spread * np.random.default_rng(3).standard_normal(N_OUTLINE)
    balance.learn_outline(circle, off[:, None] * circle.normals, 0.0)
    assert balance.common_px == pytest.approx(expected, rel=0.25)
