"""Measured forces in another unit, of other frames or another law; right ones, noisy or not, are not doubted."""

import numpy as np
import pytest

from morph_dslam.extend.reports import ForceCurve, evaluate_force, force_remarks
from tests.unit.test_force_error import pull, pulled_run

#: Three cycles of a stroke, and the model's force.
CYCLES = np.arange(48)
ARCHES = 0.03 + 0.02 * np.sin(2.0 * np.pi * CYCLES / 16.0)
#: Up and down at one speed, over 16 frames each way.
WAY = np.abs((CYCLES + 8.0) % 32.0 - 16.0) / 16.0
FRICTION = np.sign(np.gradient(WAY))


def notices(measured, frames=CYCLES, arches=ARCHES, name="force_N", run=None):
    run = pulled_run(arches) if run is None else run
    figures = evaluate_force(run, ForceCurve("frame", frames.astype(float), measured, name))
    assert all(notice["text"] in force_remarks(figures) for notice in figures["notices"])
    return {notice["kind"]: notice for notice in figures["notices"]}


@pytest.mark.parametrize(
    ("name", "factor", "unit", "then"),
    [
        ("force_kN", 1250.0, "N", 1.25),
        ("load", 1.25 / 9.80665e-3, "g", 1.25),
        ("force_g", 0.8 * 9.80665e-3, "N", 0.8),
        ("force [N]", 0.8e-3, "kN", 0.8),
        ("force", 25.0, "", 25.0),
        ("force_N", 1.05 / 9.80665, "kg", 1.05),
        ("force_N", 1.0 / 4.4482216152605, "lb", 1.0),
    ],
)
def test_forces_in_another_unit_are_named(name, factor, unit, then):
    """The measured force in newtons is a known factor of the closed form, of which the unit is a known part."""
    found = notices(factor * pull(ARCHES) + 3.0, name=name)
    assert list(found) == ["other_size"]
    other = found["other_size"]
    assert (other["unit"], other["factor"]) == (unit, pytest.approx(factor))
    assert other["factor_with_unit"] == pytest.approx(then)
    assert ("with values in" in other["text"]) == bool(unit)


@pytest.mark.parametrize("factor", [0.15, 0.2, 0.4, 1.0, 1.25, 8.0])
def test_a_model_whose_moduli_are_off_is_not_accused_of_units(factor):
    assert notices(factor * pull(ARCHES)) == {}


@pytest.mark.parametrize("shift", [1, -1])
@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_forces_whose_frames_count_from_another_number_are_named(shift, noise):
    measured = 1.25 * pull(ARCHES) + 0.2 + noise * np.random.default_rng(5).normal(size=len(CYCLES))
    found = notices(measured, CYCLES + shift)
    assert list(found) == ["other_frame_numbers"]
    other = found["other_frame_numbers"]
    assert other["shift"] == -shift
    assert other["factor"] == pytest.approx(1.25, abs=1e-9 + 0.2 * noise)
    assert other["rms"] == pytest.approx(noise, rel=0.3, abs=1e-9)
    assert ("one less" if shift > 0 else "one more") in other["text"]


def test_every_fifth_frame_tells_it_too():
    frames = CYCLES[::5]
    assert list(notices(pull(ARCHES)[::5], frames + 1)) == ["other_frame_numbers"]


def test_right_forces_with_noise_are_not_accused():
    """Independent noise of any size: residuals that are alike are allowed one time in a thousand."""
    random, found = np.random.default_rng(11), []
    for n in (12, 48):
        for size in (1e-6, 0.05, 1.0, 10.0):
            found += [notices(pull(ARCHES[:n]) + size * random.normal(size=n), CYCLES[:n], ARCHES[:n]) for _ in "12345"]
    ramp = np.linspace(0.0, 0.05, 48)
    found += [notices(pull(ramp), arches=ramp), notices(pull(ARCHES))]
    assert [each for each in found if set(each) - {"other_size"}] == []


@pytest.mark.parametrize("late", [0.3, 0.5, 0.8, 1.3, 2.0])
def test_friction_is_no_wrong_frame_number(late):
    """With a stroke of one speed, friction is what a shift by part of a frame, or more than one, would do."""
    force = 4.0 * WAY
    arches = 0.06 * (np.sqrt(1.0 + 2.0 * (force / 5.0 + 0.25)) - 1.0)
    np.testing.assert_allclose(pull(arches), force, atol=1e-12)
    assert list(notices(force + late * 0.25 * FRICTION, arches=arches)) == ["neighbours_alike"]


@pytest.mark.parametrize("scale", [10.0, 100.0])
def test_a_smaller_unit_of_the_places_of_a_curve_is_named(scale):
    """Millimetres whose title says centimetres, or centimetres of one that says metres."""
    known = np.linspace(0.0, 0.055, 1101)
    (notice,) = evaluate_force(pulled_run(ARCHES), ForceCurve("arch", scale * known, 1.25 * pull(known)))["notices"]
    assert notice["kind"] == "other_place_unit"
    assert (notice["parameter"], notice["scale"]) == ("arch", pytest.approx(1.0 / scale))
    assert notice["factor"] == pytest.approx(1.25, rel=1e-3)


@pytest.mark.parametrize("factor", [0.1, 0.15, 0.4, 1.0, 4.0, 10.0])
@pytest.mark.parametrize("reach", [1.0, 10.0])
def test_right_places_of_a_curve_are_not_accused(factor, reach):
    """Of a body that is softer or stiffer than the model, of its law, of another one, and with noise."""
    known = np.linspace(0.0, 0.055 * reach, 110)
    noise = np.random.default_rng(4).normal(size=len(known))
    for measured in (pull(known), pull(known) + 2.0 * noise, np.sqrt(known), known, known**2):
        curve = ForceCurve("arch", known, factor * measured * np.ptp(pull(ARCHES)) / np.ptp(measured[known < 0.05]))
        found = evaluate_force(pulled_run(ARCHES), curve)["notices"]
        assert "other_place_unit" not in [notice["kind"] for notice in found]


@pytest.mark.parametrize("lag", [0.4, 0.7, 1.5])
def test_a_lag_of_the_body_is_no_wrong_frame_number(lag):
    measured = pull(0.03 + 0.02 * np.sin(2.0 * np.pi * (CYCLES + lag) / 16.0))
    assert list(notices(measured)) == ["neighbours_alike"]


def test_another_law_is_seen():
    found = notices(pull(ARCHES) + 1e4 * (ARCHES - 0.03) ** 3 / 0.02)
    assert list(found) == ["neighbours_alike"]
    assert found["neighbours_alike"]["durbin_watson"] < 1.5


def test_what_the_errors_of_the_estimates_explain_is_not_doubted():
    """The arch is estimated 0.3 mm off, slowly changing; its deviation is 1 mm, or a thousandth of that."""
    off = 3e-4 * np.cos(2.0 * np.pi * CYCLES / 24.0)
    for deviation, expected in ((1e-3, []), (1e-6, ["neighbours_alike"])):
        run = pulled_run(ARCHES + off)
        covariance = np.zeros((len(CYCLES), 9, 9))
        covariance[:, 0, 0] = deviation**2
        object.__setattr__(run, "covariances", covariance)
        assert list(notices(pull(ARCHES), run=run)) == expected
