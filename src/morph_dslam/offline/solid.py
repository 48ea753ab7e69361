"""Equilibrium of hyperelastic solids: total Lagrangian finite elements on NGSolve.

A solid is its energy. With the kinematics of `kinematics`, the residual is the derivative of

    int W(F) dV + foundations - dead loads

plus the virtual work of loads without energy, and the tangent is the derivative of the residual, both taken
by NGSolve; derivatives by parameters are taken of the same integrands. `SolidProblem` implements the
`Equations` of `newton` and leaves solution paths to it.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.offline.constraints import Constraints
from morph_dslam.offline.displacement_space import DisplacementSpace
from morph_dslam.offline.kinematics import Kinematics, Shape, ShapeField
from morph_dslam.offline.linear_solver import LinearSolver
from morph_dslam.offline.loads import BodyForce, DeadSurfaceLoad, FollowerPressure, Gravity, PointLoad
from morph_dslam.offline.materials.base import Material, evaluate
from morph_dslam.offline.meshes import Mesh
from morph_dslam.offline.newton import Linearisation, State
from morph_dslam.offline.ngsolve_mesh import NgsolveMesh
from morph_dslam.offline.parameters import ParameterSymbols
from morph_dslam.offline.pressure_space import PressureSpace, check_mixed
from morph_dslam.offline.solid_assembly import Assembly, Term
from morph_dslam.offline.supports import ElasticFoundation, PrescribedMotion

Array = NDArray[np.float64]

#: Poisson's ratio from which plain displacement elements lock noticeably.
NEARLY_INCOMPRESSIBLE = 0.49

Support = PrescribedMotion | ElasticFoundation
Load = DeadSurfaceLoad | FollowerPressure | BodyForce | Gravity | PointLoad


@dataclass(frozen=True)
class SolidOptions:
    """How a solid is discretised.

    Attributes
    ----------
    order : of the displacements, 1 or 2; None for that of the cells. Order 2 on first-order cells adds
        functions on their edges, faces and inside.
    mixed : give every material with a volumetric part pressures of its own, against locking near
        incompressibility; see `pressure_space`. hex20 and prism15 then use all functions of second order.
    threads : of PARDISO; None leaves MKL's choice.
    """

    order: int | None = None
    mixed: bool = False
    threads: int | None = None


class NearlyIncompressibleWarning(UserWarning):
    """A nearly incompressible material in elements that lock."""


@dataclass(frozen=True)
class _MaterialRegion:
    """A material, where it is, and its pressure (None in the displacement form)."""

    material: Material
    region: ngs.Region
    pressures: PressureSpace | None
    pressure_unit: float

    def energy(self, F: Any, pressure_unknowns: list[Any]) -> Any:
        """Strain energy density, Pa; in the mixed form, the density whose stationary value it is."""
        if self.pressures is None:
            return self.material.energy(F)
        p = self.pressure_unit * self.pressures.combine(pressure_unknowns)
        modulus = self.material.volumetric_modulus
        return self.material.remainder(F) + p * self.material.volumetric(F) - p * p / (2.0 * modulus)


class SolidProblem:
    """A solid with its materials, supports, loads and parameters.

    Parameters
    ----------
    mesh : in metres.
    materials : by cell set; "all" takes the cells that no other set names.
    supports : see `supports`.
    loads : see `loads`.
    parameters : the symbols that materials, supports, loads and shapes were written with.
    options : see `SolidOptions`.
    shape : how the undeformed shape depends on parameters.

    Attributes
    ----------
    n_dofs, free, scale : see `newton.Equations`. The first 3 n_scalar dofs are displacements, those of x
        first; pressures follow.
    flags : what a result obtained with this discretisation must be doubted for; empty if nothing.

    Raises
    ------
    StudyError
        For unknown sets, cells with no material or with two, unstable materials, missing supports.
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
    ) -> None:
        options = options or SolidOptions()
        self.mesh, self.supports, self.loads, self.options = mesh, tuple(supports), tuple(loads), options
        self.symbols = parameters or ParameterSymbols()
        self.geometry = NgsolveMesh(mesh)
        self.displacements = DisplacementSpace(self.geometry, options.order, full=options.mixed)
        self.shape = Shape(self.displacements, shape)
        self.length = float(np.linalg.norm(np.ptp(mesh.nodes, axis=0)))
        self.flags: tuple[str, ...] = ()
        self.regions = self._place_materials(materials)
        self.space = self._product_space()
        self.n_dofs: int = self.space.ndof
        self.constraints = Constraints(self.displacements, self.shape, self.supports, self.symbols)
        self.constraints.check_rigid_motions()
        self.assembly = Assembly(self.space, self._terms(), self.symbols)
        self.free: NDArray[np.bool_] = self._free_dofs()
        self.scale: Array = np.full(self.n_dofs, np.inf)
        self.scale[: 3 * self.displacements.n_scalar] = self.length
        self._point_loads = [load for load in loads if isinstance(load, PointLoad)]

    # -- set-up ---------------------------------------------------------------------------------------

    def _place_materials(self, materials: Mapping[str, Material]) -> list[_MaterialRegion]:
        owners = np.full(self.mesh.n_cells, -1)
        names = sorted(materials, key=lambda name: name == "all")
        for number, name in enumerate(names):
            cells = self.mesh.cells(name)
            taken = cells[owners[cells] >= 0]
            if name == "all":
                cells = cells[owners[cells] < 0]
            elif len(taken):
                other = names[owners[taken[0]]]
                raise StudyError(
                    f"{len(taken)} cells are in both '{other}' and '{name}', each with a material"
                )
            owners[cells] = number
        if (owners < 0).any():
            raise StudyError(
                f"{int((owners < 0).sum())} of {len(owners)} cells have no material; "
                "give one to their cell set, or one to 'all'"
            )
        self.cell_materials = owners
        regions = self.geometry.partition(owners)
        return [
            self._material_region(name, materials[name], regions[number])
            for number, name in enumerate(names)
            if number in regions
        ]

    def _material_region(self, name: str, material: Material, region: ngs.Region) -> _MaterialRegion:
        try:
            material.check()
        except StudyError as error:
            raise StudyError(f"material of '{name}': {error}") from error
        poisson = material.equivalent_poisson
        mixed = self.options.mixed and material.volumetric_modulus is not None
        if not mixed and poisson >= NEARLY_INCOMPRESSIBLE:
            flag = (
                f"the material of '{name}' is nearly incompressible (Poisson's ratio {poisson:.4f}) "
                "in displacement elements, which lock; use mixed elements"
            )
            self.flags += (flag,)
            warnings.warn(flag, NearlyIncompressibleWarning, stacklevel=4)
        if not mixed:
            return _MaterialRegion(material, region, None, 0.0)
        check_mixed(self.mesh, self.displacements.order)
        # Pressures are counted in units that make them about as large as displacements in metres.
        stiffness = material.small_strain_stiffness()[3, 3]
        return _MaterialRegion(
            material, region, PressureSpace(self.displacements, region), stiffness / self.length
        )

    def _product_space(self) -> ngs.FESpace:
        spaces = [self.displacements.vector]
        for region in self.regions:
            spaces += region.pressures.spaces if region.pressures else []
        return spaces[0] if len(spaces) == 1 else ngs.ProductSpace(*spaces)

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
            Term(region.energy(F, unknowns) * ratio, region.region)
            for region, unknowns in zip(self.regions, pressures, strict=True)
        ]
        for support in self.supports:
            if isinstance(support, ElasticFoundation):
                u = kinematics.displacement
                u = u * kinematics.unit_normal if support.normal_only else u
                energy = 0.5 * support.stiffness * (u * u) * kinematics.area_ratio
                terms.append(Term(energy, self.geometry.boundary(support.on)))
        for load in self.loads:
            terms += self._load_terms(load, kinematics, test)
        return terms

    def _load_terms(self, load: Load, kinematics: Kinematics, test: Any) -> list[Term]:
        if isinstance(load, PointLoad):
            self.mesh.set_nodes(load.on)
            return []
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
        return [Term(load.energy(kinematics), boundary, load.bonus_order)]

    def _free_dofs(self) -> NDArray[np.bool_]:
        free = np.array(self.space.FreeDofs(), dtype=bool)
        free[: 3 * self.displacements.n_scalar] &= ~self.constraints.held
        return free

    @cached_property
    def solver(self) -> LinearSolver:
        """The linear solver, made when first needed."""
        return LinearSolver(
            self.free & self.assembly.coupled, self.assembly.symmetric, threads=self.options.threads
        )

    # -- the equations ----------------------------------------------------------------------------------

    def initial_state(self) -> State:
        """The undeformed solid at the parameters' defaults: where every path starts."""
        return State(self.symbols.default, np.zeros(self.n_dofs))

    def prescribed(self, mu: Array) -> Array:
        self.symbols.set(mu)
        return self._padded(self.constraints.values())

    def prescribed_slopes(self, mu: Array) -> Array:
        self.symbols.set(mu)
        return self._padded(self.constraints.slopes())

    def residual(self, x: Array, mu: Array) -> Array:
        self.symbols.set(mu)
        return self.assembly.residual(x) - self._padded(self._nodal_forces())

    def linearise(self, x: Array, mu: Array) -> Linearisation:
        self.symbols.set(mu)
        return self.assembly.linearise(x, mu, self._padded(self._nodal_forces()), self.solver)

    def residual_slopes(self, x: Array, mu: Array) -> Array:
        self.symbols.set(mu)
        return self.assembly.residual_slopes(x) - self._padded(self._nodal_force_slopes())

    def _padded(self, displacement_part: Array) -> Array:
        """(..., 3 n_scalar) with zeros for the pressures."""
        result = np.zeros((*displacement_part.shape[:-1], self.n_dofs))
        result[..., : displacement_part.shape[-1]] = displacement_part
        return result

    def _nodal_forces(self) -> Array:
        forces = np.zeros((3, self.displacements.n_scalar))
        for load in self._point_loads:
            forces += np.outer([evaluate(f) for f in load.force], self._share(load))
        return forces.ravel()

    def _nodal_force_slopes(self) -> Array:
        slopes = np.zeros((len(self.symbols), 3, self.displacements.n_scalar))
        for load in self._point_loads:
            by_parameter = np.column_stack([self.symbols.slopes(f) for f in load.force])
            slopes += by_parameter[:, :, None] * self._share(load)
        return slopes.reshape(len(self.symbols), -1)

    def _share(self, load: PointLoad) -> Array:
        """(n_scalar,) work that a unit force, shared by the load's nodes, does on each scalar dof."""
        nodes = self.mesh.set_nodes(load.on)
        return np.asarray(self.displacements.node_values[nodes].sum(axis=0)).ravel() / len(nodes)
