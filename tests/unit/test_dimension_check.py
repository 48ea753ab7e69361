"""What frames tell of wrong dimensions: against exact images of objects that have them, and least squares."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.diagnostics.dimensions import AS_BEST, NUMBERS, TOLERANCE, DimensionCheck
from morph_dslam.diagnostics.reference_misfit import FLOOR_PX
from morph_dslam.tracking.binding import bind_pixels, view_of
from morph_dslam.tracking.covariance import BoundPart
from morph_dslam.tracking.estimator import BoundPoints, EstimationOptions, Estimator
from morph_dslam.tracking.observability import position_std
from tests.support.bent_sheet import bent_sheet_model
from tests.support.one_view import errors_of
from tests.support.rendered_sequence import CAMERA, sheet_state
from tests.support.staged_scenes import SCENES, drawn_out, mean_error

EXACT = EstimationOptions(huber_px=50.0)
#: Of the reference state, as from some ten landmarks: arch, skew, twist, rotation and translation, SI.
SPREAD = np.array([1.5e-3, 0.012, 3e-3, 3e-3, 3e-3, 3e-3, 1e-3, 1e-3, 3e-3])


def seen(model, state, nodes):
    return CAMERA.project(state.camera_from_object.apply(model.positions(state.parameters)))[nodes]


class Stretched:
    """A sheet that is tracked with a model of which it has not got the dimensions.

    Its images are exact. The model is placed by all points in the first view.
    """

    def __init__(self, longer, covariance=None):
        """``longer`` (3,): the share by which the model is longer than the sheet along each axis."""
        self.model = bent_sheet_model(43, 31)
        self.real = drawn_out(self.model, 1.0 / (1.0 + np.asarray(longer)))
        nodes = np.random.default_rng(0).choice(len(self.model.nodes), 200, replace=False)
        self.nodes = nodes[(np.abs(self.model.nodes[nodes]) < [0.19, 0.13, 1.0]).all(axis=1)]
        self.estimator, self.weights = Estimator(self.model, CAMERA, EXACT), np.ones(len(self.nodes))
        first, reference = seen(self.real, sheet_state(0.1), self.nodes), sheet_state(0.1)
        at_nodes = self.bound(reference, seen(self.model, reference, self.nodes))
        self.placed = self.estimator.estimate(at_nodes, first, self.weights, reference).state
        self.points = self.bound(self.placed, first)
        covariance = np.diag(SPREAD**2) if covariance is None else covariance
        self.errors = errors_of(self.estimator, self.points, self.placed, covariance)

    def bound(self, state, pixels):
        surface, met = bind_pixels(self.model, CAMERA, view_of(self.model, CAMERA, state), pixels)
        assert met.all()
        return BoundPoints.from_surface(self.model, surface)

    def found(self, time, noise=None):
        pixels = seen(self.real, sheet_state(time), self.nodes)
        pixels = pixels if noise is None else pixels + noise
        return self.estimator.estimate(self.points, pixels, self.weights, sheet_state(time))


def test_what_a_wrong_length_leaves_is_as_predicted():
    sheet = Stretched([-0.005, 0.005, 0.0])
    found, taken_in = sheet.found(0.6), []
    assert np.sqrt(np.mean(found.residuals**2)) > 0.02
    sheet.errors._dimensions.learn = lambda *rows: taken_in.append(rows)
    sheet.errors.added(found, sheet.weights, 0.0)
    residuals, left, weights = taken_in[0]
    np.testing.assert_array_equal(residuals, found.residuals)
    np.testing.assert_array_equal(weights, sheet.weights)
    by_axes = left[:, :, 0] * (sheet.errors._dimensions.stretches[:, 0] @ [-0.005, 0.005, 0.0])
    assert np.linalg.norm(residuals - by_axes) < 0.15 * np.linalg.norm(residuals)


@pytest.mark.parametrize(("axis", "longer"), [(0, 0.02), (0, -0.03), (1, 0.02), (1, -0.04), (1, 0.06)])
def test_a_model_that_is_too_long_is_named_with_its_per_cent(axis, longer):
    off = np.zeros(3)
    off[axis] = longer
    sheet = Stretched(off)
    for time in (0.2, 0.4, 0.6, 0.8):
        sheet.errors.added(sheet.found(time), sheet.weights, 0.0)
    told = sheet.errors.stretch
    assert told.is_shown
    assert not told.is_excluded
    assert told.by_axis[axis] == pytest.approx(longer, rel=0.25)


@pytest.mark.parametrize("seed", range(5))
def test_a_right_model_is_not_accused(seed):
    """Points err by 0.1 px, and the reference state by what is stated."""
    rng = np.random.default_rng(seed)
    sheet = Stretched(np.zeros(3))
    off = replace(sheet.placed, parameters=sheet.placed.parameters + SPREAD[:3] * rng.standard_normal(3))
    pixels = seen(sheet.model, sheet_state(0.1), sheet.nodes)
    sheet.points = sheet.bound(off, pixels)
    sheet.errors = errors_of(sheet.estimator, sheet.points, off, np.diag(SPREAD**2))
    for time in np.linspace(0.1, 1.0, 40):
        noise = 0.1 * rng.standard_normal(pixels.shape)
        found = sheet.found(time, noise)
        sheet.errors.added(found, sheet.weights, 0.0)
        told = sheet.errors.stretch
        assert not told.is_shown
        assert told.sigmas < 2.0
    assert told.is_excluded


def test_what_is_shown_is_in_the_deviations_of_the_state():
    """The reference's own error is stated beside it; that the whole model may be too large is in it."""
    sheet, plain = Stretched([0.0, 0.04, 0.0]), Stretched([0.0, 0.04, 0.0])
    plain.errors._dimensions.learn = lambda *rows: None
    for time in (0.4, 0.6, 0.8):
        found, truth = sheet.found(time), sheet_state(time)
        none = replace(found, covariance=np.zeros((9, 9)))
        stated, before = (
            np.sqrt(np.mean(position_std(sheet.model, errors.added(none, sheet.weights, 0.0)) ** 2))
            for errors in (sheet.errors, plain.errors)
        )
        error = mean_error(sheet.model, found, sheet.real, truth)
        assert error > 0.008
        assert 0.5 * error < np.sqrt(stated**2 - before**2) < 3.0 * error


def test_the_reference_view_shows_nothing_and_a_bent_sheet_does():
    sheet = Stretched(np.zeros(3), 1e-8 * np.eye(9))
    for time, excluded in ((0.1, False), (0.8, True), (0.1, True)):
        sheet.errors.added(sheet.found(time), sheet.weights, 0.0)
        assert sheet.errors.stretch.is_excluded == excluded, time


def test_a_reference_that_is_not_known_tells_nothing():
    sheet = Stretched(np.zeros(3), np.full((9, 9), np.nan))
    sheet.errors.added(sheet.found(0.8), sheet.weights, 0.0)
    assert sheet.errors.stretch is None


def test_a_compact_body_that_hardly_turns_does_not_show_its_length():
    """The images of a wedge that is a few per cent longer are fitted to less than a tenth of a pixel."""
    scene = SCENES["wedge in the hand"](0)
    camera, model = scene.stage.camera, scene.model
    real = drawn_out(model, [1.0 + TOLERANCE, 1.0, 1.0])
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
        errors.added(found, used.astype(float), 0.0)
    assert not errors.stretch.is_excluded


def _grid(scene):
    """Pixels (n, 2) on the object in the first frame."""
    state, camera = scene.state(0.0), scene.stage.camera
    places = camera.project(state.camera_from_object.apply(scene.model.positions(state.parameters)))
    low, high = places.min(axis=0), places.max(axis=0)
    return np.stack(np.meshgrid(*np.linspace(low, high, 12).T), axis=-1).reshape(-1, 2)


@pytest.fixture
def check():
    """Of the sheet's points, to be given what frames would show."""
    return Stretched(np.zeros(3)).errors._dimensions


def frames(count, scale=1.0, n_causes=4, stretch=0.03, error_factors=0.5, seed=0):
    """Residuals (p, 2) and what one stretch and the error factors leave (p, 2, 1 + c), of frames of 50
    points."""
    rng = np.random.default_rng(seed)
    size = np.array([20.0 * scale, *np.full(n_causes, 0.3)])
    truth = np.array([stretch, *error_factors * rng.standard_normal(n_causes)])
    lefts = [size * rng.standard_normal((50, 2, 1 + n_causes)) for _ in range(count)]
    return [(left @ truth + 0.1 * rng.standard_normal((50, 2)), left) for left in lefts]


def test_the_estimate_is_that_of_least_squares(check):
    """Minimised at once, with all frames' residuals and the error factors' own size among the rows."""
    rng, shown = np.random.default_rng(1), frames(3)
    rows, numbers = [np.eye(5)], [np.zeros(5)]
    for residuals, left in shown:
        weights = rng.uniform(0.2, 1.0, 50)
        check.learn(residuals, left, weights)
        each = np.repeat(weights, 2)
        variance = np.average(residuals.ravel() ** 2, weights=each) + FLOOR_PX**2
        root = np.sqrt(NUMBERS * each / each.sum() / variance)
        rows.append(root[:, None] * left.reshape(-1, 5))
        numbers.append(root * residuals.ravel())
    rows, numbers = np.concatenate(rows), np.concatenate(numbers)
    expected = np.linalg.lstsq(rows, numbers, rcond=None)[0]
    np.testing.assert_allclose(check.evidence.estimate, expected[:1], rtol=1e-6)
    np.testing.assert_allclose(check.evidence.covariance, np.linalg.inv(rows.T @ rows)[:1, :1], rtol=1e-6)


def test_many_frames_count_as_a_few_of_the_best(check):
    (residuals, left), weights = frames(1)[0], np.ones(50)
    check.learn(residuals, left, weights)
    once = float(np.trace(check.evidence.information))
    for _ in range(200):
        check.learn(residuals, left, weights)
    assert 0.9 * AS_BEST <= np.trace(check.evidence.information) / once < 1.5 * AS_BEST
    # Nor is it forgotten what the best have told when many others tell nothing.
    for _ in range(200):
        check.learn(residuals, 1e-3 * left, weights)
    assert np.trace(check.evidence.information) > 0.9 * AS_BEST * once


def test_causes_that_are_larger_than_stated_make_the_stretch_less_sure(check):
    weights = np.ones(50)
    deviations = []
    for error_factors in (0.5, 20.0):
        check._information, check._product, check._best = np.zeros((0, 0)), np.zeros(0), 0.0
        for residuals, left in frames(3, error_factors=error_factors):
            shared = left.copy()
            shared[:, :, 0] += 30.0 * left[:, :, 1]  # a cause that leaves nearly what the stretch leaves
            check.learn(residuals, shared, weights)
        deviations.append(float(check.evidence.deviations[0]))
    assert deviations[1] > 3.0 * deviations[0]


def test_an_object_with_one_length_has_nothing_to_be_checked():
    model, state = bent_sheet_model(43, 31), sheet_state(0.1)
    pixels = seen(model, state, np.flatnonzero(np.abs(model.nodes[:, 1]) < 1e-3))
    surface, _ = bind_pixels(model, CAMERA, view_of(model, CAMERA, state), pixels)
    points = BoundPoints.from_surface(model, surface)
    jacobian = np.ones((len(points), 2, 9))
    check = DimensionCheck(points, [BoundPart(slice(None), state, None)], jacobian, np.ones(9))
    check.learn(np.ones((len(points), 2)), jacobian[:, :, :3], np.ones(len(points)))
    assert check.evidence.is_excluded
    assert not check.evidence.excess.any()
