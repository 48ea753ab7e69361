"""Tracking while something moves over the object and hides half of its points."""

import cv2
import numpy as np
import pytest

from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, SheetFilm, mean_error, sheet_state

TIMES = np.linspace(0.0, 0.6, 36)[1:]


def covered(image, step):
    """The image (h, w, 3) with a striped disc that goes round over its middle."""
    turn, along = 2.0 * np.pi * step / 15, np.indices(image.shape[:2]).sum(axis=0)
    centre = (int(320 + 70 * np.cos(turn)), int(240 + 45 * np.sin(turn)))
    mask = np.zeros(image.shape[:2], np.uint8)
    cv2.circle(mask, centre, 120, 255, -1, cv2.LINE_AA)
    stripes = (150 + 40 * np.sin(0.35 * along - 0.9 * step))[:, :, None]
    share = mask[:, :, None] / 255.0
    return np.clip((1.0 - share) * image + share * stripes, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def covered_run():
    """Mean errors by frame, mm, errors of the parameters over their deviations, and points that agreed."""
    model = bent_sheet_model(43, 31)
    film = SheetFilm(model)
    tracker = Tracker(model, CAMERA, Registration(model, sheet_state(0.0)), reference=film.frame(sheet_state(0.0)))
    errors, normalised, counts = [], [], []
    for step, time in enumerate(TIMES):
        truth = sheet_state(time)
        result = tracker.track(covered(film.frame(truth), step))
        assert result.status == "tracked", (step, result.reason)
        errors.append(1e3 * mean_error(model, result.estimate.state, truth))
        off = result.estimate.state.parameters - truth.parameters
        normalised.append(np.abs(off) / result.estimate.parameter_std)
        counts.append(result.n_inliers / len(tracker.reference.points))
    return np.array(errors), np.array(normalised), np.array(counts)


def test_windows_at_the_rim_do_not_spoil_what_the_others_tell(covered_run):
    """With the same weight for all points the errors are 0.38 mm on average and 0.23 in the median."""
    errors, _, share = covered_run
    assert 0.3 < share.mean() < 0.6
    assert errors.mean() < 0.15
    assert np.median(errors) < 0.1


def test_errors_are_as_large_as_stated(covered_run):
    """95 % of Gaussian errors are below 1.96."""
    _, normalised, _ = covered_run
    assert 1.5 < np.quantile(normalised, 0.95) < 2.6
