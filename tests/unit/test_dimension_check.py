"""Which views could show a wrong dimension: against estimates of objects that have one."""

import numpy as np
import pytest

from morph_dslam.online.estimation.estimator import BoundPoints, EstimationOptions, Estimator
from morph_dslam.online.measuring.binding import bind_pixels, view_of
from morph_dslam.online.uncertainty.dimension_check import STRETCH
from tests.support.bent_sheet import bent_sheet_model
from tests.support.one_view import errors_of
from tests.support.rendered_sequence import CAMERA, sheet_state
from tests.support.staged_scenes import SCENES, drawn_out

EXACT = EstimationOptions(huber_px=50.0)


def seen(model, state, nodes):
    return CAMERA.project(state.camera_from_object.apply(model.positions(state.parameters)))[nodes]


def test_what_a_wrong_length_leaves_is_as_predicted():
    """The real sheet is longer and narrower; its model is placed by all points and fitted to a later view."""
    model = bent_sheet_model(43, 31)
    real = drawn_out(model, 1.0 + 0.01 * np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0))
    nodes = np.random.default_rng(0).choice(len(model.nodes), 200, replace=False)
    nodes = nodes[(np.abs(model.nodes[nodes]) < [0.19, 0.13, 1.0]).all(axis=1)]
    reference, later = sheet_state(0.1), sheet_state(0.6)
    first, pixels = seen(real, reference, nodes), seen(real, later, nodes)
    estimator, weights = Estimator(model, CAMERA, EXACT), np.ones(len(nodes))
    at_nodes, _ = bind_pixels(model, CAMERA, view_of(model, CAMERA, reference), seen(model, reference, nodes))
    placed = estimator.estimate(BoundPoints.from_surface(model, at_nodes), first, weights, reference).state
    surface, met = bind_pixels(model, CAMERA, view_of(model, CAMERA, placed), first)
    assert met.all()
    points = BoundPoints.from_surface(model, surface)
    errors = errors_of(estimator, points, placed, 1e-12 * np.eye(9))
    found = estimator.estimate(points, pixels, weights, placed)
    used = weights > 0.0
    shown = errors.unexplained(found, used).px
    assert shown > 0.02
    predicted = []
    errors._dimensions.learn = predicted.append
    errors.added(found, used, 0.0)
    assert predicted[0].shape == (1, 1)
    assert 0.01 * np.sqrt(predicted[0][0, 0]) == pytest.approx(shown, rel=0.15)


def test_the_reference_view_shows_nothing_and_a_bent_sheet_does():
    model, reference = bent_sheet_model(43, 31), sheet_state(0.1)
    nodes = np.flatnonzero((np.abs(model.nodes) < [0.19, 0.13, 1.0]).all(axis=1))[::7]
    surface, _ = bind_pixels(model, CAMERA, view_of(model, CAMERA, reference), seen(model, reference, nodes))
    points, estimator = BoundPoints.from_surface(model, surface), Estimator(model, CAMERA, EXACT)
    errors = errors_of(estimator, points, reference, 1e-8 * np.eye(9))
    used = np.ones(len(points), dtype=bool)
    for time, unchecked in ((0.1, True), (0.11, True), (0.8, False), (0.1, False)):
        pixels = CAMERA.project(points.in_camera(sheet_state(time)))
        found = estimator.estimate(points, pixels, used.astype(float), sheet_state(time))
        errors.added(found, used, 0.0)
        assert errors.is_unchecked == unchecked, time


def test_a_compact_body_that_hardly_turns_does_not_show_its_length():
    """The images of a wedge that is a few per cent longer are fitted to less than a tenth of a pixel."""
    scene = SCENES["wedge in the hand"](0)
    camera, model = scene.stage.camera, scene.model
    real = drawn_out(model, [1.0 + STRETCH, 1.0, 1.0])
    points = BoundPoints.from_surface(
        model, bind_pixels(model, camera, view_of(model, camera, scene.state(0.0)), _grid(scene))[0]
    )
    longer = BoundPoints.from_surface(real, points.surface)
    estimator, used = Estimator(model, camera, EXACT), np.ones(len(points), dtype=bool)
    errors = errors_of(estimator, points, scene.state(0.0), 1e-8 * np.eye(8))
    for time in (0.2, 0.4, 0.6):
        pixels = camera.project(longer.in_camera(scene.state(time)))
        found = estimator.estimate(points, pixels, used.astype(float), scene.state(time))
        assert np.sqrt(np.mean(found.residuals**2)) < 0.15
        errors.added(found, used, 0.0)
    assert errors.is_unchecked


def _grid(scene):
    """Pixels (n, 2) on the object in the first frame."""
    state, camera = scene.state(0.0), scene.stage.camera
    places = camera.project(state.camera_from_object.apply(scene.model.positions(state.parameters)))
    low, high = places.min(axis=0), places.max(axis=0)
    return np.stack(np.meshgrid(*np.linspace(low, high, 12).T), axis=-1).reshape(-1, 2)
