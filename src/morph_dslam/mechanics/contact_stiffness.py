"""How stiff the penalty of contact has to be, for solids that obstacles confine.

A nearly incompressible solid without a free surface to bulge at is up to thousands of times as stiff as its Young's
modulus says. A penalty that is stiff beside a bending finger gives way more than such a solid does. How much follows
from the undeformed solid with all contacts closed: of its response to loads, supports and obstacles, let s be the
penalty's share of the energy E. The energy's derivative by the stiffness eps is that of the penalty alone, so that
s = d ln E / d ln eps, and a penalty f times as stiff has the share s / (s + f (1 - s)), as a spring in series with the
solid.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError

if TYPE_CHECKING:
    from morph_dslam.mechanics.solid import SolidProblem

Array = NDArray[np.float64]
#: Share of the energy that the penalty may have.
ALLOWED = 0.01


def stiffening(problem: SolidProblem) -> float:
    """Factor, at least 1, with which the penalty has the share `ALLOWED`, in each of the responses on its own.

    A viscous solid is as stiff as at once, whatever it remembers when this is asked.
    """
    present, history = problem.symbols.present, problem.history
    try:
        with history.at_rest(problem.symbols.default) if history else nullcontext():
            shares = closed_shares(problem)
    finally:
        problem.symbols.set(present)
    return float(np.max(shares / np.maximum(1.0 - shares, 1e-9), initial=0.0) * (1.0 - ALLOWED) / ALLOWED)


def closed_shares(problem: SolidProblem) -> Array:
    """Shares (k,) of the penalty, as stiff as in solids that are free, in the energy of the undeformed closed solid.

    Responses are those to the loads at the parameters' defaults, to a change of each parameter, and to each motion of a
    coupling, if there are any.
    """
    contact, mu, n = problem.contact, problem.symbols.default, 3 * problem.displacements.n_scalar
    assert contact is not None
    problem.symbols.set(mu)
    closed, x = contact.closed(), np.zeros(problem.n_unknowns)
    if not closed:
        return np.zeros(0)
    besides = problem.motions_besides()
    forces = np.vstack([problem.own_residual(x), problem.own_residual_slopes(x), np.zeros_like(besides)])
    moved = np.vstack([problem.prescribed(mu), problem.prescribed_slopes(mu)])[:, : problem.n_unknowns]
    moved, of_parameters = np.vstack([moved, besides]), slice(1, 1 + len(mu))
    for part in closed:
        forces[of_parameters, :n] += part.residual_slopes()
    tangent = sum((part.tangent(limited=True) for part in closed[1:]), closed[0].tangent(limited=True))
    solver = problem.solver_of(problem.free)
    linearisation = problem.assembly.linearise(x, mu, forces[0], solver, tangent)
    try:
        changes = moved - linearisation.solve(forces + linearisation.apply(moved))
    except SolverError:  # what holds the solid is in none of its contacts yet
        return np.zeros(0)
    whole = np.einsum("kn,kn->k", changes, linearisation.apply(changes))
    penalty = np.zeros(len(changes))
    for part in closed:
        of_solid, stiffness = part.approach(changes[:, :n]), part.spring.weights * part.spring.stiffness
        approach = of_solid.copy()
        approach[of_parameters] += part.slopes
        penalty += approach**2 @ stiffness
        whole += (approach**2 - of_solid**2) @ stiffness
    moving = whole > 0.0
    return penalty[moving] / whole[moving]
