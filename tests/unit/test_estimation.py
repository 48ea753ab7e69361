"""The estimator against finite differences, scipy's least squares and Monte Carlo."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.tracking.estimator import BoundPoints, EstimationOptions, Estimator, Prior, State, moved
from morph_dslam.tracking.noise import Observations
from morph_dslam.tracking.reprojection import linearise, products_of_rows, project_with_jacobian
from morph_dslam.tracking.state import pose_increment
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points

CAMERA = Camera(640, 480, 528.0, 520.0, 320.0, 240.0)
POSE = RigidTransform(
    rotation_exp(np.array([0.2, -0.3, 0.05])) @ np.diag([1.0, -1.0, -1.0]), np.array([0.02, -0.01, 0.6])
)
TRUTH = State(np.array([0.035, 0.3, 0.1]), POSE)


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model()


@pytest.fixture(scope="module")
def points(model):
    return bound_points(model, 150)


def arguments(points, state, pixels, weights, huber=1.5, normals=None):
    rows, pose = points.field.functions.rows(state.parameters), state.camera_from_object
    normals = np.zeros((len(points), 2)) if normals is None else normals
    return (
        rows, pose.rotation, pose.translation, points.rest, points.field.modes, CAMERA.intrinsics, pixels,
        weights, normals, huber,
    )  # fmt: skip


def observed(points, state, noise, rng):
    return CAMERA.project(points.in_camera(state)) + noise * rng.standard_normal((len(points), 2))


def start_near(rng, scale=1.0):
    step = scale * np.concatenate([[0.01, -0.2, 0.08], 0.1 * rng.standard_normal(3), [0.02, -0.01, 0.03]])
    return moved(TRUTH, step)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 13])
def test_products_of_rows_are_those_of_the_matrix(count):
    rows = np.random.default_rng(count).standard_normal((count, 7))
    np.testing.assert_allclose(products_of_rows(rows), rows @ rows.T, rtol=0.0, atol=1e-13)


def test_jacobian_agrees_with_finite_differences(points):
    _, jacobian = project_with_jacobian(*arguments(points, TRUTH, None, None)[:6])
    for k in range(9):
        step = np.zeros(9)
        step[k] = 1e-6
        ahead = CAMERA.project(points.in_camera(moved(TRUTH, step)))
        behind = CAMERA.project(points.in_camera(moved(TRUTH, -step)))
        np.testing.assert_allclose(jacobian[:, :, k], (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-4)


def assert_derivatives(points, state, pixels, weights, normals=None):
    """The gradient is the slope of the cost; where all pixels are met, the Hessian is that of the gradient."""

    def sides(at, target, step):
        return (
            linearise(*arguments(points, moved(at, sign * step), target, weights, normals=normals)) for sign in (1, -1)
        )

    _, _, gradient, _ = linearise(*arguments(points, state, pixels, weights, normals=normals))
    exact = CAMERA.project(points.in_camera(state))
    _, hessian, _, _ = linearise(*arguments(points, state, exact, weights, normals=normals))
    for k, unit in enumerate(np.eye(9)):
        ahead, behind = sides(state, pixels, 1e-7 * unit)
        assert gradient[k] == pytest.approx((ahead[0] - behind[0]) / 2e-7, rel=1e-4, abs=1e-2)
        ahead, behind = sides(state, exact, 1e-6 * unit)
        slopes = (ahead[2] - behind[2]) / 2e-6
        np.testing.assert_allclose(hessian[k], slopes, rtol=1e-5, atol=1e-8 * np.abs(hessian).max())


def directions(count, rng):
    """Unit normals for every other point, none for the rest."""
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    normals[::2] = 0.0
    return normals


def test_points_with_a_normal_count_only_along_it(points):
    """Moving their pixels across the normal changes nothing; the gradient is that of the cost."""
    rng = np.random.default_rng(11)
    normals = directions(len(points), rng)
    pixels, weights = observed(points, TRUTH, 1.0, rng), np.ones(len(points))
    state = start_near(rng, 0.3)
    across = np.column_stack([-normals[:, 1], normals[:, 0]])
    slid = pixels + 7.0 * across
    first = linearise(*arguments(points, state, pixels, weights, normals=normals))
    second = linearise(*arguments(points, state, slid, weights, normals=normals))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())
    assert_derivatives(points, state, pixels, weights, normals)


def test_normals_alone_determine_the_state(model, points):
    """One number a point, in all directions: exact measurements slid along the outline give it back."""
    rng = np.random.default_rng(12)
    angle = rng.uniform(0.0, 2.0 * np.pi, len(points))
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    slid = observed(points, TRUTH, 0.0, rng) + rng.normal(size=(len(points), 1)) * np.column_stack(
        [-normals[:, 1], normals[:, 0]]
    )
    found = Estimator(model, CAMERA).estimate(points, slid, np.ones(len(points)), start_near(rng, 0.3), normals)
    np.testing.assert_allclose(found.state.parameters, TRUTH.parameters, atol=1e-6)


def test_what_an_outline_is_off_by_as_a_whole_is_in_the_deviations(model, points):
    """Covariance of estimates over draws of it and of noise: a shift in either direction, and one outwards."""
    rng, sigma, px = np.random.default_rng(14), 0.2, 0.5
    normals, weights = directions(len(points), rng), np.ones(len(points))
    exact, estimator, away = CAMERA.project(points.in_camera(TRUTH)), Estimator(model, CAMERA), []

    def seen(pixels):
        return Observations(points, pixels, weights, normals, np.eye(len(points)), common_px=px)

    for _ in range(400):
        shared = px * rng.standard_normal(3)
        off = (shared[0] + normals @ shared[1:])[:, None] * normals + sigma * rng.standard_normal(exact.shape)
        found = estimator.fitted(seen(exact + off), TRUTH).state
        pose = pose_increment(TRUTH.camera_from_object, found.camera_from_object)
        away.append(np.concatenate([found.parameters - TRUTH.parameters, pose]))
    linear = estimator.linear(seen(exact), estimator.fit(seen(exact), TRUTH))
    stated = linear.inverse @ (sigma**2 * linear.spread + linear.in_common.T @ linear.in_common) @ linear.inverse
    # Where the stated covariance is one, a mean square of 400 draws is off by 7 %, a standard deviation.
    whitened = np.linalg.solve(np.linalg.cholesky(stated), np.transpose(away))
    np.testing.assert_allclose(np.mean(whitened**2, axis=1), 1.0, atol=0.22)
    assert np.mean(whitened**2) == pytest.approx(1.0, abs=0.08)


def test_points_behind_the_camera_are_refused(points):
    behind = State(TRUTH.parameters, RigidTransform(POSE.rotation, np.array([0.0, 0.0, -1.0])))
    given = arguments(points, behind, np.zeros((len(points), 2)), np.ones(len(points)))
    assert all(np.isnan(values).all() for values in project_with_jacobian(*given[:6]))
    cost, hessian, _, residuals = linearise(*given)
    assert cost == pytest.approx(1e9 * len(points))
    assert np.isnan(residuals).all()
    assert not hessian.any()


def test_gradient_is_that_of_the_huber_cost(points):
    rng = np.random.default_rng(2)
    pixels, weights = observed(points, TRUTH, 1.0, rng), rng.uniform(0.0, 2.0, len(points))
    assert_derivatives(points, start_near(rng, 0.3), pixels, weights)


def test_exact_pixels_give_the_exact_state_back(model, points):
    rng = np.random.default_rng(3)
    found = Estimator(model, CAMERA).estimate(
        points, observed(points, TRUTH, 0.0, rng), np.ones(len(points)), start_near(rng)
    )
    assert found.converged
    np.testing.assert_allclose(found.state.parameters, TRUTH.parameters, atol=1e-7)
    np.testing.assert_allclose(found.state.camera_from_object.matrix, POSE.matrix, atol=1e-7)
    assert not found.at_bound.any()


def scipy_minimum(points, pixels, start, held=0, huber=2.0):
    """Scipy's minimum of the same cost, the first ``held`` parameters kept; the state and the cost."""

    def state(step):
        return moved(start, np.concatenate([np.zeros(held), step]))

    def root_of_loss(step):
        """sqrt(2 rho(|r|)): its sum of squares is twice Huber's cost of the residuals' lengths."""
        length = np.linalg.norm(CAMERA.project(points.in_camera(state(step))) - pixels, axis=1)
        return np.sqrt(np.where(length <= huber, length**2, 2 * huber * (length - 0.5 * huber)))

    scale = [0.05, 0.5, 0.3, 1, 1, 1, 0.5, 0.5, 0.5][held:]
    tight = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14, "max_nfev": 500}
    result = least_squares(root_of_loss, np.zeros(9 - held), x_scale=scale, jac="3-point", **tight)
    return state(result.x), result.cost


def test_same_minimum_as_scipy_on_the_same_loss(model, points):
    rng = np.random.default_rng(4)
    pixels = observed(points, TRUTH, 0.8, rng)
    pixels[:30] += rng.uniform(-40, 40, (30, 2))
    state, cost = scipy_minimum(points, pixels, TRUTH)
    found = Estimator(model, CAMERA, EstimationOptions(huber_px=2.0, tolerance=1e-12)).estimate(
        points, pixels, np.ones(len(points)), start_near(rng)
    )
    assert found.cost == pytest.approx(cost, rel=1e-4)
    np.testing.assert_allclose(found.state.parameters, state.parameters, atol=1e-3)


def test_outliers_hardly_move_the_estimate(model, points):
    rng = np.random.default_rng(5)
    pixels = observed(points, TRUTH, 0.3, rng)
    pixels[:30] += rng.uniform(-60, 60, (30, 2))
    found = Estimator(model, CAMERA, EstimationOptions(huber_px=2.0)).estimate(
        points, pixels, np.ones(len(points)), start_near(rng)
    )
    error = np.linalg.norm(points.in_camera(found.state) - points.in_camera(TRUTH), axis=1)
    assert error.mean() < 1e-3
    assert found.sigma_px == pytest.approx(0.3, rel=0.5)


def test_points_of_zero_weight_do_not_count(model, points):
    rng = np.random.default_rng(6)
    pixels, weights = observed(points, TRUTH, 0.0, rng), np.ones(len(points))
    pixels[::3] += 100.0
    weights[::3] = 0.0
    found = Estimator(model, CAMERA).estimate(points, pixels, weights, start_near(rng))
    np.testing.assert_allclose(found.state.parameters, TRUTH.parameters, atol=1e-7)


def test_parameters_stay_in_the_box_and_are_flagged(model, points):
    outside = State(np.array([0.075, 0.3, 0.1]), POSE)
    rng = np.random.default_rng(7)
    pixels = observed(points, outside, 0.0, rng)
    found = Estimator(model, CAMERA, EstimationOptions(huber_px=2.0)).estimate(
        points, pixels, np.ones(len(points)), start_near(rng)
    )
    assert found.state.parameters[0] == pytest.approx(0.060)
    assert found.at_bound.tolist() == [True, False, False]
    # Scipy, started there with the held parameter kept, finds nothing lower nearby.
    state, cost = scipy_minimum(points, pixels, found.state, held=1)
    assert found.cost == pytest.approx(cost, rel=1e-5)
    np.testing.assert_allclose(found.state.parameters, state.parameters, atol=1e-3)


def test_unseen_direction_neither_moves_nor_looks_certain(model, points):
    """At arch = 0 the skew has no effect at all."""
    flat = State(np.array([0.0, 0.0, 0.1]), POSE)
    rng = np.random.default_rng(8)
    pixels = observed(points, flat, 0.1, rng)
    start = State(np.array([0.005, 0.0, 0.05]), POSE)
    found = Estimator(model, CAMERA).estimate(points, pixels, np.ones(len(points)), start)
    assert np.isfinite(found.state.parameters).all()
    assert abs(found.state.parameters[0]) < 1e-3
    assert found.parameter_std[1] > 0.3
    assert found.parameter_std[0] < 1e-3


def test_too_few_points_give_infinite_deviations(model, points):
    few = BoundPoints.from_surface(model, points.surface.take(np.arange(3)))
    rng = np.random.default_rng(9)
    found = Estimator(model, CAMERA).estimate(few, observed(few, TRUTH, 0.0, rng), np.ones(3), TRUTH)
    assert np.isinf(found.parameter_std).all()


@pytest.mark.parametrize(("huber", "directed"), [(1.0, False), (20.0, False), (20.0, True)])
def test_covariance_agrees_with_monte_carlo(model, points, huber, directed):
    estimator = Estimator(model, CAMERA, EstimationOptions(huber_px=huber))
    rng = np.random.default_rng(10)
    normals = directions(len(points), np.random.default_rng(11)) if directed else np.zeros((len(points), 2))
    estimates = [
        estimator.estimate(points, observed(points, TRUTH, 0.8, rng), np.ones(len(points)), TRUTH, normals)
        for _ in range(300)
    ]
    parameters = np.array([estimate.state.parameters for estimate in estimates])
    translations = np.array([estimate.state.camera_from_object.translation for estimate in estimates])
    stated = np.mean([estimate.parameter_std for estimate in estimates], axis=0)
    np.testing.assert_allclose(stated, parameters.std(axis=0), rtol=0.15)
    stated = np.mean([estimate.pose_std[3:] for estimate in estimates], axis=0)
    np.testing.assert_allclose(stated, translations.std(axis=0), rtol=0.15)
    assert np.mean([estimate.sigma_px for estimate in estimates]) == pytest.approx(0.8, rel=0.05)


def test_several_starts_return_the_best_first(model, points):
    rng = np.random.default_rng(11)
    pixels = observed(points, TRUTH, 0.2, rng)
    mirrored = State(
        TRUTH.parameters * [-1, 1, 1],
        RigidTransform(rotation_exp(np.array([0.0, 0.0, 2.0])) @ POSE.rotation, POSE.translation),
    )
    found = Estimator(model, CAMERA).estimate_from(points, pixels, np.ones(len(points)), [mirrored, TRUTH])
    assert found[0].cost <= found[1].cost
    np.testing.assert_allclose(found[0].state.parameters, TRUTH.parameters, atol=5e-3)


def pose_prior(information, away=(0.0,) * 6):
    """A prior of the pose alone, its mean ``away`` from the truth."""
    pose = moved(TRUTH, np.concatenate([np.zeros(3), away])).camera_from_object
    return Prior(np.zeros(3), np.zeros((3, 3)), pose, information)


@pytest.mark.parametrize("turn", [0.0, 1e-5, 0.3, 2.0])
def test_gradient_of_the_prior_is_that_of_its_cost(turn):
    rng = np.random.default_rng(13)
    root = rng.standard_normal((6, 6))
    prior = Prior(
        np.array([0.01, 0.1, 0.0]), np.diag([4.0, 2.0, 1.0]),
        moved(TRUTH, np.concatenate([np.zeros(3), turn * np.array([0.6, -0.5, 0.62]), [0.01, 0.2, -0.1]])
        ).camera_from_object, root @ root.T,
    )  # fmt: skip
    _, hessian, gradient = prior.terms(TRUTH)
    for k, unit in enumerate(np.eye(9)):
        ahead, behind = prior.terms(moved(TRUTH, 1e-6 * unit)), prior.terms(moved(TRUTH, -1e-6 * unit))
        assert gradient[k] == pytest.approx((ahead[0] - behind[0]) / 2e-6, rel=1e-6, abs=1e-7)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12)
    assert np.linalg.eigvalsh(hessian)[0] > -1e-9


def test_cost_of_the_pose_prior_is_quadratic_in_the_increment():
    increment = np.array([0.3, -0.2, 0.1, 0.02, 0.01, -0.03])
    information = np.diag([1.0, 2.0, 3.0, 40.0, 50.0, 60.0])
    cost = pose_prior(information, -increment).terms(TRUTH)[0]
    assert cost == pytest.approx(0.5 * increment @ information @ increment)


def test_sure_prior_of_the_pose_pins_it(model, points):
    """Also where the images say otherwise; the parameters are then those of the given pose."""
    rng = np.random.default_rng(14)
    pixels, weights = observed(points, TRUTH, 0.5, rng), np.ones(len(points))
    away = np.array([0.02, -0.01, 0.03, 0.002, 0.001, -0.004])
    prior = pose_prior(1e12 * np.eye(6), away)
    found = Estimator(model, CAMERA).estimate(points, pixels, weights, start_near(rng, 0.3), prior=prior)
    np.testing.assert_allclose(found.state.camera_from_object.matrix, prior.pose.matrix, atol=1e-6)
    assert (found.pose_std < 1e-5).all()


def test_weak_prior_of_the_pose_is_weighed_against_the_images(model, points):
    """The weighted mean of two Gaussians, with the images' information from numerical derivatives."""
    pixels, weights = CAMERA.project(points.in_camera(TRUTH)), np.ones(len(points))
    jacobian = np.stack(
        [
            CAMERA.project(points.in_camera(moved(TRUTH, 1e-6 * unit)))
            - CAMERA.project(points.in_camera(moved(TRUTH, -1e-6 * unit)))
            for unit in np.eye(9)
        ]
    ).reshape(9, -1) / 2e-6  # fmt: skip
    images, known = jacobian @ jacobian.T, np.zeros((9, 9))
    known[8, 8] = 3e6
    away = np.array([0, 0, 0, 0, 0, 0, 0, 0, 2e-4])
    expected = np.linalg.solve(images + known, known @ away)
    estimator = Estimator(model, CAMERA, EstimationOptions(tolerance=1e-13))
    found = estimator.estimate(points, pixels, weights, TRUTH, prior=pose_prior(known[3:, 3:], away[3:])).state
    np.testing.assert_allclose(found.parameters - TRUTH.parameters, expected[:3], rtol=0.05, atol=1e-6)
    moved_by = found.camera_from_object.translation - POSE.translation
    assert 1e-5 < moved_by[2] < 1.9e-4
    assert moved_by[2] == pytest.approx(expected[8], rel=0.02)


def test_joined_priors_are_their_weighted_mean_in_any_units():
    """A modulus in pascals beside a height in metres; the third parameter is known to neither."""
    first = Prior(np.array([5e4, 0.02, 7.0]), np.diag([1e-10, 1e11, 0.0]))
    second = Prior(np.array([7e4, 0.0, 0.0]), np.diag([3e-10, 0.0, 0.0]), POSE, np.eye(6))
    both = first.joined(second)
    np.testing.assert_allclose(both.mean, [6.5e4, 0.02, 0.0])
    assert both.pose is POSE
    state = State(np.array([6e4, 0.021, 3.0]), POSE)
    apart = [first.terms(state)[2] + second.terms(state)[2], both.terms(state)[2]]
    np.testing.assert_allclose(apart[0], apart[1], rtol=1e-9)
