"""Changes of parameters that a model's error hides, for displacements in closed form."""

import numpy as np
import pytest

from morph_dslam.model.hidden_changes import HiddenChanges

ERROR = 1e-6


def found(value, place, products, least=ERROR**2):
    """For functions (m,) of parameters (f,), whose derivatives are central differences."""

    def rows(at):
        steps = 1e-6 * np.eye(len(at))
        return np.array([value(at), *((value(at + step) - value(at - step)) / 2e-6 for step in steps)])

    return HiddenChanges(rows, np.asarray(products), np.array(place), least).found()


@pytest.mark.parametrize("place", [0.0, 0.3, 1.0])
def test_one_parameter_of_no_effect_is_anywhere(place):
    """Of a uniform distribution the mean square about a place is (p^3 + (1 - p)^3) / 3."""
    hidden = found(lambda at: 0.1 * ERROR * at, [place], [[1.0]])
    assert hidden.spread == pytest.approx(np.array([[(place**3 + (1.0 - place) ** 3) / 3.0]]), rel=0.03)


@pytest.mark.parametrize("slope", [5.0, 20.0, 1000.0])
def test_a_parameter_that_derivatives_show_is_left_to_them(slope):
    """It is hidden for 1 / slope of its range to either side, and of that they leave 1 / slope^4."""
    hidden = found(lambda at: slope * ERROR * at, [0.5], [[1.0]])
    assert hidden.effects == pytest.approx(np.array([[slope * ERROR]]), rel=1e-3)
    assert 0.0 <= hidden.spread[0, 0] < 1.0 / slope**4


def test_a_valley_that_is_bent_is_followed():
    """Shapes by the product of two parameters, from 1 to 3 each: (2.2, 1.5) to (1.1, 3) are alike, and (3, 1.1)."""

    def value(at):
        one, other = 1.0 + 2.0 * at
        # A change of the error that is over after a hundredth of the range.
        return np.array([one * other, ERROR * np.tanh(50.0 * (at[0] - 0.6))])

    hidden = found(value, [0.6, 0.25], np.diag([1e-4, 0.1]))
    first, second = 1.1 + 0.2 * np.linspace(0.0, 9.5, 2001), None
    second = 3.3 / first
    away = np.stack([(first - 1.0) / 2.0 - 0.6, (second - 1.0) / 2.0 - 0.25])
    lengths = np.hypot(*np.gradient(away, axis=1))
    expected = (away * lengths) @ away.T / lengths.sum()
    assert np.sqrt(np.diag(hidden.spread)) == pytest.approx(np.sqrt(np.diag(expected)), rel=0.25)
    assert hidden.spread[0, 1] / np.sqrt(np.prod(np.diag(hidden.spread))) < -0.8


def test_what_steps_over_a_hump_would_reach_is_not_hidden():
    """A shape that comes back after a quarter of the range: only what is near is alike."""
    hidden = found(lambda at: np.array([np.sin(8.0 * np.pi * at[0]), np.cos(8.0 * np.pi * at[0])]), [0.5], np.eye(2))
    assert np.sqrt(hidden.spread[0, 0]) < 1e-3
