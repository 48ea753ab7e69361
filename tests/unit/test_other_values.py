"""Values of a parameter that have the same shape: a bend by the square of its parameter, with either sign."""

import re

import numpy as np
import pytest

from morph_dslam.registration.landmarks import register_landmarks
from morph_dslam.registration.messages import OtherValues, read_warning
from morph_dslam.registration.other_values import FoundValues
from tests.support.rendered_sequence import CAMERA
from tests.unit.test_plausible_states import bent_by_the_square, clicked


def named(found):
    return [warning for warning in found.warnings if isinstance(warning, OtherValues)]


@pytest.mark.parametrize("a", [0.02, -0.025])
def test_both_signs_are_named_and_the_one_that_is_taken_first(a):
    found = register_landmarks(bent_by_the_square(), CAMERA, clicked(bent_by_the_square(), a, 5))
    (warning,) = named(found)
    first, other = (float(number) for number in re.findall(r"-?\d[\d.]*", warning.parameters))
    deviation = 1e3 * np.sqrt(found.covariance[0, 0])
    assert first == pytest.approx(1e3 * found.state.parameters[0], rel=1e-3)
    assert other == pytest.approx(-first, rel=1e-2)
    assert abs(first) == pytest.approx(1e3 * abs(a), abs=4.0 * deviation)
    assert found.ambiguous
    assert read_warning(warning.content()) == warning


def test_signs_that_the_deviation_covers_are_one():
    """Near zero the shape tells no sign, and the deviation says so."""
    model = bent_by_the_square()
    assert not any(named(register_landmarks(model, CAMERA, clicked(model, 0.0, seed))) for seed in range(20))


def test_values_a_turn_apart_are_one():
    """Of an angle 0.1 and 6.2 rad are 0.18 rad apart, two deviations; of a length they are 48."""
    one, other = (FoundValues(np.full(2, value), np.full(2, 0.09)) for value in (0.1, 6.2))
    assert one.apart(other, np.array([2.0 * np.pi, np.inf])).tolist() == [False, True]
