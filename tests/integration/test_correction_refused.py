"""What an outline or depths say beside the texture must not be taken for an error of the registration if it is none.

The sheet skews and twists, and the model can only arch; or depths are those of another instant.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.sources import Frame
from tests.support.bent_sheet import bent_sheet_model
from tests.support.clicked import clicked
from tests.support.rendered_sequence import CAMERA, SheetFilm, sheet_depth, sheet_state

SHEET, ARCHING = bent_sheet_model(43, 31), bent_sheet_model(43, 31, known=1)
START, TIMES = 0.3, (0.35, 0.4)


def states(model, options, px, lag, with_errors):
    """Nodes in two frames by a tracker that is told of the errors of its registration by clicks, or not.

    Depths are as long after the picture as ``lag``.
    """
    film, rng, true = SheetFilm(SHEET, seed=3), np.random.default_rng(3), sheet_state(START)
    there = replace(true, parameters=true.parameters[: len(model.parameters)])
    known = clicked(model, CAMERA, there, rng, px)
    known = known if with_errors else replace(known, covariance=None)
    options = md.TrackerOptions(least_inliers=16, new_views=False, **options)
    tracker, found = md.Tracker(model, CAMERA, known, options, reference=film.frame(true)), []
    for time in TIMES:
        depth = sheet_depth(SHEET, sheet_state(time + lag), rng)
        result = tracker.track(Frame(0, time, film.frame(sheet_state(time)), depth))
        assert result.estimate is not None
        place = result.estimate.state.camera_from_object
        found.append(place.apply(model.positions(result.estimate.state.parameters)))
    return np.array(found)


def moved_by_correction(model, options, px, lag=0.0):
    """Mean distance of the nodes, metres, from where they are without any correction."""
    corrected, as_registered = (states(model, options, px, lag, told) for told in (True, False))
    return np.linalg.norm(corrected - as_registered, axis=2).mean()


@pytest.mark.slow
def test_an_outline_of_a_shape_that_the_model_cannot_take_leaves_the_registration_as_it_is():
    options = {"use_outline": True}
    assert moved_by_correction(ARCHING, options, 1.0) < 1e-9
    assert moved_by_correction(SHEET, options, 1.0) > 2e-4


@pytest.mark.slow
def test_depths_of_another_instant_leave_the_registration_as_it_is():
    options = {"use_depth": True}
    assert moved_by_correction(SHEET, options, 0.2, lag=0.05) < 1e-9
    assert moved_by_correction(SHEET, options, 0.2) > 5e-5
