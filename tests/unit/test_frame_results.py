"""What a frame's result states, and what later frames learn from it."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from morph_dslam.model import SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.unknown_loads import UnknownLoads, with_unknown_loads
from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.binding import bind_pixels, view_of
from morph_dslam.tracking.covariance import BoundPart
from morph_dslam.tracking.estimator import BoundPoints, EstimationOptions, Estimator
from morph_dslam.tracking.frame_results import tracked_result
from morph_dslam.tracking.hypothesis import PoseHypothesis
from morph_dslam.tracking.measurement import Measurement
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outcomes import FewPointsAgree
from morph_dslam.tracking.recovery import Recovery
from morph_dslam.tracking.reference_factors import error_factors_of
from morph_dslam.tracking.sequence_filter import SequenceFilter
from morph_dslam.tracking.systematic_errors import SystematicErrors
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, SheetFilm, sheet_state

MODEL = bent_sheet_model(22, 16)
REFERENCE, LATER = sheet_state(0.1), sheet_state(0.6)
STD = np.array([2e-4, 2e-3, 5e-4, 3e-4, 3e-4, 3e-4, 2e-4, 2e-4, 5e-4])


class View:
    """A view of the sheet, whose frames are where they should be but for what is added to the pixels."""

    def __init__(self) -> None:
        seen = REFERENCE.camera_from_object.apply(MODEL.positions(REFERENCE.parameters))
        inside = (np.abs(MODEL.nodes) < [0.19, 0.13, 1.0]).all(axis=1)
        surface, met = bind_pixels(MODEL, CAMERA, view_of(MODEL, CAMERA, REFERENCE), CAMERA.project(seen[inside]))
        assert met.all()
        self.estimator = Estimator(MODEL, CAMERA, EstimationOptions(huber_px=50.0))
        self._points, anything = BoundPoints.from_surface(MODEL, surface), SimpleNamespace()
        self._exact, self._rng = CAMERA.project(self._points.in_camera(LATER)), np.random.default_rng(0)
        part = BoundPart(slice(None), REFERENCE, error_factors_of(np.diag(STD**2), self.estimator.scale))
        unused: Any = anything
        beside = SimpleNamespace(
            estimator=self.estimator, hessian_of_outline=lambda *_: None, whole_outline=lambda *_: None
        )
        self.active: Any = SimpleNamespace(
            systematic=SystematicErrors(self.estimator, self._points, [part], 17),
            recovery=Recovery(MODEL, CAMERA, unused, unused, TrackerOptions()),
            estimation=SimpleNamespace(beside=beside),
            reference=SimpleNamespace(few_corners=None),
        )

    def result(self, added=0.0):
        """Of a frame in which pixels are off by ``added`` (p, 2) and noise."""
        pixels = self._exact + added + 0.2 * self._rng.standard_normal(self._exact.shape)
        weights = np.ones(len(pixels))
        every = weights > 0.0
        estimate = self.estimator.estimate(self._points, pixels, weights, LATER)
        attempt = PoseHypothesis(estimate, every, Measurement(pixels, pixels, every, every, weights), weights)
        self.active.recovery.learn(attempt)
        return tracked_result(MODEL, attempt, self.active, SequenceFilter(self.estimator, []), [])

    def wave(self, size_px):
        """As where points are taken for their neighbours in a regular print, a period off in one place or another."""
        return size_px * np.column_stack([np.sin(self._exact[:, 0] / 40.0), np.cos(self._exact[:, 1] / 40.0)])


def test_frames_that_are_taken_for_what_looks_like_them_say_nothing_of_the_reference():
    """All points agree, ten times less closely than usual. Of a clear error of the model it has the blame."""
    view = View()
    for _ in range(20):
        right = view.result()
    for _ in range(5):
        assert view.result(view.wave(5.0)).warning(FewPointsAgree) is not None
    after = view.result()
    assert after.warning(FewPointsAgree) is None
    assert after.reference_factor == pytest.approx(right.reference_factor, rel=0.05)
    assert after.estimate.parameter_std == pytest.approx(right.estimate.parameter_std, rel=0.1)
    for _ in range(5):
        assert view.result(view.wave(0.8)).warning(FewPointsAgree) is None
    assert view.result().reference_factor > 1.5 * after.reference_factor


def sheet_with_load():
    """The sheet with one unknown load, which moves one of its halves out of the plane, more towards the end."""
    constant = ParameterFunctions(MODEL.lower, MODEL.upper, np.zeros((1, 3), dtype=np.int64), np.ones((1, 1)))
    moved = np.zeros((1, len(MODEL.nodes), 3))
    moved[0, :, 2] = np.maximum(MODEL.nodes[:, 0], 0.0) ** 2
    responses = {
        "displacement": SeparatedField(moved, constant),
        "compliance_root": SeparatedField(np.ones((1, 1, 1)), constant),
    }
    every = np.arange(len(MODEL.nodes))
    loads = UnknownLoads("", False, every, np.ones((len(every), 3, 1)), np.ones((1, 6)), responses)
    return with_unknown_loads(replace(MODEL, stresses={}, unknown_loads=loads))


def test_a_result_does_not_rest_on_what_its_own_frame_teaches_of_unknown_loads():
    """The next frame's prior is by a hundred times surer of the loads than the first one's, or as sure."""
    model, film, found = sheet_with_load(), SheetFilm(MODEL), []
    first = film.frame(REFERENCE)
    second = film.frame(LATER)
    state = replace(REFERENCE, parameters=np.append(REFERENCE.parameters, 0.0))
    for times in (1.0, 1e4):
        known = Registration(model, state, covariance=np.diag(np.insert(STD, 3, 1e-3) ** 2))
        tracker = Tracker(model, CAMERA, known, TrackerOptions(use_unknown_loads=True), reference=first)
        loads = tracker.estimator.loads
        assert loads is not None
        surer, learned = loads.squared_px * times, loads.learn

        def learn(*told, loads=loads, surer=surer, learned=learned):
            learned(*told)
            loads.squared_px = surer

        loads.learn = learn  # type: ignore[method-assign]
        estimate = tracker.track(second).estimate
        assert estimate is not None
        assert loads.squared_px == surer
        found.append(estimate.parameter_std)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9)
