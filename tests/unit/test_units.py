"""Units against their definitions."""

from math import pi

import pytest

from morph_dslam.errors import StudyError
from morph_dslam.units import from_si, to_si


@pytest.mark.parametrize(
    ("value", "unit", "quantity", "si"),
    [
        (297.0, "mm", "length", 0.297),
        (29.7, "cm", "length", 0.297),
        (3.0, "GPa", "stress", 3e9),
        (50.1, "kPa", "stress", 50100.0),
        (180.0, "deg", "angle", pi),
        (0.3, "1", "ratio", 0.3),
    ],
)
def test_units_follow_their_definitions_both_ways(value, unit, quantity, si):
    assert to_si(value, unit, quantity) == pytest.approx(si, rel=1e-15)
    assert from_si(si, unit, quantity) == pytest.approx(value, rel=1e-15)


def test_a_unit_of_another_quantity_is_refused_with_those_that_fit():
    with pytest.raises(StudyError, match="'mm' is not a unit of angle; use one of rad, deg"):
        to_si(1.0, "mm", "angle")
