"""From the undeformed body to a loaded first state: all loads and supports grow together.

The residual r(x) - (1 - s) r(0) is that of the share s of every dead load (Newton's homotopy; Allgower and
Georg, Numerical Continuation Methods, 1990, section 1.2): x = 0 solves it at s = 0, and s = 1 is the problem
itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.offline.solvers.newton import Equations, Linearisation, State, advance

Array = NDArray[np.float64]


@dataclass
class _Shifted:
    """A linearisation with another residual."""

    original: Linearisation
    residual: Array

    @property
    def negative_pivots(self) -> int | None:
        return self.original.negative_pivots

    def solve(self, right: Array) -> Array:
        return self.original.solve(right)

    def apply(self, vectors: Array) -> Array:
        return self.original.apply(vectors)


class LoadRamp:
    """Equations in one parameter: the share of all loads and motions at the parameters ``full``."""

    def __init__(self, equations: Equations, full: Array) -> None:
        self._equations, self._full = equations, full
        self.n_dofs, self.free, self.scale = equations.n_dofs, equations.free, equations.scale
        self._unloaded = np.where(self.free, equations.residual(np.zeros(self.n_dofs), full), 0.0)

    def prescribed(self, mu: Array) -> Array:
        return mu[0] * self._equations.prescribed(self._full)

    def prescribed_slopes(self, mu: Array) -> Array:
        return self._equations.prescribed(self._full)[None]

    def residual(self, x: Array, mu: Array) -> Array:
        return self._equations.residual(x, self._full) - (1.0 - mu[0]) * self._unloaded

    def residual_slopes(self, x: Array, mu: Array) -> Array:
        return self._unloaded[None]

    def linearise(self, x: Array, mu: Array) -> Linearisation:
        original = self._equations.linearise(x, self._full)
        return _Shifted(original, original.residual - (1.0 - mu[0]) * self._unloaded)


def loaded_state(equations: Equations, mu: Array) -> State:
    """Equilibrium at ``mu`` (d,), reached from the undeformed, stress-free body.

    Raises
    ------
    SolverError
        If the loads cannot be carried.
    """
    ramp = LoadRamp(equations, mu)
    start = State(np.zeros(1), np.zeros(equations.n_dofs))
    reached = advance(ramp, start, np.ones(1)).states[-1]
    return State(np.array(mu, dtype=float), reached.dofs, reached.negative_pivots, reached.iterations)
