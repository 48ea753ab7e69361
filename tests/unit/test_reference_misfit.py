"""How much worse than stated the reference is known: against references that are off by known amounts."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.tracking.binding import bind_pixels, view_of
from morph_dslam.tracking.estimator import BoundPoints, EstimationOptions, Estimator
from morph_dslam.tracking.state import moved
from morph_dslam.tracking.systematic_errors import FLOOR_PX, ReferenceMisfit
from tests.support.bent_sheet import bent_sheet_model
from tests.support.one_view import errors_of
from tests.support.rendered_sequence import CAMERA, sheet_state

REFERENCE, LATER = sheet_state(0.1), sheet_state(0.6)
#: Standard deviations of arch, skew, twist, rotation and translation, SI.
SPREAD = np.array([1.5e-3, 0.012, 3e-3, 3e-3, 3e-3, 3e-3, 1e-3, 1e-3, 3e-3])


def test_frames_that_expect_much_decide():
    misfit = ReferenceMisfit()
    for _ in range(50):
        misfit.learn(0.01**2, (0.1 * FLOOR_PX) ** 2)  # as in the reference view: nothing is told
    assert misfit.factor == pytest.approx(1.0, abs=0.02)
    for _ in range(10):
        misfit.learn(6.0 * 0.2**2, 0.2**2)
    assert misfit.factor == pytest.approx(6.0, rel=0.01)


def test_a_factor_below_one_narrows_nothing():
    misfit = ReferenceMisfit()
    for shown in (-1e-3, 2e-3):
        misfit.learn(shown, 0.3**2)
    assert misfit.factor == 1.0


@pytest.mark.parametrize("times", [1.0, 4.0])
def test_a_reference_that_is_off_more_than_stated_is_found_to_be(times):
    """Points are bound in references that are off by ``times`` the stated deviation, drawn at random."""
    model = bent_sheet_model(43, 31)
    estimator = Estimator(model, CAMERA, EstimationOptions(huber_px=50.0))
    nodes = np.random.default_rng(0).choice(len(model.nodes), 160, replace=False)
    nodes = nodes[(np.abs(model.nodes[nodes]) < [0.19, 0.13, 1.0]).all(axis=1)]
    seen = [
        CAMERA.project(s.camera_from_object.apply(model.positions(s.parameters)))[nodes] for s in (REFERENCE, LATER)
    ]
    used, rng, found = np.ones(len(nodes), dtype=bool), np.random.default_rng(1), []
    for _ in range(24):
        off = moved(REFERENCE, times * SPREAD * rng.standard_normal(9))
        surface, met = bind_pixels(model, CAMERA, view_of(model, CAMERA, off), seen[0])
        assert met.all()
        points = BoundPoints.from_surface(model, surface)
        errors = errors_of(estimator, points, off, np.diag(SPREAD**2))
        estimate = estimator.estimate(points, seen[1], used.astype(float), LATER)
        estimate = replace(estimate, covariance=np.zeros((9, 9)))
        for _ in range(20):
            stated = errors.added(estimate, used, 0.0)
        found.append(errors.reference_factor)
        unlearnt = errors_of(estimator, points, off, np.diag(SPREAD**2))
        before = unlearnt.added(estimate, used, 0.0, learns=False).covariance
        np.testing.assert_allclose(stated.covariance, errors.reference_factor**2 * before, rtol=1e-9)
    found = np.sqrt(np.mean(np.square(found)))
    # It is never below one, so that it is above one on average where all is as stated.
    assert found == pytest.approx(max(times, 1.25), rel=0.25)
