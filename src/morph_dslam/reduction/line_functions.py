"""Functions of a single parameter through samples that cover its whole range, wherever they lie.

Where slopes are known, piecewise cubics take values and slopes of every sample (Hermite): between two samples they
depend on these two alone, so that what is sharp in one place stays there. Their error is at most h^4 / 384 times the
fourth derivative. Where slopes are unknown, a cubic spline goes through the values, or a line or a parabola where these
are fewer than four.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.basis_functions import chebyshev_basis, cubic_spline_basis, hat_basis, hermite_basis
from morph_dslam.model.tensor_functions import TensorTrainFunctions
from morph_dslam.studies.sections import BasisName

Array = NDArray[np.float64]
#: Functions that a study may name for its single parameter.
LINE_BASES = ("cubic_spline", "hat")
#: Least samples that cubic splines can interpolate.
LEAST = 4
#: Distance of a sample from an end of the range, over the range, that is rounding.
AT_THE_END = 1e-9


def covers(samples: Array, box: Array) -> bool:
    """Whether samples (n, d) are of one parameter and reach both ends of its range, ``box`` (1, 2)."""
    if samples.shape[1] != 1 or len(np.unique(samples)) < LEAST:
        return False
    ends = np.array([samples.min(), samples.max()])
    return bool(np.abs(ends - box[0]).max() <= AT_THE_END * (box[0, 1] - box[0, 0]))


def interpolate_line(
    points: Array, values: Array, slopes: Array | None, name: BasisName | None = None
) -> TensorTrainFunctions:
    """The functions through all samples.

    Parameters
    ----------
    points : (n,) in any order.
    values : (n, n_functions).
    slopes : (n, n_functions), by the parameter; None where they are unknown.
    name : "cubic_spline" or "hat", which take no slopes; None for what suits.
    """
    order = np.argsort(points)
    nodes = points[order]
    if slopes is not None and name is None:
        basis = hermite_basis(nodes)
        # Slopes over the range, so that the rows of the matrix are alike in size.
        table, size = basis.table(nodes), nodes[-1] - nodes[0]
        matrix = np.concatenate([table[:, 0], size * table[:, 1]])
        coefficients = np.linalg.solve(matrix, np.concatenate([values[order], size * slopes[order]]))
    else:
        few = chebyshev_basis(nodes[0], nodes[-1], len(nodes) - 1) if len(nodes) < LEAST else None
        basis = hat_basis(nodes) if name == "hat" else few or cubic_spline_basis(nodes)
        coefficients = np.linalg.solve(basis.evaluate(nodes), values[order])
    core = np.ascontiguousarray(coefficients.T[:, :, None], dtype=np.float64)
    return TensorTrainFunctions((basis,), (core,))
