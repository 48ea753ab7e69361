"""A plate of 1 m whose corners move along x by a function of parameters, with the force on its edge."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions

CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])


def edge_plate(parameters: Sequence[Parameter], functions: ParameterFunctions) -> ReducedModel:
    """Stretched by the first of these functions; each makes a force of 100 newtons times its value."""
    count = functions.coefficients.shape[1]
    shape, force = np.zeros((count, 4, 3)), np.zeros((count, 1, 3))
    shape[0, :, 0], force[:, 0, 0] = CORNERS[:, 0], 100.0
    return ReducedModel(
        "plate",
        CORNERS,
        np.array([[0, 1, 2], [0, 2, 3]]),
        tuple(parameters),
        SeparatedField(shape, functions),
        reactions={"force_edge": SeparatedField(force, functions)},
    )


def plate_of_load() -> ReducedModel:
    """Stretched by load times a, both from 0 to 1, by a force of 100 load a newtons."""
    load, a = Parameter("load", "ratio", "1", 0.0, 1.0, 0.0), Parameter("a", "ratio", "1", 0.0, 1.0, 0.5)
    # Chebyshev polynomials of x = 2 load - 1 and y = 2 a - 1: load a = (1 + x + y + x y) / 4.
    indices = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    return edge_plate((load, a), ParameterFunctions(np.zeros(2), np.ones(2), indices, np.full((4, 1), 0.25)))
