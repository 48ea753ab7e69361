"""A sheet that skews and twists, followed with a model that can only arch: no error of the registration is at fault.

What an outline or depths say beside the texture then must not be taken for such an error.
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


def states(model, options, with_errors):
    """Nodes in two frames by a tracker that is told of the errors of its registration by clicks, or not."""
    film, rng, true = SheetFilm(SHEET, seed=3), np.random.default_rng(3), sheet_state(START)
    there = replace(true, parameters=true.parameters[: len(model.parameters)])
    known = clicked(model, CAMERA, there, rng)
    known = known if with_errors else replace(known, covariance=None)
    options = md.TrackerOptions(least_inliers=16, new_views=False, **options)
    tracker, found = md.Tracker(model, CAMERA, known, options, reference=film.frame(true)), []
    for time in TIMES:
        state = sheet_state(time)
        result = tracker.track(Frame(0, time, film.frame(state), sheet_depth(SHEET, state, rng)))
        assert result.estimate is not None
        place = result.estimate.state.camera_from_object
        found.append(place.apply(model.positions(result.estimate.state.parameters)))
    return np.array(found)


def moved_by_correction(model, options):
    """Mean distance of the nodes, metres, from where they are without any correction."""
    corrected, as_registered = (states(model, options, told) for told in (True, False))
    return np.linalg.norm(corrected - as_registered, axis=2).mean()


@pytest.mark.slow
@pytest.mark.parametrize("beside", ["use_outline", "use_depth"])
def test_what_the_registration_cannot_explain_leaves_it_as_it_is(beside):
    """Where the model can take the shape, the correction moves the object."""
    assert moved_by_correction(ARCHING, {beside: True}) < 1e-9
    assert moved_by_correction(SHEET, {beside: True}) > 2e-4
