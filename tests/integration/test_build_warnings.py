"""What a build says of solutions that jump, that never move, or that are too few, and of forces that are rounding."""

from __future__ import annotations

import re
import tomllib
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.cli.app import main
from morph_dslam.errors import SolverError, StudyError
from morph_dslam.mechanics.solvers.continuation import PathError, advance, loaded_state
from morph_dslam.studies.sampling import held_out_samples
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.solid_sweep import SolidSweep

SNAP = """
name = "buckled strip"
mesh = { generator = "block", size = ["40 mm", "5 mm", "0.8 mm"], divisions = [8, 1, 1], cells = "hex8" }
materials = { m = { law = "neo_hookean", young = "1 MPa", poisson = 0.4 } }
supports = [
  { kind = "fixed", on = "x_min" },
  { kind = "displacement", on = "x_max", x = "-1 mm", y = "0 mm", z = "0 mm", first = true },
]
loads = [
  { kind = "traction", on = "z_min", traction = ["0 Pa", "0 Pa", "10 Pa"], first = true },
  { kind = "traction", on = "z_max", traction = ["0 Pa", "0 Pa", "-1 * w"] },
]
parameters = { w = { range = ["0 Pa", "400 Pa"] } }
sampling = { training = 16, held_out = 4, refined = 0 }
solver = { threads = 1 }
"""
BLOCK: dict[str, Any] = tomllib.loads(
    """
name = "block"
mesh = { generator = "block", size = ["9 mm", "9 mm", "27 mm"], divisions = [1, 1, 3], cells = "hex8" }
materials = { rubber = { law = "neo_hookean", young = "3 MPa", poisson = 0.3 } }
supports = [{ kind = "fixed", on = "z_min" }]
loads = [{ kind = "traction", on = "z_max", traction = ["0 Pa", "0 Pa", "pull"] }]
parameters = { pull = { range = ["0 kPa", "100 kPa"] } }
sampling = { scheme = "even", training = 8, held_out = 4, refined = 0 }
solver = { workers = 1, threads = 1 }
"""
)


def coarse(certificate: dict[str, Any]) -> list[str]:
    """The warnings about a coarse mesh."""
    return [text for text in certificate.get("warnings", []) if "is too coarse" in text]


def test_a_plate_that_hardly_bends_is_said_to_be_too_coarse() -> None:
    """A clamped plate under pressure sinks by 0.00126 p a^4 / D (Timoshenko), D = E t^3 / 12 (1 - nu^2)."""
    side, thickness, young, pressure = 0.1, 0.3e-3, 1e9, 1.0
    study: dict[str, Any] = {
        "name": "plate",
        "mesh": {"generator": "block", "size": ["100 mm", "100 mm", "0.3 mm"], "divisions": [4, 4, 1], "cells": "hex8"},
        "materials": {"plastic": {"law": "neo_hookean", "young": "1 GPa", "poisson": 0.3}},
        "supports": [{"kind": "fixed", "on": ["x_min", "x_max", "y_min", "y_max"]}],
        "loads": [{"kind": "pressure", "on": "z_max", "pressure": "p"}],
        "parameters": {"p": {"range": ["0 Pa", "1 Pa"]}},
        "sampling": {"scheme": "even", "training": 8, "held_out": 4, "refined": 1},
        "solver": {"workers": 1, "threads": 1},
    }
    model = md.build(md.make_study(study))
    sunk = np.abs(model.displacement.value(np.array([pressure]))).max()
    assert sunk < 0.3 * 0.00126 * pressure * side**4 / (young * thickness**3 / 12.0 / (1.0 - 0.3**2))
    (said,) = coarse(model.certificate)
    share = re.search(r"16 hex8.*by (\d+) % of displacements", said)
    assert share is not None, said
    assert float(share[1]) > 70.0
    assert "solver.order = 2" in said
    assert "shell" in said


def test_a_mesh_that_is_fine_enough_is_not() -> None:
    """Two hexahedra through a bar that is pulled: its stretch is that of the law within a percent."""
    study = BLOCK | {"sampling": BLOCK["sampling"] | {"refined": 1}}
    certificate = md.build(md.make_study(study)).certificate
    assert "errors" in certificate["discretisation"]
    assert not coarse(certificate)


def middle_of(nodes: np.ndarray) -> np.ndarray:
    return np.abs(nodes[:, 0] - 0.02) < 1e-9


def last_load_above(study: SolidStudy) -> float:
    """The largest load, Pa, under which the middle of the strip stays above its ends, growing in steps of 5 Pa."""
    problem = study.problem()
    state = loaded_state(problem, np.zeros(1))
    middle = middle_of(problem.mesh.nodes)
    for load in np.arange(5.0, 401.0, 5.0):
        try:
            following = advance(problem, state, np.array([load]))[-1]
        except PathError as error:
            return float(error.states[-1].mu[0])
        if problem.sample(following.dofs, following.mu)["displacement"][middle, 2].mean() < 0.0:
            break
        state = following
    return float(state.mu[0])


@pytest.mark.slow
def test_a_strip_that_snaps_through_is_said_to_jump(tmp_path: Path, capsys) -> None:
    """It bulges up where the interval begins and down where it ends; small steps lose it there too."""
    (tmp_path / "study.toml").write_text(SNAP)
    assert main(["build", str(tmp_path / "study.toml"), "-o", str(tmp_path / "snap.morph")]) == 0
    printed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning: ")]
    found = re.match(r"warning: solutions jump between w = ([\d.]+) and ([\d.]+) Pa: there the model", printed[0])
    assert found is not None, printed
    assert "of the 4 held-out solutions that measure the errors, none lies there" in printed[0]
    assert "build each side by itself" in printed[0]
    low, high = float(found[1]), float(found[2])
    assert high - low <= 400.0 / 16.0
    study = md.load_study(tmp_path / "study.toml")
    assert isinstance(study, SolidStudy)
    assert low - 5.0 <= last_load_above(study) <= high + 5.0
    model = md.load_model(tmp_path / "snap.morph")
    before, after = ((model.positions(np.array([w])) - model.nodes)[middle_of(model.nodes), 2] for w in (low, high))
    assert before.min() > 1e-3
    assert after.max() < -1e-3
    assert model.certificate["warnings"][0] == printed[0].removeprefix("warning: ")


@pytest.mark.slow
def test_samples_that_do_not_reach_the_tolerance_are_said_to(tmp_path: Path) -> None:
    """A block of three parameters from 8 solutions: the tolerance is out of reach, and the place is in the box."""
    study = BLOCK | {
        "loads": [{"kind": "traction", "on": "z_max", "traction": ["push", "0 Pa", "pull"]}],
        "parameters": {"pull": {"range": ["0 kPa", "900 kPa"]}, "push": {"range": ["-90 kPa", "90 kPa"]}},
        "sampling": {"training": 8, "first": 8, "held_out": 4, "refined": 0},
        "reduction": {"method": "galerkin", "tolerance": 1e-6},
    }
    (said,) = md.build(md.make_study(study)).certificate["warnings"]
    assert said.startswith(
        "sampling ended at sampling.training = 8 solutions with an estimated error of the displacement of up to "
    )
    assert said.endswith("where the tolerance is 0.0001 %: allow more, or narrow the ranges of the parameters")
    place = re.search(r"at pull = ([-\d.]+) kPa, push = ([-\d.]+) kPa", said)
    assert place is not None
    assert 0.0 <= float(place[1]) <= 900.0
    assert abs(float(place[2])) <= 90.0


def test_a_body_that_never_moves_is_said_to_rest(tmp_path: Path, capsys) -> None:
    """Its load acts where it is held; the report is drawn without a complaint of a library."""
    text = SNAP.replace('on = "z_max"', 'on = "x_min"').replace("-1 mm", "0 mm").replace('"10 Pa"', '"0 Pa"')
    (tmp_path / "study.toml").write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert main(["build", str(tmp_path / "study.toml"), "-o", str(tmp_path / "rest.morph")]) == 0
    printed = capsys.readouterr().out
    assert "warning: no solution moves the body: its loads are zero, miss it or act where it is held" in printed
    assert "could not be made" not in (tmp_path / "rest.report.html").read_text()


def test_forces_that_balance_are_no_reaction() -> None:
    """A block pulled at two opposite sides: its support feels nothing but rounding, and no error is stated of it."""
    sides = [
        {"kind": "traction", "on": side, "traction": [f"{sign} * pull", "0 Pa", "0 Pa"]}
        for side, sign in (("x_min", -1), ("x_max", 1))
    ]
    model = md.build(md.make_study(BLOCK | {"loads": sides}))
    assert not model.reactions
    assert not any(name.startswith("reaction_") for name in model.certificate)
    assert "warnings" not in model.certificate
    pulled = md.build(md.make_study(BLOCK))
    assert pulled.at({"pull": 5e4}).reactions()["force_z_min"][2] == pytest.approx(-5e4 * 0.009**2, rel=1e-3)


def test_too_few_held_out_solutions_have_a_cause_and_a_remedy(tmp_path: Path, monkeypatch) -> None:
    study = md.make_study(BLOCK)
    lost = held_out_samples(study)[1]
    solve = SolidSweep.advance

    def failing(self, start, target):
        if np.allclose(target, lost):
            raise SolverError("no equilibrium found")
        return solve(self, start, target)

    monkeypatch.setattr(SolidSweep, "advance", failing)
    with pytest.raises(StudyError) as refused:
        md.build(study, tmp_path / "block.morph")
    said = str(refused.value)
    assert said.startswith(
        "only 3 of 4 held-out samples could be solved, too few to certify the model; the first failure: "
    )
    assert f"at pull = {lost[0] / 1e3:.4g} kPa, no equilibrium found" in said
    assert f"kept in {tmp_path / 'block.morph.snapshots'}" in said
    assert "Narrow the ranges of the parameters" in said


def test_a_dictionary_is_no_study() -> None:
    with pytest.raises(StudyError, match=r"this is a dictionary: make it a study with md\.make_study"):
        md.build(BLOCK)  # type: ignore[arg-type]
