"""Which tangent a sweep of solids has at hand: that of the solution that is asked about, after failures too."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam.errors import SolverError
from morph_dslam.studies.problem import SweepProblem
from morph_dslam.studies.study import make_study

#: A cube that is pulled or pushed; of this law nothing stands -100 MPa.
STUDY = {
    "name": "cube",
    "mesh": {"generator": "block", "size": ["20 mm", "20 mm", "20 mm"], "divisions": [2, 2, 2], "cells": "hex8"},
    "materials": {"m": {"law": "st_venant_kirchhoff", "young": "1 MPa", "poisson": 0.45}},
    "supports": [{"kind": "fixed", "on": "z_min"}],
    "loads": [{"kind": "traction", "on": "z_max", "traction": ["0 Pa", "0 Pa", "pull"]}],
    "parameters": {"pull": {"range": ["-100 MPa", "1 kPa"], "default": "0 Pa"}},
    "solver": {"threads": 1},
}


def sweep() -> SweepProblem:
    return make_study(STUDY).sweep_problem()


def test_a_failure_leaves_no_trace_in_what_is_solved_from_the_same_start() -> None:
    """Within rounding: the solver has been at work. Another worker, which had no failure, gives the same solution."""
    start = sweep().first_state()
    found = []
    for fails in (False, True):
        worker = sweep()
        packed = worker.pack(start)
        begin = worker.unpack(packed)
        if fails:
            with pytest.raises(SolverError):
                worker.advance(begin, np.array([-1e8]))
            begin = worker.unpack(packed)
        found.append(worker.take_snapshot(worker.advance(begin, np.array([1e3]))).fields["displacement"])
    np.testing.assert_allclose(found[1], found[0], rtol=0.0, atol=1e-14 * np.abs(found[0]).max())


def test_derivatives_of_reactions_are_those_of_the_solution_whatever_else_was_found_at_its_parameters() -> None:
    """The support holds a traction on 4 cm2; the tangent of another state at the same load tells otherwise."""
    worker = sweep()
    solved = worker.advance(worker.first_state(), np.array([1e3]))
    packed = worker.pack(solved)
    bent = np.random.default_rng(0).standard_normal(packed["dofs"].shape) * 1e-4
    worker.unpack(packed | {"dofs": packed["dofs"] + bent})
    slopes = worker.take_snapshot(solved).sensitivities["reaction_force_z_min"]
    np.testing.assert_allclose(slopes.ravel(), [0.0, 0.0, -4e-4], atol=1e-9)
