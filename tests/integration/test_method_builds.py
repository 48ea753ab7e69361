"""The methods of reduction from study files to certified model files, on tiny solids."""

from __future__ import annotations

import numpy as np

from morph_dslam import build, make_study
from morph_dslam.model import load_model

BEAM = {
    "name": "cantilever",
    "mesh": {"generator": "block", "size": ["100 mm", "10 mm", "10 mm"], "divisions": [5, 1, 1]},
    "materials": {"steel": {"law": "linear_elastic", "young": "stiffness", "poisson": 0.3}},
    "supports": [{"kind": "fixed", "on": "x_min"}],
    "loads": [
        {
            "kind": "moving_patch",
            "on": "z_max",
            "force": ["0 N", "0 N", "-1 N"],
            "centre": ["place", "5 mm", "10 mm"],
            "width": "10 mm",
        }
    ],
    "parameters": {"place": {"range": ["30 mm", "80 mm"]}, "stiffness": {"range": ["1 GPa", "4 GPa"]}},
    "solver": {"threads": 1},
    "sampling": {"held_out": 6},
    "reduction": {"method": "pgd", "tolerance": 1e-3},
}

BLOCK = {
    "name": "rubber block",
    "mesh": {"generator": "block", "size": ["20 mm", "20 mm", "60 mm"], "divisions": [2, 2, 6], "cells": "hex8"},
    "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.4}},
    "supports": [
        {"kind": "fixed", "on": "z_min"},
        {
            "kind": "rotation",
            "on": "z_max",
            "axis": [0, 1, 0],
            "angle": "bend",
            "translation": ["0 mm", "0 mm", "-1 * squash"],
        },
    ],
    "parameters": {"bend": {"range": ["-25 deg", "25 deg"]}, "squash": {"range": ["0 mm", "5 mm"]}},
    "solver": {"threads": 1},
    "sampling": {"held_out": 6, "training": 24},
    "reduction": {"method": "reduced_basis", "tolerance": 1e-5},
}


def test_pgd_needs_no_solutions_but_those_that_certify_it(tmp_path) -> None:
    build(make_study(BEAM), tmp_path / "beam.morph")
    certificate = load_model(tmp_path / "beam.morph").certificate
    assert certificate["samples"]["training"] == 0
    assert "compression_percent" not in certificate
    assert len(list((tmp_path / "beam.morph.snapshots").glob("*.npz"))) == 6
    assert certificate["displacement"]["relative_l2"] < 2e-3
    assert certificate["stress_solid"]["relative_l2"] < 1e-2
    assert certificate["reaction_force_x_min"]["relative_l2"] < 2e-3
    assert certificate["reaction_moment_x_min"]["relative_l2"] < 5e-3
    assert max(s["relative_l2"] for s in certificate["sensitivity"].values()) < 1e-2


def test_a_reduced_basis_is_sampled_one_solve_at_a_time(tmp_path) -> None:
    build(make_study(BLOCK), tmp_path / "block.morph")
    certificate = load_model(tmp_path / "block.morph").certificate
    rounds = certificate["samples"]["rounds"]
    assert [r["solves"] for r in rounds] == [6 + n for n in range(len(rounds))]
    assert len(rounds) > 2
    estimates = np.array([r["largest_estimate"] for r in rounds])
    assert estimates[-1] <= 5e-6 < estimates[-2]
    assert certificate["reduction"]["method"] == "reduced_basis"
    assert certificate["displacement"]["relative_l2"] < 2e-5
