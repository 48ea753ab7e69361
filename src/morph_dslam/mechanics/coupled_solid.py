"""Equilibrium of solids with couplings: sets of nodes that move as rigid bodies (`couplings`).

The dofs x of the solid are followed by the motions q of the couplings. Dofs s of a coupled set follow q, x_s = g(q), so
that the solid's residual r is always evaluated with g(q) in their place:

    r_f(x_f, g(q)) = 0,   x_s - g(q) = 0,   G' r_s(x_f, g(q)) - remote load = 0,   G = dg/dq.

Newton's method is exact, with H = d(G' r_s - remote load)/dq at fixed r_s in the tangent; it is solved for q first,

    C = G' (K_ss - K_sf K_ff^-1 K_fs) G + H,

so that only the solid's own K_ff is factorised, which stays symmetric where C is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from morph_dslam.errors import SolverError, StudyError
from morph_dslam.mechanics.couplings import MOTIONS, CoupledSet, Coupling
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.linear_solver import LinearSolver, SolverMaker, TangentSolver
from morph_dslam.mechanics.solvers.newton import Linearisation

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class CoupledSolid(SolidProblem):
    """A solid with couplings. Its dofs are those of the solid, then six motions of each coupling.

    Raises StudyError as `SolidProblem` does, and for sets that cannot be coupled (`couplings.CoupledSet`) or share
    nodes.

    Parameters
    ----------
    couplings : at least one.
    solid : as `SolidProblem` takes it, by place.
    options : by name.
    """

    def __init__(self, couplings: Sequence[Coupling], *solid: Any, **options: Any) -> None:
        self.couplings = tuple(couplings)
        super().__init__(*solid, **options)
        by_component = np.arange(3)[:, None] * self.displacements.n_scalar
        self._following = np.concatenate([(by_component + part.dofs).ravel() for part in self._sets])
        self._starts = np.cumsum([3 * len(part.dofs) for part in self._sets])[:-1]
        if len(np.unique(self._following)) < len(self._following):
            names = ", ".join(f"'{coupling.on}'" for coupling in self.couplings)
            raise StudyError(f"two of the couplings' sets {names} share nodes; a node follows one of them")
        count = MOTIONS * len(self._sets)
        self.n_dofs = self.n_unknowns + count
        self.free = np.concatenate([self.free, *(~part.held for part in self._sets)])
        motion_scale = np.tile(np.repeat([self.length, 1.0], 3), len(self._sets))
        self.scale = np.concatenate([np.broadcast_to(self.scale, self.n_unknowns), motion_scale])
        self.scale[self._following] = np.inf

    @cached_property
    def _sets(self) -> list[CoupledSet]:
        space, shape = self.displacements, self.shape
        return [CoupledSet(coupling, space, shape, self.constraints, self.symbols) for coupling in self.couplings]

    def _held_motions(self) -> Array:
        modes = self.constraints.rigid_modes()
        return np.concatenate([part.held_modes(modes) for part in self._sets])

    @property
    def held_sets(self) -> list[str]:
        return super().held_sets + [coupling.on for coupling in self.couplings if coupling.held]

    def motions(self, dofs: Array) -> Array:
        """(..., k, 6) translation, m, and rotation vector, rad, of each coupling, of ``dofs`` (..., n_dofs)."""
        return dofs[..., self.n_unknowns :].reshape(*dofs.shape[:-1], -1, MOTIONS)

    def _placed(self, x: Array) -> Array:
        """Dofs (n_unknowns,) of the solid, those of the sets where the couplings have them."""
        result = x[: self.n_unknowns].copy()
        result[self._following] = np.concatenate([part.displacement(q) for part, q in self._moved(x)])
        return result

    def _moved(self, x: Array) -> list[tuple[CoupledSet, Array]]:
        """Each set with its motion (6,)."""
        return list(zip(self._sets, self.motions(x), strict=True))

    def _on_sets(self, x: Array, forces: Array) -> list[tuple[CoupledSet, Array, Array]]:
        """Each set with its motion (6,) and its part of the solid's dof ``forces`` (n_unknowns,)."""
        parts = np.split(forces[self._following], self._starts)
        return [(part, q, own) for (part, q), own in zip(self._moved(x), parts, strict=True)]

    def _columns(self, x: Array) -> Array:
        """G' (6 k, m)."""
        return _block_diagonal([part.columns(q) for part, q in self._moved(x)])

    def _with_motions(self, of_solid: Array, of_motions: Array | None = None) -> Array:
        """(..., n_dofs), with zeros for motions that are not given."""
        if of_motions is None:
            of_motions = np.zeros((*of_solid.shape[:-1], self.n_dofs - self.n_unknowns))
        return np.concatenate([of_solid, of_motions], axis=-1)

    def motions_besides(self) -> Array:
        columns = self._columns(np.zeros(self.n_dofs))[self.free[self.n_unknowns :]]
        result = np.zeros((len(columns), self.n_unknowns))
        result[:, self._following] = columns
        return result

    def prescribed(self, mu: Array) -> Array:
        return self._with_motions(super().prescribed(mu))

    def prescribed_slopes(self, mu: Array) -> Array:
        return self._with_motions(super().prescribed_slopes(mu))

    def prescribed_on_the_way(self, x: Array, mu: Array, share: float) -> Array:
        return self._with_motions(super().prescribed_on_the_way(x, mu, share))

    def residual(self, x: Array, mu: Array) -> Array:
        self._set(mu)
        placed = self._placed(x)
        return self._reduced(super().residual(placed, mu), placed, x)

    def _reduced(self, forces: Array, placed: Array, x: Array) -> Array:
        """The residual (n_dofs,) at ``x``, of that of the solid (n_unknowns,) at ``placed``."""
        remote = np.concatenate([part.remote(q) for part, q in self._moved(x)])
        unbalanced = self._columns(x) @ forces[self._following] - remote
        forces = forces.copy()
        forces[self._following] = (x[: self.n_unknowns] - placed)[self._following]
        return self._with_motions(forces, unbalanced)

    def solver_of(self, free: Mask, make: SolverMaker | None = None) -> TangentSolver:
        make = make or partial(LinearSolver, threads=self.options.threads)
        inside = free[: self.n_unknowns] & self.assembly.coupled
        inside[self._following] = False
        return make(inside, self.assembly.symmetric, all_free=free)

    def linearise(self, x: Array, mu: Array, solver: TangentSolver | None = None) -> Linearisation:
        solver = solver or self.solver
        self._set(mu)
        placed = self._placed(x)
        inner, reduced = self._of_solid(x, placed, mu, solver)
        blocks = [part.stiffness(q, forces) for part, q, forces in self._on_sets(x, inner.residual)]
        has_energy = all(part.has_energy for part in self._sets)
        coupled = _Coupled(self._following, self._columns(x), _block_diagonal(blocks), has_energy)
        return _CoupledLinearisation(inner, reduced, coupled, solver.all_free)

    def _of_solid(self, x: Array, placed: Array, mu: Array, solver: TangentSolver) -> tuple[Linearisation, Array]:
        """Linearisation of the solid, its sets ``placed`` where ``x`` has them, and the residual (n_dofs,) at ``x``."""
        residual = self._known_residual(placed, mu)
        reduced = self._reduced(residual, placed, x)
        # Moments count by the forces that they are at the distance of the body's size.
        on_motions = (self.motions(reduced) / np.repeat([1.0, self.length], 3)).ravel()
        unbalanced = np.concatenate([residual[solver.free], on_motions[solver.all_free[self.n_unknowns :]]])
        return self._linearised(placed, mu, residual, solver, unbalanced), reduced

    def residual_slopes(self, x: Array, mu: Array) -> Array:
        self._set(mu)
        placed = self._placed(x)
        slopes, moved = super().residual_slopes(placed, mu), np.zeros((len(mu), self.n_unknowns))
        moved[:, self._following] = np.hstack([part.displacement_slopes(q) for part, q in self._moved(x)])
        if moved.any():
            slopes = slopes + self._of_solid(x, placed, mu, self.solver)[0].apply(moved)
        on_sets = self._on_sets(x, super().residual(placed, mu))
        explicit = np.hstack([part.unbalanced_slopes(q, forces) for part, q, forces in on_sets])
        unbalanced = slopes[:, self._following] @ self._columns(x).T + explicit
        slopes[:, self._following] = -moved[:, self._following]
        return self._with_motions(slopes, unbalanced)

    def reactions(self, dofs: Array, mu: Array, name: str, about: Array | None = None) -> tuple[Array, Array]:
        force, moment = super().reactions(dofs, mu, name, about)
        about = self.constraints.centroid(name)[0] if about is None else about
        for k, (part, q) in self._on(name, dofs):
            work = np.where(part.held, self.motions(self.residual(dofs, mu))[k], 0.0)
            own, turning = part.reaction(q, work)
            force = force + own
            moment = moment + turning + np.cross(part.point() + q[:3] - about, own)
        return force, moment

    def reaction_slopes(
        self, dofs: Array, mu: Array, dof_slopes: Array, force_slopes: Array, name: str, about: Array
    ) -> tuple[Array, Array]:
        force, moment = super().reaction_slopes(dofs, mu, dof_slopes, force_slopes, name, about)
        for k, (part, q) in self._on(name, dofs):
            forces = self.motions(self.residual(dofs, mu))[k], self.motions(force_slopes)[:, k]
            work, work_slopes = (np.where(part.held, values, 0.0) for values in forces)
            moved = self.motions(dof_slopes)[:, k]
            own, turning = part.reaction_slopes(q, work, moved, work_slopes)
            arm, arm_slopes = part.point() + q[:3] - about, part.point_slopes() + moved[:, :3]
            force = force + own
            moment = moment + turning + np.cross(arm_slopes, work[:3]) + np.cross(arm, own)
        return force, moment

    def _on(self, name: str, x: Array) -> list[tuple[int, tuple[CoupledSet, Array]]]:
        """Number, set and motion (6,) of the couplings that are on a set and hold it."""
        numbered = enumerate(self._moved(x))
        return [(k, (part, q)) for k, (part, q) in numbered if part.coupling.on == name and part.coupling.held]

    def advance_history(self, x: Array, mu: Array) -> None:
        super().advance_history(self._placed(x), mu)

    def sample(self, dofs: Array, mu: Array) -> dict[str, Array]:
        return super().sample(dofs[: self.n_unknowns], mu)

    def sample_slopes(self, dofs: Array, mu: Array, dof_slopes: Array) -> dict[str, Array]:
        return super().sample_slopes(dofs[: self.n_unknowns], mu, dof_slopes[:, : self.n_unknowns])

    def strain_energy(self, dofs: Array, mu: Array) -> float:
        return super().strain_energy(dofs[: self.n_unknowns], mu)


def _block_diagonal(blocks: Sequence[Array]) -> Array:
    return np.asarray(scipy.linalg.block_diag(*blocks), dtype=np.float64)


@dataclass(frozen=True)
class _Coupled:
    """The couplings at one point.

    Attributes
    ----------
    following : (m,) dofs of the sets.
    columns : G' (6 k, m).
    stiffness : H (6 k, 6 k).
    has_energy : whether H is symmetric at equilibrium.
    """

    following: NDArray[np.int64]
    columns: Array
    stiffness: Array
    has_energy: bool


class _CoupledLinearisation:
    """A linearisation of solid and couplings, from that of the solid with the sets held."""

    def __init__(self, inner: Linearisation, residual: Array, coupled: _Coupled, free: Mask) -> None:
        self.residual, self._inner, self._coupled, self._free = residual, inner, coupled, free
        self._n = len(inner.residual)
        self._moving = np.flatnonzero(free[self._n :])

    def _lifted(self, motions: Array) -> Array:
        """The solid's dofs (..., n) of motions (..., 6 k): those of the sets, zero elsewhere."""
        result = np.zeros((*motions.shape[:-1], self._n))
        result[..., self._coupled.following] = motions @ self._coupled.columns
        return result

    def _forces(self, vectors: Array) -> Array:
        """G' K v (..., 6 k) of the solid's dofs v (..., n)."""
        return self._inner.apply(vectors)[..., self._coupled.following] @ self._coupled.columns.T

    @cached_property
    def _condensed(self) -> tuple[Array, Array]:
        """K_ff^-1 K_fs G (p, n) and C (p, p) of the p motions that are free."""
        if not len(self._moving):  # all sets are clamped, and the solver takes no empty block of right-hand sides
            return np.zeros((0, self._n)), np.zeros((0, 0))
        unit = np.eye(len(self._coupled.columns))[self._moving]
        lifted = self._lifted(unit)
        followed = self._inner.solve(self._inner.apply(lifted))
        C = self._forces(lifted - followed).T + self._coupled.stiffness[:, self._moving]
        return followed, C[self._moving]

    @property
    def negative_pivots(self) -> int | None:
        """Those of K_ff and of C together (Haynsworth, 1968); None where C is not symmetric."""
        found = self._inner.negative_pivots
        if found is None or not self._coupled.has_energy:
            return None
        C = self._condensed[1]
        return found + int(np.count_nonzero(np.linalg.eigvalsh((C + C.T) / 2.0) < 0.0))

    def solve(self, right: Array) -> Array:
        """See `newton.Linearisation`; SolverError if C is singular."""
        rows, following = np.atleast_2d(right), self._coupled.following
        followed, C = self._condensed
        alone = self._inner.solve(rows[:, : self._n])
        asked = (rows[:, self._n :] - self._forces(alone))[:, self._moving]
        motions = np.zeros((len(rows), len(self._coupled.columns)))
        try:
            motions[:, self._moving] = np.linalg.solve(C, asked.T).T
        except np.linalg.LinAlgError as error:
            raise SolverError("the couplings' tangent is singular: they are at a limit point") from error
        solution = alone - motions[:, self._moving] @ followed
        solution[:, following] = rows[:, following] + motions @ self._coupled.columns
        result = np.hstack([solution, motions])
        result[:, ~self._free] = 0.0
        return result.reshape(right.shape)

    def apply(self, vectors: Array) -> Array:
        columns, following = np.atleast_2d(vectors), self._coupled.following
        of_solid, motions = columns[:, : self._n].copy(), columns[:, self._n :]
        moved = motions @ self._coupled.columns
        apart = of_solid[:, following] - moved
        of_solid[:, following] = moved
        product = self._inner.apply(of_solid)
        forces = product[:, following] @ self._coupled.columns.T + motions @ self._coupled.stiffness.T
        product[:, following] = apart
        return np.hstack([product, forces]).reshape(vectors.shape)
