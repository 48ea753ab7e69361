"""One pose over a sequence with depth images: against the truth that measurements were made from."""

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.registration.landmark_binding import bind_landmarks
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.depth_registration import depth_term
from morph_dslam.tracking.estimator import Estimator, State
from morph_dslam.tracking.known_state import DepthTerm, LandmarkDepthTerm, LandmarkTerm
from morph_dslam.tracking.refinement import Keyframe
from morph_dslam.tracking.still import StillProblem, fit_still
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import CAMERA, UPRIGHT, sheet_depth

MODEL = bent_sheet_model(22, 16)
POSE = RigidTransform(rotation_exp(np.array([0.3, -0.2, 0.05])) @ UPRIGHT, np.array([0.02, -0.01, 0.62]))
AT_REST = State(MODEL.default, POSE)
#: Standard deviations: of landmarks and of followed points, pixels, and of a point's depth, metres.
LANDMARK_PX, POINT_PX, DEPTH_M = 1.5, 0.3, 1e-3


def shapes():
    """The sheet bent more and more."""
    return [State(time * np.array([0.03, 0.25, 0.1]), POSE) for time in (0.3, 0.7, 1.0)]


def still_fit(seed, in_keyframes, in_reference, scale=1.0):
    """The pose from landmarks and keyframes, with depth in these or in the reference frame, too large by a factor."""
    rng = np.random.default_rng(seed)
    nodes = MODEL.nodes[rng.choice(len(MODEL.nodes), 9, replace=False)]
    clicked = CAMERA.project(POSE.apply(nodes)) + LANDMARK_PX * rng.standard_normal((9, 2))
    landmarks = bind_landmarks(MODEL, Landmarks(nodes, clicked).points), clicked, LANDMARK_PX
    known = LandmarkTerm(*landmarks)
    start = State(MODEL.default, RigidTransform(POSE.rotation, POSE.translation - [0.0, 0.0, 4e-3]))
    if in_reference:
        image = np.float32(scale) * sheet_depth(MODEL, AT_REST, rng)
        known = LandmarkDepthTerm(*landmarks, depth_term(Estimator(MODEL, CAMERA), start, image))
    points = bound_points(MODEL, 80, rng)
    frames = []
    for shape in shapes():
        places = points.in_camera(shape)
        pixels = CAMERA.project(places) + POINT_PX * rng.standard_normal((80, 2))
        depths = places[:, 2] + DEPTH_M * rng.standard_normal(80)
        measured = PointDepths(scale * depths, np.full(80, POINT_PX / DEPTH_M), POINT_PX**2, 2.0 * POINT_PX)
        frames.append(Keyframe(pixels, np.ones(80), shape, POINT_PX, depths=measured if in_keyframes else None))
    pixels = CAMERA.project(points.in_camera(AT_REST))
    return fit_still(StillProblem(MODEL, CAMERA, start, pixels, frames, known, (), range(len(MODEL.default))))


@pytest.mark.slow
@pytest.mark.parametrize(("in_keyframes", "in_reference"), [(True, False), (False, True), (True, True)])
def test_depth_places_the_one_pose_along_the_sight_line(in_keyframes, in_reference):
    with_depth, without = (
        [still_fit(seed, *where) for seed in range(2)] for where in ((in_keyframes, in_reference), (False, False))
    )
    off, before = (
        np.array([found.state.camera_from_object.translation - POSE.translation for found in fits])
        for fits in (with_depth, without)
    )
    stated = np.array([np.sqrt(np.diag(found.covariance)[-3:]) for found in with_depth])
    assert (np.abs(off) < 3.5 * stated).all()
    assert np.abs(off[:, 2]).max() < 0.8 * np.abs(before[:, 2]).max()


@pytest.mark.parametrize(("in_keyframes", "in_reference"), [(True, False), (False, True), (True, True)])
def test_deviations_contain_that_all_depths_are_off_by_one_factor(in_keyframes, in_reference):
    """By one per cent of the distance, which is its standard deviation, however many frames there are."""
    found = still_fit(0, in_keyframes, in_reference, 1.01)
    distance = POSE.translation[2]
    off = found.state.camera_from_object.translation[2] - distance
    assert off == pytest.approx(0.01 * distance, rel=0.3)
    assert np.sqrt(found.covariance[-1, -1]) == pytest.approx(0.01 * distance, rel=0.15)


def test_the_reference_frames_depth_is_compared_where_its_pixels_see_the_object():
    """A flat sheet parallel to the image, nearer than measured: by how much, in standard deviations."""
    facing = State(MODEL.default, RigidTransform(UPRIGHT, np.array([0.0, 0.0, 0.6])))
    recorded = CAMERA.project(facing.camera_from_object.apply(MODEL.nodes[[40, 120, 200]]))
    recorded = np.vstack([recorded, [[2.0, 2.0]]])  # the last one beside the sheet
    sigma = np.array([1e-3, 2e-3, 1e-3, 1e-3])
    measured = PointDepths(0.6 + np.array([1e-3, 1e-3, 1e-2, 1e-2]), 1.0 / sigma, 1.0, 2.0)
    found = DepthTerm(MODEL, recorded, measured, 0.5).residuals(CAMERA, facing)
    # The third is beyond Huber's limit of two deviations, where the weighted square is 2 * 10.
    np.testing.assert_allclose(found, 0.5 * np.array([-1.0, -0.5, -np.sqrt(20.0), 0.0]), rtol=1e-6)


def test_depth_that_the_shape_does_not_fit_counts_for_less():
    """A bump of ten deviations over half of the sheet: its points say less than where only noise is left."""
    image = sheet_depth(MODEL, AT_REST, np.random.default_rng(0))
    bumpy = image + np.where(np.arange(image.shape[1]) < CAMERA.cx, 1e-2, 0.0).astype(np.float32)
    flat, bent = (depth_term(Estimator(MODEL, CAMERA), AT_REST, one) for one in (image, bumpy))
    assert bent.share < 0.8 * flat.share
