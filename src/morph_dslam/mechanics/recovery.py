"""Fields of a solved solid at its nodes, and their derivatives by the parameters.

Stresses and strains are taken at the quadrature points where they are most accurate (two in each direction: Barlow,
IJNME 10, 1976), extrapolated within each cell and averaged, unweighted, over the cells around the node; elements of
third order, and others on request, give them at the nodes. Where materials meet, stress and strain jump, and an average
would belong to none: the cells of the stiffest one count alone, which mostly bears the largest stress. Displacements
need none of this.
Derivatives are total: by the displacements and pressures, which follow the parameters, and by the parameters where
constants or the undeformed shape contain them.
"""

from __future__ import annotations

from functools import cached_property, partial
from itertools import product
from typing import TYPE_CHECKING, Any

import ngsolve as ngs
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from morph_dslam.errors import ArgumentError
from morph_dslam.mechanics.enhanced_assembly import EnhancedAssembly
from morph_dslam.mechanics.kinematics import Kinematics
from morph_dslam.mechanics.materials.base import VOIGT
from morph_dslam.mechanics.ngsolve_mesh import corner_monomials, reference_points
from morph_dslam.model.cell_types import CellType
from morph_dslam.model.reduced_model import von_mises

if TYPE_CHECKING:
    from morph_dslam.mechanics.parameters import ParameterSymbols
    from morph_dslam.mechanics.solid import SolidProblem

Array = NDArray[np.float64]
#: Components of each field: symmetric tensors in Voigt's order (xx, yy, zz, yz, xz, xy), others row by row.
COMPONENTS = {"deformation_gradient": 9, "strain": 6, "first_piola_kirchhoff": 9, "stress": 6}
STRESSES = ("first_piola_kirchhoff", "stress")
#: Materials whose stiffness differs by a smaller share count as one.
ALIKE = 1e-9
_VOIGT_COLUMNS = [3 * i + j for i, j in VOIGT]


def _overstress(name: str, F: Array, remembered: Array) -> Array:
    """Part (p, 3, 3) of a stress due to a ``remembered`` second Piola-Kirchhoff stress (p, 3, 3), Pa."""
    first = F @ remembered
    if name == "first_piola_kirchhoff":
        return first
    return first @ np.swapaxes(F, 1, 2) / np.linalg.det(F)[:, None, None]


def _components(name: str, tensors: Array) -> Array:
    """Columns (p, c) of a field's 3x3 values."""
    values = tensors.reshape(-1, 9)
    return values[:, _VOIGT_COLUMNS] if COMPONENTS[name] == 6 else values


def _derived(name: str, F: Array, P: Array) -> Array:
    """A field (p, 3, 3) from F and the first Piola-Kirchhoff stress P."""
    if name == "deformation_gradient":
        return F
    if name == "strain":
        return 0.5 * (np.swapaxes(F, 1, 2) @ F - np.eye(3))
    if name == "first_piola_kirchhoff":
        return P
    return P @ np.swapaxes(F, 1, 2) / np.linalg.det(F)[:, None, None]


def _strain_change(F: Array, dF: Array) -> Array:
    """Change (p, 3, 3) of the strain with that of F."""
    product = np.swapaxes(F, 1, 2) @ dF
    return 0.5 * (product + np.swapaxes(product, 1, 2))


def _stress_change(F: Array, P: Array, dF: Array, dP: Array) -> Array:
    """Change (p, 3, 3) of the Cauchy stress with those of F and P."""
    J = np.linalg.det(F)[:, None, None]
    growth = np.trace(np.linalg.solve(F, dF), axis1=1, axis2=2)[:, None, None]
    return (dP @ np.swapaxes(F, 1, 2) + P @ np.swapaxes(dF, 1, 2) - growth * (P @ np.swapaxes(F, 1, 2))) / J


class _RegionLaw:
    """Stress of one material and its derivatives, compiled; those that no run asks for are never made.

    All derivatives by F are by the whole of it, and come last: so they share their sub-expressions. Along a direction,
    or before those by anything else, those of laws in principal stretches would fill the memory.
    """

    def __init__(self, region: Any, F: Any, unknowns: list[Any], symbols: ParameterSymbols) -> None:
        self._F, self._symbols = F.MakeVariable(), symbols
        pressure = region.pressure(unknowns)
        self._pressure = pressure.MakeVariable() if pressure is not None else None
        self._energy = region.elastic_energy(self._F, self._pressure)

    @cached_property
    def stress(self) -> Any:
        """P, 3x3."""
        return self._energy.Diff(self._F).Compile()

    @cached_property
    def tangent(self) -> Any:
        """Derivative of P by F."""
        return self._energy.Diff(self._F).Diff(self._F).Compile()

    @cached_property
    def by_pressure(self) -> Any | None:
        """Derivative of P by the pressure."""
        return None if self._pressure is None else self._energy.Diff(self._pressure).Diff(self._F).Compile()

    @cached_property
    def by_parameters(self) -> dict[int, Any]:
        """Derivatives of P by parameters at a fixed solution, by their index."""
        return {i: slope.Diff(self._F).Compile() for i, slope in self._symbols.derivatives(self._energy).items()}


class _Compatible:
    """Deformation gradient and pressures of a solution, and their changes with its derivatives by a parameter.

    Attributes
    ----------
    F : 3x3.
    pressures : unknowns of each material region.
    change : of F (3x3) with the solution alone.
    pressure_changes : of ``pressures``.
    explicit : derivatives (3x3) of F by parameters at a fixed solution, by their index.
    """

    def __init__(self, problem: SolidProblem) -> None:
        self._state, self._direction = ngs.GridFunction(problem.space), ngs.GridFunction(problem.space)
        mixed = any(region.pressures for region in problem.regions)
        state, self.pressures = problem.split(self._state.components if mixed else self._state)
        direction, self.pressure_changes = problem.split(self._direction.components if mixed else self._direction)
        self.F = Kinematics(state, problem.shape).deformation_gradient
        self.change = Kinematics(direction, problem.shape).displacement_gradient
        self.explicit = problem.symbols.derivatives(self.F)

    def set(self, dofs: Array) -> None:
        """Take a solution (n,)."""
        self._state.vec.FV().NumPy()[:] = dofs

    def set_change(self, dofs: Array, slope: Array, index: int | None) -> None:
        """Take the derivative ``slope`` (n,) of the solution ``dofs`` by parameter ``index``, None for a load's."""
        self._direction.vec.FV().NumPy()[:] = slope


class _Enhanced:
    """`_Compatible`, for cells with enhanced strains: through the quadrature points' F; ``change`` is the total one."""

    def __init__(self, problem: SolidProblem, assembly: EnhancedAssembly) -> None:
        self._assembly = assembly
        self._gradient, self._change = assembly.quadrature_field(), assembly.quadrature_field()
        self.F, self.change = self._gradient.function, self._change.function
        self.pressures = self.pressure_changes = [[] for _ in problem.regions]
        self.explicit: dict[int, Any] = {}

    def set(self, dofs: Array) -> None:
        self._gradient.set(self._assembly.deformation_gradients(dofs))

    def set_change(self, dofs: Array, slope: Array, index: int | None) -> None:
        self._change.set(self._assembly.deformation_gradient_slopes(dofs, slope, index))


class Recovery:
    """Evaluates the fields of one problem; its expressions are made once."""

    def __init__(self, problem: SolidProblem) -> None:
        self._problem, assembly = problem, problem.assembly
        enhanced = isinstance(assembly, EnhancedAssembly)
        self._solution = _Enhanced(problem, assembly) if enhanced else _Compatible(problem)
        self._laws = [
            _RegionLaw(region, self._solution.F, unknowns, problem.symbols)
            for region, unknowns in zip(problem.regions, self._solution.pressures, strict=True)
        ]
        changes = zip(problem.regions, self._solution.pressure_changes, strict=True)
        self._pressure_changes = [region.pressure(unknowns) for region, unknowns in changes]
        self._at_nodes: tuple[NDArray, sp.csr_matrix] | None = None

    def at_nodes(self, dofs: Array, mu: Array, names: tuple[str, ...] = ("strain", "stress")) -> dict[str, Array]:
        """Fields by name at the nodes: "displacement" (n, 3) m, and ``names`` of `COMPONENTS` (n, c), SI.

        "von_mises" (n,) comes with "stress".
        """
        points, average = self._node_rule()
        result = {"displacement": self._problem.nodal_displacement(dofs)}
        self._set(dofs, mu)
        F, P = self._gradient_and_stress(points)
        for name in names:
            values, history = _derived(name, F, P), self._problem.history
            if history and name in STRESSES:
                values = values + _overstress(name, F, history.remembered_at(points))
            result[name] = average @ _components(name, values)
        if "stress" in names:
            result["von_mises"] = von_mises(result["stress"])
        return result

    def slopes_at_nodes(
        self, dofs: Array, mu: Array, dof_slopes: Array, by_parameters: bool = True
    ) -> dict[str, Array]:
        """Total derivatives (d, n, c) of displacement, strain and stress, by the parameters or by loads beside them.

        Parameters
        ----------
        dof_slopes : (d, n_dofs) derivatives of the solution, `newton.sensitivities`.
        by_parameters : whether they are those by the parameters, on which constants and shape may depend too.

        Raises
        ------
        ArgumentError
            If the solid is viscous: its stress depends on how it came there too.
        """
        if self._problem.history:
            raise ArgumentError("a viscous solid has no derivatives of its fields: they depend on its history")
        points, average = self._node_rule()
        result = {"displacement": np.array([self._problem.nodal_displacement(s) for s in dof_slopes])}
        self._set(dofs, mu)
        F, P = self._gradient_and_stress(points)
        tangent = self._by_region([law.tangent for law in self._laws], points, (9, 9))
        strains, stresses = [], []
        for number, slope in enumerate(dof_slopes):
            index = number if by_parameters else None
            self._solution.set_change(dofs, slope, index)
            dF = self._by_region([self._solution.change] * len(self._laws), points)
            dP = (tangent @ dF.reshape(-1, 9, 1)).reshape(-1, 3, 3) + self._stress_changes(index, points)
            explicit = None if index is None else self._solution.explicit.get(index)
            if explicit is not None:
                dF = dF + self._by_region([explicit] * len(self._laws), points)
            strains.append(average @ _components("strain", _strain_change(F, dF)))
            stresses.append(average @ _components("stress", _stress_change(F, P, dF, dP)))
        return result | {"strain": np.array(strains), "stress": np.array(stresses)}

    def _set(self, dofs: Array, mu: Array) -> None:
        self._problem.symbols.set(mu)
        self._solution.set(dofs)

    def deformation_gradient(self, dofs: Array) -> Any:
        """F (3x3) of a solution at the present parameters as a coefficient function, until the next call."""
        self._solution.set(dofs)
        return self._solution.F

    def _gradient_and_stress(self, points: NDArray) -> tuple[Array, Array]:
        """F and P (p, 3, 3) of the solution that is set."""
        F = self._by_region([self._solution.F] * len(self._laws), points)
        return F, self._by_region([law.stress for law in self._laws], points)

    def _stress_changes(self, index: int | None, points: NDArray) -> Array:
        """Change (p, 3, 3) of P with pressures in the direction that is set, and with a parameter itself."""
        zero, result = ngs.CF((0.0,) * 9, dims=(3, 3)), np.zeros((len(points), 3, 3))
        if any(law.by_pressure is not None for law in self._laws):
            pairs = zip(self._laws, self._pressure_changes, strict=True)
            result += self._by_region(
                [zero if law.by_pressure is None else law.by_pressure * change for law, change in pairs], points
            )
        if index is not None and any(index in law.by_parameters for law in self._laws):
            result += self._by_region([law.by_parameters.get(index, zero) for law in self._laws], points)
        return result

    def _by_region(self, expressions: list[Any], points: NDArray, shape: tuple[int, int] = (3, 3)) -> Array:
        """Values (p, *shape) of one expression for each region at mesh points."""
        owners = self._problem.cell_materials[self._problem.geometry.cell_of_element[points["nr"]]]
        values = np.zeros((len(points), shape[0] * shape[1]))
        for number, expression in zip(np.unique(self._problem.cell_materials), expressions, strict=True):
            rows = np.flatnonzero(owners == number)
            values[rows] = np.asarray(expression.Compile()(points[rows])).reshape(len(rows), -1)
        return values.reshape(-1, *shape)

    def _node_rule(self) -> tuple[NDArray, sp.csr_matrix]:
        """Mesh points (q,) in all cells, and the matrix (n_nodes, q) that takes values there to nodes."""
        if self._at_nodes is None:
            geometry = self._problem.geometry
            order = 3 if self._problem.options.at_nodes else self._problem.displacements.order
            mesh, parts, count = geometry.mesh, [], 0
            rows, columns, data = [], [], []
            counted = self._counted_cells()
            for block, start, counts in zip(mesh.blocks, mesh.block_starts()[:-1], counted, strict=True):
                reference, weights = _extrapolation(block.type, order)
                m, q = len(block.connectivity), len(reference)
                elements = np.repeat(geometry.element_of_cell[start : start + m], q)
                points = np.tile(reference_points(block.type.shape, reference), (m, 1))
                parts.append(geometry.mesh_points(elements, points))
                numbers = count + np.arange(m * q).reshape(m, 1, q)
                rows.append(np.broadcast_to(block.connectivity[:, :, None], (m, *weights.shape)).ravel())
                columns.append(np.broadcast_to(numbers, (m, *weights.shape)).ravel())
                data.append((counts[:, :, None] * weights).ravel())
                count += m * q
            cells_around = np.bincount(
                np.concatenate([b.connectivity.ravel() for b in mesh.blocks]),
                np.concatenate([counts.ravel() for counts in counted]),
                mesh.n_nodes,
            )
            i = np.concatenate(rows)
            matrix = sp.csr_matrix(
                (np.concatenate(data) / cells_around[i], (i, np.concatenate(columns))), shape=(mesh.n_nodes, count)
            )
            self._at_nodes = np.concatenate(parts), matrix
        return self._at_nodes

    def _counted_cells(self) -> list[Array]:
        """Of each block of cells, 1 for the nodes (m, k) around which no other cell is stiffer, and 0 for others.

        Stiffness is the shear modulus at small strain and at the parameters' defaults, so that it is the same in all
        solutions.
        """
        problem, mesh = self._problem, self._problem.geometry.mesh
        corners = [block.connectivity for block in mesh.blocks]
        if len(problem.regions) == 1:
            return [np.ones(nodes.shape) for nodes in corners]
        problem.symbols.set(problem.symbols.default)
        _, shear = problem.cell_moduli()
        stiffest = np.zeros(mesh.n_nodes)
        own = [part[:, None] for part in np.split(shear, mesh.block_starts()[1:-1])]
        for nodes, stiffness in zip(corners, own, strict=True):
            np.maximum.at(stiffest, nodes, np.broadcast_to(stiffness, nodes.shape))
        return [
            (stiffness >= (1.0 - ALIKE) * stiffest[nodes]).astype(np.float64)
            for nodes, stiffness in zip(corners, own, strict=True)
        ]


def _extrapolation(kind: CellType, order: int) -> tuple[Array, Array]:
    """Points (q, 3) of the reference cell, and the weights (k, q) that extrapolate from them to its nodes."""
    if order == 3:
        return kind.nodes, np.eye(len(kind.nodes))
    gauss = (1.0 + np.array([-1.0, 1.0]) / np.sqrt(3.0)) / 2.0
    if kind.shape == "hex":
        points = np.array(list(product(gauss, repeat=3)))
    elif order == 1:
        points = kind.nodes[: kind.corners].mean(axis=0)[None]
    elif kind.shape == "tet":
        a, b = (5.0 - np.sqrt(5.0)) / 20.0, (5.0 + 3.0 * np.sqrt(5.0)) / 20.0
        points = np.array([[b if i == j else a for j in range(3)] for i in range(4)])
    else:
        triangle = np.array([[1.0, 1.0], [4.0, 1.0], [1.0, 4.0]]) / 6.0
        points = np.array([[*xy, z] for xy, z in product(triangle, gauss)])
    monomials = partial(corner_monomials, len(points))
    return points, monomials(kind.nodes) @ np.linalg.inv(monomials(points))
