"""Viscoelastic bars from study file to model, against closed forms of linear viscoelasticity."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from morph_dslam import load_model
from morph_dslam.cli import app as cli
from morph_dslam.model import ReducedModel
from tests.support.block_study import sliding

BAR = """
name = "bar"
[mesh]
generator = "block"
size = ["40 mm", "40 mm", "80 mm"]
divisions = [1, 1, 1]
cells = "hex8"
[materials.rubber]
law = "neo_hookean"
young = "3 MPa"
poisson = POISSON
prony = { relative_moduli = [0.6], times = ["2 s"] }
[[supports]]
kind = "displacement"
on = "z_max"
z = "MOTION"
[parameters.held]
range = ["0 s", "5 s"]
[time]
parameter = "held"
step = "STEP"
[solver]
threads = 1
[sampling]
scheme = "even"
training = 21
held_out = 4
[reduction]
max_degree = 8
tolerance = 1e-7
"""


def built(folder: Path, **words: str) -> ReducedModel:
    """The model of the bar with words of the study replaced."""
    text = BAR + sliding(("x_min", "x"), ("y_min", "y"), ("z_min", "z"))
    for word, value in words.items():
        text = text.replace(word, value)
    (folder / "study.toml").write_text(text)
    assert cli.main(["build", str(folder / "study.toml"), "-o", str(folder / "bar.morph")]) == 0
    return load_model(folder / "bar.morph")


def test_a_viscous_bar_relaxes_as_its_prony_series_says(tmp_path: Path) -> None:
    """g = 0.6, tau = 2 s: the stress at constant stretch falls to 0.763918 at 1 s and 0.481201 at 4 s."""
    model = built(tmp_path, POISSON="0.45", MOTION="12 mm", STEP="0.2 s")
    start, one, four = (model.von_mises(np.array([t]), "solid") for t in (0.0, 1.0, 4.0))
    assert one / start == pytest.approx(np.full(8, 0.763918), abs=2e-5)
    assert four / start == pytest.approx(np.full(8, 0.481201), abs=2e-5)
    assert "sensitivity" not in model.certificate


def test_a_support_moves_with_time(tmp_path: Path) -> None:
    """Strain e = rate t, small: stress rate E (0.4 t + 0.6 tau (1 - exp(-t / tau)))."""
    model = built(tmp_path, POISSON="0.0", MOTION="0.008 mm * held / 5 s", STEP="0.1 s")
    for time in (1.0, 2.5, 5.0):
        relaxing = 2.0 * (1.0 - np.exp(-time / 2.0))
        stress = 3e6 * 1e-4 / 5.0 * (0.4 * time + 0.6 * relaxing)
        found = model.von_mises(np.array([time]), "solid")
        assert found == pytest.approx(np.full(len(model.nodes), stress), rel=5e-4)
