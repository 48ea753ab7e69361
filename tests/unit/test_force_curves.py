"""Files of measured forces: units against their definitions, and what is said of files that cannot be meant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.force_curves import ForceCurve, load_curve
from tests.support.bent_sheet import bent_sheet_model

MODEL = bent_sheet_model(3, 3)


def curve_of(folder: Path, text: str, column: str | None = None) -> ForceCurve:
    (folder / "curve.csv").write_text(text)
    return load_curve(folder / "curve.csv", MODEL, column)


def refusal(folder: Path, text: str, column: str | None = None) -> str:
    """What is said of a file, without the folder it lies in."""
    with pytest.raises(EvaluationError) as error:
        curve_of(folder, text, column)
    return str(error.value).replace(f"{folder}/", "")


@pytest.mark.parametrize(
    ("column", "newtons"),
    [
        ("force_N", 1.0),
        ("force_mN", 1e-3),
        ("force (kN)", 1e3),
        ("load(lbf)", 0.45359237 * 9.80665),
        ("force_kN", 1e3),
        ("force_MN", 1e6),
        ("force_g", 9.80665e-3),
        ("force_gf", 9.80665e-3),
        ("load_kgf", 9.80665),
        ("load_kg", 9.80665),
        # A pound is 0.45359237 kg and has sixteen ounces.
        ("force_lbf", 0.45359237 * 9.80665),
        ("force_lb", 0.45359237 * 9.80665),
        ("force_ozf", 0.45359237 * 9.80665 / 16.0),
    ],
)
def test_a_column_of_forces_ends_in_its_unit(tmp_path: Path, column: str, newtons: float) -> None:
    curve = curve_of(tmp_path, f"arch_mm,{column}\n0,1\n1,2\n2,4\n")
    np.testing.assert_allclose(curve.forces, newtons * np.array([1.0, 2.0, 4.0]), rtol=1e-14)


@pytest.mark.parametrize(
    "column",
    [
        "force",
        "force_right",
        "notch_3.6mm",
        "specimen_A",
        "force (run 2)",
        "force N",
        "specimen_V",
        "specimen_s",
        "force_1",
        "force_min",
        "force_rad",
    ],
)
def test_a_name_without_a_unit_is_in_newtons(tmp_path: Path, column: str) -> None:
    curve = curve_of(tmp_path, f"arch_mm,{column}\n0,1\n1,2\n2,4\n")
    assert curve.forces.tolist() == [1.0, 2.0, 4.0]


@pytest.mark.parametrize("unit", ["KN", "kn", "LBF", "lbs", "kip", "dyn", "mm", "MPa", "N/mm", "mV"])
def test_what_seems_a_unit_but_is_none_of_force_is_refused(tmp_path: Path, unit: str) -> None:
    assert refusal(tmp_path, f"arch_mm,force_{unit}\n0,1\n1,2\n2,4\n") == (
        f"curve.csv: column 'force_{unit}' ends in '{unit}', which is no unit of force that is known: give one of "
        "N, mN, kN, uN, MN, gf, g, kgf, kg, lbf, lb, ozf, oz"
    )


@pytest.mark.parametrize("title", ["force kN", "force/kN", "force / kN"])
def test_a_unit_that_only_a_space_sets_apart_is_not_left_out(tmp_path: Path, title: str) -> None:
    said = refusal(tmp_path, f"arch_mm,{title}\n0,1\n1,2\n2,4\n")
    assert said == f"curve.csv: the unit of column '{title}' is not set apart: write force_kN"


@pytest.mark.parametrize("asked", [None, "force_N"])
def test_of_two_columns_of_one_name_none_is_taken(tmp_path: Path, asked: str | None) -> None:
    said = refusal(tmp_path, "arch_mm,force_N,force_N\n0,1,2\n1,2,4\n2,4,8\n", asked)
    assert said == "curve.csv has several columns 'force_N': give each a name of its own"


def test_only_the_unit_of_the_column_that_is_read_counts(tmp_path: Path) -> None:
    curve = curve_of(tmp_path, "arch_mm,force_kgf,stress_MPa\n0,1,7\n1,2,8\n2,4,9\n", "force_kgf")
    np.testing.assert_allclose(curve.forces, [9.80665, 19.6133, 39.2266])


@pytest.mark.parametrize("title", ["arch", "arch_in", "arch_N", "way_mm"])
def test_a_parameter_without_its_unit_is_refused(tmp_path: Path, title: str) -> None:
    said = refusal(tmp_path, f"{title},force_N\n0,1\n1,2\n2,4\n")
    assert said.startswith(f"curve.csv: the first column is '{title}'; name it frame, or as a parameter")
    assert said.endswith("arch_mm, skew_1, twist_deg")


@pytest.mark.parametrize(
    ("text", "column", "said"),
    [
        (
            "arch_mm\n0\n1\n2\n",
            None,
            "curve.csv has no column of forces: give one beside 'arch_mm', with its unit, as arch_mm,force_N",
        ),
        ("arch_mm,a_N\n0,1\n", "c_N", "curve.csv has no column 'c_N'; name one that it has, as curve.csv:a_N"),
        (
            "arch_mm,a_N,b_N,c_N\n0,1,2,3\n",
            None,
            "curve.csv has several columns of forces; name one that it has, as curve.csv:a_N; the others are b_N, c_N",
        ),
        (
            "arch_mm,force_N\n0,0,0,0\n0,5,0,440\n",
            None,
            "curve.csv, line 2: 4 cells under 2 titles; write decimals with points",
        ),
        (
            "arch_mm,force_N\n0,0\n\n0,5,0,440\n",
            None,
            "curve.csv, line 4: 4 cells under 2 titles; write decimals with points",
        ),
        (
            "arch_mm;force_N\n0,5;0,440\n",
            None,
            "curve.csv is separated by semicolons: write commas between cells, and decimals with points",
        ),
        (
            "arch_mm\tforce_N\n0.5\t0.440\n",
            None,
            "curve.csv is separated by tabs: write commas between cells, and decimals with points",
        ),
        (
            "arch_mm,force_N\n0,1\n1,none\n",
            None,
            "curve.csv, line 3: '1,none' is not a place on the curve and its forces, all numbers",
        ),
    ],
)
def test_a_file_that_cannot_be_meant(tmp_path: Path, text: str, column: str | None, said: str) -> None:
    assert refusal(tmp_path, text, column) == said


def test_empty_cells_at_the_end_of_lines_are_no_cells(tmp_path: Path) -> None:
    """Tables that a spreadsheet writes have commas up to the widest line."""
    curve = curve_of(tmp_path, "arch_mm,force_N,,\n0,1,,\n1,2\n2,4,,\n3,,,\n,,,\n")
    assert curve.name == "force_N"
    np.testing.assert_allclose(curve.places, [0.0, 0.001, 0.002])
    assert curve.forces.tolist() == [1.0, 2.0, 4.0]
