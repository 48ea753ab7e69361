"""Several force curves: what each has as a whole, such as its specimen or its load cell, is in the interval."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import t, ttest_1samp

from morph_dslam.cli import app as cli
from morph_dslam.evaluation.force import reaction_in_direction
from morph_dslam.evaluation.force_curves import ForceCurve
from morph_dslam.identification.curve_factors import curve_factors, noise_within
from morph_dslam.identification.found import Identification
from morph_dslam.identification.identify import identify
from morph_dslam.identification.measured_forces import MeasuredForces
from morph_dslam.identification.report import identification_lines, summarise
from morph_dslam.identification.scatter import Design, joint_labels
from morph_dslam.identification.values import FACTOR
from morph_dslam.model import Parameter, ReducedModel, save_model
from morph_dslam.model.functions import ParameterFunctions
from tests.support.edge_plate import edge_plate

STRETCHES = np.linspace(0.1, 0.9, 8)


def plate() -> ReducedModel:
    """A plate of 1 m that is stretched by a along x, by a force of 100 a newtons."""
    a = Parameter("a", "length", "mm", 0.0, 1.0, 0.0)
    functions = ParameterFunctions(np.zeros(1), np.ones(1), np.array([[0], [1]]), np.full((2, 1), 0.5))
    return edge_plate((a,), functions)


def of_specimens(factors: list[float], noise: float, free_zero: bool = False, seed: int = 0) -> Identification:
    model, rng = plate(), np.random.default_rng(seed)
    tables = []
    for k, factor in enumerate(factors):
        forces = 100.0 * factor * STRETCHES + 2.0 * free_zero + noise * rng.normal(size=8)
        curve = ForceCurve("a", STRETCHES, forces, f"s{k}.csv:force_N")
        tables.append(MeasuredForces(model, curve, reaction_in_direction(model, "edge:x"), None, free_zero))
    return identify(model, tables, moduli=True)


@pytest.mark.parametrize("free_zero", [True, False])
def test_specimens_that_differ_have_the_interval_of_their_mean(free_zero: bool) -> None:
    """With next to no noise, Student's interval of the mean of the specimens' factors, by another library."""
    factors = [0.95, 1.02, 1.06, 0.99, 1.08]
    found = of_specimens(factors, 0.02, free_zero)
    low, high = ttest_1samp(factors, 0.0).confidence_interval(0.95)
    assert found[FACTOR].value == pytest.approx(np.mean(factors), abs=2e-3)
    # Of the factor's logarithm.
    assert np.log(found[FACTOR].interval) == pytest.approx(np.log([low, high]), abs=3e-3)
    assert found.curve_std == pytest.approx(np.std(factors, ddof=1) / np.mean(factors), rel=0.02)
    text = "\n".join(identification_lines(summarise(found)))
    assert "note: force curves differ as a whole by" in text
    assert "s4.csv:force_N +5.9 %" in text


def test_curves_that_agree_have_the_interval_of_regression() -> None:
    """No curve of three counts as one value: that through the origin of all 24 forces, on average."""
    widths = []
    for seed in range(1, 7):
        found = of_specimens([1.0, 1.0, 1.0], 0.4, seed=seed)
        assert found.curve_std == 0.0
        assert "differ as a whole" not in "\n".join(identification_lines(summarise(found)))
        widths.append(np.ptp(found[FACTOR].interval))
    error = 0.4 / np.sqrt(3.0 * np.sum((100.0 * STRETCHES) ** 2))
    assert np.median(widths) == pytest.approx(2.0 * t.ppf(0.975, 23) * error, rel=0.3)


def design_of(factors: np.ndarray, rng: np.random.Generator, noise: float) -> tuple[Design, list[np.ndarray]]:
    """One common factor near 1 of curves 100 a, and what is missed at 1."""
    ways = [100.0 * STRETCHES] * len(factors)
    missed = [way * (1.0 - factor) + noise * rng.normal(size=8) for way, factor in zip(ways, factors, strict=True)]
    labels = joint_labels([np.arange(8)] * len(factors))
    slopes = np.concatenate(ways)[:, None] / noise
    return Design(slopes, np.zeros((0, 1)), [np.zeros((8, 0))] * len(factors), labels), missed


@pytest.mark.parametrize("count", [2, 4, 8])
def test_curves_that_agree_are_seldom_said_to_differ(count: int) -> None:
    rng, draws, ways = np.random.default_rng(1), 400, [100.0 * STRETCHES] * count
    said = 0
    for _ in range(draws):
        design, missed = design_of(np.ones(count), rng, 0.5)
        within = noise_within(design, missed, ways, ["N"] * count, np.full(count, 50.0), np.full(count, 0.5))
        by_noise = [way / std for way, std in zip(ways, within.std, strict=True)]
        scaled = replace(design, slopes=np.concatenate(by_noise)[:, None])
        said += curve_factors(scaled, missed, ways, 0.0, np.zeros((0, 8 * count)), within).std > 0.0
    # One of a hundred, and three deviations of that count.
    assert said <= 0.01 * draws + 3.0 * np.sqrt(draws * 0.01)


def test_the_file_is_named_where_columns_have_one_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_model(tmp_path / "plate.morph", plate())
    asked = ["identify", str(tmp_path / "plate.morph"), "--moduli", "--no-offset", "-o", str(tmp_path / "out")]
    for name, factor in {"one.csv": 1.0, "two.csv": 1.1}.items():
        rows = [f"{1e3 * a},{100.0 * factor * a}" for a in STRETCHES]
        (tmp_path / name).write_text("a_mm,force_N\n" + "\n".join(rows) + "\n")
        asked += ["--force", str(tmp_path / name), "--reaction", "edge:x"]
    assert cli.main(asked) == 0
    said = capsys.readouterr().out
    assert "one.csv:force_N: 8 values missed" in said
    assert "two.csv:force_N: 8 values missed" in said
    assert cli.main([*asked[:-4], "--overwrite"]) == 0
    assert "\nforce_N: 8 values missed" in capsys.readouterr().out
