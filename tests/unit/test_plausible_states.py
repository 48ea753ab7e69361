"""Deviations of a registration whose cost is no parabola, against the likelihood by SciPy's fits of the pose."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.optimize import least_squares

from morph_dslam.io.landmarks import Landmarks
from morph_dslam.model import Parameter, SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.registration.landmarks import register_landmarks
from morph_dslam.registration.messages import ShapeAgainstPose
from tests.support.rendered_sequence import CAMERA
from tests.support.stretched_block import SIZE, stretched_block_model

#: Range of the parameter, and standard deviation of a pixel.
MOST, NOISE = 0.03, 1.0
ROTATION, TRANSLATION = np.array([0.4, -0.3, 0.1]), np.array([-0.03, -0.01, 0.5])


def bent_by_the_square():
    """u = (0, 0, a^2 / 10 mm (x / length)^2): near a = 0 the shape hardly changes with a."""
    block = stretched_block_model()
    mode = np.zeros((1, len(block.nodes), 3))
    mode[0, :, 2] = (block.nodes[:, 0] / SIZE[0]) ** 2 / 0.01
    half = 0.5 * MOST**2  # a^2 = MOST^2 (1 + T_2(a / MOST)) / 2
    square = ParameterFunctions(
        np.array([-MOST]), np.array([MOST]), np.array([[0], [2]], dtype=np.int64), np.array([[half], [half]])
    )
    return replace(
        block,
        parameters=(Parameter("a", "length", "mm", -MOST, MOST, 0.0, ""),),
        displacement=SeparatedField(mode, square),
        stresses={},
        strain=None,
    )


def shape(model, a):
    return model.nodes + np.outer((model.nodes[:, 0] / SIZE[0]) ** 2, [0.0, 0.0, a**2 / 0.01])


def seen(points, pose):
    return cv2.projectPoints(points, pose[:3], pose[3:], CAMERA.matrix, None)[0][:, 0]


def clicked(model, a, seed):
    exact = seen(shape(model, a), np.concatenate([ROTATION, TRANSLATION]))
    return Landmarks(model.nodes, exact + NOISE * np.random.default_rng(seed).standard_normal(exact.shape))


def likeliest(model, pixels, a):
    """Half the sum of squared residuals, px^2, of the best pose with a value of the parameter."""
    start = np.concatenate([ROTATION, TRANSLATION])
    return least_squares(lambda pose: (seen(shape(model, a), pose) - pixels).ravel(), start).cost


def test_the_variance_is_that_of_the_likelihood():
    model = bent_by_the_square()
    landmarks = clicked(model, 0.0, 3)
    found = register_landmarks(model, CAMERA, landmarks)
    a, variance = found.state.parameters[0], found.facts["sigma_px"] ** 2
    values = np.linspace(-MOST, MOST, 201)
    costs = np.array([likeliest(model, landmarks.pixels, value) for value in values])
    density = np.exp((costs.min() - costs) / variance)
    expected = trapezoid(density * (values - a) ** 2, values) / trapezoid(density, values)
    assert found.covariance[0, 0] == pytest.approx(expected, rel=0.02)
    assert any(isinstance(warning, ShapeAgainstPose) for warning in found.warnings)


def test_deviations_contain_the_truth_where_the_cost_is_flat():
    model = bent_by_the_square()
    found = [register_landmarks(model, CAMERA, clicked(model, 0.0, seed)) for seed in range(30)]
    off = np.array([each.state.parameters[0] / np.sqrt(each.covariance[0, 0]) for each in found])
    assert np.mean(np.abs(off) > 2.0) < 0.1
    assert np.abs(off).max() < 3.0


def test_where_the_cost_is_a_parabola_nothing_is_wider():
    """Far from zero a^2 is a straight line: the linear theory of least squares holds about each of both signs."""
    model = bent_by_the_square()
    landmarks = clicked(model, 0.02, 5)
    found = register_landmarks(model, CAMERA, landmarks)
    start = np.concatenate([ROTATION, TRANSLATION, [0.02]])
    fit = least_squares(lambda x: (seen(shape(model, x[6]), x[:6]) - landmarks.pixels).ravel(), start)
    linear = np.linalg.inv(fit.jac.T @ fit.jac)[6, 6] * found.facts["sigma_px"] ** 2
    assert abs(found.state.parameters[0]) == pytest.approx(fit.x[6], rel=1e-3)
    assert found.covariance[0, 0] == pytest.approx(linear, rel=0.1)
    assert not any(isinstance(warning, ShapeAgainstPose) for warning in found.warnings)
