"""Whether a frame is fit to be a reference view, and which of these serves."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.tracking.binding import DrawnSurface, draw_view, view_of
from morph_dslam.tracking.estimator import Estimator, State
from morph_dslam.tracking.frame_estimation import FrameEstimation
from morph_dslam.tracking.hypothesis import Image
from morph_dslam.tracking.measurement import PATCH_HALF
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.patches import normalize_contrast
from morph_dslam.tracking.reference import PosedImage, ReferenceView, SurfaceSamples, choose_view, covered_share
from morph_dslam.tracking.views import is_known_well, is_sharp, seen_part, sharpness, surface_spread
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, UPRIGHT, SheetFilm, sheet_state
from tests.support.turning_block import SIZE, block_state, turning_block

OPTIONS, NOW = TrackerOptions(), sheet_state(0.1)


def picture(image, **others):
    grey = np.ascontiguousarray(image[:, :, 0])
    return Image(grey, normalize_contrast(grey), **others)


@pytest.fixture(scope="module")
def scene():
    """The first view, and an attempt at the picture of a later frame."""
    film = SheetFilm(bent_sheet_model(43, 31))
    estimator = Estimator(film.model, CAMERA)
    known = PosedImage(picture(film.frame(sheet_state(0.0))), sheet_state(0.0))
    view = ReferenceView(estimator, [known], OPTIONS)
    estimation = FrameEstimation(estimator, view, OPTIONS)

    def attempt(image):
        made = picture(image)
        return made, estimation.correct(made, NOW, None, None)

    return film, view, attempt


@pytest.mark.parametrize("distance", [0.62, 2.0])
def test_points_of_the_texture_count_as_one_by_their_windows_whether_or_not_an_outline_counts_too(distance):
    """The share of two squares of 15 pixels that is the same, summed; the outline's 160 points diluted it."""
    film = SheetFilm(bent_sheet_model(22, 16))
    turn = sheet_state(0.1).camera_from_object.rotation
    known = State(sheet_state(0.1).parameters, RigidTransform(turn, np.array([0.0, 0.0, distance])))
    seen, estimator = PosedImage(picture(film.frame(known)), known), Estimator(film.model, CAMERA)
    for use_outline in (False, True):
        view = ReferenceView(estimator, [seen], replace(OPTIONS, use_outline=use_outline))
        apart = np.abs(view.pixels[:, None] - view.pixels[None])
        alike = np.prod(np.maximum(1.0 - apart / 15.0, 0.0), axis=2)
        assert view.redundancy == pytest.approx(alike.sum() / len(view.points), rel=1e-3)


def fit(view, made, attempt, unexplained_px=0.1, spread=0.01, **changed):
    estimate = replace(attempt.estimate, **changed)
    attempt, half = replace(attempt, estimate=estimate), PATCH_HALF
    known = is_known_well(attempt, spread, unexplained_px, OPTIONS)
    return known and is_sharp(made, attempt, view, half)


def test_a_sharp_frame_whose_state_is_known_is_fit(scene):
    film, view, attempt = scene
    made, tried = attempt(film.frame(NOW))
    assert fit(view, made, tried)
    assert fit(view, *attempt(film.frame(NOW, light=0.6)))
    assert not fit(view, made, tried, unexplained_px=0.6)
    assert not fit(view, made, tried, sigma_px=1.2)
    assert not fit(view, made, tried, spread=0.051)
    few = np.arange(len(tried.inliers)) % 2 == 0
    assert not is_known_well(replace(tried, inliers=tried.inliers & few), 0.01, 0.1, OPTIONS)


def test_the_spread_of_the_surface_is_that_of_its_place(scene):
    """A shift is the same everywhere; a turn moves each point by its distance from the axis."""
    film, view, attempt = scene
    _, tried = attempt(film.frame(NOW))
    samples = SurfaceSamples(Estimator(film.model, CAMERA), view.surface)
    covariance = np.diag([0.0] * 6 + [1e-6, 4e-6, 4e-6])
    assert surface_spread(samples, replace(tried.estimate, covariance=covariance)) == pytest.approx(3e-3)
    covariance = np.diag([0.0] * 3 + [0.0, 0.0, 0.01**2] + [0.0] * 3)
    turned = surface_spread(samples, replace(tried.estimate, covariance=covariance))
    # Nodes stand for equal areas, but for those on the rim.
    pose = tried.estimate.state.camera_from_object
    nodes = film.model.positions(tried.estimate.state.parameters) @ pose.rotation.T
    assert turned == pytest.approx(0.01 * np.sqrt(np.mean(np.sum(nodes[:, :2] ** 2, axis=1))), rel=0.05)


def test_a_blurred_frame_is_not(scene):
    film, view, attempt = scene
    made, tried = attempt(film.frame(NOW))
    streak = np.zeros((9, 9), np.float32)
    streak[4] = 1.0 / 9.0
    blurred = picture(cv2.filter2D(film.frame(NOW), -1, streak))
    assert not fit(view, blurred, tried)
    everywhere = np.ones(made.normalized.shape, dtype=bool)
    assert sharpness(blurred.normalized, everywhere) < 0.8 * sharpness(made.normalized, everywhere)


def test_a_frame_is_as_sharp_as_the_view_where_its_points_have_the_texture(scene):
    """An outline may have placed the object elsewhere, here twice as far, where the view's texture is finer."""
    film, view, attempt = scene
    made, tried = attempt(film.frame(NOW))
    pose = tried.estimate.state.camera_from_object
    farther = replace(NOW, camera_from_object=RigidTransform(pose.rotation, 2.0 * pose.translation))
    assert not fit(view, made, tried, state=farther)
    assert fit(view, made, replace(tried, by_points=tried.estimate.state), state=farther)


def test_nothing_is_bound_around_points_that_disagree_or_behind_another_object(scene):
    film, view, attempt = scene
    hand = (250, 150, 90, 90)
    made, tried = attempt(film.frame(NOW, occluder=hand))
    inside = np.zeros(made.normalized.shape, dtype=bool)
    inside[155:235, 255:335] = True
    should_be = view.rendered(tried.estimate.state)
    covered = np.isfinite(should_be.depth)
    seen = seen_part(made, tried, should_be, view)
    hidden = covered & ~seen
    assert hidden[inside].mean() > 0.8
    assert hidden[300:400, 400:500].mean() < 0.1
    depths = np.where(inside, np.float32(0.3), np.float32(np.inf))
    assert not seen_part(replace(made, occluder_depth=depths), tried, should_be, view)[inside].any()
    found = PosedImage(made, tried.estimate.state, seen=seen)
    new = ReferenceView(Estimator(film.model, CAMERA), [found], OPTIONS, view.surface)
    places = np.rint(new.pixels).astype(int)
    assert seen[places[:, 1], places[:, 0]].all()


FAR = 2.0


def flat(turn=0.0, distance=FAR, x=0.0):
    pose = RigidTransform(UPRIGHT @ rotation_exp(np.array([0.0, turn, 0.0])), np.array([x, 0.0, distance]))
    return State(np.zeros(3), pose)


def looker(model):
    """What a view in a state shows of the samples of a model."""
    surface = DrawnSurface.of(model)
    samples = SurfaceSamples(Estimator(model, CAMERA), surface)

    def seen(state):
        drawn = surface.model
        return samples.seen(state, draw_view(view_of(drawn, CAMERA, state), drawn.triangles, CAMERA).depth)

    return seen


@pytest.fixture(scope="module")
def sheet():
    return looker(bent_sheet_model(43, 31))


@pytest.fixture(scope="module")
def block():
    return looker(turning_block()[0])


def test_what_is_seen_is_the_area_in_the_image_over_that_of_the_sheet(sheet):
    front = sheet(flat())
    np.testing.assert_allclose(np.abs(front), (CAMERA.fx / FAR) ** 2, rtol=1e-9)
    turned = sheet(flat(turn=np.radians(60)))
    assert np.abs(turned).mean() == pytest.approx(0.5 * (CAMERA.fx / FAR) ** 2, rel=0.05)


def test_the_other_side_is_not_covered(sheet):
    front, back = sheet(flat()), sheet(flat(turn=np.pi))
    assert covered_share(front, front) == 1.0
    assert covered_share(back, front) == 0.0


def test_a_view_from_twice_as_far_still_serves_and_one_from_farther_does_not(sheet):
    far = sheet(flat(distance=2.0))
    assert covered_share(sheet(flat(distance=1.05)), far) == 1.0
    assert covered_share(sheet(flat(distance=0.95)), far) == 0.0


def test_what_the_reference_did_not_show_is_not_covered(sheet):
    """In the reference half of the sheet is outside of the image."""
    at_edge = flat(x=0.5 * CAMERA.width / CAMERA.fx * FAR)
    assert covered_share(sheet(flat()), sheet(at_edge)) == pytest.approx(0.5, abs=0.06)


def test_share_of_a_turned_block_is_that_of_its_faces_in_the_image(block):
    """Seen from far enough, faces z and x take cos and sin of the turn; the top takes part of the rest."""
    turn = np.radians(50)
    front, now = block_state(0.0, 0.0), block_state(turn, 0.0)
    tilt = 0.25
    width, height, depth = SIZE
    faces = height * np.cos(tilt) * np.array([width * np.cos(turn), depth * np.sin(turn)])
    top = width * depth * np.sin(tilt)
    expected = (faces[0] + top) / (faces.sum() + top)
    assert covered_share(block(now), block(front)) == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize(
    ("shares", "active", "chosen"),
    [
        ([0.9], 0, 0),
        ([0.61], 0, 0),
        ([0.59], 0, None),
        # The first view is not gone back to before it serves well, and then even from one that serves better.
        ([0.7, 0.9, 0.9], 1, 1),
        ([0.8, 0.9, 0.9], 1, 0),
        # Of views that serve when the active one does not, the one that serves best.
        ([0.5, 0.62, 0.3, 0.7], 2, 3),
        ([0.5, 0.5, 0.3], 2, None),
        # A later view has larger errors: it is not changed to while the active one serves.
        ([0.1, 0.65, 0.99], 1, 1),
    ],
)
def test_choice_of_the_view(shares, active, chosen):
    errors = [0.0, 1e-4, 2e-4, 3e-4][: len(shares)]
    assert choose_view(shares, errors, active) == chosen
