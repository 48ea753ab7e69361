"""A plain block that moves, bends and twists before a plain background, followed by its outline alone."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.geometry import RigidTransform, SimilarityTransform, rotation_exp
from morph_dslam.model.parameter_errors import parameter_errors
from morph_dslam.registration.registration import MapRegistration, PosePrior, Registration
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.tracking.anchoring import CameraLocalization
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.multi_camera import RigTracker
from morph_dslam.tracking.rig import RigCamera
from morph_dslam.tracking.run_notices import RunWarning, notices_of
from morph_dslam.tracking.run_results import RunResults
from tests.support.rendered_sequence import CAMERA, UPRIGHT, colours, mean_error
from tests.support.turning_block import turning_block

FINE = 4
FINER = Camera(
    FINE * CAMERA.width, FINE * CAMERA.height, FINE * CAMERA.fx, FINE * CAMERA.fy,
    FINE * CAMERA.cx + 1.5, FINE * CAMERA.cy + 1.5,
)  # fmt: skip
TIMES = np.linspace(0.0, 1.0, 31)


@pytest.fixture(scope="module")
def model():
    return turning_block()[0]


def state(time) -> State:
    parameters = np.array([0.012 * np.sin(6.0 * time), np.radians(10) * np.sin(4.0 * time)])
    turn = rotation_exp(np.array([0.3 + 0.05 * time, 0.25 * time + 0.4, 0.1]))
    return State(parameters, RigidTransform(turn @ UPRIGHT, np.array([0.01 * np.sin(3.0 * time), 0.0, 0.4])))


def plain(model, time, rng, inner=90.0, outer=180.0):
    """A frame (h, w, 3) with antialiased edges and noise of two grey levels."""
    there = state(time)
    nodes = there.camera_from_object.apply(model.positions(there.parameters))
    covered = rasterise(FINER.project(nodes), nodes[:, 2], model.triangles, FINER.height, FINER.width).covered
    image = np.where(covered, inner, outer)
    image = cv2.resize(image, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    return colours(cv2.GaussianBlur(image, (0, 0), 0.6) + 2.0 * rng.standard_normal(image.shape))


def new_tracker(model, first, **options):
    known = Registration(model, state(0.0))
    return md.Tracker(model, CAMERA, known, md.TrackerOptions(use_outline=True, **options), reference=first)


@pytest.mark.slow
@pytest.mark.parametrize(("inner", "outer"), [(90.0, 180.0), (170.0, 60.0)])
def test_a_body_without_texture_is_followed_by_its_outline(model, inner, outer):
    rng = np.random.default_rng(0)
    tracker = new_tracker(model, plain(model, 0.0, rng, inner, outer))
    errors, away = [], []
    for time in TIMES:
        result = tracker.track(plain(model, time, rng, inner, outer))
        assert (result.status, result.pose_from) == (md.Status.TRACKED, "outline")
        assert result.n_inliers > 0.9 * result.n_points > 90
        assert result.estimate is not None
        errors.append(mean_error(model, result.estimate.state, state(time)))
        off = result.estimate.state.parameters - state(time).parameters
        away.append(np.abs(off) / result.estimate.parameter_std)
    assert np.mean(errors) < 0.15e-3
    assert np.mean(np.array(away) < 3.0) > 0.9


def test_it_is_found_again_after_it_was_hidden(model):
    rng, result = np.random.default_rng(1), None
    tracker = new_tracker(model, plain(model, 0.0, rng))
    for time in TIMES:
        image = plain(model, time, rng)
        if 0.3 < time < 0.4:
            image[:] = 128
        result = tracker.track(image)
        assert result.status == (md.Status.LOST if 0.3 < time < 0.4 else md.Status.TRACKED)
    assert result is not None
    assert result.estimate is not None
    assert mean_error(model, result.estimate.state, state(TIMES[-1])) < 0.2e-3


def test_what_is_before_the_object_and_known_does_not_count(model):
    rng = np.random.default_rng(2)
    tracker = new_tracker(model, plain(model, 0.0, rng))
    before = np.full((CAMERA.height, CAMERA.width), np.inf, dtype=np.float32)
    before[:, :300] = 0.1
    for time in TIMES[:5]:
        image = plain(model, time, rng)
        image[:, :300] = 128
        result = tracker.track(image, occluder_depth=before)
        assert result.estimate is not None
        assert tracker.last_measured.pixels[tracker.last_measured.weights > 0.0][:, 0].min() > 298.0
        assert mean_error(model, result.estimate.state, state(time)) < 1e-3


ROWS, COLUMNS = np.mgrid[0:480, 0:640]
BALL_AT = State(np.zeros(2), RigidTransform(UPRIGHT, np.array([0.0, 0.0, 0.4])))
#: Of a ball's disc, pixels: a plane touches the ball all around it.
RADIUS_PX = 528.0 * 0.05 / np.sqrt(0.4**2 - 0.05**2)


@pytest.fixture(scope="module")
def ball():
    """Of 50 mm, that keeps its shape."""
    model = turning_block(32)[0]
    nodes = 0.05 * model.nodes / np.linalg.norm(model.nodes, axis=1)[:, None]
    still = model.displacement.with_modes(np.zeros_like(model.displacement.modes))
    return md.ReducedModel("ball", nodes, model.triangles, model.parameters, still)


def disc(radius):
    """A dark disc (h, w) of this radius, pixels, one or by pixel."""
    return 180.0 - 90.0 * np.clip(radius - np.hypot(COLUMNS - 320.0, ROWS - 240.0) + 0.5, 0.0, 1.0)


def test_what_moves_nothing_of_the_outline_is_unobservable(ball):
    """Of a ball that keeps its shape, both parameters; where it is its outline tells.

    By the tenth of a pixel that all of it may be off by: the disc has the radius f R / (z^2 - R^2)^1/2.
    """
    options = md.TrackerOptions(use_outline=True)
    tracker = md.Tracker(ball, CAMERA, Registration(ball, BALL_AT), options, reference=colours(disc(RADIUS_PX)))
    result = tracker.track(colours(disc(RADIUS_PX) + np.random.default_rng(0).standard_normal(ROWS.shape)))
    assert result.estimate is not None
    np.testing.assert_allclose(result.estimate.state.camera_from_object.translation, [0.0, 0.0, 0.4], atol=0.5e-3)
    sideways, away = 0.1 * 0.4 / 528.0, 0.1 * (0.4**2 - 0.05**2) / (0.4 * RADIUS_PX)
    np.testing.assert_allclose(result.estimate.pose_std[3:], [sideways, sideways, away], rtol=0.05)
    anywhere = (ball.upper - ball.lower) / np.sqrt(12.0)
    np.testing.assert_allclose(result.estimate.parameter_std, anywhere, rtol=1e-3)


def test_an_outline_that_errs_as_a_whole_does_not_outweigh_the_map(ball):
    """A ball's disc is a pixel too small, which is 6 mm of distance, and bent by one more; the map knows it to 1 mm."""
    rng, sight = np.random.default_rng(3), np.zeros((6, 6))
    sight[5, 5] = 1e-3
    known = PosePrior(BALL_AT.camera_from_object, 1e-8 * np.eye(6), sight)
    options, angles = md.TrackerOptions(use_outline=True), np.arctan2(ROWS - 240.0, COLUMNS - 320.0)
    tracker = md.Tracker(ball, CAMERA, Registration(ball, BALL_AT), options, reference=colours(disc(RADIUS_PX)))
    off = []
    for _ in range(12):
        bent = disc(RADIUS_PX - 1.0 + np.cos(9.0 * angles + rng.uniform(0.0, 6.3)))
        result = tracker.track(colours(bent + rng.standard_normal(bent.shape)), CameraLocalization(known))
        assert result.estimate is not None
        off.append(abs(result.estimate.state.camera_from_object.translation[2] - 0.4))
    assert max(off) < 3e-3


def test_the_outline_is_used_unasked_where_a_map_has_an_object_without_texture(ball):
    image, there = colours(disc(RADIUS_PX)), BALL_AT.camera_from_object
    place = MapRegistration(SimilarityTransform(1.0, there.rotation, there.translation), np.zeros(3), 1e-6 * np.eye(7))
    known = Registration(ball, BALL_AT, map_registration=place)
    result = md.Tracker(ball, CAMERA, known, reference=image).track(image)
    assert result.by_outline
    assert result.estimate is not None
    np.testing.assert_allclose(result.estimate.state.camera_from_object.translation, there.translation, atol=0.5e-3)
    flat = colours(np.full(ROWS.shape, 128.0))
    for free, options in ((Registration(ball, BALL_AT), None), (known, md.TrackerOptions(pose="free"))):
        with pytest.raises(RegistrationError, match="--outline") as caught:
            md.Tracker(ball, CAMERA, free, options, reference=flat)
        assert caught.value.reason is RegistrationFailure.FEW_CORNERS


def test_several_cameras_need_texture(model):
    image, rig = (
        plain(model, 0.0, np.random.default_rng(3)),
        [RigCamera(CAMERA, RigidTransform(np.eye(3), np.zeros(3)))] * 2,
    )
    with pytest.raises(RegistrationError, match="leave out --with"):
        RigTracker(
            model, rig, Registration(model, state(0.0)), md.TrackerOptions(use_outline=True), references=[image, image]
        )


def test_a_few_corners_are_said_to_be_too_few(ball):
    """A print of three squares: their corners, which are fewer than the thirty that texture needs."""
    image = disc(RADIUS_PX)
    for x, y in ((300, 225), (340, 232), (315, 262)):
        image[y - 8 : y + 8, x - 8 : x + 8] = 40.0
    image = colours(image)

    def followed(**options):
        options = md.TrackerOptions(use_outline=True, **options)
        result = md.Tracker(ball, CAMERA, Registration(ball, BALL_AT), options, reference=image).track(image)
        assert result.by_outline
        run = RunResults(ball, reference_frame=0)
        run.add(0, 0.0, result)
        return result.few_corners, [notice.warning for notice in notices_of(run)]

    few, warnings = followed()
    assert few == (12, 30)
    assert RunWarning.FEW_CORNERS in warnings
    few, warnings = followed(use_texture=False)
    assert few is None
    assert RunWarning.BY_OUTLINE in warnings


def test_what_a_sensor_tells_is_exact_and_the_shape_errs_by_what_it_keeps_from_it(model):
    """The object moves by a twentieth more than the model, which the certificate has, and a sensor tells the bend."""
    mu = np.array([0.01, 0.1])
    shape = model.displacement.value(mu)
    entry = parameter_errors(model, [(mu, shape, 1.05 * shape)])
    too_stiff = replace(model, certificate={"discretisation": {"parameters": entry}})
    softer = replace(model, displacement=model.displacement.with_modes(1.05 * model.displacement.modes))
    rng, result, std = np.random.default_rng(4), None, 1e-5
    tracker = new_tracker(too_stiff, plain(softer, 0.0, rng))
    for time in (0.08, 0.16, 0.24):
        tracker.know({"bend": (float(state(time).parameters[0]), std)})
        result = tracker.track(plain(softer, time, rng))
        assert result.estimate is not None
    assert result.parameter_std["bend"] == pytest.approx(std, rel=0.1)
    found = model.displacement.value(result.estimate.state.parameters)
    off = np.linalg.norm(found - softer.displacement.value(state(0.24).parameters), axis=1)
    assert np.sqrt(np.mean(result.displacement_std() ** 2)) == pytest.approx(np.sqrt(np.mean(off**2)), rel=0.3)
