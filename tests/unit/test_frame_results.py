"""What a frame's result states, and what later frames learn from it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from morph_dslam.tracking.binding import bind_pixels, view_of
from morph_dslam.tracking.covariance import BoundPart
from morph_dslam.tracking.estimator import BoundPoints, EstimationOptions, Estimator
from morph_dslam.tracking.frame_results import tracked_result
from morph_dslam.tracking.hypothesis import PoseHypothesis
from morph_dslam.tracking.measurement import Measurement
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outcomes import FewPointsAgree
from morph_dslam.tracking.recovery import Recovery
from morph_dslam.tracking.sequence_filter import SequenceFilter
from morph_dslam.tracking.systematic_errors import SystematicErrors, error_factors_of
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, sheet_state

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
        self.active: Any = SimpleNamespace(
            systematic=SystematicErrors(self.estimator, self._points, [part], 17),
            recovery=Recovery(MODEL, CAMERA, unused, unused, TrackerOptions()),
            estimation=SimpleNamespace(known=self.estimator.known, hessian_of_outline=lambda attempt: None),
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
