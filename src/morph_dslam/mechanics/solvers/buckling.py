"""Linear buckling: the parameters at which the tangent, extrapolated from the unloaded state, is singular.

With K0 the tangent at the base state and K' its derivative along the response to one parameter, modes and
critical values solve (K0 + lambda K') phi = 0 (Bathe, Finite Element Procedures, section 6.8.2). Solved as
K0^-1 K' phi = -phi / lambda, so that the parameters nearest to the base state come first. Arnoldi's method
is used, since in mixed formulations K0 is indefinite and does not give the inner product that Lanczos' needs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse.linalg
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solvers.newton import Equations, State, sensitivities

Array = NDArray[np.float64]
_sla: Any = scipy.sparse.linalg


@dataclass(frozen=True)
class BucklingMode:
    """One mode.

    Attributes
    ----------
    change : of the parameter from the base state to buckling.
    shape : (n,) dofs; the largest measured entry (see `Equations.scale`) is one unit of the scale.
    """

    change: float
    shape: Array


def buckling_modes(
    equations: Equations, base: State, parameter: int, step: float, count: int = 1
) -> list[BucklingMode]:
    """The first modes as a parameter grows from ``base``, nearest first.

    Raises SolverError if no mode is found for growing parameters.

    Parameters
    ----------
    equations : their linearisations must stay usable after the next one is made.
    base : a stable equilibrium, before buckling.
    parameter : index in mu of the parameter that makes the body buckle.
    step : of that parameter, for differencing K along the response; well below the critical change.
    count : how many modes.
    """
    direction = np.zeros(len(base.mu))
    direction[parameter] = step
    response = step * sensitivities(equations, base)[parameter]
    above = equations.linearise(base.dofs + response, base.mu + direction)
    below = equations.linearise(base.dofs - response, base.mu - direction)
    centre = equations.linearise(base.dofs, base.mu)
    free = np.flatnonzero(equations.free)

    def apply(free_values: Array) -> Array:
        vector = np.zeros(equations.n_dofs)
        vector[free] = np.ravel(free_values)
        slope = (above.apply(vector) - below.apply(vector)) / (2.0 * step)
        return -centre.solve(slope)[free]

    values, vectors = _largest(apply, len(free), count)
    modes = []
    for value, vector in zip(values, vectors.T, strict=True):
        shape = np.zeros(equations.n_dofs)
        shape[free] = vector
        measured = np.abs(shape / equations.scale)
        largest = int(np.argmax(measured))
        modes.append(BucklingMode(1.0 / value, shape / np.copysign(measured[largest], shape[largest])))
    if not modes:
        raise SolverError("no buckling mode was found for a growing parameter: is the step's sign right?")
    return modes


def _largest(apply: Callable[[Array], Array], n: int, count: int) -> tuple[Array, Array]:
    """The ``count`` largest positive eigenvalues, falling, of an operator on n dofs, and their vectors."""
    if n <= 2 * count + 2:
        values, vectors = np.linalg.eig(np.column_stack([apply(unit) for unit in np.eye(n)]))
    else:
        operator = _sla.LinearOperator((n, n), matvec=apply, dtype=float)
        start = np.random.default_rng(0).standard_normal(n)
        values, vectors = _sla.eigs(operator, k=count, which="LR", v0=start, tol=1e-8)
    values, vectors = np.real(values), np.real(vectors)
    order = np.argsort(-values)
    order = order[values[order] > 0.0][:count]
    return values[order], vectors[:, order]
