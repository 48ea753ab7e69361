"""Errors of a model that are alike in neighbours, against SciPy's minimum with the whole covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.distance import cdist

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.tracking.estimator import Estimator, State
from morph_dslam.tracking.model_error import ALIKE_SHARE, with_model_error
from morph_dslam.tracking.noise import Observations
from morph_dslam.tracking.state import moved
from tests.support.bent_sheet import LENGTH, WIDTH, bent_sheet_model
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import CAMERA

TRUTH = State(
    np.array([0.03, 0.2, 0.05]),
    RigidTransform(rotation_exp(np.array([0.3, -0.2, 0.0])) @ np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6])),
)


def test_the_state_is_that_of_generalised_least_squares():
    """Points, some of which count along one direction only, and with different weights; one does not count."""
    rng = np.random.default_rng(3)
    model = bent_sheet_model(22, 16)
    points, estimator = bound_points(model, 80, rng), Estimator(model, CAMERA)
    rest = points.rest
    smooth = 1.5 * np.sin(rest[:, :2] / 0.07)
    pixels = CAMERA.project(points.in_camera(TRUTH)) + smooth + 0.3 * rng.standard_normal((80, 2))
    weights, normals, angles = rng.uniform(0.5, 2.0, 80), np.zeros((80, 2)), rng.uniform(0.0, 6.0, 20)
    normals[60:], weights[5] = np.column_stack([np.cos(angles), np.sin(angles)]), 0.0
    measured = Observations(points, pixels, weights, normals, np.eye(80))
    alone = replace(estimator.fit(measured, TRUTH), sigma_px=1.5)
    found = with_model_error(estimator, measured, alone, 0.3)

    # The root of covariance of all numbers: both coordinates of 59 points, and one of 20.
    rows = [(j, axis) for j in range(60) if j != 5 for axis in np.eye(2)] + [(j, normals[j]) for j in range(60, 80)]
    places, axes = np.array([j for j, _ in rows]), np.array([axis for _, axis in rows])
    length = ALIKE_SHARE * float(np.hypot(LENGTH, WIDTH))
    alike = (1.5**2 / 0.3**2 - 1.0) * np.exp(-0.5 * cdist(rest[places], rest[places]) ** 2 / length**2)
    root = np.linalg.cholesky(alike * (axes @ axes.T) + np.diag(1.0 / weights[places]))

    def whitened(step):
        residuals = CAMERA.project(points.in_camera(moved(TRUTH, step))) - pixels
        return np.linalg.solve(root, np.sum(residuals[places] * axes, axis=1))

    expected = moved(TRUTH, least_squares(whitened, np.zeros(9), x_scale="jac", xtol=1e-12, ftol=1e-12).x)
    other = np.abs(alone.state.parameters - expected.parameters)
    assert (np.abs(found.state.parameters - expected.parameters) < 0.1 * other + 1e-4).all()
    np.testing.assert_allclose(
        found.state.camera_from_object.translation, expected.camera_from_object.translation, atol=2e-4
    )
    whole = CAMERA.project(points.in_camera(found.state)) - pixels
    np.testing.assert_allclose(found.residuals[:60], whole[:60], atol=1e-9)


def test_without_errors_in_common_nothing_changes():
    model = bent_sheet_model(22, 16)
    points, estimator = bound_points(model, 80), Estimator(model, CAMERA)
    pixels = CAMERA.project(points.in_camera(TRUTH)) + 0.2 * np.random.default_rng(0).standard_normal((80, 2))
    measured = Observations(points, pixels, np.ones(80), np.zeros((80, 2)), np.eye(80))
    alone = estimator.fit(measured, TRUTH)
    assert with_model_error(estimator, measured, alone, alone.sigma_px) is alone
