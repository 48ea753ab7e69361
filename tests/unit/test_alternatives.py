"""The plain alternatives that the tracker is compared with are what they say."""

import importlib
import sys

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform
from morph_dslam.tracking.estimator import Estimator, State, moved
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points
from tests.support.real_data import ROOT

MODEL = bent_sheet_model(22, 16)
FUNCTIONS = MODEL.displacement.functions
MU = np.array([0.021, -0.17, 0.08])


@pytest.fixture(scope="module")
def alternatives():
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        return importlib.import_module("alternatives")
    finally:
        sys.path.pop(0)


def test_differences_of_the_field_are_its_derivatives(alternatives):
    found = alternatives.Differenced(FUNCTIONS).rows(MU)
    np.testing.assert_allclose(found, FUNCTIONS.rows(MU), rtol=1e-4, atol=1e-7)
    # Also at the end of the box, where there are values on one side only.
    end = MODEL.upper
    np.testing.assert_allclose(alternatives.Differenced(FUNCTIONS).rows(end), FUNCTIONS.rows(end), rtol=1e-3, atol=1e-6)


def test_linear_elastic_model_is_the_tangent(alternatives):
    linear = alternatives.Linearised(FUNCTIONS, MODEL.default)
    np.testing.assert_allclose(linear.rows(MODEL.default), FUNCTIONS.rows(MODEL.default))
    step = np.array([0.01, 0.1, 0.05])
    values = [linear.rows(MODEL.default + share * step)[0] for share in (0.0, 0.5, 1.0)]
    np.testing.assert_allclose(values[1], 0.5 * (values[0] + values[2]), atol=1e-15)


def test_hat_functions_are_exact_at_their_values_and_straight_between(alternatives):
    hats = alternatives.Hats(FUNCTIONS, 4)
    axes = [np.linspace(low, high, 4) for low, high in zip(MODEL.lower, MODEL.upper, strict=True)]
    node = np.array([axis[index] for axis, index in zip(axes, (1, 2, 0), strict=True)])
    np.testing.assert_allclose(hats.rows(node)[0], FUNCTIONS.rows(node)[0], atol=1e-12)
    other = node.copy()
    other[1] = axes[1][3]
    middle = 0.5 * (FUNCTIONS.rows(node)[0] + FUNCTIONS.rows(other)[0])
    np.testing.assert_allclose(hats.rows(0.5 * (node + other))[0], middle, atol=1e-12)
    for k, unit in enumerate(np.eye(3)):
        slope = (hats.rows(MU + 1e-6 * unit)[0] - hats.rows(MU - 1e-6 * unit)[0]) / 2e-6
        np.testing.assert_allclose(hats.rows(MU)[1 + k], slope, rtol=1e-5, atol=1e-8)


def test_differences_of_the_residual_give_the_normal_equations(alternatives):
    rng, camera = np.random.default_rng(0), Camera(640, 480, 528.0, 528.0, 320.0, 240.0)
    points = bound_points(MODEL, 40, rng)
    truth = State(MU, RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6])))
    pixels = camera.project(points.in_camera(truth)) + rng.standard_normal((40, 2))
    state = moved(truth, np.full(9, 5e-3))
    exact = Estimator(MODEL, camera).evaluate(points, pixels, np.ones(40), state)
    found = alternatives.ByDifferences(MODEL, camera).evaluate(points, pixels, np.ones(40), state)
    for a, b in zip(found, exact, strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-3, atol=1e-4 * np.abs(b).max())
