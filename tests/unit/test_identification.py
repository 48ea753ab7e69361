"""Identification from points and forces against least squares in closed form, and what it says where it cannot tell."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.stats import t

from morph_dslam.camera import Camera
from morph_dslam.cli import app as cli
from morph_dslam.errors import EvaluationError, IdentificationError
from morph_dslam.evaluation.force import reaction_in_direction
from morph_dslam.evaluation.force_curves import ForceCurve, load_curve
from morph_dslam.evaluation.run_folder import Run
from morph_dslam.identification.identify import identify
from morph_dslam.identification.measured_forces import MeasuredForces
from morph_dslam.identification.measured_points import MeasuredPoints, load_points
from morph_dslam.identification.prior import KnownValues
from morph_dslam.identification.report import identification_lines, summarise, write_identification
from morph_dslam.identification.values import FACTOR
from morph_dslam.model import Parameter, ReducedModel, SeparatedField, save_model
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.unknown_loads import UnknownLoads
from tests.support.run_folders import write_run

#: A plate of 1 m in the plane z = 0; it is shifted by (a, 0, 0) and (0, b c, 0), and turned about x by a small angle d.
CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
RNG = np.random.default_rng(5)


def plate() -> ReducedModel:
    names = ("a", "b", "c")
    indices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1]])
    functions = ParameterFunctions(np.zeros(3), np.ones(3), indices, np.eye(3))
    # Chebyshev polynomials of the scaled parameter 2 a - 1.
    shift, lift = np.zeros((4, 3)), np.zeros((4, 3))
    shift[:, 0], lift[:, 1] = 0.5, 0.25
    modes = np.array([shift + lift, shift, lift])
    force = np.zeros((3, 1, 3))
    force[0, 0, 2], force[1, 0, 2] = 50.0, 50.0  # 100 a newtons along z
    functions_of_force = ParameterFunctions(np.zeros(3), np.ones(3), indices, np.eye(3))
    return ReducedModel(
        "plate",
        CORNERS,
        np.array([[0, 1, 2], [0, 2, 3]]),
        tuple(Parameter(name, "ratio", "1", 0.0, 1.0, 0.5) for name in names),
        SeparatedField(modes, functions),
        reactions={"force_edge": SeparatedField(force, functions_of_force)},
    )


def points_at(shifts: list[float], noise: float, known: dict[str, np.ndarray] | None = None) -> MeasuredPoints:
    """Four points of the plate along x in states in which it is shifted so, each state with an error of its own."""
    states = [f"state {i}" for i, _ in enumerate(shifts) for _ in range(4)]
    errors = np.repeat(noise * RNG.normal(size=len(shifts)), 4)
    places = np.tile(CORNERS, (len(shifts), 1))
    measured = np.full_like(places, np.nan)
    measured[:, 0] = places[:, 0] + np.repeat(shifts, 4) + errors
    return MeasuredPoints(plate(), tuple(states), known or {}, places, measured)


def test_a_shift_is_the_mean_and_its_deviation_that_of_the_states() -> None:
    """Errors within a state are one: n states, not 4 n points, tell the deviation."""
    table = points_at([0.3] * 9, 0.01)
    means = (table.measured[:, 0] - table.places[:, 0]).reshape(9, 4).mean(axis=1)
    found = identify(table.model, [table], ["a"])
    assert found["a"].value == pytest.approx(means.mean(), abs=1e-8)
    # The covariance with groups is that of n states, but with n in place of n - 1 corrected by n / (n - 1).
    assert found["a"].std == pytest.approx(means.std(ddof=1) / 3.0, rel=1e-4)
    half = float(t.ppf(0.975, 8)) * found["a"].std
    assert found["a"].interval == pytest.approx((means.mean() - half, means.mean() + half), abs=1e-8)
    assert found["a"].identified
    assert found.groups == 9


def test_only_the_product_of_two_parameters_is_identified() -> None:
    table = points_at([0.0] * 3, 0.0)
    table.measured[:, 1] = table.places[:, 1] + lift_of(0.6, 0.4) + 1e-3 * RNG.normal(size=12)
    table = MeasuredPoints(table.model, table.states, {"a": np.zeros(12)}, table.places, table.measured)
    figures = summarise(identify(table.model, [table], ["b", "c"]))
    assert abs(figures["correlation"]["b"]["c"]) > 0.95
    text = "\n".join(identification_lines(figures))
    assert "b and c are correlated" in text
    assert not any(each["identified"] for each in figures["parameters"])


def lift_of(b: float, c: float) -> float:
    """How far the plate goes along y: the constant and the product of the scaled parameters, 0.25 each."""
    return 0.25 + 0.25 * (2.0 * b - 1.0) * (2.0 * c - 1.0)


def test_forces_give_the_factor_of_the_moduli_and_the_zero_of_the_cell() -> None:
    model, places = plate(), np.linspace(0.0, 1.0, 25)
    measured = 0.8 * 100.0 * places + 1.5 + 0.2 * RNG.normal(size=25)
    forces = MeasuredForces(model, ForceCurve("a", places, measured), reaction_in_direction(model, "edge:z"))
    found = identify(model, [forces], moduli=True)
    slope, offset = np.polyfit(100.0 * places, measured, 1)
    assert found[FACTOR].value == pytest.approx(slope, rel=1e-6)
    assert found.misfits[0].offset == pytest.approx(offset, rel=1e-4)
    assert found.groups == 8
    low, high = found[FACTOR].interval
    assert low < 0.8 < high < 0.85


def test_an_interval_wider_than_numbers_reach_can_be_written() -> None:
    """Forces that scatter by a thousand newtons tell nothing of a model of 100 N."""
    model, places = plate(), np.linspace(0.0, 1.0, 25)
    curve = ForceCurve("a", places, 1e3 * (-1.0) ** np.arange(25) * np.sin(np.pi * places) + places)
    found = identify(model, [MeasuredForces(model, curve, reaction_in_direction(model, "edge:z"))], moduli=True)
    assert json.dumps(summarise(found), allow_nan=False)
    assert not found[FACTOR].identified


def test_forces_outside_of_the_models_range_are_left_out() -> None:
    """Within the range the factor is 0.8; the model has no solutions beyond, where the measured force falls."""
    model, places = plate(), np.linspace(0.0, 1.5, 31)
    measured = np.where(places <= 1.0, 80.0 * places, 80.0 - 300.0 * (places - 1.0))
    reaction = reaction_in_direction(model, "edge:z")
    found = identify(model, [MeasuredForces(model, ForceCurve("a", places, measured), reaction)], moduli=True)
    assert found[FACTOR].value == pytest.approx(0.8, rel=1e-6)
    said = "note: 10 of 31 forces of force are left out: they are outside of the model's range of a, 0 to 1"
    assert said in identification_lines(summarise(found))
    with pytest.raises(IdentificationError, match=r"0 forces of force are left .* range of a, 0 to 1"):
        MeasuredForces(model, ForceCurve("a", 2.0 + places, measured), reaction)


def test_a_smaller_unit_with_which_all_forces_are_inside_is_offered() -> None:
    """Millimetres whose title says centimetres: nine of ten are beyond the range of 1 m."""
    model, places = plate(), np.linspace(0.0, 0.9, 91)
    stroke = replace(model, parameters=tuple(replace(p, quantity="length", unit="m") for p in model.parameters))
    reaction = reaction_in_direction(stroke, "edge:z")
    assert MeasuredForces(stroke, ForceCurve("a", places, 80.0 * places), reaction).smaller_unit is None
    table = MeasuredForces(stroke, ForceCurve("a", 10.0 * places, 80.0 * places), reaction)
    assert table.smaller_unit == pytest.approx(0.1)
    said = "\n".join(identification_lines(summarise(identify(stroke, [table], moduli=True))))
    assert "with 0.1 times its places all would be inside: is the unit in the title right?" in said


def stating(certificate: dict[str, Any]) -> ReducedModel:
    return replace(plate(), certificate=certificate)


def test_what_a_result_rests_on_is_said() -> None:
    """Which defaults were assumed, and whether intervals contain the error of the mesh."""
    stated = {
        "reaction_force_edge": {"relative_l2": 0.01},
        "discretisation": {"errors": {"reaction_force_edge": {"relative_l2": 0.03}}},
    }
    model, places = stating(stated), np.linspace(0.0, 1.0, 9)
    forces = MeasuredForces(model, ForceCurve("a", places, 70.0 * places), reaction_in_direction(model, "edge:z"))
    found = identify(model, [forces], moduli=True)
    # Both errors are factors of the force, as the one to identify; that of the reduction has another sign in each of
    # eight parts too, of which the first has two places. A line's slope is sum((x - mean) y) / sum((x - mean)^2).
    slope = (places - 0.5) * places / np.sum((places - 0.5) ** 2)
    waves = 0.01 * np.r_[slope[0] + slope[1], slope[2:]]
    expected = np.hypot(0.04, np.linalg.norm(waves))
    assert found[FACTOR].model_std == pytest.approx(0.7 * expected, rel=1e-6)
    assert found[FACTOR].std == pytest.approx(0.7 * expected, rel=1e-6)
    ends = 0.7 * np.exp(np.array([-1.96, 1.96]) * expected)
    assert found[FACTOR].interval == pytest.approx(tuple(ends), rel=1e-4)
    text = "\n".join(identification_lines(summarise(found)))
    assert f"defaults for force: b = 0.5, c = 0.5; {FACTOR} multiplies the moduli there" in text
    assert f"most of the interval of {FACTOR} is the model's own error" in text
    assert "do not contain the error of the model's mesh" not in text
    table = points_at([0.3] * 4, 1e-3, {"b": np.full(16, 0.2)})
    text = "\n".join(identification_lines(summarise(identify(table.model, [table], ["a"]))))
    assert "defaults for points: c = 0.5" in text
    assert "do not contain the error of the model's mesh for points" in text


def test_an_error_of_the_shape_is_one_of_the_parameters_that_are_not_known() -> None:
    """At 0.5 m of displacement the mesh errs as a and b together; b is known, so that a makes the error good alone.

    There a moved the surface by half a metre for each of its units, and b by a fifth of that along it: so a makes good
    0.04. The displacement is (0.3, 0.25) m where a = 0.3 and c = 0.5; a moves it by a metre there, and half will do.
    """
    errors = {"a": [0.02], "b": [0.1], "c": [0.0]}
    products = [[[0.25, 0.05, 0.0], [0.05, 0.02, 0.0], [0.0, 0.0, 0.0]]]
    entry = {"errors": errors, "displacement_rms_mm": [500.0], "left_rms_mm": [0.0], "products_m2": products}
    model = stating({"discretisation": {"parameters": entry}})
    table = replace(points_at([0.3] * 4, 1e-4, {"b": np.full(16, 0.5)}), model=model)
    found = identify(model, [table], ["a"])
    assert found["a"].model_std == pytest.approx(0.5 * 0.04 * np.hypot(0.3, 0.25) / 0.5, rel=1e-3)
    assert found["a"].std == pytest.approx(found["a"].model_std, rel=1e-2)


def test_a_table_is_right_about_what_it_gives() -> None:
    """One has b, of another it is unknown: a is that of both, b that of the other, by 1 m and 0.5 m for each unit.

    The model's error of the first is one of a alone, as above, for b is held there.
    """
    errors, products = {"a": [0.02], "b": [0.1], "c": [0.0]}, [[[0.25, 0.05, 0.0], [0.05, 0.02, 0.0], [0.0, 0.0, 0.0]]]
    entry = {"errors": errors, "displacement_rms_mm": [500.0], "left_rms_mm": [0.0], "products_m2": products}
    model = stating({"discretisation": {"parameters": entry}})
    given, other = points_at([0.3] * 4, 0.0, {"b": np.full(16, 0.5)}), points_at([0.3] * 4, 0.0, {"c": np.ones(16)})
    other.measured[:, 1] = other.places[:, 1] + 0.5 * 0.2
    tables = [replace(given, model=model), replace(other, model=model, name="other")]
    found = identify(model, tables, ["a", "b"])
    assert (found["a"].value, found["b"].value) == pytest.approx((0.3, 0.2), abs=1e-6)
    assert found.misfits[0].model_rms == pytest.approx(0.5 * 0.04 * np.hypot(0.3, 0.25) / 0.5, rel=1e-3)
    with pytest.raises(IdentificationError, match="what points has of it is taken as known"):
        identify(model, tables[:1], ["a", "b"])


def test_forces_by_frame_name_the_loading_rate() -> None:
    """One parameter rises by 0.02 a frame, one frame is lost, the others stay."""
    model, frames = plate(), np.arange(10, 40)
    parameters = np.tile([0.0, 0.5, 0.5], (30, 1))
    parameters[:, 0] = 0.1 + 0.02 * np.arange(30)
    status = ("tracked",) * 12 + ("lost",) + ("tracked",) * 17
    run = Run(
        model,
        Camera(640, 480, 500.0, 500.0, 319.5, 239.5),
        frames,
        status,
        ("",) * 30,
        np.tile(np.eye(4), (30, 1, 1)),
        parameters,
        {},
    )
    curve = ForceCurve("frame", frames.astype(float), 70.0 * parameters[:, 0])
    forces = MeasuredForces(model, curve, reaction_in_direction(model, "edge:z"), run)
    figures = summarise(identify(model, [forces], moduli=True))
    (found,) = figures["measurements"]
    assert found["loading_rate_per_frame"] == pytest.approx({"a_1": 0.02})
    assert "loading rate: a_1 0.02 a frame" in "\n".join(identification_lines(figures))


def test_what_is_identified_is_no_loading_rate() -> None:
    """All parameters rise in the run, and c, of which the force depends by b, is identified."""
    model, frames = plate(), np.arange(10, 40)
    edge = model.reactions["force_edge"]
    edge.modes[2, 0, 2] = 10.0
    rise = np.arange(30)[:, None] * [0.02, 0.01, 0.005] + [0.1, 0.2, 0.5]
    words, poses = ("tracked",) * 30, np.tile(np.eye(4), (30, 1, 1))
    run = Run(model, Camera(640, 480, 500.0, 500.0, 319.5, 239.5), frames, words, words, poses, rise, {})
    # With c = 0.8, whose scaled value is 0.6.
    curve = ForceCurve("frame", frames.astype(float), 100.0 * rise[:, 0] + 6.0 * (2.0 * rise[:, 1] - 1.0))
    found = identify(model, [MeasuredForces(model, curve, reaction_in_direction(model, "edge:z"), run)], ["c"])
    assert found.estimates[0].value == pytest.approx(0.8, abs=1e-4)
    (figures,) = summarise(found)["measurements"]
    assert figures["loading_rate_per_frame"] == pytest.approx({"a_1": 0.02, "b_1": 0.01})


def test_points_and_forces_are_weighted_by_what_they_are_missed_by() -> None:
    """The shift is 0.3 by points good to 1 mm, and 0.35 by forces with an error of 20 N: the points decide."""
    table = points_at([0.3] * 6, 1e-3)
    model = table.model
    curve = ForceCurve("b", np.linspace(0.0, 1.0, 9), np.linspace(-20.0, 20.0, 9) + 35.0)
    forces = MeasuredForces(model, curve, reaction_in_direction(model, "edge:z"))
    found = identify(model, [table, forces], ["a"])
    assert found["a"].value == pytest.approx(0.3, abs=2e-3)


def test_what_pictures_have_told_counts_with_its_deviation() -> None:
    """A single prior and points: the mean weighted by the inverse variances."""
    table = points_at([0.3] * 12, 0.02)
    alone = identify(table.model, [table], ["a"])["a"].value
    std = float(np.std(table.measured[:, 0] - table.places[:, 0])) / np.sqrt(48.0)
    both = identify(table.model, [table], ["a"], prior=KnownValues.independent({"a": (alone + 2.0 * std, std)}))[
        "a"
    ].value
    assert both == pytest.approx(alone + std, abs=0.05 * std)


@pytest.mark.parametrize("known", [(0.5, 0.0), (0.5, np.nan), (np.inf, 0.1)])
def test_what_is_known_before_has_a_deviation(known: tuple[float, float]) -> None:
    with pytest.raises(IdentificationError, match="standard deviation above zero"):
        KnownValues.independent({"a": (0.3, 0.1), "b": known})


def test_known_deviations_stay_without_measurements() -> None:
    known = {"a": (0.3, 0.05), "b": (0.6, 0.1)}
    found = identify(plate(), [], ["a", "b"], prior=KnownValues.independent(known))
    for name, (value, std) in known.items():
        assert found[name].value == pytest.approx(value, abs=1e-6)
        assert found[name].std == pytest.approx(std, rel=1e-4)
        assert found[name].interval == pytest.approx((value - 1.95996 * std, value + 1.95996 * std), abs=1e-5)
    assert found.correlation == pytest.approx(np.eye(2), abs=1e-6)
    assert not any(line.startswith("note") for line in identification_lines(summarise(found)))


def test_a_known_deviation_stays_where_measurements_tell_nothing() -> None:
    """The points tell the shift alone."""
    table = points_at([0.3] * 6, 1e-3)
    found = identify(table.model, [table], ["a", "b"], prior=KnownValues.independent({"b": (0.6, 0.05)}))
    assert found["b"].std == pytest.approx(0.05, rel=1e-3)
    assert found["a"].std < 1e-3


def test_what_is_measured_of_one_parameter_tells_of_another_that_is_correlated_with_it() -> None:
    """A Gaussian of a and b, of which a is measured: mean and variance of b by conditioning."""
    table = points_at([0.3] * 12, 0.02)
    alone = identify(table.model, [table], ["a"])["a"]
    covariance = np.array([[0.02, -0.015], [-0.015, 0.03]]) ** 2 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    prior = KnownValues(("a", "b"), np.array([0.31, 0.6]), covariance)
    found = identify(table.model, [table], ["b", "a"], prior=prior)
    gain = covariance[0, 1] / (covariance[0, 0] + alone.std**2)
    assert found["b"].value - 0.6 == pytest.approx(gain * (alone.value - 0.31), rel=0.1)
    assert found["b"].std == pytest.approx(np.sqrt(covariance[1, 1] - gain * covariance[0, 1]), rel=0.02)


def test_a_point_beside_the_surface_is_carried_as_a_rigid_body() -> None:
    """The upper two corners turn about the lower edge by 0.1 rad: a marker 0.2 m above the plate goes with it."""
    turn = np.zeros((4, 3))
    turn[2:, 1], turn[2:, 2] = np.cos(0.1) - 1.0, np.sin(0.1)
    functions = ParameterFunctions(np.zeros(1), np.ones(1), np.array([[0]]), np.eye(1))
    parameter = Parameter("a", "ratio", "1", 0.0, 1.0, 0.5)
    model = ReducedModel(
        "plate", CORNERS, np.array([[0, 1, 2], [0, 2, 3]]), (parameter,), SeparatedField(turn[None], functions)
    )
    place = np.array([[0.5, 0.5, 0.2]])
    table = MeasuredPoints(model, ("one",), {}, place, place)
    expected = [0.5, 0.5 * np.cos(0.1) - 0.2 * np.sin(0.1), 0.5 * np.sin(0.1) + 0.2 * np.cos(0.1)]
    assert table.positions(lambda known: model.vector(known))[0] == pytest.approx(expected, abs=1e-12)


def test_tables_are_read_with_units(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("state,b_1,place_x_mm,place_y [cm],place_z_m,x_mm,y_mm,z [mm]\none,0.25,10,2,0.03,11,,33\n")
    table = load_points(path, plate())
    assert table.places[0] == pytest.approx([0.01, 0.02, 0.03])
    assert table.values == pytest.approx([0.011, 0.033])
    assert table.known["b"] == pytest.approx([0.25])


HEADER = "state,place_x_mm,place_y_mm,place_z_mm,x_mm,y_mm,z_mm\n"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "has no column state"),
        ("state,place_x_mm\none,1\n", "place_y_mm"),
        (HEADER.replace("x_mm,y", "x_N,y", 1) + "one,0,0,0,1,1,1\n", "unit of length"),
        (HEADER + "one,0,0,zero,1,1,1\n", "line 2, column 'place_z_mm': 'zero' is not a number"),
        (HEADER.replace(",", ";") + "one;0;0;0;1;1;1\n", "is separated by semicolons"),
        ("one,0,0,0,1,1,1\n", "has no column state, place_x_mm"),
        (HEADER + "one,0,0,0,1,1,1\none,0,0,0\n", "line 3: 4 cells under 7 titles"),
        ("b_1," + HEADER + "0.5,one,0,0,0,1,1,1\n5,two,0,0,0,1,1,1\n", "line 3, column 'b_1': 5 is .* range, 0 to 1"),
        ("b_1," + HEADER + "0.5,one,0,0,0,1,1,1\n0.6,one,1,0,0,1,1,1\n", "0.6 here and 0.5 in line 2"),
        (HEADER + "one,0,,0,1,1,1\n", "every row needs"),
        (HEADER + "one,0,0,0,,,\n", "no point was measured"),
        ("load_N," + HEADER + "1,one,0,0,0,1,1,1\n", "'load_N' is no parameter"),
        ("b_1," + HEADER + ",one,0,0,0,1,1,1\n", "column 'b_1' is empty"),
        ("x_m," + HEADER + "9,one,0,0,0,1,1,1\n", "x_m and x_mm both hold x"),
        ("x_mm," + HEADER + "9,one,0,0,0,1,1,1\n", "x_mm and x_mm both hold x"),
        ("state," + HEADER + "two,one,0,0,0,1,1,1\n", "state and state both hold state"),
        ("b_1,b_1," + HEADER + "0.5,0.2,one,0,0,0,1,1,1\n", "b_1 and b_1 both hold b"),
        ("b_1,b [1]," + HEADER + "0.5,0.2,one,0,0,0,1,1,1\n", r"b_1 and b \[1\] both hold b"),
    ],
)
def test_wrong_tables_are_refused(tmp_path: Path, content: str, said: str) -> None:
    (tmp_path / "points.csv").write_text(content)
    with pytest.raises(IdentificationError, match=said):
        load_points(tmp_path / "points.csv", plate())


def test_wrong_questions_are_refused() -> None:
    table = points_at([0.3] * 3, 0.0)
    model = table.model
    with pytest.raises(IdentificationError, match="no parameter 'young'"):
        identify(model, [table], ["young"])
    with pytest.raises(IdentificationError, match="nothing is to be identified"):
        identify(model, [table])
    with pytest.raises(IdentificationError, match="nothing was measured"):
        identify(model, [], ["a"])
    with pytest.raises(IdentificationError, match=f"depends on '{FACTOR}'"):
        identify(model, [table], ["a"], moduli=True)
    far = MeasuredPoints(model, ("one",), {}, np.array([[0.0, 0.0, 5.0]]), np.zeros((1, 3)))
    with pytest.raises(IdentificationError, match="off the undeformed object"):
        identify(model, [far], ["a"])
    with pytest.raises(EvaluationError, match="names no direction"):
        reaction_in_direction(model, "edge")
    with pytest.raises(EvaluationError, match="it has those on edge"):
        reaction_in_direction(model, "rim:x")
    with pytest.raises(
        EvaluationError, match="along x is zero in this model; it acts along z: write --reaction edge:z"
    ):
        reaction_in_direction(model, "edge:x")
    with pytest.raises(IdentificationError, match="give --run"):
        MeasuredForces(model, ForceCurve("frame", np.arange(5.0), np.ones(5)), reaction_in_direction(model, "edge:z"))


@pytest.mark.parametrize(
    ("asked", "slope", "direction"),
    [("edge:z", 80.0, "z"), ("edge:z", -80.0, "-z"), ("edge:+z", 80.0, "z"), ("edge:-z", -80.0, "-z")],
)
def test_a_force_follows_the_measured_one_or_has_the_sign_that_was_given(
    asked: str, slope: float, direction: str
) -> None:
    """The model has 100 a newtons along z, whichever way the machine counts."""
    model, places = plate(), np.linspace(0.0, 1.0, 25)
    curve = ForceCurve("a", places, slope * places + 1.5, "pull_N")
    figures = summarise(
        identify(model, [MeasuredForces(model, curve, reaction_in_direction(model, asked))], moduli=True)
    )
    assert figures["parameters"][0]["value"] == pytest.approx(0.8, rel=1e-6)
    assert figures["measurements"][0]["offset"] == pytest.approx(1.5, rel=1e-4)
    assert (figures["measurements"][0]["support"], figures["measurements"][0]["direction"]) == ("edge", direction)
    said = f"note: pull_N is compared with the force on 'edge' in direction {direction} of the object frame"
    assert said in identification_lines(figures)


@pytest.mark.parametrize(("asked", "slope", "other"), [("edge:+z", -80.0, "edge:-z"), ("edge:-z", 80.0, "edge:+z")])
def test_the_wrong_sign_is_refused_with_the_other(asked: str, slope: float, other: str) -> None:
    model, places = plate(), np.linspace(0.0, 1.0, 25)
    forces = MeasuredForces(model, ForceCurve("a", places, slope * places), reaction_in_direction(model, asked))
    with pytest.raises(EvaluationError) as refusal:
        identify(model, [forces], moduli=True)
    assert str(refusal.value).endswith(f"falls where the measured force grows: write --reaction {other}")


def test_a_given_sign_holds_where_that_of_the_force_depends_on_what_is_identified() -> None:
    """The force is a (2 b - 1) along z: at the default of b, 0.2, it falls with a, and at 0.9 it grows."""
    model = plate()
    low = replace(model.parameters[1], default=0.2)
    functions = ParameterFunctions(np.zeros(3), np.ones(3), np.array([[0, 1, 0], [1, 1, 0]]), np.eye(2))
    force = np.zeros((2, 1, 3))
    force[:, 0, 2] = 0.5
    swung = replace(
        model,
        parameters=(model.parameters[0], low, model.parameters[2]),
        reactions={"force_edge": SeparatedField(force, functions)},
    )
    places = np.linspace(0.0, 1.0, 25)
    forces = MeasuredForces(swung, ForceCurve("a", places, 0.8 * places), reaction_in_direction(swung, "edge:+z"))
    assert identify(swung, [forces], ["b"])["b"].value == pytest.approx(0.9, abs=1e-6)


STROKES = np.linspace(0.1, 0.9, 9)


def write_run_of_plate(
    folder: Path, constants: dict[str, float] | None = None, correlation: float | None = None
) -> None:
    """A run that found the shift of each frame, and that b is 0.5 in all of them, say, known to 0.01.

    With a correlation of b and c its covariances are kept.
    """
    write_run(folder, frames=np.arange(9))
    save_model(folder / "model.morph", plate())
    with h5py.File(folder / "result.h5", "r+") as file:
        del file["parameters"]
        file["parameters"] = np.column_stack([STROKES, np.full(9, 0.5), np.full(9, 0.5)])
        if correlation is not None:
            covariance = np.diag(np.full(9, 1e-4))
            covariance[1, 2] = covariance[2, 1] = 1e-4 * correlation
            file["covariance"] = np.tile(covariance, (9, 1, 1))
    values = {"b": 0.5} if constants is None else constants
    found = [{"name": n, "value": v, "standard_deviation": 0.01, "observable": True} for n, v in values.items()]
    (folder / "summary.json").write_text(json.dumps({"one_over_the_sequence": found}))


@pytest.mark.parametrize(
    ("title", "asked", "used"),
    [("a_1", ["--moduli"], False), ("a_1", ["--moduli", "--parameter", "b"], True), ("frame", ["--moduli"], True)],
)
def test_a_run_that_changes_nothing_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], title: str, asked: list[str], used: bool
) -> None:
    """A run counts where forces are given by its frames, or where it found what is to be identified."""
    write_run_of_plate(tmp_path / "run")
    places = STROKES if title == "a_1" else np.arange(9)
    rows = "".join(f"{place},{70 * a + 2}\n" for place, a in zip(places, STROKES, strict=True))
    (tmp_path / "curve.csv").write_text(f"{title},force_N\n{rows}")
    command = ["identify", str(tmp_path / "run" / "model.morph"), *asked, "--force", str(tmp_path / "curve.csv")]
    command += ["--reaction", "edge:z", "--run", str(tmp_path / "run"), "-o", str(tmp_path / "out")]
    assert cli.main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("note: --run changes nothing here") for line in lines) is not used
    assert lines[-1].startswith(f"{FACTOR}=0.7 std=" if len(asked) == 1 else "b=0.5 std=")


def test_forces_of_a_run_with_unknown_loads_have_the_force_of_these(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """100 a newtons along z by the study, 40 by each unit of the load, all 1.3 times as large, and 2 N of offset."""
    write_run_of_plate(tmp_path / "run")
    constant = ParameterFunctions(np.zeros(3), np.ones(3), np.zeros((1, 3), int), np.ones((1, 1)))
    responses = {
        "displacement": SeparatedField(np.ones((1, 4, 3)), constant),
        "reaction_force_edge": SeparatedField(np.array([[[0.0, 0.0, 40.0]]]), constant),
        "compliance_root": SeparatedField(np.ones((1, 1, 1)), constant),
    }
    loads = UnknownLoads("", False, np.arange(4), np.ones((4, 3, 1)), np.ones((1, 6)), responses)
    save_model(tmp_path / "run" / "model.morph", replace(plate(), unknown_loads=loads))
    coefficients = 0.3 * np.sin(7.0 * STROKES)
    with h5py.File(tmp_path / "run" / "result.h5", "r+") as file:
        before = np.asarray(file["parameters"])
        del file["parameters"]
        file["parameters"] = np.column_stack([before, coefficients])
    forces = 1.3 * (100.0 * STROKES + 40.0 * coefficients) + 2.0
    rows = "".join(f"{frame},{force}\n" for frame, force in enumerate(forces.tolist()))
    (tmp_path / "curve.csv").write_text(f"frame,force_N\n{rows}")
    command = ["identify", str(tmp_path / "run" / "model.morph"), "--force", str(tmp_path / "curve.csv")]
    command += ["--reaction", "edge:z", "--run", str(tmp_path / "run"), "-o", str(tmp_path / "out")]
    assert cli.main([*command, "--moduli"]) == 0
    figures = json.loads((tmp_path / "out" / "identification.json").read_text())
    assert figures["parameters"][0]["value"] == pytest.approx(1.3, rel=1e-6)
    (of_force,) = figures["measurements"]
    assert of_force["offset"] == pytest.approx(2.0, abs=1e-4)
    assert of_force["loading_rate_per_frame"] == pytest.approx({"a_1": 0.1})
    capsys.readouterr()
    assert cli.main([*command, "--parameter", "b", "--overwrite"]) == 2
    assert "identify --moduli alone" in capsys.readouterr().err


def values_by(folder: Path, *more: str) -> list[dict[str, Any]]:
    """What the command finds of b and c with the run in a folder."""
    command = ["identify", str(folder / "run" / "model.morph"), "--parameter", "b", "--parameter", "c"]
    assert cli.main([*command, *more, "--run", str(folder / "run"), "-o", str(folder / "out")]) == 0
    return json.loads((folder / "out" / "identification.json").read_text())["parameters"]


def test_a_run_alone_gives_its_own_values(tmp_path: Path) -> None:
    write_run_of_plate(tmp_path / "run", {"b": 0.5, "c": 0.7})
    b, c = values_by(tmp_path)
    assert (b["value"], c["value"]) == pytest.approx((0.5, 0.7), abs=1e-6)
    assert (b["standard_deviation"], c["standard_deviation"]) == pytest.approx((0.01, 0.01), rel=1e-3)


def test_a_runs_values_keep_their_correlation(tmp_path: Path) -> None:
    """Forces that tell nothing of b and c change nothing in what the run knows of them."""
    write_run_of_plate(tmp_path / "run", {"b": 0.5, "c": 0.7}, correlation=-0.9)
    (tmp_path / "curve.csv").write_text("a_1,force_N\n" + "".join(f"{a},{100 * a + a % 0.2}\n" for a in STROKES))
    b, c = values_by(tmp_path, "--force", str(tmp_path / "curve.csv"), "--reaction", "edge:z")
    assert (b["standard_deviation"], c["standard_deviation"]) == pytest.approx((0.01, 0.01), rel=1e-3)
    correlation = json.loads((tmp_path / "out" / "identification.json").read_text())["correlation"]
    assert correlation["b"]["c"] == pytest.approx(-0.9, abs=1e-3)


def test_the_unknown_correlation_of_a_runs_values_narrows_nothing(tmp_path: Path) -> None:
    """Forces tell nothing of b and c: with the least favourable correlation 0.01 each is as sqrt(2) 0.01."""
    write_run_of_plate(tmp_path / "run", {"b": 0.5, "c": 0.7})
    (tmp_path / "curve.csv").write_text("a_1,force_N\n" + "".join(f"{a},{100 * a + a % 0.2}\n" for a in STROKES))
    b, c = values_by(tmp_path, "--force", str(tmp_path / "curve.csv"), "--reaction", "edge:z")
    assert (b["standard_deviation"], c["standard_deviation"]) == pytest.approx((0.0141421, 0.0141421), rel=1e-3)


def identification_of_c(folder: Path, found: dict[str, float]) -> list[str]:
    """A command that identifies c by a run that found these values; and ``points.csv``, measured with c = 0.6."""
    write_run_of_plate(folder / "run", found)
    rows = "".join(f"{i},1,{0.5 * i},0,0,,{lift_of(1.0, 0.6)},\n" for i in range(3))
    (folder / "points.csv").write_text("state,b_1,place_x_m,place_y_m,place_z_m,x_m,y_m,z_m\n" + rows)
    model, run = str(folder / "run" / "model.morph"), str(folder / "run")
    return ["identify", model, "--parameter", "c", "--run", run, "-o", str(folder / "out")]


def test_a_run_that_ended_at_an_end_of_a_range_does_not_count(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = identification_of_c(tmp_path, {"b": 1.0, "c": 0.7})
    assert cli.main(command) == 2
    assert "the run found b at the end of its range, 1, where its deviations do not hold" in capsys.readouterr().err
    assert cli.main([*command, "--points", str(tmp_path / "points.csv")]) == 0
    assert "note: what the run found for its whole sequence does not count: b at the end" in capsys.readouterr().out


def test_a_run_whose_frames_contradict_each_other_does_not_count(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its last frames say c = 0.9; points measured otherwise 0.6."""
    command = identification_of_c(tmp_path, {"b": 0.5, "c": 0.9})
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    summary["one_over_the_sequence"][1]["is_one_value"] = False
    (tmp_path / "run" / "summary.json").write_text(json.dumps(summary))
    assert cli.main(command) == 2
    assert "frames of the run contradict each other in c" in capsys.readouterr().err
    assert cli.main([*command, "--points", str(tmp_path / "points.csv")]) == 0
    said = capsys.readouterr().out
    assert "does not count: frames contradict each other in c" in said
    assert float(said.splitlines()[-1].split("c=")[1].split()[0]) == pytest.approx(0.6, abs=0.01)


def test_what_could_not_be_written_whole_is_no_identification(tmp_path: Path) -> None:
    table = points_at([0.3] * 3, 0.0)
    (tmp_path / "identification.png").mkdir()
    with pytest.raises(IdentificationError):
        write_identification(tmp_path, identify(table.model, [table], ["a"]))
    assert not (tmp_path / "identification.json").exists()


@pytest.mark.usefixtures("drawn_figures")
def test_the_command_writes_figures_and_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_model(tmp_path / "plate.morph", plate())
    places = np.linspace(0.0, 1.0, 9)
    (tmp_path / "curve.csv").write_text("a_1,force_N\n" + "".join(f"{a},{70 * a + 2}\n" for a in places))
    curve = load_curve(tmp_path / "curve.csv", plate())
    assert curve.forces[-1] == 72.0
    command = ["identify", str(tmp_path / "plate.morph"), "--moduli", "--force", str(tmp_path / "curve.csv")]
    assert cli.main([*command, "--reaction", "edge:z", "-o", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith(f"{FACTOR}=0.7 std=")
    assert (tmp_path / "out" / "identification.json").is_file()
    assert (tmp_path / "out" / "identification.png").stat().st_size > 1000
    assert cli.main([*command, "-o", str(tmp_path / "out")]) == 2
    assert "give one --reaction" in capsys.readouterr().err
    (tmp_path / "out" / "identification.json").write_text("earlier")
    again = [*command, "--reaction", "edge:z", "-o", str(tmp_path / "out")]
    assert cli.main(again) == 2
    assert "holds an identification already" in capsys.readouterr().err
    assert (tmp_path / "out" / "identification.json").read_text() == "earlier"
    assert cli.main([*again, "--overwrite"]) == 0
    assert (tmp_path / "out" / "identification.json").read_text() != "earlier"
