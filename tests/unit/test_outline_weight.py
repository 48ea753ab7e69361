"""How exact texture and an outline are that are weighed against each other."""

import numpy as np
import pytest

from morph_dslam.model import SurfacePoints
from morph_dslam.tracking.estimator import BoundPoints, EstimationOptions, Estimator
from morph_dslam.tracking.noise import Observations, block_diagonal, window_correlation
from morph_dslam.tracking.outline import OutlineMeasurement
from morph_dslam.tracking.outline_weight import OutlineBalance, mean_square
from morph_dslam.tracking.sequence_filter import SequenceFilter
from morph_dslam.tracking.state import pose_increment
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points, rim
from tests.support.rendered_sequence import CAMERA, sheet_state

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


@pytest.mark.parametrize(("spread", "length"), [(0.5, 30.0), (0.02, 5.0)])
def test_a_point_that_counts_for_less_than_its_variance_says_is_not_stated_to_err_more(spread, length):
    """Because its neighbours err alike, or as nothing is known better than by a tenth of a pixel.

    The covariance of draws is that which is stated of an estimate from points of 0.1 pixels and the rim.
    """
    rng, of_points, there, n_draws = np.random.default_rng(5), 0.1, sheet_state(0.5), 100
    model = bent_sheet_model(22, 16)
    points, (outline, places, normals) = bound_points(model, 60), rim(model, CAMERA, there)
    exact, n, balance = CAMERA.project(points.in_camera(there)), len(outline), OutlineBalance()
    seen = OutlineMeasurement(outline, places, normals, np.ones(n, dtype=bool), np.ones(n))
    alike = np.exp(-np.linalg.norm(places[:, None] - places, axis=2) / length)
    root = spread * np.linalg.cholesky(alike + 1e-9 * np.eye(n))

    def off_by():
        across = root @ rng.standard_normal(n)
        return of_points * rng.standard_normal(exact.shape), across[:, None] * normals

    for _ in range(60):
        of_texture, of_outline = off_by()
        balance.texture.learn(exact, of_texture, of_points**2)
        balance.learn_outline(seen, of_outline, 0.0)
    seen, joined = seen.weighted(balance.weight), points.joined(outline)
    weights, directions = np.concatenate([np.ones(60), seen.weights]), np.concatenate([0.0 * exact, normals])
    correlation = block_diagonal([window_correlation(exact, 1), balance.correlation(seen)])
    estimator, sizes = Estimator(model, CAMERA, EstimationOptions(huber_px=50.0)), []
    for _ in range(n_draws):
        of_texture, of_outline = off_by()
        pixels = np.concatenate([exact + of_texture, places + of_outline])
        frame = Observations(joined, pixels, weights, directions, correlation)
        found = SequenceFilter(estimator, []).fuse(frame, estimator.fit(frame, there))
        pose = pose_increment(there.camera_from_object, found.state.camera_from_object)
        away = np.concatenate([found.state.parameters - there.parameters, pose])
        sizes.append(away @ np.linalg.solve(found.covariance, away) / len(away))
    assert np.mean(sizes) == pytest.approx(1.0, abs=0.15), "the mean of so many is off by 0.05, a deviation"


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
