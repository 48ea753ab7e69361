"""What the depths of a frame tell of the reference's error, and what becomes of that in the rest of its estimate."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from morph_dslam.registration.registration import PosePrior
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.tracking.binding import bind_pixels, view_of
from morph_dslam.tracking.covariance import BoundPart
from morph_dslam.tracking.depth_scale import CommonDepthScale
from morph_dslam.tracking.estimator import BoundPoints, Estimator, State
from morph_dslam.tracking.frame_estimation import FrameEstimation
from morph_dslam.tracking.hypothesis import Image, PoseHypothesis
from morph_dslam.tracking.measurement import Measurement
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.other_tilt import OtherTilt
from morph_dslam.tracking.state import moved, pose_increment
from morph_dslam.tracking.systematic_errors import SystematicErrors
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import CAMERA, sheet_state

MODEL = bent_sheet_model(22, 16)
REFERENCE, TRUTH = State(MODEL.default, sheet_state(0.1).camera_from_object), sheet_state(0.3)
NOISE_PX, COUNT = 0.1, 150
#: Of a registration in a map, which knows the shape: by the rotation vector, rad, and the translation, metres.
FACTORS = np.vstack([np.zeros((3, 6)), np.diag([3e-3, 3e-3, 3e-3, 5e-4, 5e-4, 2e-3])])


class Frame:
    """Points that were bound by a registration that is off, seen in a later frame beside exact depths.

    Parameters
    ----------
    seed : of what the registration is off by, the points and their noise.
    depth_sigma : as of `TrackerOptions`: how little the depths count.
    """

    def __init__(self, seed: int, depth_sigma: float) -> None:
        rng = np.random.default_rng(seed)
        self.taken = moved(REFERENCE, FACTORS @ rng.standard_normal(6))
        true_points = bound_points(MODEL, COUNT, rng)
        seen = CAMERA.project(true_points.in_camera(REFERENCE))
        surface, met = bind_pixels(MODEL, CAMERA, view_of(MODEL, CAMERA, self.taken), seen)
        self.points = BoundPoints.from_surface(MODEL, surface)
        self.every = np.ones(len(self.points))
        pixels = CAMERA.project(true_points.take(np.flatnonzero(met)).in_camera(TRUTH))
        self.pixels = pixels + NOISE_PX * rng.standard_normal(pixels.shape)
        nodes = TRUTH.camera_from_object.apply(MODEL.positions(TRUTH.parameters))
        drawn = rasterise(CAMERA.project(nodes), nodes[:, 2], MODEL.triangles, CAMERA.height, CAMERA.width).depth
        nothing = np.zeros((2, 2), np.uint8)
        self.picture = Image(nothing, nothing, depth=np.where(np.isfinite(drawn), drawn, np.nan).astype(np.float32))
        view = SimpleNamespace(points=self.points, all_points=self.points, redundancy=1.0, outline=None)
        options = TrackerOptions(use_depth=True, depth_sigma=depth_sigma)
        self.estimator = Estimator(MODEL, CAMERA)
        self.estimation = FrameEstimation(self.estimator, view, options)  # type: ignore[arg-type]
        part = BoundPart(slice(None), self.taken, FACTORS)
        self.systematic = SystematicErrors(self.estimator, self.points, [part], 15, scale=CommonDepthScale(0.01))

    def by_points(self, prior=None):
        """The attempt by the points alone, beside what is known of the pose."""
        measurement = Measurement(self.pixels, self.pixels, self.every > 0.0, self.every > 0.0, self.every)
        found = self.estimator.estimate(self.points, self.pixels, self.every, TRUTH, prior=prior)
        return PoseHypothesis(found, self.every > 0.0, measurement, self.every, prior)

    def corrected(self, attempt):
        """The attempt with the depths."""
        return self.estimation.beside.fit_depths(self.picture, attempt, self.systematic)


def test_a_pose_by_the_map_tells_nothing_of_the_registration_that_it_rests_on():
    """Where depths say nothing either, each error factor is left as it was stated; six of seven seemed to be known."""
    frame = Frame(0, 10.0)
    between = TRUTH.camera_from_object @ REFERENCE.camera_from_object.inverse
    exact = between @ REFERENCE.camera_from_object
    lasting = [pose_increment(exact, between @ moved(REFERENCE, one).camera_from_object) for one in FACTORS.T]
    of_camera = np.diag([2e-4, 2e-4, 2e-4, 5e-5, 5e-5, 1e-4]) ** 2
    known = PosePrior(between @ frame.taken.camera_from_object, of_camera, np.column_stack(lasting))
    found = frame.corrected(frame.by_points(known.prior(3, NOISE_PX**2)))
    assert found.correction is not None
    assert np.linalg.eigvalsh(found.correction.left) == pytest.approx(np.ones(7), abs=0.01)


def test_a_correction_stays_where_depths_leave_one_tilt_only():
    """From the mirrored one the cost leads back to the same minimum, without the correction."""
    frame, apart = Frame(0, 2e-4), np.zeros(9)
    attempt = frame.by_points()
    apart[3] = 0.5
    found = frame.corrected(replace(attempt, other_tilt=OtherTilt(attempt.estimate.state, apart, 0.0)))
    assert found.correction is not None
    kept = frame.estimation.with_other_tilt(found)
    assert kept.other_tilt is None
    assert kept.correction is found.correction
    np.testing.assert_array_equal(kept.estimate.state.parameters, found.estimate.state.parameters)
