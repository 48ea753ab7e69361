"""The chord method: Newton's iteration with the tangent of a nearby solution, factorised already.

For a step small enough it converges linearly and fast, and each iteration costs a residual and a
back-substitution in place of a tangent and its factorisation (Kelley, Iterative Methods for Linear and
Nonlinear Equations, 1995, section 5.4).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.offline.solvers.newton import DEFAULT, Equations, Linearisation, State, size

Array = NDArray[np.float64]

#: Two iterations must shrink the correction to this part, or the tangent is too far off to be worth keeping.
#: Single ones need not: bending and stretching of thin walls converge in turns.
CONTRACTION = 0.2
MAX_ITERATIONS = 14
MAX_TANGENTS = 2
#: The error left is about as large as the last correction times the contraction, so stop later than Newton.
TOLERANCE = 0.1 * DEFAULT.tolerance


def solve_with_kept_tangent(
    equations: Equations, mu: Array, guess: Array, tangent: Linearisation | None
) -> State | None:
    """Equilibrium at ``mu`` (d,) from ``guess`` (n,), or None where this does not lead there.

    Parameters
    ----------
    tangent : linearisation at a solution nearby; None for one at the guess. Where it has served its turn, it
        is made anew at the point reached; two are used in all.
    """
    x = np.where(equations.free, guess, equations.prescribed(mu))
    first = np.inf
    for _ in range(MAX_TANGENTS):
        tangent = tangent or equations.linearise(x, mu)
        reached, lengths = _iterate(equations, mu, x, tangent)
        if not lengths or not lengths[0] < first:
            return None
        if lengths[-1] <= TOLERANCE:
            return State(mu, reached, None, len(lengths))
        if len(lengths) < 2 or lengths[-1] < lengths[0]:
            x, first = reached, lengths[0]
        tangent = None
    return None


def _iterate(equations: Equations, mu: Array, x: Array, tangent: Linearisation) -> tuple[Array, list[float]]:
    """The point reached from ``x`` with one tangent while that converges well, and each correction's size."""
    lengths: list[float] = []
    while len(lengths) < MAX_ITERATIONS:
        residual = equations.residual(x, mu)
        if not np.all(np.isfinite(residual)):
            return x, []
        correction = -tangent.solve(residual)
        length = size(equations, correction)
        if len(lengths) > 1 and not length < CONTRACTION * lengths[-2]:
            break
        x = x + correction
        lengths.append(length)
        if length <= TOLERANCE:
            break
    return x, lengths
