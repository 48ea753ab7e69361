"""Studies with [[couplings]]: a bar bent by a remote moment, from its study to its model."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam import build, make_study
from morph_dslam.errors import StudyError
from morph_dslam.mechanics.solid import SolidOptions
from morph_dslam.mechanics.solvers.continuation import loaded_state
from morph_dslam.studies.defaults import resolve_defaults
from morph_dslam.studies.higher_order import HigherOrder
from morph_dslam.studies.solid_study import SolidStudy

YOUNG, WIDTH, LENGTH = 3e6, 4e-3, 20e-3


def bar_study(**changes: Any) -> SolidStudy:
    """A slender bar along x with a moment about y on its end."""
    content = {
        "name": "bar",
        "mesh": {"generator": "block", "size": ["20 mm", "4 mm", "4 mm"], "divisions": [5, 1, 1], "cells": "hex8"},
        "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.0}},
        "supports": [{"kind": "fixed", "on": "x_min"}],
        "couplings": [{"on": "x_max", "moment": ["0 N.mm", "bend", "0 N.mm"]}],
        "parameters": {"bend": {"range": ["-2 N.mm", "2 N.mm"]}},
        "solver": {"threads": 1},
        "sampling": {"scheme": "even", "training": 8, "held_out": 4, "refined": 0},
    }
    study = make_study(content | changes)
    assert isinstance(study, SolidStudy)
    return study


def test_a_model_of_a_bar_bent_by_a_remote_moment(tmp_path) -> None:
    model = build(bar_study(), tmp_path / "bar.morph")
    moment = 1.5e-3
    angle = moment * LENGTH / (YOUNG * WIDTH**4 / 12.0)
    tip = np.flatnonzero(model.nodes[:, 0] > 0.999 * LENGTH)
    moved = model.displacement.value(np.array([moment]))[tip].mean(axis=0)
    bent = [LENGTH * (np.sin(angle) / angle - 1.0), 0.0, -LENGTH * (1.0 - np.cos(angle)) / angle]
    np.testing.assert_allclose(moved, bent, atol=0.03 * np.linalg.norm(bent))
    held = model.reactions["moment_x_min"].value(np.array([moment]))
    np.testing.assert_allclose(held, [[0.0, -moment, 0.0]], atol=1e-3 * moment)
    assert list(model.reactions) == ["moment_x_min"], "there is no force"
    assert model.certificate["reduction"]["method"] == "pod"
    assert model.certificate["stability"]["stable"] == 12, "also where a moment has no energy"


def test_motions_of_a_coupling_are_outputs() -> None:
    point = ["30 mm", "2 mm", "2 mm"]
    study = bar_study(couplings=[{"on": "x_max", "point": point, "force": ["0 N", "0 N", "0.02 N * bend / 1 N.mm"]}])
    sweep, mesh = study.sweep_problem(), study.solid_mesh()
    snapshot = sweep.take_snapshot(sweep.advance(sweep.first_state(), np.array([1e-3])))
    nodes = mesh.set_nodes("x_max")
    turn = Rotation.from_rotvec(snapshot.outputs["rotation_x_max"])
    arms = mesh.nodes[nodes] - [0.03, 0.002, 0.002]
    expected = snapshot.outputs["translation_x_max"] + turn.apply(arms) - arms
    np.testing.assert_allclose(snapshot.fields["displacement"][nodes], expected, atol=1e-12)
    assert turn.magnitude() > 0.05
    force, moved = np.array([0.0, 0.0, 0.02]), np.array([0.03, 0.002, 0.002]) + snapshot.outputs["translation_x_max"]
    np.testing.assert_allclose(snapshot.outputs["force_x_min"], -force, atol=1e-8)
    np.testing.assert_allclose(snapshot.outputs["moment_x_min"], -np.cross(moved, force), atol=1e-10)
    ends = [sweep.take_snapshot(sweep.advance(sweep.first_state(), np.array([1e-3 + h]))) for h in (1e-6, -1e-6)]
    slope = (ends[0].outputs["moment_x_min"] - ends[1].outputs["moment_x_min"]) / 2e-6
    found = snapshot.sensitivities["reaction_moment_x_min"][0, 0]
    np.testing.assert_allclose(found, slope, atol=1e-5 * np.abs(slope).max())


def test_a_viscoelastic_bar_creeps_under_a_remote_moment() -> None:
    """Small bends grow by the instantaneous over the relaxed modulus."""
    prony = {"relative_moduli": [0.6], "times": ["1 s"]}
    law = {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.0}
    study = bar_study(
        materials={"rubber": law | {"prony": prony}},
        parameters={"bend": {"range": ["0.01 N.mm", "0.02 N.mm"]}, "age": {"range": ["0 s", "40 s"]}},
        time={"parameter": "age", "step": "2 s"},
    )
    sweep = study.sweep_problem()
    first = sweep.first_state()
    states = first, sweep.advance(first, np.array([1e-5, 40.0]))
    angles = [sweep.take_snapshot(state).outputs["rotation_x_max"][1] for state in states]
    assert angles[1] / angles[0] == pytest.approx(1.0 / 0.4, rel=1e-3)


@pytest.mark.parametrize("iterative", [False, True])
def test_finer_elements_start_from_the_motions_of_the_couplings(iterative: bool) -> None:
    """The solution next to a coarse one is that of the path from the unloaded bar."""
    study, mu = bar_study(), np.array([1.8e-3])
    coarse, finer = study.problem(), study.problem(SolidOptions(order=2, serendipity=True))
    given, expected = (loaded_state(problem, mu).dofs for problem in (coarse, finer))
    found = HigherOrder(coarse, finer, iterative).solve(given, mu).dofs
    motions = [dofs[-6:] for dofs in (given, found, expected)]
    assert np.abs(motions[1] - motions[2]).max() < 0.2 * np.abs(motions[0] - motions[2]).max()


def test_a_prop_of_a_study_has_a_reaction() -> None:
    moment = ["0 N.mm", "0.1 * bend", "0 N.mm"]
    study = bar_study(couplings=[{"on": "x_max", "moment": moment, "held": ["z"]}])
    sweep = study.sweep_problem()
    snapshot = sweep.take_snapshot(sweep.advance(sweep.first_state(), np.array([1e-3])))
    assert "reaction_force_x_max" in snapshot.sensitivities
    np.testing.assert_allclose(snapshot.outputs["force_x_max"][2], 1.5 * 1e-4 / LENGTH, rtol=0.1)
    assert set(study.model_mesh().supports) == {"x_min", "x_max"}
    with pytest.raises(StudyError, match=r"coupling 1: held, entry 1: 'turn' must be .*'rz'"):
        bar_study(couplings=[{"on": "x_max", "held": ["turn"]}])


def test_a_coupling_that_holds_every_motion_is_a_clamp() -> None:
    """A bar carries a traction on its side as between two ends that are fixed."""
    pressed = [{"kind": "traction", "on": "z_max", "traction": ["0 Pa", "0 Pa", "-1 kPa * press"]}]
    shared = {"loads": pressed, "parameters": {"press": {"range": [0.0, 2.0]}}}
    clamped = bar_study(**shared, couplings=[{"on": "x_max", "held": ["x", "y", "z", "rx", "ry", "rz"]}])
    fixed = bar_study(
        **shared, couplings=[], supports=[{"kind": "fixed", "on": "x_min"}, {"kind": "fixed", "on": "x_max"}]
    )
    found, expected = (
        sweep.take_snapshot(sweep.advance(sweep.first_state(), np.array([2.0])))
        for sweep in (clamped.sweep_problem(), fixed.sweep_problem())
    )
    for name, values in expected.fields.items():
        np.testing.assert_allclose(found.fields[name], values, atol=1e-9 * np.abs(values).max())
    for name in ("force_x_max", "moment_x_max", "force_x_min"):
        np.testing.assert_allclose(found.outputs[name], expected.outputs[name], atol=1e-9)
    assert found.outputs["negative_pivots"] == 0


def test_methods_that_project_equations_are_refused() -> None:
    several = {"bend": {"range": ["-2 N.mm", "2 N.mm"]}, "young": {"range": ["2 MPa", "3 MPa"]}}
    rubber = {"rubber": {"law": "neo_hookean", "young": "young", "poisson": 0.3}}
    study = bar_study(parameters=several, materials=rubber)
    assert resolve_defaults(study).reduction.method == "pod"
    galerkin = bar_study(parameters=several, materials=rubber, reduction={"method": "galerkin"})
    with pytest.raises(StudyError, match=r'"galerkin" does not suit this study: the rigid motions of couplings'):
        resolve_defaults(galerkin)


def test_mistakes_in_a_coupling_are_named() -> None:
    with pytest.raises(StudyError, match=r"no node set or surface 'lid'"):
        bar_study(couplings=[{"on": "lid"}]).problem()
    with pytest.raises(StudyError, match=r"coupling 1: 'bond' names 'bond', which is no parameter"):
        bar_study(couplings=[{"on": "x_max", "force": ["0 N", "0 N", "bond"]}])
    with pytest.raises(StudyError, match=r"coupling 1: 'N' is not a unit of moment; use one of N.m, N.mm"):
        bar_study(couplings=[{"on": "x_max", "moment": ["1 N", "0 N.m", "0 N.m"]}])
    with pytest.raises(
        StudyError, match=r"coupling 1: unknown key kind; known here: first, on, point, force, moment, held"
    ):
        bar_study(couplings=[{"on": "x_max", "kind": "rigid"}])


def test_a_coupling_enters_the_fingerprint() -> None:
    moved = bar_study(couplings=[{"on": "x_max", "moment": ["0 N.mm", "2 * bend", "0 N.mm"]}])
    assert len({study.fingerprint() for study in (bar_study(), moved, bar_study(couplings=[]))}) == 3
