"""When a tracker goes over to a view that it made: a sheet that the reference shows flat turns to the camera."""

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outcomes import Status
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, UPRIGHT, SheetFilm, mean_error

#: The frame after the last of these is compared with a view that this one became.
FLAT, TURNING = 1.2, np.arange(1.05, 0.1, -0.15)
STD = np.array([1e-4, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 2e-4, 2e-4, 5e-4])


def state(angle):
    pose = RigidTransform(rotation_exp(np.array([0.0, angle, 0.0])) @ UPRIGHT, np.array([0.0, 0.0, 0.6]))
    return State(np.array([0.05, 0.0, 0.0]), pose)


@pytest.fixture(scope="module")
def film():
    return SheetFilm(bent_sheet_model(22, 16))


def turned(film, options=None):
    """A tracker that saw the sheet turn."""
    known, first = Registration(film.model, state(FLAT), covariance=np.diag(STD**2)), film.frame(state(FLAT))
    tracker = Tracker(film.model, CAMERA, known, options, reference=first)
    for angle in TURNING:
        assert not tracker.track(film.frame(state(angle))).made_view
    return tracker


def test_no_view_is_made_where_one_is_kept(film):
    angles = (0.0, -0.1, -0.2)
    assert turned(film).track(film.frame(state(angles[0]))).made_view
    tracker = turned(film, TrackerOptions(max_views=1))
    for angle in angles:
        result = tracker.track(film.frame(state(angle)))
        assert (result.status, result.view, result.made_view) == (Status.TRACKED, 0, False)


@pytest.mark.parametrize("has_picture", [True, False])
def test_a_view_from_before_a_loss_is_not_gone_over_to_unchecked(film, has_picture):
    """The sheet is back as the reference shows it, which the view does not."""
    tracker = turned(film)
    lost = tracker.track(film.blank()) if has_picture else tracker.pass_over(None)
    assert lost.status is Status.LOST
    for _ in range(4):
        result = tracker.track(film.frame(state(FLAT)))
        assert result.estimate is not None
        assert (result.view, result.made_view) == (0, False)
        assert mean_error(film.model, result.estimate.state, state(FLAT)) < 3e-4
