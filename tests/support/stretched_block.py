"""A reduced model of two bricks stretched and sheared evenly, known in closed form."""

from __future__ import annotations

import numpy as np

from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions

YOUNG_MODULUS, SHEAR_MODULUS = 3e6, 1e6
SIZE = (0.08, 0.04, 0.04)
PARAMETERS = (
    Parameter("stretch", "ratio", "1", -0.2, 0.2, 0.0, "strain along x"),
    Parameter("slide", "length", "mm", -0.01, 0.01, 0.0, "motion of the top along x"),
)
_FACES = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))


def _mesh():
    x, y, z = (np.linspace(0.0, size, n) for size, n in zip(SIZE, (3, 2, 2), strict=True))
    nodes = np.array([(a, b, c) for c in z for b in y for a in x])
    first = np.array([0, 1, 4, 3, 6, 7, 10, 9])
    cells = np.stack([first, first + 1])
    inner = [set(cells[0][[1, 2, 6, 5]])]
    quads = [cell[list(face)] for cell in cells for face in _FACES if set(cell[list(face)]) not in inner]
    triangles = np.array([corner for a, b, c, d in quads for corner in ((a, b, c), (a, c, d))])
    return nodes, cells, triangles


def _linear(*modes):
    """Mode k times parameter k: T_1 of the scaled parameter times half its range."""
    upper = np.array([p.upper for p in PARAMETERS])
    functions = ParameterFunctions(-upper, upper, np.eye(2, dtype=np.int64), np.diag(upper))
    return SeparatedField(np.stack(modes).astype(float), functions)


def stretched_block_model():
    """u = (stretch x + slide z / height, 0, 0); Cauchy stress E stretch in xx and G slide / height in xz."""
    nodes, cells, triangles = _mesh()
    n, height = len(nodes), SIZE[2]
    x, z = np.zeros((2, n, 3))
    x[:, 0], z[:, 0] = nodes[:, 0], nodes[:, 2] / height
    along, across = np.zeros((2, n, 6))
    along[:, 0], across[:, 4] = 1.0, 0.5 / height
    return ReducedModel(
        name="stretched block",
        nodes=nodes,
        triangles=triangles,
        parameters=PARAMETERS,
        displacement=_linear(x, z),
        stresses={"solid": _linear(YOUNG_MODULUS * along, 2.0 * SHEAR_MODULUS * across)},
        cells={"hex8": cells},
        strain=_linear(along, across),
    )
