"""A small model in every format of the model file."""

from __future__ import annotations

import numpy as np

from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.basis_functions import Basis
from tests.support.function_formats import SMOOTH, make_functions

PARAMETERS = (
    Parameter("stretch", "ratio", "1", -1.0, 1.0, 0.0, "strain along x"),
    Parameter("pressure", "pressure", "MPa", 0.0, 1.0, 0.0, "on the top"),
    Parameter("shift", "length", "mm", 0.0, 2.0, 0.0, "motion of the top"),
)
N = 3  # nodes along each edge


def block_model(form: str, bases: tuple[Basis, ...] = SMOOTH) -> ReducedModel:
    """A cube of 8 hex8 cells with random fields of every kind, its displacement in the format ``form``."""
    rng = np.random.default_rng(2)
    index = np.arange(N**3).reshape(N, N, N)
    nodes = np.stack(np.meshgrid(*[np.linspace(0.0, 0.1, N)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    starts = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]  # the corners of a cell, in VTK's order
    starts += [(a, b, 1) for a, b, _ in starts]
    corners = [index[a : N - 1 + a, b : N - 1 + b, c : N - 1 + c].ravel() for a, b, c in starts]
    top = index[:, :, -1]
    a, b, c, d = (part.ravel() for part in (top[:-1, :-1], top[1:, :-1], top[1:, 1:], top[:-1, 1:]))
    tucker = make_functions("tucker", 6, bases)
    displacement = SeparatedField(rng.normal(size=(6, N**3, 3)), make_functions(form, 6, bases))
    return ReducedModel(
        name="block",
        nodes=nodes,
        triangles=np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])]),
        parameters=PARAMETERS,
        displacement=displacement,
        stresses={"solid": SeparatedField(1e6 * rng.normal(size=(6, N**3, 6)), tucker)},
        cells={"hex8": np.column_stack(corners)},
        strain=SeparatedField(rng.normal(size=(6, N**3, 6)), tucker),
        reactions={"force_clamped/end": SeparatedField(rng.normal(size=(6, 1, 3)), tucker)},
        certificate={"displacement": {"mean_mm": 0.01}},
        provenance={"study": "a block"},
    )
