"""Expressions of parameters in study files, and units."""

import re
from math import pi

import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.amplitudes import Amplitude
from morph_dslam.model import Parameter
from morph_dslam.studies.affine import Amplitudes, read_affine
from morph_dslam.units import from_si, read_quantity, to_si

PARAMETERS = (
    Parameter("load", "pressure", "kPa", 0.0, 5e3, 0.0),
    Parameter("share", "ratio", "1", 0.0, 1.0, 0.0),
    Parameter("tilt", "angle", "deg", -1.0, 1.0, 0.0),
)
MU = np.array([2000.0, 0.25, 0.5])


@pytest.mark.parametrize(
    ("text", "quantity", "value"),
    [
        ("3 MPa", "stress", 3e6),
        ("-3 MPa", "stress", -3e6),
        ("1.5 bar + 200 mbar - load", "pressure", 1.68e5),
        (0.45, "ratio", 0.45),
        ("0.45", "ratio", 0.45),
        ("load", "stress", 2000.0),
        ("-load", "pressure", -2000.0),
        ("-1 * load", "pressure", -2000.0),
        ("0.5 * load + 2 kPa", "pressure", 3000.0),
        ("2 kPa - 0.5*load", "pressure", 1000.0),
        ("10 N * share", "force", 2.5),
        ("1e-2 m * share - 1 mm", "length", 0.0015),
        ("1 - share", "ratio", 0.75),
        ("90 deg - 2 * tilt", "angle", np.pi / 2 - 1.0),
        ("2.5e-1 N/mm3", "stiffness per area", 2.5e8),
        ("7 g/cm3", None, 7000.0),
        ("load + 1 kPa", None, 3000.0),
        ("3 mm * load / 4 kPa + 1 mm", "length", 0.0025),
        ("-2 * tilt / 0.5 rad", "ratio", -2.0),
        ("load / 1 kPa - share", "ratio", 1.75),
        ("load / 4 Pa", None, 500.0),
    ],
)
def test_values(text, quantity, value):
    assert read_affine(text, quantity, PARAMETERS)(MU) == pytest.approx(value, rel=1e-14)


def test_expression_is_the_same_function_of_other_variables():
    affine = read_affine("3 kPa + 0.5 * load + 1 kPa * share", "stress", PARAMETERS)
    assert affine.slopes == (0.5, 1000.0, 0.0)
    assert affine.expression(MU.tolist()) == pytest.approx(affine(MU), rel=1e-15)
    assert read_affine("3 kPa", "stress", PARAMETERS).expression(["not", "looked", "at"]) == 3000.0


@pytest.mark.parametrize(
    ("text", "quantity", "message"),
    [
        ("3", "stress", r"'3' lacks a unit of stress: Pa, kPa"),
        (3.0, "length", r'with its unit, "3\.0 mm" for example'),
        (True, "ratio", r"True is not a number"),
        ("3 mm", "stress", r"'mm' is not a unit of stress"),
        ("weight", "stress", r"names 'weight', which is no parameter; the parameters are load, share, tilt"),
        ("tilt", "stress", r'of angle, and stress is wanted here: write "10 Pa \* tilt / 1 deg" for example'),
        ("2 * load", "ratio", r'of pressure, and ratio is wanted here: write "load / 1 kPa" for example'),
        ("tilt / 100 mm2", "stress", r"'mm2' is not a unit of angle.* its own kind; write \"10 Pa \* tilt / 1 deg\""),
        ("3 kPa * load", "stress", r"only a parameter without unit can be multiplied by 3 kPa"),
        ("3 kPa * load", "stress", r'make it one with "load / 1 kPa"'),
        ("3 mm * load / 2 s", "length", r"'s' is not a unit of pressure"),
        ("3 mm / 2 mm", "length", r"only a parameter can be divided"),
        ("load / 0 kPa", "ratio", r"not by zero"),
        ("load / 2", "ratio", r"is not a number with a unit, nor a sum"),
        ("tilt / 2 deg", "angle", r"the parameter tilt is of ratio, and angle is wanted"),
        ("load * load", "stress", r"multiplies by 'load', which is no amplitude of \[time\]; the study has none"),
        ("3 MPa 4", "stress", r"is not a number with a unit, nor a sum"),
        ("", "stress", r"an empty text"),
        ("load +", "stress", r"is not a number with a unit, nor a sum"),
    ],
)
def test_mistakes(text, quantity, message):
    with pytest.raises(StudyError, match=message):
        read_affine(text, quantity, PARAMETERS)


@pytest.mark.parametrize(
    ("text", "quantity"),
    [
        ("share", "angle"),
        ("-9.81 * share", "acceleration"),
        ("tilt", "stress"),
        ("2 * load", "ratio"),
        ("load/2", "stress"),
    ],
)
def test_what_messages_tell_to_write_can_be_read(text, quantity):
    with pytest.raises(StudyError) as refused:
        read_affine(text, quantity, PARAMETERS)
    (advised,) = re.findall('"(.+?)"', str(refused.value))
    assert not read_affine(advised, quantity, PARAMETERS).fixed


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


@pytest.mark.parametrize(
    ("text", "quantity", "si"),
    [("20 mN", "force", 0.02), (" -1.5e1mm ", "length", -0.015), ("0.3", "ratio", 0.3), ("30 deg", "angle", pi / 6)],
)
def test_a_quantity_in_a_text(text, quantity, si):
    assert read_quantity(text, quantity) == pytest.approx(si, rel=1e-15)


@pytest.mark.parametrize("text", ["20", "mN", "20 mm", "2 0 mN", "nan mN", ""])
def test_a_text_that_is_no_force_is_refused(text):
    with pytest.raises(StudyError, match="force"):
        read_quantity(text, "force")


def test_a_unit_of_another_quantity_is_refused_with_those_that_fit():
    with pytest.raises(StudyError, match="'mm' is not a unit of angle; use one of rad, deg"):
        to_si(1.0, "mm", "angle")


RAMP = Amplitudes(2, {"ramp": Amplitude((0.0, 1.0), (0.0, 3.0))})


@pytest.mark.parametrize(
    ("text", "quantity", "value", "used"),
    [
        ("load * ramp", "pressure", 3000.0, {0, 2}),
        ("0.5 * load * ramp + 2 kPa", "stress", 3500.0, {0, 2}),
        ("10 N * share * ramp", "force", 3.75, {1, 2}),
        ("16 mm * ramp", "length", 0.024, {2}),
        ("3 mm * load / 4 kPa * ramp - 1 mm", "length", 0.00125, {0, 2}),
        ("1 - ramp", "ratio", -0.5, {2}),
    ],
)
def test_terms_are_multiplied_by_amplitudes(text, quantity, value, used):
    """The third parameter stands for the time: at 0.5 the ramp is at 1.5."""
    found = read_affine(text, quantity, PARAMETERS, RAMP)
    assert found(MU) == pytest.approx(value, rel=1e-14)
    assert (found.used, found.fixed) == (used, False)
    assert found.expression(MU, {"ramp": 1.5}) == pytest.approx(value, rel=1e-14)


def test_extremes_are_those_of_all_corners_and_values():
    ends = np.array([[p.lower, p.upper] for p in PARAMETERS])
    falling = Amplitudes(2, {"ramp": Amplitude((0.0, 1.0, 2.0), (0.0, 3.0, -2.0))})
    assert read_affine("1 kPa - load * ramp", "pressure", PARAMETERS, falling).extremes(ends) == (-14e3, 11e3)
    assert read_affine("10 N - 2 N * share", "force", PARAMETERS, falling).extremes(ends) == (8.0, 10.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("load * share", "multiplies by 'share', which is no amplitude of [time]; the amplitudes are ramp"),
        ("ramp * ramp", "names 'ramp', which is no parameter"),
        ("ramp", "lacks a unit of pressure"),
    ],
)
def test_other_products_are_refused(text, message):
    with pytest.raises(StudyError, match=re.escape(message)):
        read_affine(text, "pressure", PARAMETERS, RAMP)
