"""A law of one's own, registered in one file, in a study and against its closed form."""

from typing import ClassVar

import ngsolve as ngs
import numpy as np
import pytest

from morph_dslam import make_study
from morph_dslam.extend import register_law
from morph_dslam.mechanics.materials import base
from morph_dslam.mechanics.materials.base import Constant
from morph_dslam.mechanics.materials.isotropic import Rubber, first_invariant
from morph_dslam.mechanics.solvers.continuation import advance

STUDY = {
    "name": "strip",
    "mesh": {"generator": "block", "size": ["1 m"] * 3, "divisions": [1, 1, 1], "cells": "hex20"},
    "materials": {"skin": {"law": "demiray", "mu": "20 kPa", "growth": 0.3, "bulk": "1 GPa"}},
    "supports": [
        {"kind": "displacement", "on": f"{axis}_min", axis: "0 m"} for axis in "xyz"
    ] + [{"kind": "displacement", "on": "x_max", "x": "pull"}],
    "parameters": {"pull": {"range": ["0 m", "1 m"]}},
    "solver": {"formulation": "mixed", "threads": 1},
}  # fmt: skip


@pytest.fixture
def registry(monkeypatch):
    """Laws that are registered meanwhile, forgotten afterwards."""
    monkeypatch.setattr(base, "_LAWS", dict(base._LAWS))


def test_a_law_of_ones_own_is_named_in_a_study_and_solved(registry):
    @register_law("demiray")
    class Demiray(Rubber):
        """W = mu / 2b (exp(b (I1~ - 3)) - 1) + kappa/2 (J - 1)^2: Demiray, J. Biomech. 5, 1972."""

        mu: Constant
        growth: Constant
        quantities: ClassVar = {"growth": "ratio"}

        def distortional(self, F, J):
            return 0.5 * self.mu / self.growth * (ngs.exp(self.growth * (first_invariant(F, J) - 3.0)) - 1.0)

    problem = make_study(STUDY).problem()
    state = advance(problem, problem.initial_state(), np.array([0.6]))[-1]
    force = problem.reactions(state.dofs, state.mu, "x_max")[0][0]
    # Uniaxial and incompressible: P = mu exp(b (I1 - 3)) (l - l^-2).
    stretch, first = 1.6, 1.6**2 + 2.0 / 1.6
    assert force == pytest.approx(2e4 * np.exp(0.3 * (first - 3.0)) * (stretch - stretch**-2), rel=1e-4)
