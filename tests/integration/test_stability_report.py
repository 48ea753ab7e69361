"""A column pushed past its buckling load without an imperfection: the build says what it has passed."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam import load_model
from morph_dslam.cli import app as cli
from morph_dslam.model import Parameter
from morph_dslam.reduction.certificate import stability_report, stability_warnings

COLUMN = """
name = "column"
[mesh]
generator = "block"
size = ["10 mm", "20 mm", "150 mm"]
divisions = [1, 1, 12]
[materials.rubber]
law = "neo_hookean"
young = "3 MPa"
poisson = 0.0
[[supports]]
kind = "fixed"
on = "z_min"
[[supports]]
kind = "displacement"
on = "z_max"
x = "0 mm"
y = "0 mm"
z = "-150 mm * shortening"
[parameters.shortening]
range = [0.0, 0.025]
[solver]
threads = 1
[sampling]
scheme = "even"
training = 11
held_out = 4
refined = 0
"""
#: Shortening at which a clamped column buckles: 4 pi^2 I / (A L^2), Euler.
EULER = 4.0 * np.pi**2 * 10.0**2 / (12.0 * 150.0**2)


#: A pressure on its sides alone, whose rims are held, and one on a face whose rim is free: the tangent is symmetric,
#: and is not.
PRESSURE = '[[loads]]\nkind = "pressure"\non = {on}\npressure = "{size} Pa"\n'
SIDES, FACE = '["x_min", "x_max", "y_min", "y_max"]', '"part"'
PART = '\n[sets.part]\nof = "x_max"\nbox = [["-1 mm", "-1 mm", "50 mm"], ["11 mm", "21 mm", "80 mm"]]\n'


LOADS = {"none": "", "closed": PRESSURE.format(on=SIDES, size=100), "open": PART + PRESSURE.format(on=FACE, size=1)}


@pytest.mark.slow
@pytest.mark.parametrize("load", LOADS.values(), ids=LOADS)
def test_a_bifurcation_that_was_passed_is_reported(tmp_path, capsys, load) -> None:
    (tmp_path / "study.toml").write_text(COLUMN + load)
    assert cli.main(["build", str(tmp_path / "study.toml"), "-o", str(tmp_path / "column.morph")]) == 0
    printed = capsys.readouterr().out
    report = load_model(tmp_path / "column.morph").certificate["stability"]
    (passed,) = report["passed"]
    (before,), (after,) = passed["coordinates"]
    assert before < EULER < after
    assert passed["negative_pivots"] == [0, 1]
    beyond = [sample["coordinates"][0] for sample in report["unstable_samples"]]
    assert min(beyond) == after
    assert report["stable"] + report["unstable"] == 15
    assert report["unstable"] == len(beyond) > 3
    assert f"warning: {len(beyond)} of 15 solutions are unstable" in printed
    assert "warning: negative pivots change from 0 to 1 between shortening = 0.01" in printed
    assert cli.main(["info", str(tmp_path / "column.morph")]) == 0
    assert f"{len(beyond)} of 15 solutions are unstable; bifurcations" in capsys.readouterr().out


@pytest.mark.slow
def test_a_column_with_an_imperfection_bends_out_past_its_buckling_load(tmp_path) -> None:
    """Bent inextensibly to a cosine it is shorter by (pi w / 2)^2 / length, beside what Euler's load compresses."""
    (tmp_path / "study.toml").write_text(
        COLUMN + '[[loads]]\nkind = "body_force"\nforce = ["1000 N/m3", "0 N/m3", "0 N/m3"]\n'
    )
    assert cli.main(["build", str(tmp_path / "study.toml"), "-o", str(tmp_path / "column.morph")]) == 0
    model = load_model(tmp_path / "column.morph")
    assert model.certificate["stability"]["unstable"] == 0
    for shortening in (0.02, 0.025):
        deflection = model.at({"shortening": shortening}).displacement()[:, 0].max()
        expected = 2.0 / np.pi * 0.15 * np.sqrt(shortening - EULER)
        np.testing.assert_allclose(deflection, expected, rtol=0.07)


SHIFT = Parameter("shift", "length", "mm", 0.0, 1.0, 0.0)
SAMPLES = np.array([[0.001], [0.002], [0.003], [0.004]])


def test_neighbours_are_those_of_the_sweep_tree() -> None:
    """Two branches from the first sample; one of them ends beyond a critical point."""
    report = stability_report([SHIFT], SAMPLES, {0: 0, 1: 0, 2: 2, 3: None}, [-1, 0, 0, 2])
    assert report["passed"] == [
        {"between": ["shift = 1 mm", "shift = 3 mm"], "coordinates": [[0.001], [0.003]], "negative_pivots": [0, 2]}
    ]
    assert (report["stable"], report["unstable"], report["unknown"]) == (2, 1, 1)
    assert stability_warnings({"stability": report}) == [
        "1 of 4 solutions are unstable; bifurcations may have been passed in one place; of 1 it is not known",
        "negative pivots change from 0 to 2 between shift = 1 mm and shift = 3 mm",
    ]


def test_what_the_solver_cannot_tell_is_stated_and_is_no_warning() -> None:
    unknown = stability_report([SHIFT], SAMPLES, dict.fromkeys(range(4)), [-1, 0, 1, 2])
    assert unknown["statement"] == "the solver cannot tell whether the solutions are stable"
    assert stability_warnings({"stability": unknown}) == []
    stable = stability_report([SHIFT], SAMPLES, dict.fromkeys(range(4), 0), [-1, 0, 1, 2])
    assert stable["statement"] == "all 4 solutions are stable"
    assert stability_warnings({"stability": stable}) == []
    assert stability_warnings({}) == []


def test_a_default_that_is_unstable_is_said_first() -> None:
    """All others are followed from there: they may belong to a branch that no body takes."""
    report = stability_report([SHIFT], SAMPLES, dict.fromkeys(range(4), 3), [-1, 0, 1, 2])
    assert report["unstable_start"]
    first, second = stability_warnings({"stability": report})
    assert "the solution at the defaults, from which all others are followed, is unstable" in first
    assert second.startswith("4 of 4 solutions are unstable")
