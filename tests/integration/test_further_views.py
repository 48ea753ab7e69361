"""A printed block is known from several sides: pictures of a scan serve as reference views, all at once."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.estimator import Estimator
from morph_dslam.tracking.hypothesis import Image
from morph_dslam.tracking.observability import position_std
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.patches import normalize_contrast
from morph_dslam.tracking.reference import PosedImage, ReferenceView
from morph_dslam.tracking.state import moved
from morph_dslam.tracking.tracker import Tracker
from morph_dslam.tracking.views import KeyframeViews, choose_keyframe_views
from tests.support.rendered_sequence import CAMERA, mean_error
from tests.support.turning_block import BlockFilm, block_state

OPTIONS = TrackerOptions()
#: Where the scan's pictures show the block, degrees about y; the first one is the reference.
SCAN = (0, 20, 45, 80, 100, 140, 170)


def known_views(film, step=None, deviations=None):
    """The scan's pictures; their states are off by ``step`` (6,) in the object's frame of each camera."""
    views = []
    for degrees in SCAN:
        state = block_state(np.radians(degrees), 0.0)
        grey = np.ascontiguousarray(film.frame(state)[..., 0])
        error_factors = None
        if deviations is not None:
            error_factors = np.vstack([np.zeros((2, 6)), np.diag(deviations)])
        if step is not None:
            state = moved(state, np.concatenate([np.zeros(2), step]))
        views.append(PosedImage(Image(grey, normalize_contrast(grey)), state, error_factors))
    return views


def chosen_degrees(further, views):
    of_picture = {id(view.picture): degrees for view, degrees in zip(views, SCAN, strict=True)}
    return [of_picture[id(kept.picture)] for kept in further.views]


@pytest.fixture(scope="module")
def film():
    return BlockFilm()


@pytest.fixture(scope="module")
def views(film):
    return known_views(film)


@pytest.fixture(scope="module")
def estimator(film):
    return Estimator(film.model, CAMERA)


def test_those_pictures_are_chosen_that_show_another_side(film, views, estimator):
    further = choose_keyframe_views(estimator, views[0], views[1:], OPTIONS)
    degrees = chosen_degrees(further, views)
    # From 20 degrees hardly anything new is seen; the far side and one between are needed.
    assert 20 not in degrees
    assert max(degrees) >= 140
    assert any(45 <= each <= 100 for each in degrees)


def test_a_view_from_between_looks_as_it_is_rendered_from_both_sides(film, views, estimator):
    first = ReferenceView(estimator, views[:1], OPTIONS)
    both = ReferenceView(estimator, [views[0], views[4]], OPTIONS)
    between = block_state(np.radians(50), 0.3)
    actual = normalize_contrast(np.ascontiguousarray(film.frame(between, noise=0.0)[..., 0]), 31)
    seen = cv2.erode(np.isfinite(both.depth(between)).astype(np.uint8), np.ones((21, 21))) > 0
    likeness = [np.corrcoef(r.rendered(between).image[seen], actual[seen])[0, 1] for r in (first, both)]
    assert likeness[0] < 0.8
    assert likeness[1] > 0.95
    assert len(both.points) > 1.4 * len(first.points)
    measurement = both.measure(Image(actual, actual), between, None)
    for part in both.parts:
        good = measurement.valid[part.rows]
        off = measurement.pixels - both.projected(between)
        assert good.sum() > 50
        assert np.median(np.linalg.norm(off[part.rows][good], axis=1)) < 0.15


def test_the_block_is_followed_all_around_without_a_view_that_is_made(film, views, estimator):
    further = choose_keyframe_views(estimator, views[0], views[1:], OPTIONS)
    start = block_state(0.0, 0.0)
    turns = np.radians(np.linspace(4, 160, 40))
    truths = [block_state(turn, (k + 1) / 40) for k, turn in enumerate(turns)]
    tracker = Tracker(
        film.model, CAMERA, Registration(film.model, start), OPTIONS, reference=views[0].picture, keyframes=further
    )
    results = [tracker.track(film.frame(truth)) for truth in truths]
    assert not any(result.made_view for result in results)
    assert [result.status for result in results] == ["tracked"] * 40
    errors = np.array([mean_error(film.model, r.estimate.state, t) for r, t in zip(results, truths, strict=True)])
    assert errors.mean() < 0.1e-3
    assert errors.max() < 0.6e-3


def test_what_covers_a_picture_is_not_taken_for_the_object(film, views, estimator):
    """A hand is over a part of the block in one picture of the scan: nothing is bound on it."""
    grey = views[4].picture.grey.copy()
    cv2.circle(grey, (320, 240), 40, 150, -1)
    noise = np.random.default_rng(1).integers(-40, 40, grey.shape)
    hand = np.zeros(grey.shape, dtype=bool)
    hand[200:280, 280:360] = True
    grey[hand] = np.clip(grey.astype(int) + noise, 0, 255)[hand].astype(np.uint8)
    covered = replace(views[4], picture=Image(grey, normalize_contrast(grey, 31)))
    further = choose_keyframe_views(estimator, views[0], [views[2], covered, views[5]], OPTIONS)
    (number,) = (k for k, view in enumerate(further.views) if view.picture is covered.picture)
    bound = ReferenceView(estimator, [views[0], *further.views], OPTIONS)
    part = bound.parts[1 + number]
    places = CAMERA.project(bound.points.in_camera(part.state)[part.rows])
    rows, columns = np.rint(places[:, ::-1]).astype(int).T
    assert len(places) > 50
    assert hand[rows, columns].mean() < 0.02


def test_the_error_that_all_views_have_in_common_is_stated(film, estimator):
    """All pictures place the block wrongly by the same draw: errors in the frames are as large as stated."""
    deviations = np.array([2e-3, 2e-3, 2e-3, 2e-4, 2e-4, 4e-4])
    rng, squared = np.random.default_rng(3), []
    for _ in range(6):
        views = known_views(film, deviations * rng.standard_normal(6), deviations)
        further = KeyframeViews(views[0].error_factors, (views[3], views[5]))
        start = Registration(film.model, views[0].state)
        tracker = Tracker(film.model, CAMERA, start, OPTIONS, reference=views[0].picture, keyframes=further)
        for turn in np.radians([10, 25, 40]):
            truth = block_state(turn, 0.25)
            result = tracker.track(film.frame(truth))
            assert result.status == "tracked", result.reason
            apart = truth.camera_from_object.apply(film.model.positions(truth.parameters))
            apart -= result.estimate.state.camera_from_object.apply(
                film.model.positions(result.estimate.state.parameters)
            )
            stated = np.mean(position_std(film.model, result.estimate) ** 2)
            squared.append(np.mean(np.sum(apart**2, axis=1)) / stated)
    assert 0.3 < np.sqrt(np.mean(squared)) < 1.6
