"""Which force of a run is its largest: closed-form lengths and deviations."""

from types import SimpleNamespace

import numpy as np

from morph_dslam.tracking.reactions import Reaction, VectorEstimate
from morph_dslam.tracking.run_folder import largest_forces
from tests.support.stretched_block import stretched_block_model


def test_the_largest_force_is_that_which_is_largest_for_certain():
    """3 N along z to 0.1 N; 5 N, of which 4 N along y are known to 3 N; and 3.1 N of which nothing is known."""
    none = VectorEstimate.of(np.zeros(3), np.zeros((3, 3)))
    forces = [
        VectorEstimate.of(np.array([0.0, 0.0, 3.0]), 0.01 * np.eye(3)),
        VectorEstimate.of(np.array([0.0, 4.0, 3.0]), np.diag([0.01, 9.0, 0.01])),
        VectorEstimate.of(np.array([0.0, 3.1, 0.0]), np.full((3, 3), np.inf)),
    ]
    reactions = {"tip": [Reaction(np.zeros(3), force, none) for force in forces]}
    run = SimpleNamespace(model=stretched_block_model(), frames=[4, 5, 6], reactions=lambda: reactions)
    (largest,) = largest_forces(run)
    assert (largest["frame"], largest["force_N"]) == (4, 3.0)
    del reactions["tip"][0], run.frames[0]
    assert largest_forces(run)[0]["frame"] == 5
