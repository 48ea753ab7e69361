"""Equilibrium of a body that its loads alone hold in place, such as a cloth that hangs: pseudo-transient continuation.

The body sinks through a viscous fluid to where it comes to rest: implicit Euler steps of drag * velocity = forces, each
longer than the one before (Kelley and Keyes, SIAM Journal on Numerical Analysis 35, 1998, 508-523).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solvers.newton import LARGEST_TURN, State, size, solve

if TYPE_CHECKING:
    from morph_dslam.mechanics.shell_problem import ShellProblem

Array = NDArray[np.float64]
#: Length of the first step in units of the body's size; factors of the drag after a step that converged, or did not.
FIRST, FALL, RISE = 1e-3, 0.6, 3.0
MAX_STEPS = 100
#: The drag is let go where a step moves the body by less than this.
AT_REST = 1e-4


def relaxed_state(equations: ShellProblem, mu: Array) -> State:
    """Where a shell comes to rest from the undeformed state under the loads at ``mu`` (d,).

    Raises SolverError if it does not in `MAX_STEPS` steps, or if supports turn by more than `newton.LARGEST_TURN`.
    """
    if equations.turn_from(np.zeros(equations.n_dofs), mu) > LARGEST_TURN:
        raise SolverError(
            f"supports turn by more than {np.degrees(LARGEST_TURN):.0f} degrees before the body comes to rest"
        )
    x = equations.prescribed(mu)
    forces = np.where(equations.free, equations.residual(np.zeros(equations.n_dofs), mu), 0.0)
    drag = max(float(np.linalg.norm(forces)), 1e-12) / (FIRST * equations.length * equations.area)
    state = State(mu, x)
    try:
        for _ in range(MAX_STEPS):
            equations.set_drag(drag, state.dofs)
            try:
                following = solve(equations, mu, state)
            except SolverError:
                drag *= RISE
                continue
            moved = size(equations, following.dofs - state.dofs)
            state, drag = following, FALL * drag
            if moved < AT_REST:
                equations.set_drag(0.0, state.dofs)
                return solve(equations, mu, state)
    finally:
        equations.set_drag(0.0, state.dofs)
    raise SolverError(f"the body has not come to rest in {MAX_STEPS} steps of relaxation")
