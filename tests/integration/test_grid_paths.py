"""Continuation on a grid: along the tree solves are short steps, straight from the defaults they are cut."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from morph_dslam.studies import solid_sweep, sweep
from morph_dslam.studies.executors import SerialExecutor
from morph_dslam.studies.sampling import training_samples
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.study import make_study

BAR = {
    "name": "bar",
    "mesh": {"generator": "block", "size": ["10 mm", "10 mm", "80 mm"], "divisions": [1, 1, 4]},
    "materials": {"rubber": {"law": "neo_hookean", "young": "young", "poisson": 0.3}},
    "supports": [{"kind": "fixed", "on": "z_min"}],
    "loads": [{"kind": "traction", "on": "z_max", "traction": ["push", "0 Pa", "0 Pa"]}],
    "parameters": {
        "push": {"range": ["-30 kPa", "30 kPa"]},
        "young": {"range": ["2 MPa", "4 MPa"], "default": "3 MPa"},
    },
    "solver": {"threads": 1, "order": 2},
    "sampling": {"scheme": "grid", "points": [9, 3]},
}


def straight(samples, scale, root, solved=(), failed=()):
    """Every sample from the defaults."""
    return [number for number in range(len(samples)) if number not in solved], [-1] * len(samples)


@pytest.mark.slow
def test_paths_on_a_grid_need_few_cut_steps(tmp_path: Path, monkeypatch) -> None:
    """A bar bent far; a step is cut where the prediction from its start does not lead to a solution."""
    study = make_study(BAR)
    assert isinstance(study, SolidStudy)
    samples, follow, cut = training_samples(study), solid_sweep.follow, []

    def counted(*arguments):
        cut.append(arguments[-1])
        return follow(*arguments)

    monkeypatch.setattr(solid_sweep, "follow", counted)
    along_tree = sweep.run_sweep(study, samples, tmp_path / "tree", SerialExecutor())
    n_tree = len(cut)
    monkeypatch.setattr(sweep, "neighbour_tree", straight)
    alone = sweep.run_sweep(study, samples, tmp_path / "straight", SerialExecutor())
    n_straight = len(cut) - n_tree
    assert not along_tree.failed
    assert not alone.failed
    assert n_tree < 0.5 * n_straight
    for sample in range(len(samples)):  # both ways lead to the same solution
        states = [sweep.load_state(result.solved[sample])["dofs"] for result in (along_tree, alone)]
        np.testing.assert_allclose(states[0], states[1], rtol=0.0, atol=1e-9)
