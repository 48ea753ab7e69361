"""Fields outside the box of their parameters: bounded unless asked, else continued with their tangents."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam.model import SeparatedField
from tests.support.bent_sheet import bent_sheet_model
from tests.support.function_formats import FORMATS, make_functions

LOWER, UPPER = np.array([-1.0, 0.0, 0.0]), np.array([1.0, 1.0, 2.0])


@pytest.fixture(params=FORMATS)
def field(request):
    modes = np.random.default_rng(4).normal(size=(6, 5, 3))
    return SeparatedField(modes, make_functions(request.param, n_functions=6))


def test_a_bounded_field_is_that_of_the_nearest_state(field):
    found = field.value_and_sensitivities([1.4, 0.3, -0.2])
    nearest = field.value_and_sensitivities([1.0, 0.3, 0.0], outside="linear")
    for one, other in zip(found, nearest, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(field.value([1.4, 0.3, -0.2]), nearest[0])
    assert field.inside([1.4, 0.3, -0.2]).tolist() == [False, True, False]
    assert field.inside([1.0, 0.0, 2.0]).all()


@pytest.mark.parametrize("k", range(3))
def test_the_extension_is_smooth_across_each_face_of_the_box(field, k):
    """One-sided differences on both sides of a face agree with each other and with the sensitivity."""
    mu, h = np.array([0.2, 0.4, 0.7]), 1e-6
    for end, sign in ((UPPER[k], 1.0), (LOWER[k], -1.0)):
        mu[k] = end
        step = sign * h * np.eye(3)[k]
        values = [field.value(mu + i * step, outside="linear") for i in (-1, 0, 1)]
        inner, outer = (values[1] - values[0]) / h, (values[2] - values[1]) / h
        scale = np.abs(values[1]).max() * 10.0
        np.testing.assert_allclose(outer, inner, atol=1e-3 * scale)
        _, slopes = field.value_and_sensitivities(mu, outside="linear")
        np.testing.assert_allclose(sign * outer, slopes[k], atol=1e-7 * scale)


def test_the_extension_is_a_straight_line(field):
    mu, step = np.array([1.0, 0.4, 0.7]), np.array([0.8, 0.0, 0.0])
    near, middle, far = (field.value(mu + i * step, outside="linear") for i in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(middle, (near + far) / 2.0, rtol=1e-10, atol=1e-10)
    _, slopes = field.value_and_sensitivities(mu)
    np.testing.assert_allclose(far - near, 0.8 * slopes[0], rtol=1e-9, atol=1e-9)
    plain = field.value_and_sensitivities_numpy(mu + step, outside="linear")
    for one, other in zip(field.value_and_sensitivities(mu + step, outside="linear"), plain, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


def test_another_word_for_the_outside_is_refused(field):
    with pytest.raises(ValueError, match="'bounded' or 'linear', not 'wild'"):
        field.value([0.0, 0.0, 0.0], outside="wild")


def test_a_model_passes_the_choice_on():
    model = bent_sheet_model(5, 4)
    mu = np.array([0.075, 0.1, 0.1])
    at_end = np.array([0.060, 0.1, 0.1])
    np.testing.assert_array_equal(model.positions(mu), model.positions(at_end))
    np.testing.assert_array_equal(model.von_mises(mu, "top"), model.von_mises(at_end, "top"))
    assert model.inside(mu).tolist() == [False, True, True]
    # bending stress is proportional to the arch, so its tangent is exact
    only_arch, ratio = np.array([0.075, 0.0, 0.0]), 0.075 / 0.060
    expected = ratio * model.von_mises(np.array([0.060, 0.0, 0.0]), "top")
    np.testing.assert_allclose(model.von_mises(only_arch, "top", outside="linear"), expected, rtol=1e-9)
    assert not np.allclose(model.positions(mu, outside="linear"), model.positions(mu))
