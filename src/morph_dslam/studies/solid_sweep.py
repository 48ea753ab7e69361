"""A solid as the sweep sees it: paths from neighbour to neighbour, and snapshots of its fields."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError, StudyError
from morph_dslam.mechanics.coupled_solid import CoupledSolid
from morph_dslam.mechanics.load_modes import LoadedSurface, Respond
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.continuation import (
    SMALLEST_INCREMENT,
    PathError,
    advance,
    loaded_state,
    refuse_passage,
    stable_state,
)
from morph_dslam.mechanics.solvers.newton import (
    Linearisation,
    State,
    refuse_large_turn,
    sensitivities,
    solve,
    solve_with_kept_tangent,
)
from morph_dslam.mechanics.solvers.stability import unstable_directions
from morph_dslam.model.reduced_model import FORCE, MOMENT, REACTION
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studies.sections import UnknownLoadsSection

Array = NDArray[np.float64]
#: Second derivatives are differences of steps that move no node by more than this part of the body's extent.
SECOND_STEP = 2e-3
#: So many times the smallest increment of a path is made in smaller ones, to say how far a body can be followed.
ROUNDS = 4
#: Fields of a snapshot and what they are called when recovered.
_FIELDS = {"displacement": "displacement", "stress_solid": "stress", "strain": "strain"}


def solid_snapshot(
    problem: SolidProblem,
    dofs: Array,
    mu: Array,
    slopes: Array | None = None,
    force_slopes: Array | None = None,
    reactions: bool = True,
) -> Snapshot:
    """Displacement, Cauchy stress and Green-Lagrange strain at the nodes, and what supports exert.

    The solver's displacements count from the undeformed shape, which may move with the parameters; those of a
    snapshot count from the mesh's nodes, so that deformed positions are these nodes plus the displacement.

    Parameters
    ----------
    problem : the solid.
    dofs : (n,) of the solution.
    mu : (d,) parameters, SI.
    slopes : (d, n) of the dofs by the parameters; None where they are unknown.
    force_slopes : (d, n) of the residual by the parameters, as `SolidProblem.reaction_slopes` has them; None where
        they are unknown.
    reactions : whether forces (N) and moments (N m, about the origin) on each set held are among the outputs.
    """
    fields = _named(problem.sample(dofs, mu))
    derivatives = {} if slopes is None else _named(problem.sample_slopes(dofs, mu, slopes))
    if problem.shape.functions:
        problem.symbols.set(mu)
        at_nodes = problem.displacements.node_values
        moved = at_nodes @ problem.shape.coordinates(problem.symbols) - problem.mesh.nodes
        fields["displacement"] = fields["displacement"] + moved
        if derivatives:
            changes = [at_nodes @ change for change in problem.shape.coordinate_slopes(problem.symbols)]
            derivatives["displacement"] = derivatives["displacement"] + np.array(changes)
    if slopes is not None and force_slopes is not None:
        of_reactions = partial(problem.reaction_slopes, dofs, mu, slopes, force_slopes)
        derivatives |= _reaction_fields(problem, of_reactions)
    outputs = support_reactions(problem, dofs, mu) if reactions else {}
    return Snapshot(mu, fields, derivatives, outputs | _coupled_motions(problem, dofs))


def _coupled_motions(problem: SolidProblem, dofs: Array) -> dict[str, Array]:
    """Translation (3,), m, and rotation vector (3,), rad, of each coupling."""
    if not isinstance(problem, CoupledSolid):
        return {}
    outputs = {}
    for coupling, motion in zip(problem.couplings, problem.motions(dofs), strict=True):
        outputs["translation_" + coupling.on], outputs["rotation_" + coupling.on] = motion[:3], motion[3:]
    return outputs


def _named(recovered: dict[str, Array]) -> dict[str, Array]:
    """Recovered fields under the names that they have in snapshots and model files."""
    return {name: recovered[key] for name, key in _FIELDS.items()}


def support_reactions(problem: SolidProblem, dofs: Array, mu: Array) -> dict[str, Array]:
    """Force (N) and moment (N m, about the object frame's origin) on each set that is held."""
    outputs = {}
    for name in problem.held_sets:
        outputs[FORCE + name], outputs[MOMENT + name] = problem.reactions(dofs, mu, name, np.zeros(3))
    return outputs


def _reaction_fields(problem: SolidProblem, slopes: Callable[[str, Array], tuple[Array, Array]]) -> dict[str, Array]:
    """Derivatives (c, 1, 3) of `support_reactions`, given those of each set, by names of fields."""
    found = {name: slopes(name, np.zeros(3)) for name in problem.held_sets}
    return {
        REACTION + kind + name: part[:, None]
        for name, parts in found.items()
        for kind, part in zip((FORCE, MOMENT), parts, strict=True)
    }


def response_reactions(
    problem: SolidProblem, dofs: Array, mu: Array, changes: Array, forces: Array
) -> dict[str, Array]:
    """Derivatives (c, 1, 3) of `support_reactions` by loads that act besides the study's.

    Parameters
    ----------
    problem : the solid or shell.
    dofs : (n,) of the solution.
    mu : (d,) parameters, SI.
    changes : (c, n) of the dofs by each load.
    forces : (c, n) of the residual by each, at the dofs that supports hold.
    """
    return _reaction_fields(problem, partial(problem.response_reactions, dofs, mu, changes, forces))


def follow(
    problem: SolidProblem,
    start: State,
    target: Array,
    farthest: Callable[[State, Array], Array] | None = None,
    remember: bool = True,
) -> State:
    """Solve at ``target``, (d,) or (k, d) in turn, in increments from ``start``; ``remember`` as `advance` has it.

    Raises SolverError, which names the last parameters that converged; where not even the first increment did, those
    (d,) that ``farthest`` finds on the way from the start to a target (d,).
    """
    try:
        return advance(problem, start, target, remember=remember)[-1]
    except PathError as error:
        mu = error.states[-1].mu
        if farthest is not None and len(error.states) == 1 and error.passage is None:
            mu = farthest(start, target)
        further = f": {error.passage}, however small the increments" if error.passage else ""
        raise SolverError(
            f"no equilibrium found beyond {problem.state_text(mu)}, where the last solution converged{further}"
        ) from error


def farthest_solved(problem: SolidProblem, start: State, target: Array) -> Array:
    """Parameters (d,) up to which increments lead that are smaller than those of a path to ``target`` (d,).

    They are looked for where a path's first increment is too large, over the first `ROUNDS` of such increments.
    """
    for _ in range(ROUNDS):
        try:
            start = advance(problem, start, start.mu + SMALLEST_INCREMENT * (target - start.mu))[-1]
        except PathError as error:
            return error.states[-1].mu
    return start.mu


@dataclass(frozen=True)
class _SolidState:
    """A solution and its derivatives.

    Attributes
    ----------
    mu : (d,).
    dofs : (n,).
    slopes : (d, n) of the dofs by the parameters.
    negative_pivots : of the tangent, or the `unstable_directions`; None if they are not known.
    """

    mu: Array
    dofs: Array
    slopes: Array
    negative_pivots: int | None


class SolidSweep:
    """Solves a solid at one parameter point after another (`morph_dslam.studies.problem.SweepProblem`).

    It has the tangent of every start at hand: kept where this worker solved it last, or else made anew. Whether a
    solution is reached with one tangent or another shows in the last digits of the iteration's tolerance; so the
    numbers of a sweep are the same whatever the number of workers and their timing.
    """

    def __init__(self, problem: SolidProblem) -> None:
        self.problem = problem
        self._kept: tuple[State, Linearisation] | None = None
        self._farthest: dict[tuple[bytes, bytes], Array] = {}

    def first_state(self) -> _SolidState:
        """Equilibrium at the parameters' defaults, all loads grown together."""
        found = self._with_slopes(loaded_state(self.problem, self.problem.symbols.default))
        return found if self.problem.applied_first else self._stable(found)

    def pack(self, state: _SolidState) -> dict[str, Array]:
        pivots = -1 if state.negative_pivots is None else state.negative_pivots
        return {"mu": state.mu, "dofs": state.dofs, "slopes": state.slopes, "pivots": np.array(pivots)}

    def unpack(self, arrays: dict[str, Array]) -> _SolidState:
        pivots = int(arrays["pivots"])
        state = _SolidState(arrays["mu"], arrays["dofs"], arrays["slopes"], None if pivots < 0 else pivots)
        if self._tangent_at(state) is None:
            self._kept = None  # its memory is needed for the next one
            self._kept = State(state.mu, state.dofs), self.problem.linearise(state.dofs, state.mu)
        return state

    def advance(self, start: _SolidState, target: Array) -> _SolidState:
        """Solve at ``target``: from the prediction of the sensitivities, or else in increments.

        If the tangent at ``start`` is still at hand it serves first.
        """
        predicted = start.dofs + (target - start.mu) @ start.slopes
        tangent, self._kept = self._tangent_at(start), None
        try:
            refuse_large_turn(self.problem, start.mu, target)
            state = solve_with_kept_tangent(self.problem, target, predicted, tangent)
            state = state or solve(self.problem, target, State(target, predicted))
            refuse_passage(self.problem, State(start.mu, start.dofs), state)
        except SolverError:
            state = follow(self.problem, State(start.mu, start.dofs), target, self._found_farthest)
        found = self._with_slopes(state)
        return self._stable(found, State(start.mu, start.dofs)) if start.negative_pivots == 0 else found

    def _stable(self, found: _SolidState, start: State | None = None) -> _SolidState:
        """The solution that was found, or the stable one beside it that the path from a stable start leads to."""
        if not found.negative_pivots:
            return found
        state = stable_state(self.problem, found.mu, start)
        if state is None:
            return found
        if start is not None:
            try:
                refuse_passage(self.problem, start, state)
            except SolverError:
                return found
        other = self._with_slopes(state)
        return found if other.negative_pivots != 0 else other

    def _found_farthest(self, start: State, target: Array) -> Array:
        """`farthest_solved`, once in each direction of a single parameter: that takes as long as many solves."""
        if len(target) > 1:
            return start.mu
        key = start.mu.tobytes(), np.sign(target - start.mu).tobytes()
        if key not in self._farthest:
            self._farthest[key] = farthest_solved(self.problem, start, target)
        return self._farthest[key]

    def _tangent_at(self, state: _SolidState) -> Linearisation | None:
        """The tangent of a solution if it is still at hand; there may be others at the same parameters."""
        if self._kept is None:
            return None
        at, tangent = self._kept
        return tangent if np.array_equal(at.mu, state.mu) and np.array_equal(at.dofs, state.dofs) else None

    def _with_slopes(self, state: State) -> _SolidState:
        self._kept = None
        tangent = self.problem.linearise(state.dofs, state.mu)
        slopes = sensitivities(self.problem, state, tangent)
        self._kept = State(state.mu, state.dofs), tangent
        return _SolidState(state.mu, state.dofs, slopes, unstable_directions(self.problem, tangent))

    def loaded_surface(self, name: str, inward: bool) -> LoadedSurface:
        """The functions on the surface of this name, or on all of a shell; see `LoadedSurface.of`."""
        return self.problem.loaded_surface(name, inward)

    def response(self, state: _SolidState) -> Respond:
        """How the dofs of a solved state answer loads at them, by its tangent."""
        return self._tangent(state).solve

    def response_fields(self, state: _SolidState, loads: Array, responses: Array) -> dict[str, Array]:
        """By the names in the model file, (c, n, k) for each of ``loads`` (c, n_dofs) with its response (c, n_dofs)."""
        forces = self._tangent(state).apply(responses) - loads
        fields = _named(self.problem.response_slopes(state.dofs, state.mu, responses))
        return fields | response_reactions(self.problem, state.dofs, state.mu, responses, forces)

    def second_order(self, state: _SolidState, responses: Array) -> Array | None:
        """The displacement (p, n, 3) of the nodes that the product of two loads' coefficients adds; None if unknown.

        Of each pair a <= b of ``responses`` (s, n_dofs), row by row.
        """
        if self.problem.contact:  # a gap that closes has no second derivative
            return None
        pairs = [(a, b) for a in range(len(responses)) for b in range(a, len(responses))]
        sums = [responses[a] if a == b else responses[a] + responses[b] for a, b in pairs]
        bends = dict(zip(pairs, (self._curvature(state, one) for one in sums), strict=True))
        # Along a sum of two, the second derivative has those along each, and twice the mixed one.
        forces = [0.5 * bends[a, a] if a == b else 0.5 * (bends[a, b] - bends[a, a] - bends[b, b]) for a, b in pairs]
        changes = -self._tangent(state).solve(np.array(forces))
        return np.array([self.problem.nodal_displacement(change) for change in changes])

    def _curvature(self, state: _SolidState, change: Array) -> Array:
        """Second derivative (n,) of the residual along a change of the dofs (n,), by central differences."""
        extent = float(np.linalg.norm(np.ptp(self.problem.mesh.nodes, axis=0)))
        step = SECOND_STEP * extent / max(float(np.abs(self.problem.nodal_displacement(change)).max()), 1e-300)
        at = [self.problem.residual(state.dofs + k * step * change, state.mu) for k in (-1.0, 0.0, 1.0)]
        return (at[0] - 2.0 * at[1] + at[2]) / step**2

    def _tangent(self, state: _SolidState) -> Linearisation:
        return self._tangent_at(state) or self.problem.linearise(state.dofs, state.mu)

    def take_snapshot(self, state: _SolidState) -> Snapshot:
        """Fields at the nodes, their slopes, reactions, and the tangent's negative pivots."""
        snapshot = self._snapshot(state)
        if state.negative_pivots is not None:
            snapshot.outputs["negative_pivots"] = np.array(state.negative_pivots)
        return snapshot

    def _snapshot(self, state: _SolidState) -> Snapshot:
        forces = self._tangent(state).apply(state.slopes) + self.problem.residual_slopes(state.dofs, state.mu)
        return solid_snapshot(self.problem, state.dofs, state.mu, state.slopes, forces)


Loadable = TypeVar("Loadable", bound=SolidSweep)


def loadable(sweep: Loadable, section: UnknownLoadsSection | None) -> Loadable:
    """The sweep itself; StudyError if unknown loads of the study could move nothing."""
    if section is not None:
        inward = section.direction == "inward"
        if not sweep.loaded_surface(section.on, inward).can_move(sweep.problem.free):
            where = f"'{section.on}'" if section.on else "the shell"
            acting = "a pressure" if inward else "a force"
            raise StudyError(
                f"unknown_loads.on: supports hold all of {where}, so that {acting} there moves nothing: name another "
                "surface"
            )
    return sweep
