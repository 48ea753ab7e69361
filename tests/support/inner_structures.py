"""A structure inside the block of `stretched_block`, whose motion is known in closed form."""

from __future__ import annotations

import numpy as np

from morph_dslam.extend.studies import place_inner_structure
from tests.support.stretched_block import SIZE

#: Four points inside of the block, the corners of a tetrahedron.
NODES = np.array([[0.01, 0.01, 0.01], [0.03, 0.01, 0.02], [0.02, 0.03, 0.02], [0.06, 0.02, 0.03]])
TRIANGLES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def inner_structure(model, name="tumour", shift=0.0):
    """The structure in a block, each coordinate moved by ``shift``, metres."""
    return place_inner_structure(model, name, NODES + shift, TRIANGLES)


def moved(rest, stretch, slide):
    """Where the block takes points: u_x = stretch x + slide z / height."""
    return rest + np.column_stack([stretch * rest[:, 0] + slide * rest[:, 2] / SIZE[2], *np.zeros((2, len(rest)))])
