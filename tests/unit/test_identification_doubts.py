"""Identification from tables in other units, of other axes and frames, given twice, or of another law."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.cli import app as cli
from morph_dslam.errors import IdentificationError
from morph_dslam.evaluation.force import reaction_in_direction
from morph_dslam.evaluation.force_curves import ForceCurve, load_curve
from morph_dslam.evaluation.likeness import likeness
from morph_dslam.evaluation.run_folder import Run
from morph_dslam.identification.found import Identification
from morph_dslam.identification.identify import identify
from morph_dslam.identification.measured_forces import MeasuredForces
from morph_dslam.identification.measured_points import MeasuredPoints
from morph_dslam.identification.report import identification_lines, summarise
from morph_dslam.identification.values import FACTOR
from morph_dslam.model import Parameter, ReducedModel, SeparatedField, save_model
from morph_dslam.model.functions import ParameterFunctions
from tests.support.edge_plate import CORNERS, edge_plate

#: A plate of 1 m that is stretched by a along x, by a force of 100 a + 100 b a^2 newtons along it.


def stretched_plate() -> ReducedModel:
    a, b = Parameter("a", "length", "mm", 0.0, 1.0, 0.0), Parameter("b", "ratio", "1", 0.0, 1.0, 0.0)
    # Chebyshev polynomials of x = 2 a - 1 and y = 2 b - 1: a = (1 + x) / 2, a^2 = (3 + 4 x + T2(x)) / 8.
    indices = np.array([[0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1]])
    stretch, bent = np.array([0.5, 0.5, 0, 0, 0, 0]), np.array([3.0, 4.0, 1.0, 3.0, 4.0, 1.0]) / 16.0
    functions = ParameterFunctions(np.zeros(2), np.ones(2), indices, np.column_stack([stretch, bent]))
    return edge_plate((a, b), functions)


STRETCHES = np.linspace(0.05, 0.95, 19)
RANDOM = np.random.default_rng(7)
NOISE = 0.3 * np.random.default_rng(3).normal(size=19)


def forces(measured: np.ndarray, stretches: np.ndarray = STRETCHES, free_zero: bool = True) -> MeasuredForces:
    model = stretched_plate()
    curve = ForceCurve("a", stretches, measured)
    return MeasuredForces(model, curve, reaction_in_direction(model, "edge:x"), free_zero=free_zero)


def lines(found: Identification) -> str:
    return "\n".join(identification_lines(summarise(found)))


def of_law(share: float) -> np.ndarray:
    return 100.0 * STRETCHES + 100.0 * share * STRETCHES**2


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_forces_of_another_size_are_refused(factor: float) -> None:
    table = forces(factor * (of_law(0.4) + NOISE))
    with pytest.raises(IdentificationError, match="times what the model's force changes by"):
        identify(table.model, [table], ["b"])


def test_right_forces_are_not_doubted() -> None:
    table = forces(of_law(0.4) + NOISE + 7.0)
    found = identify(table.model, [table], ["b"])
    low, high = found["b"].interval
    assert low < 0.4 < high
    text = lines(found)
    assert not any(word in text for word in ("check the units", "alike", "is the unit"))


def test_another_law_is_seen_from_neighbouring_residuals() -> None:
    """Forces of a law without a quadratic part by a model with one of 100 N, whose moduli alone are free."""
    table = forces(of_law(1.0) + NOISE)
    found = identify(table.model, [table], moduli=True)
    assert "neighbouring residuals of force are alike" in lines(found)


def test_errors_of_a_load_cell_that_last_are_named_beside_the_law() -> None:
    """A drift that wanders over the curve, of a law that is right."""
    drift = 3.0 * np.sin(np.linspace(0.0, 3.0 * np.pi, len(NOISE)))
    table = forces(of_law(0.4) + drift)
    assert "errors of the load cell last over many readings" in lines(identify(table.model, [table], ["b"]))


def test_a_factor_of_all_moduli_that_no_unit_explains_is_doubted() -> None:
    table = forces(30.0 * of_law(0.0) + 3.0)
    figures = summarise(identify(table.model, [table], moduli=True))
    (notice,) = figures["measurements"][0]["notices"]
    assert (notice["kind"], notice["unit"]) == ("other_size", "")
    assert notice["factor"] == pytest.approx(30.0, rel=1e-4)


@pytest.mark.parametrize(
    ("name", "factor", "says"),
    [
        ("force_g", 0.8 * 9.80665e-3, r"0\.007845 times .* with values in N it would be 0\.8 times"),
        ("force", 1.25 / 9.80665e-3, r"127\.5 times .* with values in g it would be 1\.25 times"),
    ],
)
def test_a_factor_of_all_moduli_beyond_its_range_is_refused(name: str, factor: float, says: str) -> None:
    """At the end of 0.01 to 100 it is no estimate, even where what is left is less than ten times."""
    right = forces(factor * of_law(0.0) + 3.0)
    table = replace(right, curve=replace(right.curve, name=name))
    with pytest.raises(IdentificationError, match=says):
        identify(table.model, [table], moduli=True)


def test_forces_in_other_units_are_refused_with_the_unit_that_is_meant() -> None:
    """Beyond ten times the largest factor that is searched."""
    right = forces(1250.0 * of_law(0.0))
    table = replace(right, curve=replace(right.curve, name="force_kN"))
    with pytest.raises(IdentificationError, match=r"1250 times .* with values in N it would be 1\.25 times"):
        identify(table.model, [table], moduli=True)


@pytest.mark.parametrize("shift", [-1, 0, 1])
def test_forces_of_other_frames_are_named(shift: int) -> None:
    model, frames = stretched_plate(), np.arange(40)
    stretches = 0.5 + 0.4 * np.sin(2.0 * np.pi * frames / 20.0)
    words, poses = ("tracked",) * 40, np.tile(np.eye(4), (40, 1, 1))
    states = np.column_stack([stretches, np.zeros(40)])
    run = Run(model, Camera(640, 480, 500.0, 500.0, 320.0, 240.0), frames, words, words, poses, states, {})
    curve = ForceCurve("frame", frames + float(shift), 130.0 * stretches + 0.2 * RANDOM.normal(size=40))
    table = MeasuredForces(model, curve, reaction_in_direction(model, "edge:x"), run)
    notices = summarise(identify(model, [table], moduli=True))["measurements"][0]["notices"]
    assert [(notice["kind"], notice["shift"]) for notice in notices] == [("other_frame_numbers", -shift)] * abs(shift)


def stiff_plate(share: float) -> ReducedModel:
    """The plate, stretched by a; a modulus between 0 and 1 MPa stretches it by that share more."""
    plate = stretched_plate()
    modulus = Parameter("b", "stress", "MPa", 0.0, 1e6, 0.0)
    functions = ParameterFunctions(np.zeros(2), np.array([1.0, 1e6]), np.array([[0, 0], [1, 0], [0, 1]]), np.eye(3))
    shape = np.zeros((3, 4, 3))
    shape[:, :, 0] = np.outer([0.5 + share / 2.0, 0.5, share / 2.0], CORNERS[:, 0])
    return replace(plate, parameters=(plate.parameters[0], modulus), displacement=SeparatedField(shape, functions))


def test_a_modulus_on_which_shapes_hardly_depend_is_said_not_to_be_determined_by_them() -> None:
    """Over the range two of twelve coordinates change by 0.1 mm; they are off by 1 mm, up or down by turns."""
    model, share = stiff_plate(1e-4), 1e-4
    states, known = ("s0",) * 4 + ("s1",) * 4, {"a": np.repeat([0.2, 0.4], 4)}
    measured = np.tile(CORNERS, (2, 1)) + np.outer(known["a"], [1, 0, 0]) * np.tile(CORNERS, (2, 1))
    measured[:, 0] += np.tile([1e-3, -1e-3, 2e-3, -1e-3], 2)
    table = MeasuredPoints(model, states, known, np.tile(CORNERS, (2, 1)), measured)
    found = identify(model, [table], ["b"])
    figures = summarise(found)
    assert figures["measurements"][0]["change_over_range_rms"]["b"] == pytest.approx(1e3 * share * np.sqrt(2.0 / 12.0))
    assert not found["b"].identified
    text = lines(found)
    assert "over its whole range b changes points by 0.041 mm rms, less than" in text
    assert "measure forces (--force)" in text
    assert "the model may need a wider one" not in text
    low, high = found["b"].interval
    assert 0.0 <= low <= high <= 1e6


def test_intervals_end_with_the_range_and_say_so() -> None:
    """A modulus near the end of its range, with noise that would reach beyond it."""
    table = forces(of_law(0.02) + 6.0 * NOISE)
    found = identify(table.model, [table], ["b"])
    assert found["b"].interval[0] == 0.0
    assert found["b"].identified
    assert "95 % interval 0 to " in lines(found)
    assert "cut off at the end of its range" in lines(found)
    beyond = lines(identify(table.model, [forces(of_law(-0.2) + NOISE)], ["b"]))
    assert "b = 0, without an interval\nnote: b is at the end of its range: the model may need a wider one" in beyond


def test_residuals_below_the_models_own_error_are_not_doubted() -> None:
    table = forces(of_law(0.02) + 1e-3 * NOISE)
    stated = replace(table.model, certificate={"reaction_force_edge": {"relative_l2": 0.02}})
    found = identify(stated, [replace(table, model=stated)], moduli=True)
    assert "alike" not in lines(found)


def test_independent_residuals_are_alike_as_often_as_is_said() -> None:
    """Whatever a fit of a parabola leaves of noise: one time in twenty the probability is below 0.05."""
    random, x = np.random.default_rng(8), np.linspace(0.0, 1.0, 15)
    found = [likeness(random.normal(size=15), np.vander(x, 3)) for _ in range(3000)]
    below = np.mean([each is not None and each.probability < 0.05 for each in found])
    assert below == pytest.approx(0.05, abs=0.015)
    assert likeness(x**2, np.vander(x, 3)) is None
    # Four differences of 2 and a sum of squares of 5, without any unknown.
    alternating = likeness(np.array([1.0, -1.0, 1.0, -1.0, 1.0]), np.empty((5, 0)))
    assert alternating is not None
    assert alternating.durbin_watson == pytest.approx(16.0 / 5.0)


def test_two_branches_are_refused_and_repetitions_are_not() -> None:
    places, measured = np.append(STRETCHES, 0.95), of_law(0.4)
    repeated = forces(np.append(measured, measured[-1] + 1.0), places)
    assert identify(repeated.model, [repeated], ["b"])["b"].value == pytest.approx(0.4, abs=0.05)
    with pytest.raises(IdentificationError, match=r"131\.1 N and 200 N at a = 950 mm: give one branch"):
        forces(np.append(measured, 200.0), places)


def test_a_short_part_of_the_range_is_said() -> None:
    table = forces(100.0 * 1e-3 * STRETCHES, 1e-3 * STRETCHES)
    text = lines(identify(table.model, [table], moduli=True))
    assert "covers 0.09 % of the model's range of a: is the unit" in text


def test_a_known_zero_is_not_fitted() -> None:
    """The factor is that of the line through the origin."""
    measured = 80.0 * STRETCHES + 5.0
    table = forces(measured, free_zero=False)
    found = identify(table.model, [table], moduli=True)
    slope = float(STRETCHES @ measured / (STRETCHES @ STRETCHES)) / 100.0
    assert found[FACTOR].value == pytest.approx(slope, rel=1e-6)
    assert "offset" not in summarise(found)["measurements"][0]


def points(stretches: list[float], turn: float = 0.0, shift: float = 0.0, aligned: bool = False) -> MeasuredPoints:
    """The corners in each state, all turned about z and shifted along x."""
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    moved = np.vstack([CORNERS * [1.0 + a, 1.0, 1.0] for a in stretches]) @ rotation.T + [shift, 0.0, 0.0]
    states, places = (
        np.repeat([f"state {i}" for i, _ in enumerate(stretches)], 4),
        np.tile(CORNERS, (len(stretches), 1)),
    )
    return MeasuredPoints(stretched_plate(), tuple(states), {}, places, moved, aligned)


def test_points_of_another_frame_are_aligned() -> None:
    table = points([0.2, 0.2, 0.2], turn=0.3, shift=2.0, aligned=True)
    found = identify(table.model, [table], ["a"])
    assert found["a"].value == pytest.approx(0.2, abs=1e-6)
    assert found.misfits[0].rms < 1e-8
    assert "moved by" in lines(found)
    missing = table.measured.copy()
    missing[3, 2] = np.nan
    with pytest.raises(IdentificationError, match="all three measured coordinates"):
        replace(table, measured=missing)


@pytest.mark.parametrize("shift", [0.0, 2.0])
def test_another_frame_is_no_change_by_the_load(shift: float) -> None:
    """Two of four corners move along x; of one that shrinks, which the model cannot, all is missed, to both sides."""
    tables = [points([a, a, a], turn=0.3, shift=shift, aligned=True) for a in (0.2, -0.2)]
    both = [summarise(identify(table.model, [table], ["a"])) for table in tables]
    (of_right,), (of_wrong,) = (figures["measurements"] for figures in both)
    moved, left = 1e3 * 0.2 * np.sqrt(2 / 12), 1e3 * 0.1 / np.sqrt(3)
    assert [of_right["change_rms"], *(s["change_rms"] for s in of_right["states"])] == pytest.approx([moved] * 4)
    assert (of_wrong["rms"], of_wrong["change_rms"]) == pytest.approx((left, left))
    said = ["\n".join(identification_lines(figures)) for figures in both]
    assert ["of it is missed: check the units" in text for text in said] == [False, True]


def test_points_that_are_displacements_or_in_other_units_are_doubted() -> None:
    right = points([0.2, 0.2, 0.4])
    as_displacements = replace(right, measured=right.measured - right.places)
    assert "check the units, and that x, y, z are positions" in lines(identify(right.model, [as_displacements], ["a"]))
    in_other_units = replace(right, places=1e-3 * right.places, measured=1e-3 * right.measured)
    assert "all points lie within 0.1 % of the object" in lines(identify(right.model, [in_other_units], ["a"]))
    spread = points([0.2, 0.22, 0.18])
    text = lines(identify(spread.model, [spread], ["a"]))
    assert "check the units" not in text
    assert "all points lie" not in text


def loaded(loads: list[float], own: float, noise: float = 0.0, seed: int = 0) -> MeasuredPoints:
    """The corners, stretched by the load times a factor b of 0.5, and by ``own`` that the model does not have.

    The model's stretch is a b, with a known. Each state is measured twice, each time with an error of its own.
    """
    at, random = np.repeat(loads, 2), np.random.default_rng(seed)
    stretched = 0.5 * at + own
    moved = [CORNERS * [1.0 + a, 1.0, 1.0] + noise * random.normal(size=(4, 3)) for a in stretched]
    states = [f"{a:g} kg, {'ab'[i % 2]}" for i, a in enumerate(at)]
    known = {"a": np.repeat(at, 4)}
    # a b = (1 + x) (1 + y) / 4, in Chebyshev polynomials of x = 2 a - 1 and y = 2 b - 1.
    indices = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    functions = ParameterFunctions(np.zeros(2), np.ones(2), indices, np.full((4, 1), 0.25))
    shape = np.zeros((1, 4, 3))
    shape[0, :, 0] = CORNERS[:, 0]
    model = replace(stretched_plate(), displacement=SeparatedField(shape, functions), reactions={})
    return MeasuredPoints(model, tuple(np.repeat(states, 4)), known, np.tile(CORNERS, (len(at), 1)), np.vstack(moved))


def test_states_that_are_missed_are_named_though_the_others_fit() -> None:
    """A load of its own that the model lacks: what is left of own + (0.5 - b) a by the best b, in each state."""
    at = np.array([0.0, 0.5, 0.9])
    table = loaded(at.tolist(), own=0.1)
    found = identify(table.model, [table], ["b"])
    (figures,) = summarise(found)["measurements"]
    b = at @ (0.5 * at + 0.1) / (at @ at)
    assert found["b"].value == pytest.approx(b, abs=1e-6)
    # Two of the four corners move, along one axis of three: one value of six.
    left, moved = np.abs(0.1 + (0.5 - b) * at), 0.5 * at + 0.1
    assert [s["rms"] for s in figures["states"]] == pytest.approx(np.repeat(1e3 * left / np.sqrt(6), 2), abs=1e-3)
    assert [s["change_rms"] for s in figures["states"]] == pytest.approx(np.repeat(1e3 * moved / np.sqrt(6), 2))
    assert [s["known"]["a_mm"] for s in figures["states"]] == pytest.approx(np.repeat(1e3 * at, 2))
    assert figures["rms"] < 0.25 * figures["change_rms"]
    text = lines(found)
    assert "note: states 0 kg, a, 0 kg, b of points changed by 40.8 mm rms, and 40.8 mm of it is missed" in text
    assert "0.5 kg, a" not in text


@pytest.mark.slow
def test_states_that_hardly_move_are_not_accused() -> None:
    """Nothing but the error of measurement is in the unloaded states, of which all is missed."""
    accused = 0
    for seed in range(6):
        table = loaded([0.0, 0.05, 0.5, 0.9], own=0.0, noise=0.02, seed=seed)
        found = identify(table.model, [table], ["b"])
        (figures,) = summarise(found)["measurements"]
        assert figures["states"][0]["rms"] == pytest.approx(figures["states"][0]["change_rms"])
        accused += "of other states" in lines(found)
    assert accused == 0


def test_what_stands_at_an_end_and_could_not_be_found_is_said_to_be_both() -> None:
    """Forces with 200 N of noise, whose best law would be beyond the range."""
    table = forces(of_law(1.6) + 200.0 * np.cos(9.0 * STRETCHES))
    found = identify(table.model, [table], ["b"])
    assert found["b"].value in (0.0, 1.0)
    text = lines(found)
    assert "note: b is at the end of its range\n" in text
    assert "note: b could not be identified" in text
    assert "95 % interval wider than its range, 0 to 1" in text


def test_empty_cells_are_counted(tmp_path: Path) -> None:
    rows = [f"{1e3 * a},{f}" for a, f in zip(STRETCHES, of_law(0.4), strict=True)]
    rows[3], rows[7] = rows[3].split(",")[0] + ",", rows[7].split(",")[0] + ",nan"
    (tmp_path / "curve.csv").write_text("a_mm,force_N\n" + "\n".join(rows) + "\n")
    model = stretched_plate()
    curve = load_curve(tmp_path / "curve.csv", model)
    assert curve.empty == 2
    table = MeasuredForces(model, curve, reaction_in_direction(model, "edge:x"))
    assert "force_N is empty in 2 lines of its file" in lines(identify(model, [table], ["b"]))


def test_tables_given_twice_and_too_short_ones_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_model(tmp_path / "plate.morph", stretched_plate())
    curve = tmp_path / "curve.csv"
    curve.write_text("a_mm,force_N\n100,10\n200,20\n300,30\n")
    asked = ["identify", str(tmp_path / "plate.morph"), "--moduli", "-o", str(tmp_path / "out")]
    once = ["--force", str(curve), "--reaction", "edge:x"]
    assert cli.main([*asked, *once]) == 2
    assert "3 forces in column 'force_N': give at least 4" in capsys.readouterr().err
    curve.write_text("a_mm,force_N\n100,10\n200,20\n300,30\n400,40\n")
    assert cli.main([*asked, *once, "--no-offset"]) == 0
    assert cli.main([*asked, *once, "--force", f"{curve}:force_N", "--reaction", "edge:x", "--overwrite"]) == 2
    assert "is given twice" in capsys.readouterr().err
