"""Equilibrium of a thin shell on a surface mesh in space; the energy is in `shell_energy`.

Dofs are those of the displacement, then membrane forces and bending moments, which are condensed element by element,
then the rotations of the edges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import ngsolve as ngs
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.kinematics import Kinematics, Shape
from morph_dslam.mechanics.load_modes import LoadedSurface
from morph_dslam.mechanics.loads import BodyForce, EdgeLoad, Gravity, Load
from morph_dslam.mechanics.materials.base import evaluate
from morph_dslam.mechanics.parameters import ParameterSymbols, Scalar
from morph_dslam.mechanics.shell_energy import AveragedNormals, ShellKinematics, ShellUnknowns, rim_angle, unit
from morph_dslam.mechanics.shell_material import ShellMaterial, components
from morph_dslam.mechanics.shell_recovery import ShellRecovery
from morph_dslam.mechanics.shell_supports import HoldsDirection, SymmetryPlane
from morph_dslam.mechanics.solid import SolidProblem, Support
from morph_dslam.mechanics.solid_assembly import Assembly, Term
from morph_dslam.mechanics.solvers.linear_solver import TangentSolver
from morph_dslam.mechanics.solvers.newton import Linearisation
from morph_dslam.mechanics.spaces import DisplacementSpace
from morph_dslam.mechanics.supports import Constraints
from morph_dslam.mechanics.surface_mesh import SurfaceMesh
from morph_dslam.meshing.meshes import Mesh

Array = NDArray[np.float64]
#: Place of the rotations among the parts of the space.
ROTATIONS = 3


@dataclass(frozen=True)
class ShellOptions:
    """How a shell is discretised.

    Attributes
    ----------
    order : of the displacements, 2 or 3; forces, moments and rotations have one less.
    threads : of PARDISO; None leaves MKL's choice.
    """

    order: int = 2
    threads: int | None = None


class ShellProblem(SolidProblem):
    """A shell with its material, supports, loads and parameters.

    Raises StudyError for unknown sets, an unstable material, a thickness that is not positive, missing supports, and a
    plane of symmetry whose set is in none.

    Parameters
    ----------
    mesh : of surface cells, metres, a manifold whose cells turn alike (`surface_checks`).
    material : of every cell.
    thickness : m; the mesh is in the middle of it.
    supports : see `supports` and `shell_supports`.
    loads : see `loads`.
    parameters : the symbols that all of these were written with.
    options : see `ShellOptions`.

    Attributes
    ----------
    at_rest : makes the same shell whose supports do not move; None if that is not known.
    """

    at_rest: Callable[[], ShellProblem] | None = None

    def __init__(
        self,
        mesh: Mesh,
        material: ShellMaterial,
        thickness: Scalar,
        supports: Sequence[Support] = (),
        loads: Sequence[Load] = (),
        parameters: ParameterSymbols | None = None,
        options: ShellOptions | None = None,
    ) -> None:
        self.options = options or ShellOptions()
        self.material, self.thickness = material, thickness
        self.supports, self.loads = tuple(supports), tuple(loads)
        self.history = self.enhanced = self.contact = None
        self.regions = []  # a shell's forces and moments stand in their place
        self.in_contact, self.applied_first = 0.0, None
        self.symbols = parameters or ParameterSymbols()
        self.symbols.set(self.symbols.default)
        material.check()
        if not evaluate(thickness) > 0.0:
            raise StudyError(f"the shell has thickness {evaluate(thickness):g} m; it must be positive")
        for plane in (support for support in supports if isinstance(support, SymmetryPlane)):
            plane.check(mesh)
        self.geometry = SurfaceMesh(mesh, [load.on for load in loads if isinstance(load, EdgeLoad)])
        self.mesh = self.geometry.mesh
        self.displacements = DisplacementSpace(self.geometry, self.options.order)
        self.shape, self.flags = Shape(self.displacements, ()), ()
        self.length = float(np.linalg.norm(np.ptp(mesh.nodes, axis=0)))
        self.space = self._make_space()
        self.n_unknowns: int = self.space.ndof
        self.n_dofs: int = self.n_unknowns
        self.constraints = Constraints(self.displacements, self.shape, self.supports, self.symbols)
        directed = [support for support in self.supports if isinstance(support, HoldsDirection)]
        axes = self._edge_directions([support.on for support in directed])
        hanging = any(isinstance(load, Gravity) for load in self.loads)
        self.constraints.check_rigid_motions(np.hstack([np.zeros(axes.shape), axes]), hanging)
        self._state = ngs.GridFunction(self.space)
        self._drag, self._anchor = ngs.Parameter(0.0), ngs.GridFunction(self.displacements.vector)
        self._turned = ngs.Parameter(1.0)
        held = self._held_edges(directed)
        self._normals = AveragedNormals(
            self.geometry.ngs, self.options.order - 1, self._state.components[0], held, self._turned
        )
        self.assembly = _ShellAssembly(self.space, self._terms(), self.symbols, self.refresh_normals)
        self._held_rotations = self._rotation_dofs([edge for _, edges in held for edge in edges])
        self._set_up_dofs()

    def _edge_directions(self, sets: list[str]) -> Array:
        """Unit vectors (e, 3) along the edges of node sets."""
        ends = np.concatenate([np.empty((0, 2), dtype=np.int64), *(self.geometry.edges_on(name) for name in sets)])
        along = self.mesh.nodes[ends[:, 1]] - self.mesh.nodes[ends[:, 0]]
        return along / np.linalg.norm(along, axis=1, keepdims=True)

    def _held_edges(self, supports: Sequence[HoldsDirection]) -> list[tuple[HoldsDirection, list[int]]]:
        """The edges whose direction each support holds; the one listed first has those that two name."""
        taken, result = set(), []
        for support in supports:
            edges = [edge for edge in self.geometry.edge_numbers(support.on) if edge not in taken]
            taken.update(edges)
            if edges:
                result.append((support, edges))
        return result

    def _make_space(self) -> ngs.FESpace:
        mesh, order = self.geometry.ngs, self.options.order - 1
        # Membrane forces of fewer functions leave quadrilaterals free to hourglass.
        forces = ngs.HCurlCurl(mesh, order=order, discontinuous=True)
        moments = ngs.HDivDivSurface(mesh, order=order, discontinuous=True)
        rotations = ngs.NormalFacetSurface(mesh, order=order)
        self.strain_space = forces
        return self.displacements.vector * forces * moments * rotations

    def unknowns(self, functions: Sequence[Any]) -> ShellUnknowns:
        """The parts of trial functions or of a state, in SI units.

        Forces and moments are carried in units of the shell's stiffness at the parameters' defaults over its size, in
        which they are about as large as displacements.
        """
        displacement, *others = functions
        # Only trial functions have to be told that they are meant on the surface.
        force, moment, rotation = (f.Trace() if hasattr(f, "Trace") else f for f in others)
        force_unit, moment_unit = self.units
        return ShellUnknowns(displacement, force_unit * force, moment_unit * moment, rotation)

    def loaded_surface(self, name: str, inward: bool) -> LoadedSurface:
        """See `SolidProblem.loaded_surface`; without a name all of the shell."""
        space = self.displacements
        region = self.geometry.boundary(name) if name else self.geometry.region("all")
        nodes = self.mesh.surface_nodes(name) if name else np.arange(self.mesh.n_nodes, dtype=np.int64)
        return LoadedSurface.of(space, region, nodes, self.n_dofs, inward)

    @cached_property
    def units(self) -> tuple[float, float]:
        """Of membrane forces (N/m per m) and of moments (N per m)."""
        young, thickness = evaluate(self.material.young_fibre), evaluate(self.thickness)
        return young * thickness / self.length, young * thickness**3 / 12.0 / self.length

    def _terms(self) -> list[Term]:
        unknowns = self.unknowns(self.space.TrialFunction())
        kinematics, bonus = ShellKinematics(unknowns.displacement), self.displacements.bonus_order
        everywhere, t = self.geometry.region("all"), self.thickness
        n, tangent = ShellKinematics.reference_normal, ngs.specialcf.tangential(3)
        m, force, across = unknowns.moment, unknowns.force, ngs.Cross(n, tangent)
        frame, compliance = self.material.frame(n), self.material.complementary_energy
        strain = ngs.Interpolate(kinematics.strain, self.strain_space)
        membrane = ngs.InnerProduct(force, strain) - compliance(*components(force, *frame)) / t
        bending = ngs.InnerProduct(m, kinematics.curvature) - 12.0 / t**3 * compliance(*components(m, *frame))
        now = rim_angle(kinematics.normal, kinematics.tangent, self._normals.current)
        before = rim_angle(n, tangent, self._normals.reference)
        # `Cross(normal, tangent)` points out of the element, as a positive angle turns the normal.
        hinge = -(now - before - unknowns.rotation * across) * ((m * across) * across)
        terms = [
            Term(membrane, everywhere, bonus),
            Term(bending, everywhere, bonus),
            Term(hinge, everywhere, bonus, on_rims=True),
        ]
        moved = unknowns.displacement - self._anchor
        terms.append(Term(0.5 * self._drag * (moved * moved), everywhere, bonus))
        at_points, test = Kinematics(unknowns.displacement, self.shape), self.space.TestFunction()[0]
        return terms + self._outer_terms(at_points, test)

    def _load_terms(self, load: Load, kinematics: Kinematics, test: Any) -> list[Term]:
        if isinstance(load, EdgeLoad):
            return [Term(load.energy(kinematics), self.geometry.edge_region(load.on), load.bonus_order)]
        if isinstance(load, Gravity):
            load = BodyForce(tuple(self.material.density * a for a in load.acceleration))
        if isinstance(load, BodyForce):
            weight = ngs.CF(load.force) * kinematics.displacement
            return [Term(-self.thickness * weight, self.geometry.region(load.on), self.displacements.bonus_order)]
        return super()._load_terms(load, kinematics, test)

    def _rotation_dofs(self, edges: list[int]) -> NDArray[np.int64]:
        """Dofs of the rotations of edges."""
        rotations, first = self.space.components[ROTATIONS], self.space.Range(ROTATIONS).start
        numbers = [dof for edge in edges for dof in rotations.GetDofNrs(ngs.NodeId(ngs.EDGE, edge))]
        return first + np.array(numbers, dtype=np.int64)

    def _free_dofs(self) -> NDArray[np.bool_]:
        free = super()._free_dofs()
        free[self._held_rotations] = False
        return free

    @property
    def area(self) -> float:
        """Of the undeformed shell, m2."""
        return ngs.Integrate(ngs.CF(1.0) * ngs.ds, self.geometry.ngs)

    def set_drag(self, drag: float, x: Array) -> None:
        """Tie the shell to its solution ``x`` (n,) by ``drag``, a force per area and displacement; 0 lets it go."""
        self._drag.Set(drag)
        self._anchor.vec.FV().NumPy()[:] = x[: 3 * self.displacements.n_scalar]
        self._latest = None

    def turn_directions(self, share: float) -> None:
        """Turn the directions that supports hold by that share of the angle that parameters give."""
        if share != self._turned.Get():
            self._turned.Set(share)
            self._latest = None

    def refresh_normals(self, x: Array) -> None:
        """Average the edge normals at the solution ``x`` (n,), at the parameters' present values."""
        self._state.vec.FV().NumPy()[:] = x
        self._normals.update()

    def linearise(self, x: Array, mu: Array, solver: TangentSolver | None = None) -> Linearisation:
        """Tangent at ``x``; the frozen edge normals are averaged there first.

        That renewal shifts the meaning of the edges' rotations, which the next correction makes up for.
        """
        self.refresh_normals(x)
        self._latest = None
        return super().linearise(x, mu, solver)

    def response_slopes(self, dofs: Array, mu: Array, responses: Array) -> dict[str, Array]:
        """See `SolidProblem.response_slopes`; displacement and stresses are linear in the dofs."""
        fields = [self.sample(response, mu) for response in responses]
        return {name: np.array([field[name] for field in fields]) for name in fields[0]}

    def reactions(self, dofs: Array, mu: Array, name: str, about: Array | None = None) -> tuple[Array, Array]:
        force, moment = super().reactions(dofs, mu, name, about)
        return force, moment + self._edge_couple(dofs, name)

    def reaction_slopes(
        self, dofs: Array, mu: Array, dof_slopes: Array, force_slopes: Array, name: str, about: Array
    ) -> tuple[Array, Array]:
        force, moment = super().reaction_slopes(dofs, mu, dof_slopes, force_slopes, name, about)
        return force, moment + self._edge_couple_slopes(dofs, dof_slopes, name)

    def response_reactions(
        self, dofs: Array, mu: Array, responses: Array, forces: Array, name: str, about: Array
    ) -> tuple[Array, Array]:
        force, moment = super().response_reactions(dofs, mu, responses, forces, name, about)
        return force, moment + self._edge_couple_slopes(dofs, responses, name)

    def _edge_couple(self, dofs: Array, name: str) -> Array:
        """Moment (3,), N m, by which the supports of a set hold the direction of its edges."""
        indicator = self._normals.indicators.get(name)
        if indicator is None:
            return np.zeros(3)
        self._state.vec.FV().NumPy()[:] = dofs
        parts = self.unknowns(self._state.components)
        couple = _rim_moment(parts.moment) * ShellKinematics(parts.displacement).tangent
        return self._on_rims(indicator * couple)

    def _edge_couple_slopes(self, dofs: Array, changes: Array, name: str) -> Array:
        """Derivatives (c, 3) of `_edge_couple` along changes (c, n) of the dofs, of which alone it is a function."""
        indicator = self._normals.indicators.get(name)
        if indicator is None:
            return np.zeros((len(changes), 3))
        self._state.vec.FV().NumPy()[:] = dofs
        change = ngs.GridFunction(self.space)
        at, along = self.unknowns(self._state.components), self.unknowns(change.components)
        edge = ngs.specialcf.tangential(3)
        deformed, moved = ShellKinematics(at.displacement).gradient * edge, ngs.Grad(along.displacement) * edge
        tangent = unit(deformed)
        turned = (moved - (tangent * moved) * tangent) / ngs.Norm(deformed)
        slope = indicator * (_rim_moment(along.moment) * tangent + _rim_moment(at.moment) * turned)
        result = np.empty((len(changes), 3))
        for row, values in zip(result, changes, strict=True):
            change.vec.FV().NumPy()[:] = values
            row[:] = self._on_rims(slope)
        return result

    def _on_rims(self, vector: Any) -> Array:
        """Integral (3,) of a vector over the rims of the elements."""
        rims, mesh = ngs.ds(element_boundary=True), self.geometry.ngs
        return np.array([ngs.Integrate(vector[axis] * rims, mesh) for axis in range(3)])

    @cached_property
    def recovery(self) -> ShellRecovery:
        """Fields at nodes, made when first needed."""
        return ShellRecovery(self)

    def strain_energy(self, dofs: Array, mu: Array) -> float:
        self.symbols.set(mu)
        return self.assembly.energy(dofs, 3)


def _rim_moment(moment: Any) -> Any:
    """The part of bending moments (3x3) that bends across the rim of an element."""
    across = ngs.Cross(ShellKinematics.reference_normal, ngs.specialcf.tangential(3))
    return (moment * across) * across


class _ShellAssembly(Assembly):
    """The forms of a shell, assembled with the edge normals of the point itself."""

    def __init__(
        self, space: ngs.FESpace, terms: list[Term], symbols: ParameterSymbols, refresh: Callable[[Array], None]
    ) -> None:
        # Forces and moments are condensed, and rotations add no negative pivots: none of the dofs left is a multiplier.
        super().__init__(space, terms, symbols, space.ndof)
        self._refresh = refresh

    def tangent(self, x: Array) -> sp.csr_matrix:
        self._refresh(x)
        return super().tangent(x)
