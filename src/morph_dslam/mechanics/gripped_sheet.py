"""Equilibrium of a sheet held by two rigid grips, at given coordinates, with all sensitivities.

Unknowns are the shell's dofs and the two free motions of the grips (approach, and their turn in the
plane). The equations are equilibrium of the sheet, the prescribed bulge, and zero moment against the turn.
Prescribing the bulge instead of the approach follows the path through the flat state and past any largest
approach (as in arc-length methods), and puts no lateral force on the sheet: the bulge equation replaces that
of the axial force, it does not add a load.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.grips import FREE_MOTIONS, MOTION, Grips
from morph_dslam.mechanics.shell import KoiterSheet, OrthotropicSheet, rectangle_mesh
from morph_dslam.mechanics.solvers.continuation import step_towards

Array = NDArray[np.float64]
#: Newton has converged when no dof changes by more than this part of the sheet's length.
TOLERANCE = 1e-7
MAX_ITERATIONS = 14
#: After so many iterations the update must be below this part of the first: an iteration that wanders hardly
#: ever comes back, and a smaller increment is cheaper than waiting for it.
PATIENCE, PROGRESS = 6, 0.25
#: Longest displacement update, as a part of the length; longer ones are scaled back.
MAX_UPDATE = 0.06
#: An update longer than this means divergence; NaN does too.
DIVERGED = 2.0


@dataclass(frozen=True)
class EquilibriumState:
    """A converged state: coordinates (4,), grip motion (5,) and the shell's dofs."""

    coordinates: Array
    motion: Array
    dofs: Array


@dataclass(frozen=True)
class _Response:
    """One factorised tangent: how the sheet answers the residual and each grip motion.

    ``reactions`` (6, 3 n_held) are the forces at the held dofs after the correction, in units of the shell's energy,
    and their derivatives by the motions.
    """

    correction: Array
    per_motion: Array
    reactions: Array
    border: Array
    border_residual: Array


class GrippedSheet:
    """A rectangular sheet, its grips and its shell.

    Parameters
    ----------
    material : of the sheet.
    grips : where they are.
    width : of the sheet along y, m; the length is the grips'.
    divisions : elements along x between the grips, and along y.
    order : polynomial degree of the displacements.
    """

    def __init__(
        self, material: OrthotropicSheet, grips: Grips, width: float, divisions: tuple[int, int], order: int = 3
    ) -> None:
        self.grips, self.width = grips, width
        mesh = rectangle_mesh(*mesh_lines(grips, width, divisions))
        self._held_vertices = _vertices_under(grips, mesh)
        rigid = _elements_within(mesh, np.concatenate(self._held_vertices))
        self.shell = KoiterSheet(mesh, material, order, rigid_elements=rigid)
        self._find_held_dofs(rigid)
        self._bulge_row = self._bulge_functional()
        self._latest: tuple[EquilibriumState, _Response] | None = None

    def _find_held_dofs(self, rigid_elements: list[int]) -> None:
        """Dofs under the grips: those of vertices move with the grip, those of higher order stay zero."""
        mesh, scalar = self.shell.mesh, self.shell.scalar_space
        vertices = np.array([v.point for v in mesh.vertices])
        material_points = np.column_stack([vertices, np.zeros(len(vertices))])
        self._held_points = [material_points[indices] for indices in self._held_vertices]
        higher = {
            dof
            for number in rigid_elements
            for dof in scalar.GetDofNrs(ngs.ElementId(ngs.VOL, number))
            if dof >= mesh.nv
        }
        held = np.concatenate(self._held_vertices)
        starts = [self.shell.displacement_dofs(i).start for i in range(3)]
        self._held_dofs = np.concatenate([start + held for start in starts])
        fixed = [self._held_dofs] + [start + np.array(sorted(higher), dtype=int) for start in starts]
        free = ngs.BitArray(self.shell.space.FreeDofs(True))
        for dof in np.concatenate(fixed):
            free.Clear(int(dof))
        self._free = free

    def _bulge_functional(self) -> Array:
        """Row of weights over all dofs whose product with the state is the bulge."""
        space, grips = self.shell.space, self.grips
        free_length = grips.free_length
        weight = ngs.IfPos(free_length / 2.0 - ngs.sqrt(ngs.x * ngs.x), ngs.cos(np.pi / free_length * ngs.x) ** 2, 0.0)
        test = space.TestFunction()[2]
        form = ngs.LinearForm(space)
        form += weight * test * ngs.dx(bonus_intorder=4)
        form.Assemble()
        total = ngs.Integrate(weight * ngs.dx(bonus_intorder=4), self.shell.mesh)
        return form.vec.FV().NumPy() / total

    def _by_component(self, vectors: Array) -> Array:
        """(n_held, 3, ...) to the order of the held dofs: all x, then y, then z."""
        return np.moveaxis(vectors, 1, 0).reshape(3 * vectors.shape[0], *vectors.shape[2:])

    def _held_values(self, motion: Array) -> Array:
        material = np.vstack(self._held_points)
        return self._by_component(self.grips.positions(motion, *self._held_points) - material)

    def _held_velocity(self, motion: Array) -> Array:
        return self._by_component(self.grips.velocity(motion, *self._held_points))

    def bulge(self) -> float:
        """Bulge of the current state, metres."""
        return float(self._bulge_row @ self.shell.state_vector())

    def _respond(self, motion: Array, target: Array) -> _Response:
        """Assemble and factorise at the current state; solve for the residual and for each grip motion.

        The border holds an equation for each free motion: the bulge, and zero moment of the turn.
        """
        shell = self.shell
        form, state = shell.form, shell.state.vec
        residual, work, result = (state.CreateVector() for _ in range(3))
        form.Apply(state, residual)
        form.AssembleLinearization(state)
        inverse = form.mat.Inverse(self._free, inverse="sparsecholesky")
        condensed = state.CreateVector()
        condensed.data = residual + form.harmonic_extension_trans * residual

        velocity = self._held_velocity(motion)
        gap = self._held_values(motion) - shell.state_vector()[self._held_dofs]
        fields, reactions = [], []
        for column in range(1 + len(MOTION)):
            work[:] = 0.0
            work.FV().NumPy()[self._held_dofs] = gap if column == 0 else velocity[:, column - 1]
            load = state.CreateVector()
            load.data = form.mat * work
            if column == 0:
                load.data += condensed
            work.data -= inverse * load
            load.data = form.mat * work
            if column == 0:
                load.data += condensed
            reactions.append(load.FV().NumPy()[self._held_dofs].copy())
            result.data = work + form.harmonic_extension * work
            if column == 0:
                result.data -= form.inner_solve * residual
            fields.append(result.FV().NumPy().copy())
        per_motion = np.array(fields[1:])
        border = self._border(motion, target, fields, reactions, velocity)
        return _Response(fields[0], per_motion, np.array(reactions), *border)

    def _border(
        self, motion: Array, target: Array, fields: list[Array], reactions: list[Array], velocity: Array
    ) -> tuple[Array, Array]:
        """Rows of the border equations: derivative (2, 5) by the motions, and residual (2,)."""
        row = self._bulge_row
        border, residual = np.zeros((2, 5)), np.zeros(2)
        residual[0] = row @ (self.shell.state_vector() + fields[0]) - target[0]
        border[0] = [row @ field for field in fields[1:]]
        turn, step = FREE_MOTIONS[1], 1e-5
        residual[1] = velocity[:, turn] @ reactions[0]
        border[1] = [velocity[:, turn] @ reaction for reaction in reactions[1:]]
        for other in range(5):
            change = np.zeros(5)
            change[other] = step
            # The direction in which the turn moves the grip changes with the other motions.
            forward, backward = self._held_velocity(motion + change), self._held_velocity(motion - change)
            border[1, other] += (forward - backward)[:, turn] @ reactions[0] / (2.0 * step)
        return border, residual

    def solve(self, coordinates: Array, start: EquilibriumState) -> EquilibriumState:
        """Newton's method from ``start`` to equilibrium at ``coordinates`` (4,).

        Raises SolverError if it does not converge; the caller may try smaller increments.
        """
        shell, length = self.shell, self.grips.length
        vector = shell.state_vector()
        vector[:] = start.dofs
        shell.refresh_normals()
        prescribed = self.grips.prescribed_motion(coordinates)
        free = list(FREE_MOTIONS)
        motion = prescribed.copy()
        motion[free] = start.motion[free]
        n_displacement = 3 * shell.scalar_space.ndof
        first = np.inf
        for iteration in range(MAX_ITERATIONS):
            response = self._respond(motion, coordinates)
            change = -np.linalg.solve(response.border[:, free], response.border_residual)
            update = response.correction + change @ response.per_motion[free]
            largest = np.abs(update[:n_displacement]).max()
            first = largest if iteration == 0 else first
            stalled = iteration >= PATIENCE and largest > PROGRESS * first
            if stalled or not largest < DIVERGED * length:
                break
            scale = min(1.0, MAX_UPDATE * length / largest)
            vector += scale * update
            motion[free] += scale * change
            if largest < TOLERANCE * length:
                return EquilibriumState(coordinates.copy(), motion.copy(), vector.copy())
        raise SolverError(f"no equilibrium found at {_describe(coordinates)}")

    def advance(self, start: EquilibriumState, target: Array) -> EquilibriumState:
        """Solve at ``target`` (4,) along the straight line from ``start``.

        Raises SolverError naming the last coordinates that converged.
        """
        origin = start.coordinates

        def attempt(fraction: float, nearby: EquilibriumState) -> EquilibriumState:
            return self.solve(origin + fraction * (target - origin), nearby)

        return step_towards(attempt, start)

    def sensitivities(self, state: EquilibriumState) -> tuple[Array, Array]:
        """Derivatives of the dofs (4, n_dofs) and of the grip motion (4, 5) by the coordinates.

        Implicit differentiation of the equilibrium equations: one factorisation, one solve each.
        """
        response = self._response_at(state)
        free = list(FREE_MOTIONS)
        motions = self.grips.prescribed_motion_gradient(state.coordinates).T
        for k, motion in enumerate(motions):
            load = response.border @ motion
            load[0] -= 1.0 if k == 0 else 0.0
            motion[free] -= np.linalg.solve(response.border[:, free], load)
        return motions @ response.per_motion, motions

    def _response_at(self, state: EquilibriumState) -> _Response:
        """At a solved state; that of the latest one is kept."""
        if self._latest is None or self._latest[0] is not state:
            self.shell.state_vector()[:] = state.dofs
            self.shell.refresh_normals()
            self._latest = state, self._respond(state.motion, state.coordinates)
        return self._latest[1]

    def reactions(self, state: EquilibriumState) -> tuple[Array, Array]:
        """What the left and the right grip exert, with derivatives by the coordinates.

        Returns
        -------
        Force (N) and moment about the origin (N m) of each grip, (2, 6); derivatives (4, 2, 6).
        """
        response, (_, motions) = self._response_at(state), self.sensitivities(state)
        positions = np.vstack(self._held_points) + self._by_vertex(self._held_values(state.motion))
        forces = self.shell.energy_scale * self._by_vertex(response.reactions[0])
        velocities = np.moveaxis(self._by_vertex(self._held_velocity(state.motion).T), 0, -1) @ motions.T
        slopes = self.shell.energy_scale * self._by_vertex(motions @ response.reactions[1:])
        both = np.concatenate([forces, np.cross(positions, forces)], axis=1)
        turned = np.cross(np.moveaxis(velocities, -1, 0), forces) + np.cross(positions, slopes)
        both_slopes = np.concatenate([slopes, turned], axis=2)
        left = len(self._held_points[0])
        return (
            np.array([both[:left].sum(axis=0), both[left:].sum(axis=0)]),
            np.stack([both_slopes[:, :left].sum(axis=1), both_slopes[:, left:].sum(axis=1)], axis=1),
        )

    def _by_vertex(self, held: Array) -> Array:
        """(..., n_held, 3) of values (..., 3 n_held) at the held dofs; the inverse of `_by_component`."""
        return np.swapaxes(held.reshape(*held.shape[:-1], 3, -1), -1, -2)

    def first_state(self, bulge: float) -> EquilibriumState:
        """Equilibrium of the gently arched sheet, bend = 1, from a circular arc as the first guess.

        Should Newton's method not converge from there, a flatter arch is tried: the state returned may bulge less than
        asked. Raises SolverError if no arch converges.
        """
        shell = self.shell
        half = self.grips.free_length / 2.0
        arc = ngs.IfPos(half * half - ngs.x * ngs.x, 1.0 - ngs.x * ngs.x / (half * half), 0.0)
        guess = ngs.GridFunction(shell.scalar_space)
        guess.Set(arc)
        dofs = np.zeros(shell.space.ndof)
        dofs[shell.displacement_dofs(2)] = guess.vec.FV().NumPy()
        dofs /= float(self._bulge_row @ dofs)
        for reduction in (1.0, 0.5, 0.25, 0.125):
            coordinates = np.array([reduction * bulge, 1.0, 0.0, 0.0])
            start = EquilibriumState(coordinates, np.zeros(5), coordinates[0] * dofs)
            try:
                return self.solve(coordinates, start)
            except SolverError:
                continue
        raise SolverError("not even a gently arched sheet converges: refine solver.divisions")


def _vertices_under(grips: Grips, mesh: ngs.Mesh) -> list[NDArray[np.intp]]:
    """Mesh vertices under the left and the right grip."""
    vertices = np.array([v.point for v in mesh.vertices])
    tolerance = 1e-9 * grips.length
    inner = grips.length / 2.0 - grips.depth - tolerance
    return [
        np.flatnonzero(
            (sign * vertices[:, 0] >= inner) & (np.abs(vertices[:, 1] - centre) <= grips.height / 2.0 + tolerance)
        )
        for sign, centre in ((-1.0, grips.centre_left), (1.0, grips.centre_right))
    ]


def _elements_within(mesh: ngs.Mesh, vertices: NDArray[np.intp]) -> list[int]:
    """Elements all of whose vertices are in ``vertices``."""
    inside = set(vertices.tolist())
    return [element.nr for element in mesh.Elements(ngs.VOL) if all(v.nr in inside for v in element.vertices)]


def _describe(coordinates: Array) -> str:
    bulge, bend, skew, slant = coordinates
    return f"bulge {1e3 * bulge:.1f} mm, bend {bend:.2f}, skew {np.degrees(skew):.1f} deg, slant {slant:.2f}"


def mesh_lines(grips: Grips, width: float, divisions: tuple[int, int]) -> tuple[Array, Array]:
    """Mesh lines along x and y that follow the grips' outlines, elements elsewhere about equal."""
    half = grips.length / 2.0
    x = np.linspace(-half + grips.depth, half - grips.depth, divisions[0] + 1)
    x_lines = np.concatenate([[-half], x, [half]])
    edges = {-width / 2.0, width / 2.0}
    for centre in (grips.centre_left, grips.centre_right):
        edges |= {centre - grips.height / 2.0, centre + grips.height / 2.0}
    stops = np.array(sorted(edges))
    stops = stops[np.concatenate([[True], np.diff(stops) > 1e-6])]
    target = width / divisions[1]
    pieces = [np.linspace(a, b, max(1, round((b - a) / target)) + 1)[:-1] for a, b in pairwise(stops)]
    return x_lines, np.concatenate([*pieces, [width / 2.0]])
