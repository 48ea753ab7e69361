"""The chord method: Newton's iteration with the tangent of a nearby solution, factorised already.

For a step small enough it converges linearly and fast, and each iteration costs a residual and a
back-substitution in place of a tangent and its factorisation (Kelley, Iterative Methods for Linear and
Nonlinear Equations, 1995, section 5.4).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.offline.newton import DEFAULT, Equations, Linearisation, State, size

Array = NDArray[np.float64]

#: Two iterations must shrink the correction to this part, or the tangent is too far off to be worth keeping.
#: Single ones need not: bending and stretching of thin walls converge in turns.
CONTRACTION = 0.2
MAX_ITERATIONS = 14
#: The error left is about as large as the last correction times the contraction, so stop later than Newton.
TOLERANCE = 0.1 * DEFAULT.tolerance


def solve_with_kept_tangent(
    equations: Equations, mu: Array, guess: Array, tangent: Linearisation
) -> State | None:
    """Equilibrium at ``mu`` (d,) from ``guess`` (n,), or None where the kept tangent does not lead there.

    Parameters
    ----------
    tangent : linearisation at a solution nearby.
    """
    x = np.where(equations.free, guess, equations.prescribed(mu))
    lengths: list[float] = []
    for iteration in range(1, MAX_ITERATIONS + 1):
        residual = equations.residual(x, mu)
        if not np.all(np.isfinite(residual)):
            return None
        try:
            correction = -tangent.solve(residual)
        except SolverError:
            return None
        length = size(equations, correction)
        if len(lengths) > 1 and not length < CONTRACTION * lengths[-2]:
            return None
        x = x + correction
        if length <= TOLERANCE:
            return State(mu, x, None, iteration)
        lengths.append(length)
    return None
