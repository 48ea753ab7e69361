"""Equilibrium of hyperelastic solids: total Lagrangian finite elements on NGSolve.

A solid is its energy. With the kinematics of `kinematics`, the residual is the derivative of

    int W(F) dV + foundations - dead loads

plus the virtual work of loads without energy, and the tangent is the derivative of the residual, both taken
by NGSolve; derivatives by parameters are taken of the same integrands. Contact is added, see `contact_assembly`.
`SolidProblem` implements the `Equations` of `newton` and leaves solution paths to it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import ngsolve as ngs
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from morph_dslam.mechanics.contact import Contact
from morph_dslam.mechanics.contact_assembly import ContactAssembly
from morph_dslam.mechanics.contact_stiffness import stiffening
from morph_dslam.mechanics.enhanced_assembly import EnhancedAssembly
from morph_dslam.mechanics.enhanced_strain import EnhancedStrain, takes_enhanced_strain
from morph_dslam.mechanics.kinematics import Kinematics, Shape, ShapeField
from morph_dslam.mechanics.load_modes import LoadedSurface
from morph_dslam.mechanics.loads import BodyForce, FollowerPressure, Gravity, Load, NodalForces, PointLoad, SurfaceForce
from morph_dslam.mechanics.materials.base import Material, isotropic_average
from morph_dslam.mechanics.ngsolve_mesh import NgsolveMesh
from morph_dslam.mechanics.parameters import ParameterSymbols, Scalar
from morph_dslam.mechanics.recovery import Recovery
from morph_dslam.mechanics.solid_assembly import Assembly, Term
from morph_dslam.mechanics.solid_materials import can_be_mixed, mixed_materials, owners_of_cells, place_materials
from morph_dslam.mechanics.solvers.linear_solver import LinearSolver, SolverMaker, TangentSolver
from morph_dslam.mechanics.solvers.newton import Linearisation, State
from morph_dslam.mechanics.spaces import DisplacementSpace, default_order
from morph_dslam.mechanics.support_forces import SupportForces
from morph_dslam.mechanics.supports import Constraints, ElasticFoundation, PrescribedMotion, largest_turn
from morph_dslam.mechanics.viscous_history import ViscousHistory
from morph_dslam.meshing.meshes import Mesh

Array = NDArray[np.float64]
#: The tangent of contact is complete where the forces on what is free are balanced to such a part of those of contact.
BALANCED = 0.02
Support = PrescribedMotion | ElasticFoundation


@dataclass(frozen=True)
class SolidOptions:
    """How a solid is discretised.

    Attributes
    ----------
    order : of the displacements, 1 to 3; None for 2, save on meshes of hex8 cells alone, which have elements of first
        order that do not lock. Order 2 on first-order cells adds functions on their edges, faces and inside.
    mixed : give every material pressures of its own whose energy has a volumetric part with a modulus that is positive
        at the parameters' defaults, against locking near incompressibility; see `PressureSpace`. hex20 and prism15
        then use all functions of second order. None gives meshes of hex8 cells alone enhanced strains (see
        `enhanced_strain`); of the materials on other meshes, those take the mixed form that need it, where the cells
        have one. False is plain displacement elements.
    serendipity : leave out functions that second-order cells with nodes on their edges alone have not, where no
        material is mixed; see `DisplacementSpace`.
    at_nodes : evaluate stresses and strains at the nodes themselves, as elements of third order do, in place of where
        they are most accurate: what coarser elements are compared with must not share their error of extrapolation.
    contact : factor of the stiffness of contact: what others are compared with must not give way as they do.
    threads : of PARDISO; None leaves MKL's choice.
    """

    order: int | None = None
    mixed: bool | None = None
    serendipity: bool = False
    at_nodes: bool = False
    contact: float = 1.0
    threads: int | None = None


class SolidProblem:
    """A solid with its materials, supports, loads and parameters.

    Raises StudyError for unknown sets, cells with no material or with two, unstable materials, missing supports,
    obstacles that overlap the undeformed solid.

    Parameters
    ----------
    mesh : in metres.
    materials : by cell set; "all" takes the cells that no other set names.
    supports : see `supports`.
    loads : see `loads`.
    parameters : the symbols that materials, supports, loads and shapes were written with.
    options : see `SolidOptions`.
    shape : how the undeformed shape depends on parameters.
    time : expression of the parameters that is the time, s; viscous materials need it.
    contacts : what surfaces touch, see `contact`.

    Attributes
    ----------
    n_dofs : see `newton.Equations`. The first 3 n_scalar dofs are displacements, those of x first; pressures, or
        the added unknowns of enhanced strains, follow.
    n_unknowns : how many dofs are the solid's own; motions of couplings follow (`coupled_solid`).
    free : see `newton.Equations`.
    scale : see `newton.Equations`.
    applied_first : makes the same solid with what is to act before everything else (`continuation.loaded_state`);
        None if all grows together.
    flags : what a result obtained with this discretisation must be doubted for; empty if nothing.
    """

    def __init__(
        self,
        mesh: Mesh,
        materials: Mapping[str, Material],
        supports: Sequence[Support] = (),
        loads: Sequence[Load] = (),
        parameters: ParameterSymbols | None = None,
        options: SolidOptions | None = None,
        shape: Sequence[ShapeField] = (),
        time: Scalar | None = None,
        contacts: Sequence[Contact] = (),
    ) -> None:
        options = options or SolidOptions()
        self.mesh, self.supports, self.loads, self.options = mesh, tuple(supports), tuple(loads), options
        self.symbols = parameters or ParameterSymbols()
        self.symbols.set(self.symbols.default)
        self.geometry = NgsolveMesh(mesh)
        order = default_order(mesh) if options.order is None else options.order
        enhanced = options.mixed is None and takes_enhanced_strain(mesh, order)
        mixed = set() if enhanced else mixed_materials(self.geometry, order, materials, options.mixed)
        full = bool(mixed or options.mixed)
        self.displacements = DisplacementSpace(self.geometry, order, full, options.serendipity)
        self.shape = Shape(self.displacements, shape)
        self.length = float(np.linalg.norm(np.ptp(mesh.nodes, axis=0)))
        self.cell_materials = owners_of_cells(mesh, materials)
        self.regions = place_materials(self.displacements, self.cell_materials, materials, mixed, enhanced)
        self.history = self._make_history(time)
        self.flags = tuple(region.flag for region in self.regions if region.flag)
        self.space = self._product_space()
        self.enhanced = self._make_enhanced() if enhanced else None
        self.n_unknowns: int = self.enhanced.n_dofs if self.enhanced else self.space.ndof
        self.n_dofs: int = self.n_unknowns
        self.constraints = Constraints(self.displacements, self.shape, self.supports, self.symbols)
        self.constraints.check_rigid_motions(self._held_motions())
        self.assembly = self._make_assembly()
        self.contact = self._make_contact(contacts)
        self.applied_first: Callable[[], SolidProblem] | None = None
        self._set_up_dofs()

    def _set_up_dofs(self) -> None:
        """Which dofs are free, how they are measured, and the forces of points on them."""
        self.free: NDArray[np.bool_] = self._free_dofs()
        scale = np.full(self.n_dofs, np.inf)
        scale[: 3 * self.displacements.n_scalar] = self.length
        self.scale: Array | float = scale
        self._latest: tuple[Array, Array, Array] | None = None
        points = [load for load in self.loads if isinstance(load, PointLoad)]
        self._nodal_forces = NodalForces(self.displacements, points, self.symbols)

    def _held_motions(self) -> Array:
        """What holds the body beside its supports, see `Constraints.check_rigid_motions`."""
        return np.zeros((0, 6))

    @property
    def held_sets(self) -> list[str]:
        """Sets that have reactions."""
        return [support.on for support in self.supports]

    def _make_enhanced(self) -> EnhancedStrain:
        owners = self.cell_materials[self.geometry.cell_of_element]
        split = [n for n, r in zip(np.unique(owners), self.regions, strict=True) if can_be_mixed(r.material)]
        return EnhancedStrain(self.displacements, np.flatnonzero(np.isin(owners, split)))

    def _make_history(self, time: Scalar | None) -> ViscousHistory | None:
        if all(region.material.prony is None for region in self.regions):
            return None
        history = ViscousHistory(self.displacements, self.regions, time, self.symbols)
        self.regions = history.regions
        return history

    def _product_space(self) -> ngs.FESpace:
        spaces = [self.displacements.vector]
        for region in self.regions:
            spaces += region.pressures.spaces if region.pressures else []
        return spaces[0] if len(spaces) == 1 else ngs.ProductSpace(*spaces)

    def embedded_pressures(self, coarse: SolidProblem, dofs: Array) -> Array:
        """Dofs (n_unknowns,) with the pressures of ``dofs`` (n,) of the same solid with elements of lower order.

        All else is zero, and so are pressures of materials that have none in the lower order.
        """
        result, own, other = (
            np.zeros(self.n_unknowns),
            3 * self.displacements.n_scalar,
            3 * coarse.displacements.n_scalar,
        )
        for region, known in zip(self.regions, coarse.regions, strict=True):
            n_own = region.pressures.n_dofs if region.pressures else 0
            n_other = known.pressures.n_dofs if known.pressures else 0
            if region.pressures and known.pressures:
                values = dofs[other : other + n_other]
                result[own : own + n_own] = region.pressures.embedded(known.pressures, values)
            own, other = own + n_own, other + n_other
        return result

    def split(self, functions: Any) -> tuple[Any, list[list[Any]]]:
        """Displacement, and for each material region its pressure unknowns, of the product space's parts."""
        if not any(region.pressures for region in self.regions):
            return functions, [[] for _ in self.regions]
        displacement, *rest = functions
        groups = []
        for region in self.regions:
            count = len(region.pressures.spaces) if region.pressures else 0
            groups.append(rest[:count])
            rest = rest[count:]
        return displacement, groups

    def _terms(self) -> list[Term]:
        trial, pressures = self.split(self.space.TrialFunction())
        test, _ = self.split(self.space.TestFunction())
        kinematics = Kinematics(trial, self.shape)
        F, ratio = kinematics.deformation_gradient, kinematics.volume_ratio
        terms = [
            Term(
                region.energy(F, region.pressure(unknowns)) * ratio,
                region.region,
                self.shape.bonus_order,
                rules=self.history.rules if self.history else {},
            )
            for region, unknowns in zip(self.regions, pressures, strict=True)
        ]
        return terms + self._outer_terms(kinematics, test)

    def _outer_terms(self, kinematics: Kinematics, test: Any) -> list[Term]:
        """Those of foundations and loads."""
        springs = [support for support in self.supports if isinstance(support, ElasticFoundation)]
        terms = [Term(support.energy(kinematics), self.geometry.boundary(support.on)) for support in springs]
        return terms + [term for load in self.loads for term in self._load_terms(load, kinematics, test)]

    def _make_assembly(self) -> Assembly | EnhancedAssembly:
        terms, n_displacements = self._terms(), 3 * self.displacements.n_scalar
        if self.enhanced is None:
            return Assembly(self.space, terms, self.symbols, n_displacements)
        others, owners = terms[len(self.regions) :], self.cell_materials[self.geometry.cell_of_element]
        return EnhancedAssembly(
            self.displacements, self.enhanced, self.shape, self.regions, owners, others, self.symbols
        )

    def _make_contact(self, contacts: Sequence[Contact]) -> ContactAssembly | None:
        if not contacts:
            return None
        bulk, shear = self.cell_moduli()
        asked, factor = partial(stiffening, self), self.options.contact
        return ContactAssembly(self.displacements, self.shape, contacts, bulk, shear, self.symbols, asked, factor)

    def cell_moduli(self) -> tuple[Array, Array]:
        """Bulk and shear modulus (m,) of each cell at small strain and at the parameters' present values, Pa."""
        moduli = [isotropic_average(region.material.small_strain_stiffness()) for region in self.regions]
        bulk, shear = np.array(moduli)[np.searchsorted(np.unique(self.cell_materials), self.cell_materials)].T
        return bulk, shear

    def _load_terms(self, load: Load, kinematics: Kinematics, test: Any) -> list[Term]:
        if isinstance(load, PointLoad):
            return []  # see `NodalForces`
        u, ratio = kinematics.displacement, kinematics.volume_ratio
        if isinstance(load, BodyForce):
            return [Term(-(ngs.CF(load.force) * u) * ratio, self.geometry.region(load.on))]
        if isinstance(load, Gravity):
            weight = ngs.CF(load.acceleration) * u * ratio
            return [Term(-region.material.density * weight, region.region) for region in self.regions]
        boundary = self.geometry.boundary(load.on)
        if isinstance(load, FollowerPressure):
            work = load.virtual_work(kinematics, test)
            return [Term(work, boundary, load.bonus_order, has_energy=False)]
        if isinstance(load, SurfaceForce):
            # By the quadrature of the load, or a curved surface would have a little more or less than the force.
            order = 2 * self.displacements.order + load.bonus_order
            area = ngs.Integrate(ngs.CF(1.0), self.geometry.ngs, ngs.BND, order=order, definedon=boundary)
            return [Term(load.energy(kinematics, area), boundary, load.bonus_order)]
        return [Term(load.energy(kinematics), boundary, load.bonus_order)]

    def _free_dofs(self) -> NDArray[np.bool_]:
        free = np.ones(self.n_dofs, dtype=bool)
        free[: self.space.ndof] = np.array(self.space.FreeDofs(), dtype=bool)
        free[: 3 * self.displacements.n_scalar] &= ~self.constraints.held
        return free

    @cached_property
    def in_contact(self) -> float:
        """See `newton.in_contact`."""
        return self.contact.stiffening if self.contact else 0.0

    @cached_property
    def solver(self) -> TangentSolver:
        """The linear solver, made when first needed."""
        return self.solver_of(self.free)

    def solver_of(self, free: NDArray[np.bool_], make: SolverMaker | None = None) -> TangentSolver:
        """A linear solver of the ``free`` (n_dofs,) dofs; ``make`` makes another one than `LinearSolver`."""
        make = make or partial(LinearSolver, threads=self.options.threads)
        return make(free & self.assembly.coupled, self.assembly.symmetric, all_free=free)

    def initial_state(self) -> State:
        """The undeformed solid at the parameters' defaults: where every path starts."""
        return State(self.symbols.default, np.zeros(self.n_dofs))

    def state_text(self, mu: Array) -> str:
        """A state (d,) for messages."""
        return self.symbols.text(mu)

    def prescribed(self, mu: Array) -> Array:
        self.symbols.set(mu)
        return self._padded(self.constraints.values())

    def prescribed_slopes(self, mu: Array) -> Array:
        self.symbols.set(mu)
        return self._padded(self.constraints.slopes())

    def residual(self, x: Array, mu: Array) -> Array:
        return self._evaluate(x, mu).copy()

    def motions_besides(self) -> Array:
        """(k, n_unknowns) displacements of the undeformed solid by what moves it beside its supports and loads."""
        return np.zeros((0, self.n_unknowns))

    def own_residual(self, x: Array) -> Array:
        """(n_unknowns,) at ``x`` (n_unknowns,) and the present parameters, without contact."""
        return self.assembly.residual(x) - self._padded(self._nodal_forces.values())

    def own_residual_slopes(self, x: Array) -> Array:
        """(d, n_unknowns) derivatives of `own_residual` by the parameters."""
        return self.assembly.residual_slopes(x) - self._padded(self._nodal_forces.slopes())

    def _evaluate(self, x: Array, mu: Array) -> Array:
        """The residual, kept for the tangent at the same point."""
        self._set(mu)
        residual = self.own_residual(x)
        if self.contact:
            residual += self._padded(self.contact.residual(x[: 3 * self.displacements.n_scalar]))
        self._latest = x.copy(), np.array(mu), residual
        return residual

    def linearise(self, x: Array, mu: Array, solver: TangentSolver | None = None) -> Linearisation:
        """See `newton.Equations`; ``solver``, in place of the solid's own, holds part of the free dofs too."""
        solver = solver or self.solver
        residual = self._known_residual(x, mu)
        return self._linearised(x, mu, residual, solver, residual[solver.free])

    def _known_residual(self, x: Array, mu: Array) -> Array:
        """The residual at ``x``, which Newton's method has mostly just asked for; the parameters are set."""
        known = self._latest
        same = known is not None and np.array_equal(known[0], x) and np.array_equal(known[1], mu)
        residual = known[2] if known is not None and same else self._evaluate(x, mu)
        self._set(mu)
        return residual

    def _linearised(
        self, x: Array, mu: Array, residual: Array, solver: TangentSolver, unbalanced: Array
    ) -> Linearisation:
        """Tangent at ``x``, whose ``residual`` leaves forces (k,) ``unbalanced`` on what is free to move, N."""
        contact = self._contact_tangent(x, unbalanced) if self.contact else None
        return self.assembly.linearise(x, mu, residual, solver, contact)

    def _contact_tangent(self, x: Array, unbalanced: Array) -> sp.csr_matrix:
        assert self.contact is not None
        n = 3 * self.displacements.n_scalar
        # All forces of contact count, not those on free dofs alone: what they press on may be held or coupled.
        balanced = np.linalg.norm(unbalanced) <= BALANCED * np.linalg.norm(self.contact.residual(x[:n]))
        return self.contact.tangent(x[:n], limited=not balanced)

    def residual_slopes(self, x: Array, mu: Array) -> Array:
        self._set(mu)
        slopes = self.own_residual_slopes(x)
        if self.contact:
            slopes += self._padded(self.contact.residual_slopes(x[: 3 * self.displacements.n_scalar]))
        return slopes

    def advance_history(self, x: Array, mu: Array) -> None:
        """Accept a solution: viscous materials remember it. Derivatives are those at a fixed history."""
        if self.history:
            self._set(mu)
            self.history.advance(self.recovery.deformation_gradient(x))
            self._latest = None

    def passage(self, before: State, after: State) -> str | None:
        """See `continuation.refuse_passage`."""
        n = 3 * self.displacements.n_scalar
        return self.contact.passage((before.dofs[:n], before.mu), (after.dofs[:n], after.mu)) if self.contact else None

    def strides(self, begin: Array, end: Array) -> int:
        """See `continuation.advance`."""
        return self.contact.strides(begin, end) if self.contact else 1

    def turn(self, begin: Array, end: Array) -> float:
        """See `newton.turn`."""
        rotations = []
        for mu in (begin, end):
            self.symbols.set(mu)
            rotations.append(self.constraints.rotations())
        return largest_turn(rotations[1] - rotations[0])

    def turn_from(self, x: Array, mu: Array) -> float:
        """See `continuation.loaded_state`: by which supports at rest in ``x`` (n_dofs,) turn up to ``mu`` (d,), rad."""
        self.symbols.set(mu)
        return largest_turn(self.constraints.resting_rotations(x[: 3 * self.displacements.n_scalar]))

    def prescribed_on_the_way(self, x: Array, mu: Array, share: float) -> Array:
        """(n_dofs,) values at prescribed dofs on that share of the way from ``x`` (n_dofs,) to ``mu`` (d,)."""
        self.symbols.set(mu)
        return self._padded(self.constraints.values_on_the_way(x[: 3 * self.displacements.n_scalar], share))

    def turn_directions(self, share: float) -> None:
        """See `continuation.loaded_state`: a solid's supports hold places alone."""

    def _set(self, mu: Array) -> None:
        self.symbols.set(mu)
        if self.history:
            self.history.check_time()

    def _padded(self, displacement_part: Array) -> Array:
        """(..., 3 n_scalar) with zeros for the pressures."""
        result = np.zeros((*displacement_part.shape[:-1], self.n_unknowns))
        result[..., : displacement_part.shape[-1]] = displacement_part
        return result

    @cached_property
    def recovery(self) -> Recovery:
        """Fields at nodes and points, made when first needed."""
        return Recovery(self)

    def nodal_displacement(self, dofs: Array) -> Array:
        """(n_nodes, 3), m; linear in ``dofs`` (n_dofs,), so it maps their derivatives too."""
        parts = dofs[: 3 * self.displacements.n_scalar].reshape(3, -1)
        return self.displacements.node_values @ parts.T

    def sample(self, dofs: Array, mu: Array) -> dict[str, Array]:
        """Displacement (n, 3) m, strain (n, 6), stress (n, 6) Pa and von_mises (n,) Pa at the nodes.

        Green-Lagrange strain and Cauchy stress are in Voigt's order; `recovery` says how they come to nodes.
        """
        return self.recovery.at_nodes(dofs, mu)

    def sample_slopes(self, dofs: Array, mu: Array, dof_slopes: Array) -> dict[str, Array]:
        """Total derivatives (d, n, c) of displacement, strain and stress at the nodes by the parameters.

        ``dof_slopes`` (d, n_dofs) are those of the solution: `newton.sensitivities`. Raises ArgumentError if the solid
        is viscous.
        """
        return self.recovery.slopes_at_nodes(dofs, mu, dof_slopes)

    def response_slopes(self, dofs: Array, mu: Array, responses: Array) -> dict[str, Array]:
        """Derivatives (c, n, k) of the fields of `sample_slopes` by loads that change the dofs by (c, n_dofs)."""
        return self.recovery.slopes_at_nodes(dofs, mu, responses, by_parameters=False)

    def loaded_surface(self, name: str, inward: bool) -> LoadedSurface:
        """The functions on a surface of the mesh, for tractions there along the inward normal or in any direction."""
        space, region = self.displacements, self.geometry.boundary(name)
        return LoadedSurface.of(space, region, self.mesh.surface_nodes(name), self.n_dofs, inward)

    def reactions(self, dofs: Array, mu: Array, name: str, about: Array | None = None) -> tuple[Array, Array]:
        """Force (3,) N and moment (3,) Nm that the supports of a set exert on the solid.

        Parameters
        ----------
        name : node set or surface. A support has the components that it holds itself, and an equal share of those
            that others hold too; of a set that no support names, all that is held of its nodes counts.
        about : point of the moment (3,), m; None for the centroid of the set's undeformed nodes.
        """
        forces, displacement = self._by_component(self.residual(dofs, mu)), self._by_component(dofs)
        return self._support_forces.resultant(name, forces, displacement, about)

    def reaction_slopes(
        self, dofs: Array, mu: Array, dof_slopes: Array, force_slopes: Array, name: str, about: Array
    ) -> tuple[Array, Array]:
        """Derivatives (d, 3) of the force and the moment of `reactions` by the parameters.

        Parameters
        ----------
        dof_slopes : (d, n_dofs) of the solution.
        force_slopes : (d, n_dofs) of the residual along the solution: the tangent times ``dof_slopes``, plus
            `residual_slopes`.
        name : node set or surface.
        about : point of the moment (3,), m.
        """
        forces = self._by_component(self.residual(dofs, mu)), self._by_component(force_slopes)
        displacements = self._by_component(dofs), self._by_component(dof_slopes)
        return self._support_forces.resultant_slopes(name, forces, displacements, about)

    def response_reactions(
        self, dofs: Array, mu: Array, responses: Array, forces: Array, name: str, about: Array
    ) -> tuple[Array, Array]:
        """`reaction_slopes` (c, 3) by loads that change the dofs by (c, n_dofs) and the residual by ``forces``."""
        held = self._by_component(self.residual(dofs, mu)), self._by_component(forces)
        displacements = self._by_component(dofs), self._by_component(responses)
        return self._support_forces.resultant_slopes(name, held, displacements, about, by_parameters=False)

    def _by_component(self, dofs: Array) -> Array:
        """(..., 3, n_scalar) displacement part of (..., n_dofs)."""
        return dofs[..., : 3 * self.displacements.n_scalar].reshape(*dofs.shape[:-1], 3, -1)

    @cached_property
    def _support_forces(self) -> SupportForces:
        return SupportForces(self.constraints, self.displacements, self.shape, self.supports, self.symbols)

    def contact_forces(self, dofs: Array, mu: Array, number: int) -> Array:
        """Forces (3, n_scalar) that a contact exerts on the solid, N, by displacement dof.

        Those of the corners (see `spaces`) add up to the resultant. ``number`` counts the contacts from 0.
        """
        assert self.contact is not None
        self.symbols.set(mu)
        return self.contact.forces(dofs[: 3 * self.displacements.n_scalar], number).reshape(3, -1)

    def strain_energy(self, dofs: Array, mu: Array) -> float:
        """Elastic energy, J."""
        self.symbols.set(mu)
        return self.assembly.energy(dofs, len(self.regions))
