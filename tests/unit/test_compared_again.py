"""A frame is compared again where windows miss a part of the change, unless that would lose the object."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform
from morph_dslam.tracking.estimator import Estimator, State
from morph_dslam.tracking.frame_estimation import FrameEstimation
from morph_dslam.tracking.hypothesis import Image, reject
from morph_dslam.tracking.measurement import Measurement
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.window_means import WindowMeans
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import CAMERA

MODEL, COUNT, NOISE_PX = bent_sheet_model(22, 16), 200, 0.05
POSE = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
BEFORE, TRUTH = (State(np.array([arch, 0.0, 0.0]), POSE) for arch in (0.0, 0.05))
POINTS = bound_points(MODEL, COUNT)


def comparisons(shares: list[float], rng: np.random.Generator) -> Iterator[Measurement]:
    """One after the other, in which these shares of the points are found, each drawn in the state before."""
    for share in shares:
        pixels = CAMERA.project(POINTS.in_camera(TRUTH)) + NOISE_PX * rng.standard_normal((COUNT, 2))
        every, found = np.ones(COUNT, dtype=bool), np.arange(COUNT) < share * COUNT
        drawing: Any = SimpleNamespace(state=BEFORE)
        yield Measurement(pixels, pixels, found, every, np.ones(COUNT), drawing)


@pytest.mark.parametrize(("shares", "found"), [([0.6, 0.9, 0.9], 0.9), ([0.6, 0.05, 0.9], 0.6)])
def test_a_comparison_in_which_the_object_is_lost_does_not_take_the_place_of_one_in_which_it_is_not(shares, found):
    rest = comparisons(shares, np.random.default_rng(0))
    reference: Any = SimpleNamespace(
        points=POINTS,
        all_points=POINTS,
        redundancy=1.0,
        window_means=WindowMeans(POINTS.rest),
        projected=lambda state: CAMERA.project(POINTS.in_camera(state)),
        measure=lambda picture, state, offsets: next(rest),
    )
    estimation, grey = (
        FrameEstimation(Estimator(MODEL, CAMERA), reference, TrackerOptions()),
        np.zeros((4, 4), np.uint8),
    )
    picture = Image(grey, grey)
    first = estimation.correct(picture, BEFORE, None, None)
    attempt = estimation.correct_shape(picture, first)
    assert reject(attempt, TrackerOptions()) is None
    assert int(attempt.inliers.sum()) == pytest.approx(found * COUNT, abs=2)
    assert attempt.estimate.state.parameters[0] == pytest.approx(0.05, abs=1e-3)
