"""Errors of the reference, of the model and of neighbours in the covariance: what they do, and sums over pairs."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.tracking.binding import bind_pixels, view_of
from morph_dslam.tracking.covariance import (
    ALIKE_SHARE,
    FACTOR_TOLERANCE,
    MOST_COMPARED,
    PAIR_SHARE,
    BoundPart,
    SharedErrors,
    evenly,
    gaussian_factor,
    trace_of_share,
)
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.estimator import BoundPoints, EstimationOptions, Estimator, LinearCost
from morph_dslam.tracking.noise import Observations
from morph_dslam.tracking.observability import position_std
from morph_dslam.tracking.reference_correction import ReferenceCorrection
from morph_dslam.tracking.reference_factors import error_factors_of
from morph_dslam.tracking.reference_misfit import FLOOR_PX, ReferenceMisfit
from morph_dslam.tracking.sequence_filter import SequenceFilter
from morph_dslam.tracking.state import moved, pose_increment
from morph_dslam.tracking.still import held
from morph_dslam.tracking.systematic_errors import SystematicErrors
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import measured, rim
from tests.support.rendered_sequence import CAMERA, sheet_state

REFERENCE, LATER = sheet_state(0.1), sheet_state(0.6)
WINDOW = 17


def errors_of(estimator, points, reference, covariance):
    """Of points bound in one picture, with the covariance of the state there, None where it is not known."""
    part = BoundPart(slice(None), reference, error_factors_of(covariance, estimator.scale))
    return SystematicErrors(estimator, points, [part], WINDOW)


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model(43, 31)


@pytest.fixture(scope="module")
def estimator(model):
    return Estimator(model, CAMERA, EstimationOptions(huber_px=50.0))


@pytest.fixture(scope="module")
def pixels(model):
    """Places of 200 corners in the reference view, on the sheet with a margin."""
    nodes = np.random.default_rng(0).choice(len(model.nodes), 200, replace=False)
    inside = np.abs(model.nodes[nodes]) < [0.19, 0.13, 1.0]
    seen = REFERENCE.camera_from_object.apply(model.positions(REFERENCE.parameters))[nodes]
    return CAMERA.project(seen[inside.all(axis=1)])


def bound(model, state, pixels):
    surface, met = bind_pixels(model, CAMERA, view_of(model, CAMERA, state), pixels)
    assert met.all()
    return BoundPoints.from_surface(model, surface)


@pytest.mark.slow
def test_an_error_of_the_reference_moves_later_estimates_as_predicted(model, estimator, pixels):
    """Points are bound in a wrong reference state, and a later frame is estimated from exact measurements."""
    true_points = bound(model, REFERENCE, pixels)
    seen = CAMERA.project(true_points.in_camera(LATER))
    scale = np.array([2e-4, 2e-3, 5e-4, 3e-4, 3e-4, 3e-4, 2e-4, 2e-4, 5e-4])
    weights = np.ones(len(pixels))
    for k in range(9):
        step = np.zeros(9)
        step[k] = scale[k]
        off = moved(REFERENCE, step)
        points = bound(model, off, pixels)
        found = estimator.estimate(points, seen, weights, LATER)
        covariance = np.outer(step, step)
        errors = errors_of(estimator, points, off, covariance)
        used = np.ones(len(pixels), dtype=bool)
        plain = replace(found, covariance=np.zeros((9, 9)))
        stated = errors.added(plain, used, 0.0)
        truth = LATER.camera_from_object.apply(model.positions(LATER.parameters))
        now = found.state.camera_from_object.apply(model.positions(found.state.parameters))
        off_by = np.sqrt(np.mean(np.sum((now - truth) ** 2, axis=1)))
        predicted = np.sqrt(np.mean(position_std(model, stated) ** 2))
        assert predicted == pytest.approx(off_by, rel=0.1), k


def by_deformation(points, state):
    """By how much the deformation moves the pixels (p, 2) of points."""
    return CAMERA.project(points.in_camera(state)) - CAMERA.project(state.camera_from_object.apply(points.rest))


def test_what_the_deformation_moves_points_by_is_off_as_predicted(model, estimator, pixels):
    """A reference state that is off, and a parameter that a sensor tells and that moves the object less than stated."""
    true_points = bound(model, REFERENCE, pixels)
    seen, used = CAMERA.project(true_points.in_camera(LATER)), np.ones(len(pixels), dtype=bool)
    for k, size in ((0, 2e-4), (1, 2e-3), (2, 5e-4), (3, 3e-4), (4, 3e-4)):
        step = np.eye(9)[k] * size
        off = moved(REFERENCE, step)
        points = bound(model, off, pixels)
        found = estimator.estimate(points, seen, np.ones(len(pixels)), LATER)
        errors = errors_of(estimator, points, off, np.outer(step, step))
        errors.added(found, used, 0.0)
        columns = errors.deformation_errors(found.state, np.zeros((9, 9)), None)()
        wrong = by_deformation(points, found.state) - by_deformation(true_points, LATER)
        predicted = columns.sum(axis=2)
        predicted *= np.sign(np.sum(predicted * wrong))
        assert np.linalg.norm(predicted - wrong) < 0.15 * np.linalg.norm(wrong), k


def test_what_the_deformation_moves_corrected_points_by_is_off_as_stated(model, estimator, pixels):
    """Over registrations of which corrections leave a fifth in some directions, by the covariance of draws.

    What is left has the state off, and the points lie where all of the error has put them: the two are alike only by
    what is left.
    """
    rng, size, n_draws, pixels = np.random.default_rng(5), 9, 80, pixels[::2]
    turned = np.linalg.qr(rng.standard_normal((size, size)))[0]
    shares = np.where(np.arange(size) % 2, 0.2, 0.05)
    left, noise = ((turned * np.sqrt(some)) @ turned.T for some in (shares, shares / (1.0 - shares)))
    covariance = np.diag((0.1 * SPREAD) ** 2)
    factors = error_factors_of(covariance, estimator.scale)
    true_points, weights = bound(model, REFERENCE, pixels), np.ones(len(pixels))
    seen, errors = (
        CAMERA.project(true_points.in_camera(LATER)),
        errors_of(estimator, true_points, REFERENCE, covariance),
    )
    texture, wrong = errors.pushed_texture(LATER, 0.0 * pixels, weights), []
    for _ in range(n_draws):
        true = rng.standard_normal(size)
        found = (np.eye(size) - left @ left) @ (true + noise @ rng.standard_normal(size))
        points = bound(model, moved(REFERENCE, factors @ true), pixels)
        shift = np.einsum("pkn,n->pk", texture.frame.jacobian, texture.transfer @ found)
        state = estimator.estimate(points, seen - shift, weights, LATER).state
        wrong.append((by_deformation(points, state) - by_deformation(true_points, LATER)).ravel())
    nothing = np.zeros((size, size))
    correction = ReferenceCorrection(
        nothing[0], 0.0 * pixels, texture.transfer, left, nothing, np.zeros(size + 3), nothing[:, :3]
    )
    exact = estimator.estimate(true_points, seen, weights, LATER)
    errors.added(exact, weights, 0.0, learns=False, corrected=correction)
    columns = errors.deformation_errors(exact.state, np.zeros((size, size)), None)().reshape(2 * len(pixels), -1)
    directions, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    seen_well = sizes > 0.01 * sizes[0]
    ratios = np.mean((np.array(wrong) @ directions[:, seen_well]) ** 2, axis=0) / sizes[seen_well] ** 2
    assert ratios == pytest.approx(1.0, abs=0.5), "a mean square of so many draws is off by 0.16, a deviation"


def test_the_images_make_no_error_of_the_model_good_in_a_parameter_that_a_sensor_tells(model, pixels):
    """The object has 1 % more arch than the model at the same value, which is known to a thousandth of its range."""
    points, change = bound(model, REFERENCE, pixels), 0.01 * LATER.parameters[0] * np.eye(3)[:, :1]
    truth = replace(LATER, parameters=LATER.parameters + change[:, 0])
    seen, used = CAMERA.project(points.in_camera(truth)), np.ones(len(pixels), dtype=bool)
    for is_known in (True, False):
        estimator = Estimator(model, CAMERA, EstimationOptions(huber_px=50.0))
        if is_known:
            estimator.known.tell({"arch": (float(LATER.parameters[0]), 1e-6)})
        found = estimator.estimate(points, seen, np.ones(len(pixels)), LATER)
        errors = errors_of(estimator, points, REFERENCE, np.zeros((9, 9)))
        errors.added(found, used, 0.0)
        filtered = SequenceFilter(estimator, [])
        filtered.fuse(measured(points, seen), found)
        column = errors.deformation_errors(found.state, filtered.by_known, lambda mu: (change, 0.0))()[:, :, 9]
        missed = by_deformation(points, truth) - by_deformation(points, found.state)
        expected = by_deformation(points, truth) - by_deformation(points, LATER)
        assert np.linalg.norm(column - missed) < 0.05 * np.linalg.norm(expected)
        moved_by = found.state.parameters - LATER.parameters
        held = filtered.held[:3] @ change[:, 0] if is_known else np.zeros(3)
        assert moved_by / estimator.scale[:3] == pytest.approx((change[:, 0] - held) / estimator.scale[:3], abs=1e-3)


def test_in_the_reference_view_itself_the_error_is_that_of_the_reference(model, estimator, pixels):
    points = bound(model, REFERENCE, pixels)
    root = np.random.default_rng(1).standard_normal((9, 9)) * estimator.scale[:, None] * 1e-3
    errors = errors_of(estimator, points, REFERENCE, root @ root.T)
    found = estimator.estimate(points, pixels, np.ones(len(pixels)), REFERENCE)
    used = np.ones(len(pixels), dtype=bool)
    plain = replace(found, covariance=np.zeros((9, 9)))
    stated = errors.added(plain, used, errors.unexplained(plain, used).px)
    np.testing.assert_allclose(stated.covariance, root @ root.T, rtol=1e-3, atol=1e-9)


def test_what_neighbours_have_in_common_is_not_noise(model, estimator, pixels):
    points = bound(model, REFERENCE, pixels)
    errors = errors_of(estimator, points, REFERENCE, None)
    found = estimator.estimate(points, pixels, np.ones(len(pixels)), REFERENCE)
    used = np.ones(len(pixels), dtype=bool)
    noise = np.random.default_rng(2).standard_normal(pixels.shape)
    by_noise = errors.unexplained(replace(found, residuals=noise), used)
    assert by_noise.total_px == pytest.approx(1.0, abs=0.1)
    assert by_noise.px < 0.3
    assert not by_noise.is_failure
    wave = np.column_stack([np.sin(pixels[:, 0] / 60.0), np.cos(pixels[:, 1] / 60.0)]) * np.sqrt(2.0)
    by_model = errors.unexplained(replace(found, residuals=wave + 0.1 * noise), used)
    assert by_model.px == pytest.approx(1.0, abs=0.25)
    assert by_model.is_failure


@pytest.mark.parametrize("still", [True, False])
def test_a_camera_that_was_moved_is_told_from_another_model_by_the_one_shift_of_all_points(
    model, estimator, pixels, still
):
    """The parameters take up a part of a shift, and a wave over the object has no shift in common."""
    points, weights = bound(model, REFERENCE, pixels), np.ones(len(pixels))
    parts = [BoundPart(slice(None), REFERENCE, None)]
    errors = SystematicErrors(estimator, points, parts, WINDOW, still)
    exact, noise = CAMERA.project(points.in_camera(LATER)), np.random.default_rng(2).standard_normal(pixels.shape)
    pose = held(LATER, estimator)

    def shift_of(seen):
        return errors.common_shift(estimator.estimate(points, seen, weights, LATER, prior=pose), weights)

    wave = np.column_stack([np.sin(pixels[:, 0] / 30.0), np.cos(pixels[:, 1] / 30.0)])
    assert shift_of(exact + [3.0, -4.0] + 0.2 * noise) == (pytest.approx(5.0, rel=0.1) if still else 0.0)
    assert shift_of(exact + 3.0 * wave + 0.2 * noise) == 0.0
    assert shift_of(exact + 0.2 * noise) == 0.0


def test_a_parameter_that_is_held_to_a_wrong_value_is_no_shift_of_the_camera(model, estimator, pixels):
    """The residuals are those of the right parameters, which explain them; the noise alone has a shift by chance."""
    points, weights = bound(model, REFERENCE, pixels), np.ones(len(pixels))
    errors = SystematicErrors(estimator, points, [BoundPart(slice(None), REFERENCE, None)], WINDOW, still=True)
    wrong = replace(LATER, parameters=REFERENCE.parameters)
    noise = np.random.default_rng(4).standard_normal(pixels.shape)
    off = CAMERA.project(points.in_camera(LATER)) - CAMERA.project(points.in_camera(wrong))
    estimate = replace(
        estimator.estimate(
            points, CAMERA.project(points.in_camera(wrong)), weights, wrong, prior=held(wrong, estimator)
        ),
        state=wrong,
    )
    assert np.linalg.norm(off, axis=1).mean() > 2.0
    assert errors.common_shift(replace(estimate, residuals=off + 0.02 * noise), weights) == 0.0
    shifted = errors.common_shift(replace(estimate, residuals=off + [6.0, -8.0] + 0.02 * noise), weights)
    assert shifted == pytest.approx(10.0, rel=0.3)


def beyond_reference(model, estimator, pixels, off, push, rng):
    """Of a later frame whose points were bound in the state ``off`` and moved by ``push`` (p, 2); noise is 0.15 px."""
    true_points = bound(model, REFERENCE, pixels)
    seen = CAMERA.project(true_points.in_camera(LATER)) + push + 0.15 * rng.standard_normal(pixels.shape)
    points, weights = bound(model, off, pixels), np.ones(len(pixels))
    errors = errors_of(estimator, points, off, np.diag(SPREAD**2))
    found = estimator.estimate(points, seen, weights, LATER)
    left = errors.unexplained(found, weights > 0.0)
    for _ in range(5):
        errors.added(found, weights, left.px)
    return errors, left, found


def test_an_error_of_the_reference_is_not_laid_on_the_model(model, estimator, pixels):
    """Noise alone, and three times as many deviations off as stated, in random directions."""
    rng, factors = np.random.default_rng(21), []
    for times in np.repeat([0.0, 3.0], 20):
        off = moved(REFERENCE, times * SPREAD * rng.standard_normal(9))
        errors, left, _ = beyond_reference(model, estimator, pixels, off, 0.0, rng)
        assert not left.is_failure
        assert not errors.beyond_reference.is_failure, (times, errors.beyond_reference)
        factors.append(errors.reference_factor)
    assert np.sqrt(np.mean(np.square(factors[20:]))) > 1.5, "the residuals are wide, and the reference has the blame"


def test_a_push_that_the_model_lacks_is_found_where_the_fit_hides_most_of_it(model, estimator, pixels):
    """A bump in the images as a finger makes it, after which less than half a pixel is left in common."""
    rng = np.random.default_rng(22)
    middle, width = pixels.mean(axis=0), 0.5 * np.std(pixels[:, 0])
    away = pixels - middle - [width, 0.0]
    push = np.outer(4.0 * np.exp(-0.5 * np.sum(away**2, axis=1) / width**2), [0.6, 0.8])
    errors, left, found = beyond_reference(model, estimator, pixels, REFERENCE, push, rng)
    assert left.px < 0.5
    assert not left.is_failure
    assert errors.beyond_reference.is_failure
    estimated = found.state.camera_from_object.apply(model.positions(found.state.parameters))
    truth = LATER.camera_from_object.apply(model.positions(LATER.parameters))
    assert np.linalg.norm(estimated - truth, axis=1).max() > 3e-3


def test_a_failure_of_the_model_widens_the_deviations(model, estimator, pixels):
    points = bound(model, REFERENCE, pixels)
    errors = errors_of(estimator, points, REFERENCE, None)
    found = estimator.estimate(points, pixels, np.ones(len(pixels)), REFERENCE)
    used = np.ones(len(pixels), dtype=bool)
    narrow, wide = (errors.added(found, used, px) for px in (0.0, 1.0))
    np.testing.assert_allclose(narrow.covariance, found.covariance)
    # Errors that are alike over many points average out less than independent ones of the same size.
    independent = np.linalg.inv(estimator.evaluate(points, pixels, np.ones(len(pixels)), REFERENCE)[1])
    assert position_std(model, wide).mean() > 2.0 * position_std(model, replace(found, covariance=independent)).mean()


def test_a_smooth_error_of_the_model_is_stated_as_large_as_it_is_though_the_fit_takes_most_of_it(
    model, estimator, pixels
):
    """Random fields that vary over the whole object; what the fit leaves of them is a small part."""
    points = bound(model, REFERENCE, pixels)
    errors = errors_of(estimator, points, REFERENCE, None)
    used = np.ones(len(pixels), dtype=bool)
    spread = np.sqrt(np.mean(np.sum((pixels - pixels.mean(axis=0)) ** 2, axis=1)))
    squared = np.sum((pixels[:, None] - pixels[None]) ** 2, axis=2)
    kernel = np.exp(-0.5 * squared / (0.75 * spread) ** 2)
    root = np.linalg.cholesky(kernel + 1e-9 * np.eye(len(pixels)))
    rng = np.random.default_rng(3)
    truth = REFERENCE.camera_from_object.apply(model.positions(REFERENCE.parameters))
    off, stated, left = [], [], []
    for _ in range(40):
        seen = pixels + 0.5 * root @ rng.standard_normal(pixels.shape)
        found = estimator.estimate(points, seen, used.astype(float), REFERENCE)
        unexplained = errors.unexplained(found, used)
        with_model = errors.added(replace(found, covariance=np.zeros((9, 9))), used, unexplained.px)
        now = found.state.camera_from_object.apply(model.positions(found.state.parameters))
        off.append(np.mean(np.sum((now - truth) ** 2, axis=1)))
        stated.append(np.mean(position_std(model, with_model) ** 2))
        left.append(unexplained.px)
    assert np.sqrt(np.mean(np.square(left))) < 0.35  # of 0.5
    assert np.sqrt(np.median(off) / np.median(stated)) == pytest.approx(1.0, abs=0.4)
    # Five times what is stated is exceeded by none.
    assert (np.sqrt(off) < 5.0 * np.sqrt(stated)).all()


def test_an_error_of_the_reference_stays_in_a_shared_parameter_as_predicted(model, estimator, pixels):
    """The arch, the same in all frames, is estimated from five; the last by itself would hardly show it."""
    true_points, weights = bound(model, REFERENCE, pixels), np.ones(len(pixels))
    step = np.array([0.0, 2e-3, 5e-4, 3e-4, -3e-4, 2e-4, 2e-4, -1e-4, 5e-4])
    off = moved(REFERENCE, step)
    points = bound(model, off, pixels)
    errors = errors_of(estimator, points, off, np.outer(step, step))
    filtered = SequenceFilter(estimator, [0])
    for time in (0.5, 0.6, 0.7, 0.8, 0.9):
        truth = replace(sheet_state(time), parameters=np.array([0.03, *sheet_state(time).parameters[1:]]))
        seen = CAMERA.project(true_points.in_camera(truth))
        used = weights if time < 0.9 else 1e-4 * weights
        frame = measured(points, seen, used)
        fused = filtered.fuse(frame, estimator.fit(frame, truth))
        plain = replace(fused, covariance=np.zeros((9, 9)))
        stated = errors.added(
            plain, used, 0.0, past_information=filtered.past_information, keeps=filtered.keeps, learns=False
        )
        off_by = abs(fused.state.parameters[0] - 0.03)
        assert stated.parameter_std[0] == pytest.approx(off_by, rel=0.1), time


@pytest.mark.parametrize("other", ["depth", "outline"])
def test_what_holds_an_estimate_beside_its_points_holds_it_against_the_reference_s_error(
    model, estimator, pixels, other
):
    """By exact measurements: the estimate moves as stated."""
    true_points, n = bound(model, REFERENCE, pixels), len(pixels)
    seen, depths, of_outline = CAMERA.project(true_points.in_camera(LATER)), None, None
    beside, places, normals = rim(model, CAMERA, LATER)
    steps = np.diag([2e-4, 2e-3, 5e-4, 3e-4, 3e-4, 3e-4, 2e-4, 2e-4, 1e-3])
    for step in steps[[1, 3, 6, 8]]:
        off = moved(REFERENCE, step)
        points = bound(model, off, pixels)
        errors = errors_of(estimator, points, off, np.outer(step, step))
        frame = measured(points, seen)
        if other == "depth":
            depths = PointDepths(true_points.in_camera(LATER)[:, 2], np.full(n, 400.0), 1.0, 1e6)
            frame = replace(frame, depths=depths)
        else:
            joined, every = points.joined(beside), np.ones(n + len(places))
            no_normals = np.zeros((n, 2))
            frame = replace(measured(joined, np.vstack([seen, places])), normals=np.vstack([no_normals, normals]))
            of_outline = estimator.of_pixels(beside, places, every[n:], LATER, normals)[1]
        found = estimator.fit(frame, LATER)
        plain = replace(found, covariance=np.zeros((9, 9)), residuals=found.residuals[:n])
        stated = errors.added(plain, np.ones(n), 0.0, learns=False, depths=depths, of_outline=of_outline)
        off_by = np.concatenate(
            [
                found.state.parameters - LATER.parameters,
                pose_increment(LATER.camera_from_object, found.state.camera_from_object),
            ]
        )
        within = 0.1 * np.abs(off_by / estimator.scale).max()
        np.testing.assert_allclose(
            np.sqrt(np.diag(stated.covariance)) / estimator.scale, np.abs(off_by) / estimator.scale, atol=within
        )


def test_a_state_that_was_found_beside_an_outline_is_off_with_it_and_goes_on_being_so(model, pixels):
    """All edges are too far outwards, by which the state is too near, and in another frame both have it too near."""
    estimator = Estimator(model, CAMERA, EstimationOptions(huber_px=50.0, max_iterations=50, tolerance=1e-12))
    true_points, n, off_px = bound(model, REFERENCE, pixels), len(pixels), 0.3
    seen, (beside, places, normals) = CAMERA.project(true_points.in_camera(LATER)), rim(model, CAMERA, LATER)
    step = -1e-3 * np.eye(9)[8]
    points, every = bound(model, moved(REFERENCE, step), pixels), np.ones(n + len(places))

    def estimated(points, outwards):
        both = np.vstack([seen, places + outwards * normals]), np.vstack([np.zeros((n, 2)), normals])
        found = estimator.estimate(points.joined(beside), both[0], every, LATER, both[1])
        turned = pose_increment(LATER.camera_from_object, found.state.camera_from_object)
        return found, np.concatenate([found.state.parameters - LATER.parameters, turned])

    found, off = estimated(points, off_px)
    _, by_outline = estimated(true_points, off_px)
    own = Observations(beside, places, every[n:], normals, common_px=off_px)
    whole = LinearCost.about(own, LATER, np.zeros_like(places), CAMERA, 50.0, estimator.scale).in_common
    whole[1:] = 0.0  # no shift
    of_outline = estimator.of_pixels(beside, places, every[n:], LATER, normals)[1]
    part = BoundPart(slice(None), moved(REFERENCE, step), error_factors_of(np.outer(step, step), estimator.scale))
    plain = replace(found, covariance=np.outer(by_outline, by_outline), residuals=found.residuals[:n])
    away, within = [], 0.1 * np.abs(off / estimator.scale).max()
    for with_outline in (np.outer(step, [1.0, 0.0, 0.0]), None):
        errors = SystematicErrors(estimator, points, [part], WINDOW, with_outline=with_outline)
        stated = errors.added(plain, np.ones(n), 0.0, learns=False, of_outline=of_outline, whole=whole)
        away.append(np.sqrt(stated.covariance[8, 8]))
        if with_outline is not None:  # a view that this frame becomes gets the same of its state
            np.testing.assert_allclose(errors.with_outline[:, 0] / estimator.scale, off / estimator.scale, atol=within)
    assert away[0] == pytest.approx(abs(off[8]), rel=0.05)
    assert away[1] < 0.8 * away[0], "as if both told the distance independently"


#: Standard deviations of arch, skew, twist, rotation and translation, SI.
SPREAD = np.array([1.5e-3, 0.012, 3e-3, 3e-3, 3e-3, 3e-3, 1e-3, 1e-3, 3e-3])


def test_frames_that_expect_much_decide():
    misfit = ReferenceMisfit()
    for _ in range(50):
        misfit.learn(0.01**2, (0.1 * FLOOR_PX) ** 2)  # as in the reference view: nothing is told
    assert misfit.factor == pytest.approx(1.0, abs=0.02)
    for _ in range(10):
        misfit.learn(6.0 * 0.2**2, 0.2**2)
    assert misfit.factor == pytest.approx(6.0, rel=0.01)


def test_a_factor_below_one_narrows_nothing():
    misfit = ReferenceMisfit()
    for shown in (-1e-3, 2e-3):
        misfit.learn(shown, 0.3**2)
    assert misfit.factor == 1.0


@pytest.mark.parametrize("times", [1.0, 4.0])
def test_a_reference_that_is_off_more_than_stated_is_found_to_be(times):
    """Points are bound in references that are off by ``times`` the stated deviation, drawn at random."""
    model = bent_sheet_model(43, 31)
    estimator = Estimator(model, CAMERA, EstimationOptions(huber_px=50.0))
    nodes = np.random.default_rng(0).choice(len(model.nodes), 160, replace=False)
    nodes = nodes[(np.abs(model.nodes[nodes]) < [0.19, 0.13, 1.0]).all(axis=1)]
    seen = [
        CAMERA.project(s.camera_from_object.apply(model.positions(s.parameters)))[nodes] for s in (REFERENCE, LATER)
    ]
    used, rng, found = np.ones(len(nodes), dtype=bool), np.random.default_rng(1), []
    for _ in range(24):
        off = moved(REFERENCE, times * SPREAD * rng.standard_normal(9))
        surface, met = bind_pixels(model, CAMERA, view_of(model, CAMERA, off), seen[0])
        assert met.all()
        points = BoundPoints.from_surface(model, surface)
        errors = errors_of(estimator, points, off, np.diag(SPREAD**2))
        estimate = estimator.estimate(points, seen[1], used.astype(float), LATER)
        estimate = replace(estimate, covariance=np.zeros((9, 9)))
        for _ in range(20):
            stated = errors.added(estimate, used, 0.0)
        found.append(errors.reference_factor)
        unlearnt = errors_of(estimator, points, off, np.diag(SPREAD**2))
        before = unlearnt.added(estimate, used, 0.0, learns=False).covariance
        np.testing.assert_allclose(stated.covariance, errors.reference_factor**2 * before, rtol=1e-9)
    found = np.sqrt(np.mean(np.square(found)))
    # It is never below one, so that it is above one on average where all is as stated.
    assert found == pytest.approx(max(times, 1.25), rel=0.25)


def places(count: int):
    """Points on a curved surface, 300 by 200 pixels."""
    x, y = np.random.default_rng(3).uniform([[0.0], [0.0]], [[300.0], [200.0]], (2, count))
    return np.column_stack([x, y, 40.0 * np.sin(x / 90.0)])


def covariance_and_pairs(points):
    """Of each two points (p, p): how alike an error is, and whether they are compared."""
    spread = np.sqrt(np.sum(np.var(points, axis=0)))
    alike, pairs = np.zeros((2, len(points), len(points)))
    for i, one in enumerate(points):
        for j, other in enumerate(points):
            distance = np.linalg.norm(one - other)
            alike[i, j] = np.exp(-0.5 * (distance / (ALIKE_SHARE * spread)) ** 2)
            pairs[i, j] = distance < PAIR_SHARE * spread and np.abs(one - other).max() >= WINDOW
    return alike, pairs


def test_a_factor_of_few_columns_holds_the_covariance():
    points = places(400)
    factor = gaussian_factor(points, 70.0)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    assert np.abs(factor @ factor.T - np.exp(-0.5 * (apart / 70.0) ** 2)).max() < FACTOR_TOLERANCE
    assert factor.shape[1] < 60


@pytest.fixture
def case():
    """Points of which some do not count, their derivatives and weights."""
    rng, points = np.random.default_rng(5), places(90)
    used = rng.random(90) < 0.8
    jacobian = np.where(used[:, None, None], rng.standard_normal((90, 2, 4)) + 1.0, 0.0)
    scores = rng.uniform(0.5, 2.0, (90, 1, 1)) * jacobian
    return points, used, jacobian, scores


@pytest.mark.parametrize(("count", "most"), [(348, 256), (7, 7), (100, 2), (3, 10), (1, 5), (0, 5)])
def test_rows_are_spread_evenly_from_the_first_to_the_last(count, most):
    found, fewer = evenly(count, most), min(count, most)
    assert len(found) == fewer
    if fewer:
        assert (found[0], found[-1]) == (0, count - 1 if fewer > 1 else 0)
        np.testing.assert_allclose(found, np.arange(fewer) * (count - 1) / max(fewer - 1, 1), atol=1.0)
        assert (np.diff(found) > 0).all()


def test_what_pairs_have_in_common_is_the_mean_over_them(case):
    points, used, jacobian, _ = case
    common, (_, pairs) = SharedErrors(points, WINDOW), covariance_and_pairs(points)
    chosen = [(i, j) for i, j in np.argwhere(pairs) if used[i] and used[j]]
    assert common.n_pairs(used) == len(chosen)
    mean = sum(jacobian[i].T @ jacobian[j] for i, j in chosen) / (2 * len(chosen))
    np.testing.assert_allclose(common.in_common(jacobian, len(chosen)), mean, rtol=1e-9, atol=1e-12)


def test_the_gradient_of_an_alike_error_and_what_is_left_of_it(case):
    points, used, jacobian, scores = case
    common, (alike, pairs) = SharedErrors(points, WINDOW), covariance_and_pairs(points)
    both = np.kron(alike, np.eye(2))  # alike in the same coordinate of others
    rows, weighted = jacobian.reshape(-1, 4), scores.reshape(-1, 4)
    gradients = common.gradients(scores)
    expected = weighted.T @ both @ weighted
    np.testing.assert_allclose(gradients.T @ gradients, expected, rtol=0.02, atol=0.005 * expected.max())
    gain = np.linalg.inv(weighted.T @ rows)
    remover = np.eye(len(rows)) - rows @ gain @ weighted.T
    counted = np.kron(pairs * np.outer(used, used), np.eye(2)) > 0
    left = (remover @ both @ remover.T)[counted].mean()
    assert common.share_left(used, jacobian, gradients, gain, common.n_pairs(used)) == pytest.approx(left, abs=0.01)


def test_of_many_points_some_tell_what_all_have_in_common():
    points = places(4 * MOST_COMPARED)
    wave = np.column_stack([np.sin(points[:, 0] / 200.0), np.cos(points[:, 1] / 150.0)])[:, :, None]
    common, used = SharedErrors(points, WINDOW), np.ones(len(points), dtype=bool)
    spread = np.sqrt(np.sum(np.var(points, axis=0)))
    apart = points[:, None] - points[None]
    pairs = np.linalg.norm(apart, axis=2) < PAIR_SHARE * spread
    pairs &= np.abs(apart).max(axis=2) >= WINDOW
    expected = np.sum((wave[:, None, :, 0] * wave[None, :, :, 0]).sum(axis=2)[pairs]) / (2 * pairs.sum())
    assert common.in_common(wave, common.n_pairs(used))[0, 0] == pytest.approx(expected, rel=0.05)


def test_the_share_of_a_part_is_counted_on_what_the_whole_sees():
    """Five unknowns of sizes from 1e-3 to 10, one of which nothing tells of."""
    rng, scale = np.random.default_rng(0), np.array([1e-3, 10.0, 1.0, 0.1, 1.0])
    rows = rng.standard_normal((30, 5)) / scale
    rows[:, 4] = 0.0
    whole, part = rows.T @ rows, rows[:12].T @ rows[:12]
    scaled = np.linalg.pinv(whole * np.outer(scale, scale), 1e-10) @ (part * np.outer(scale, scale))
    assert trace_of_share(whole, part, scale) == pytest.approx(np.trace(scaled), rel=1e-9)
    assert trace_of_share(whole, whole, scale) == pytest.approx(4.0, rel=1e-9)
