"""How many directions an equilibrium is unstable in, also where its tangent is not symmetric.

A body that creeps as x' = -M K x, M positive, leaves an equilibrium along the eigenvectors of K whose eigenvalues have
a negative real part. A symmetric K has as many as negative pivots. Others are looked at through the inverse that the
factorisation gives: Arnoldi's method finds the eigenvalues nearest to zero, and only through zero can a real one become
negative. Dofs that follow from others (multipliers, nodes of couplings) are eliminated by the same solves.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse.linalg
from numpy.typing import NDArray

from morph_dslam.mechanics.solvers.newton import Equations, Linearisation

Array = NDArray[np.float64]
_sla: Any = scipy.sparse.linalg
#: So many eigenvalues are looked at, each to this part of itself.
LOOKED_AT, PRECISION = 4, 1e-2


def unstable_directions(equations: Equations, linearisation: Linearisation) -> int | None:
    """Number of directions in which an equilibrium is unstable, at most `LOOKED_AT` if K is not symmetric.

    Parameters
    ----------
    equations : those of the equilibrium.
    linearisation : theirs, at the equilibrium.

    Returns
    -------
    None if it is not known: the eigenvalues were not found.
    """
    found = linearisation.negative_pivots
    if found is not None:
        return found
    scale = np.broadcast_to(np.asarray(equations.scale, dtype=float), equations.n_dofs)
    moving = np.flatnonzero(equations.free & np.isfinite(scale))

    def flexibility(forces: Array) -> Array:
        right = np.zeros((*forces.shape[:-1], equations.n_dofs))
        right[..., moving] = forces / scale[moving]
        return linearisation.solve(right)[..., moving] / scale[moving]

    n = len(moving)
    if n <= 4 * LOOKED_AT:
        values = np.linalg.eigvals(flexibility(np.eye(n)))
    else:
        operator = _sla.LinearOperator((n, n), matvec=lambda x: flexibility(np.ravel(x)), dtype=float)
        start = np.random.default_rng(0).standard_normal(n)
        try:
            values = _sla.eigs(operator, LOOKED_AT, which="LM", v0=start, tol=PRECISION, return_eigenvectors=False)
        except _sla.ArpackNoConvergence:
            return None
    return int(np.count_nonzero(np.real(values) < 0.0))
