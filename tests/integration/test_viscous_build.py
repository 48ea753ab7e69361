"""Viscoelastic bars from study file to model, against closed forms of linear viscoelasticity."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam import load_model, make_study
from morph_dslam.cli import app as cli
from morph_dslam.errors import StudyError
from morph_dslam.model import ReducedModel
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.viscous_sweep import ViscousSweep
from tests.support.block_study import sliding
from tests.support.closed_form_stress import lame

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


@pytest.mark.slow
def test_a_support_moves_with_time(tmp_path: Path) -> None:
    """Strain e = rate t, small: stress rate E (0.4 t + 0.6 tau (1 - exp(-t / tau)))."""
    model = built(tmp_path, POISSON="0.0", MOTION="0.008 mm * held / 5 s", STEP="0.1 s")
    for time in (1.0, 2.5, 5.0):
        relaxing = 2.0 * (1.0 - np.exp(-time / 2.0))
        stress = 3e6 * 1e-4 / 5.0 * (0.4 * time + 0.6 * relaxing)
        found = model.von_mises(np.array([time]), "solid")
        assert found == pytest.approx(np.full(len(model.nodes), stress), rel=5e-4)


@pytest.mark.slow
def test_a_stroke_that_grows_and_stays_is_tracked_by_forces_over_paths(tmp_path: Path) -> None:
    """Without contraction P = E / 2 (s - 1 / s) at once; S = P / s relaxes, integrated in 8000 lines (Boltzmann)."""
    pulled = [*SIDES, {"kind": "displacement", "on": "z_max", "z": "load * ramp"}]
    ramp = {"times": ["0 s", "2 s", "12 s", "13 s"], "values": [0.0, 1.0, 1.0, 0.4]}
    content = VARIED | {
        "materials": {
            "rubber": {
                "law": "neo_hookean",
                "young": "3 MPa",
                "poisson": 0.0,
                "prony": {"relative_moduli": [0.6], "times": ["2 s"]},
            }
        },
        "mesh": {"generator": "block", "size": ["10 mm", "10 mm", "20 mm"], "divisions": [1, 1, 1], "cells": "hex8"},
        "time": {"parameter": "held", "step": "0.25 s", "amplitudes": {"ramp": ramp}},
        "supports": pulled,
        "parameters": {"held": VARIED["parameters"]["held"], "load": VARIED["parameters"]["load"]},
        "sampling": {"training": 8, "held_out": 4},
        "reduction": {"tolerance": 1e-2},
    }
    model = md.build(make_study(content))
    assert model.certificate["reduction"]["paths"] == 8
    times = np.linspace(0.0, 20.0, 8001)
    for load in (2e-3, 6e-3):
        stretch = 1.0 + load / 0.02 * np.interp(times, [0.0, 2.0, 12.0, 13.0], ramp["values"])
        at_once = 3e6 / 2.0 * (1.0 - 1.0 / stretch**2)
        fade = np.exp(-np.diff(times)[0] / 2.0)
        relaxing = [0.0]
        for change in np.diff(at_once):
            relaxing.append(fade * relaxing[-1] + np.sqrt(fade) * change)
        force = 1e-4 * stretch * (0.4 * at_once + 0.6 * np.array(relaxing))
        found = [
            model.at({"held": t, "load": load}).reactions()["force_z_max"][2] for t in (1.0, 2.0, 2.3, 5, 12.5, 13, 17)
        ]
        wanted = np.interp([1.0, 2.0, 2.3, 5.0, 12.5, 13.0, 17.0], times, force)
        np.testing.assert_allclose(found, wanted, atol=1.3e-2 * np.abs(force).max())


@pytest.mark.slow
def test_an_increment_that_is_too_long_shows_in_the_discretisation_error() -> None:
    """Creep under a stress s, small: the strain is s / E (1 + g / (1 - g) (1 - exp(-(1 - g) t / tau)))."""
    gel = {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.0}
    content = VARIED | {
        "materials": {"gel": gel | {"prony": {"relative_moduli": [0.6], "times": ["0.2 s"]}}},
        "time": {"parameter": "held", "step": "20 s"},
        "supports": SIDES,
        "loads": [{"kind": "traction", "on": "z_max", "traction": ["0 Pa", "0 Pa", "30 Pa"]}],
        "parameters": {"held": {"range": ["0 s", "2 s"]}},
        "reduction": {"tolerance": 2e-2},
    }
    model = md.build(make_study(content))
    entry = model.certificate["discretisation"]
    assert entry["method"] == "displacements of order 3 on the same cells, half the increments of time"
    errors = []
    for (held,) in entry["coordinates"]:
        truth = 30.0 / 3e6 * (1.0 + 1.5 * (1.0 - np.exp(-2.0 * held)))
        errors.append(1e3 * (model.at({"held": held}).displacement()[:, 2] - truth * model.nodes[:, 2]))
    stated = entry["errors"]["displacement"]["max_mm"]
    assert 0.5 < stated / np.abs(errors).max() < 1.5
    assert stated > 2e-4 * entry["errors"]["displacement"]["largest_mm"], "the increments are long indeed"


def test_a_state_does_not_depend_on_the_samples_before_it() -> None:
    weight = [{"kind": "traction", "on": "z_max", "traction": ["0 Pa", "0 Pa", "300 kPa"]}]
    sweep = varied({"relative_moduli": ["g"], "times": ["tau"]}, 0.3, "20 s", supports=SIDES, loads=weight)

    def at(held: float) -> np.ndarray:
        return np.array([held, 0.4, 0.0, 1.0, 1e6, 0.0])

    alone = sweep.advance(sweep.first_state(), at(17.3))
    state = sweep.first_state()
    for held in (0.01, 3.3, 9.0, 9.1, 16.9, 17.3):
        state = sweep.unpack(sweep.pack(sweep.advance(state, at(held))))
    found, wanted = (sweep.take_snapshot(one).fields["displacement"] for one in (state, alone))
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-9 * np.abs(wanted).max())


#: The same bar with what may change from sample to sample: at t = 0 none of it is any default's.
VARIED = {
    "name": "bar",
    "mesh": {"generator": "block", "size": ["10 mm", "10 mm", "20 mm"], "divisions": [1, 1, 2], "cells": "hex8"},
    "parameters": {
        "held": {"range": ["0 s", "20 s"]},
        "g": {"range": [0.0, 0.8], "default": 0.4},
        "k": {"range": [0.0, 0.5]},
        "tau": {"range": ["1 s", "8 s"]},
        "young": {"range": ["1 MPa", "4 MPa"]},
        "load": {"range": ["0 mm", "6 mm"]},
    },
    "solver": {"threads": 1},
}
SIDES = [{"kind": "displacement", "on": f"{axis}_min", axis: "0 mm"} for axis in "xyz"]


def varied(prony: dict, poisson: float, step: str, **others: Any) -> ViscousSweep:
    """The sweep of that bar; parameters that nothing names do not matter here."""
    law = {"law": "neo_hookean", "young": "young", "poisson": poisson, "prony": prony}
    content = VARIED | {"materials": {"rubber": law}, "time": {"parameter": "held", "step": step}} | others
    study = make_study(content)
    assert isinstance(study, SolidStudy)
    sweep = study.sweep_problem()
    assert isinstance(sweep, ViscousSweep)
    return sweep


@pytest.mark.slow
def test_each_sample_has_the_history_of_its_own_parameters() -> None:
    """Without contraction P = E / 2 (s - 1 / s) at once, and the part 1 - g (1 - exp(-t / tau)) of it is left."""
    pulled = [*SIDES, {"kind": "displacement", "on": "z_max", "z": "load"}]
    sweep = varied({"relative_moduli": ["g"], "times": ["tau"]}, 0.0, "5 s", supports=pulled)
    start = sweep.first_state()
    for g, tau, young, load in product((0.0, 0.1, 0.8), (1.0, 8.0), (1e6, 4e6), (2e-3, 6e-3)):
        stretch = 1.0 + load / 0.02
        at_once = 1e-4 * young / 2.0 * (stretch - 1.0 / stretch)
        for held in (0.0, 4.0, 20.0):
            start = sweep.advance(start, np.array([held, g, 0.0, tau, young, load]))
            force = sweep.take_snapshot(start).outputs["force_z_max"][2]
            assert force == pytest.approx(at_once * (1.0 - g * (1.0 - np.exp(-held / tau))), rel=1e-8)


@pytest.mark.parametrize("cells", ["hex8", "tet10"])
def test_the_volume_relaxes_by_parameters_that_are_zero_by_default(cells: str) -> None:
    """Creep between walls under a stress s: the modulus M = lambda + 2 mu relaxes by the part m.

    The strain is s / M (1 + m / (1 - m) (1 - exp(-(1 - m) t / tau))).
    """
    walls = [{"kind": "displacement", "on": f"{axis}_max", axis: "0 mm"} for axis in "xy"]
    prony = {"relative_moduli": ["g"], "times": ["tau"], "bulk_moduli": ["k"]}
    weight = [{"kind": "traction", "on": "z_max", "traction": ["0 Pa", "0 Pa", "-1 Pa"]}]
    mesh = {"generator": "block", "size": ["10 mm", "10 mm", "20 mm"], "divisions": [1, 1, 2], "cells": cells}
    sweep = varied(prony, 0.4, "0.2 s", supports=[*SIDES, *walls], loads=weight, mesh=mesh)
    lam, shear = lame(4e6, 0.4)
    for g, k in ((0.0, 0.5), (0.8, 0.0), (0.6, 0.3)):
        m = (k * lam + g * 2.0 * shear) / (lam + 2.0 * shear)
        state = sweep.advance(sweep.first_state(), np.array([4.0, g, k, 2.0, 4e6, 0.0]))
        strain = np.abs(sweep.take_snapshot(state).fields["displacement"][:, 2]).max() / 0.02
        crept = 1.0 + m / (1.0 - m) * (1.0 - np.exp(-(1.0 - m) * 4.0 / 2.0))
        assert strain == pytest.approx(crept / (lam + 2.0 * shear), rel=1e-3)


def test_relative_moduli_that_can_sum_to_one_are_refused() -> None:
    with pytest.raises(StudyError, match=r"sum below 1 .* where g = 0.8, k = 0.5, young = 1 MPa: change"):
        varied({"relative_moduli": ["g", "k"], "times": ["1 s", "9 s"]}, 0.0, "5 s", supports=SIDES)
