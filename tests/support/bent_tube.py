"""A tube that a load bends towards x: a body of revolution with a closed form, exact to rounding."""

import numpy as np

from morph_dslam.meshing.generators import tube
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions

AXIS = np.array([0.0, 0.0, 1.0])


def polynomial(coefficients):
    """Functions of one parameter in [0, 2], by their Chebyshev coefficients (terms, functions)."""
    degrees = np.arange(len(coefficients))[:, None]
    return ParameterFunctions(np.array([0.0]), np.array([2.0]), degrees, np.asarray(coefficients, dtype=float))


def bent_tube(mesh=None):
    """u = mu z² e_x, and a stress mu (e_x e_x + y e_x e_y): on a tube 0.1 m long, for a load along x."""
    mesh = mesh or tube(0.02, 0.03, 0.1, (4, 1, 24), cell_type="hex8")
    x, y, z = mesh.nodes.T
    zero = np.zeros_like(x)
    linear = polynomial([[1.0], [1.0]])  # mu = 1 + T_1(mu - 1)
    stress = np.column_stack([1e6 + zero, zero, zero, zero, zero, 1e7 * y])
    return ReducedModel(
        "bent tube",
        mesh.nodes,
        mesh.surface_triangles(),
        (Parameter("load", "ratio", "1", 0.0, 2.0, 0.0),),
        SeparatedField(np.column_stack([z**2, zero, zero])[None], linear),
        stresses={"solid": SeparatedField(stress[None], linear)},
    )
