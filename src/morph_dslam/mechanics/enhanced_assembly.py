"""Residual, tangent and their derivatives of solids of enhanced hexahedra.

NGSolve evaluates the energies' derivatives by F at all quadrature points at once; compiled loops over the cells make
the matrices and eliminate the added unknowns, many times faster than NGSolve's forms of two unknown functions. Loads
and foundations stay with NGSolve.

Newton's method crawls where the volume hardly changes, for a step's stresses are K times the error of its volume. So
for laws with a volumetric part (see `materials.base`) the volumetric strain e is an unknown of each quadrature point:

    W = remainder(F) + K (e g(F) - e^2 / 2),   g(F) = e

The solution is the same, with a third fewer iterations for Poisson's ratio 0.45 and a fifteenth of them for 0.4999
(Pfefferkorn, Bieber, Oesterle, Bischoff and Betsch, IJNME 122, 2021, treat all stresses so). The second equation is
weighted with the shear modulus, which K, zero even, has no part in. These unknowns are eliminated point by point.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import ngsolve as ngs
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.contact_assembly import added
from morph_dslam.mechanics.enhanced_strain import (
    ADDED,
    NODAL,
    CellGeometry,
    CellState,
    EnhancedStrain,
    QuadratureField,
    add_to_csr,
    condensed_matrices,
)
from morph_dslam.mechanics.kinematics import Shape
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.solid_assembly import Assembly, Term, threads
from morph_dslam.mechanics.solid_materials import MaterialRegion, can_be_mixed
from morph_dslam.mechanics.solvers.cellwise import CellwiseLinearisation, PointwiseLinearisation
from morph_dslam.mechanics.solvers.linear_solver import AssembledLinearisation, TangentSolver
from morph_dslam.mechanics.solvers.newton import Linearisation
from morph_dslam.mechanics.spaces import DisplacementSpace

Array = NDArray[np.float64]
#: Cells whose second derivatives are kept at a time.
PORTION = 2048


@dataclass(frozen=True)
class _Law:
    """One material's energy density (Pa), its derivatives by F, and theirs by parameters, compiled.

    Attributes
    ----------
    cells : that it fills, in NGSolve's order.
    points : (8 k,) NGSolve's quadrature points there.
    energy : W.
    stress : dW/dF.
    moduli : d2W/dF2.
    shear : modulus that weights ``misfit``.
    bulk : K; None without the unknown e, as are the others.
    misfit : g - e times ``shear``.
    volume : dg/dF times ``shear``.
    formulas : F, ``energy`` and ``misfit`` before they were compiled.
    """

    cells: NDArray[np.int64]
    points: NDArray
    energy: Any
    stress: Any
    moduli: Any
    formulas: tuple[Any, Any, Any]
    shear: float = 1.0
    bulk: Any | None = None
    misfit: Any | None = None
    volume: Any | None = None

    def at(self, name: str, points: NDArray, *shape: int) -> Array:
        """One of the expressions at ``points`` of whole cells (k, 8, *shape)."""
        return np.asarray(getattr(self, name)(points)).reshape(-1, 8, *shape)

    def portions(self) -> Iterator[tuple[NDArray[np.int64], NDArray]]:
        """Cells and their points, so few at a time that second derivatives there need little memory."""
        for start in range(0, len(self.cells), PORTION):
            yield self.cells[start : start + PORTION], self.points[8 * start : 8 * (start + PORTION)]


class EnhancedAssembly:
    """What `solid_assembly.Assembly` is, for cells with enhanced strains.

    Parameters
    ----------
    displacements : their space.
    enhanced : the cells.
    shape : how the undeformed shape depends on parameters.
    regions : the materials.
    owners : (m,) number of each cell's region, in NGSolve's order.
    terms : all other integrals; those over the volume are dead loads.

    Attributes
    ----------
    symmetric : whether all terms have an energy.
    coupled : (n,) dofs that are not condensed.
    """

    def __init__(
        self,
        displacements: DisplacementSpace,
        enhanced: EnhancedStrain,
        shape: Shape,
        regions: Sequence[MaterialRegion],
        owners: NDArray[np.int64],
        terms: Sequence[Term],
        symbols: ParameterSymbols,
    ) -> None:
        self._enhanced, self._shape, self._symbols = enhanced, shape, symbols
        self._n_displacements = 3 * displacements.n_scalar
        self.coupled = np.arange(enhanced.n_dofs) < self._n_displacements
        space, size = displacements.vector, self._n_displacements
        self._others = Assembly(space, terms, symbols, size) if terms else None
        stiff = [term for term in terms if term.region.VB() != ngs.VOL]
        self._stiff = Assembly(space, stiff, symbols, size) if stiff else None
        self.symmetric = self._others is None or self._others.symmetric
        self._F = ngs.GridFunction(ngs.MatrixValued(enhanced.points, dim=3))
        self._e = ngs.GridFunction(enhanced.points)
        mesh, rules = displacements.geometry.ngs, enhanced.points.GetIntegrationRules()
        points = mesh.MapToAllElements(rules, ngs.VOL).reshape(len(enhanced.nodes), -1)
        self._laws = []
        for number, region in zip(np.unique(owners), regions, strict=True):
            cells = np.flatnonzero(owners == number)
            self._laws.append(self._law(region, cells, points[cells].ravel()))
        shear = np.concatenate([np.full(len(law.cells), law.shear) for law in self._laws])
        order = np.argsort(np.concatenate([law.cells for law in self._laws]))
        self._shear: Array = shear[order][enhanced.split][:, None]
        self._geometry: tuple[Array, CellGeometry] | None = None
        self._other_entries: tuple[Any, ...] | None = None

    def _law(self, region: MaterialRegion, cells: NDArray[np.int64], points: NDArray) -> _Law:
        F = ngs.CF(self._F).MakeVariable()
        e, split = ngs.CF(self._e), can_be_mixed(region.material)
        energy, g = region.energy_and_strain(F, e) if split else (region.energy(F, None), None)
        stress = energy.Diff(F)
        compiled = energy.Compile(), stress.Compile(), stress.Diff(F).Compile()
        if g is None:
            return _Law(cells, points, *compiled, (F, energy, None))
        shear = float(region.material.small_strain_stiffness()[3, 3])
        misfit = shear * (g - e)
        return _Law(
            cells,
            points,
            *compiled,
            (F, energy, misfit),
            shear=shear,
            bulk=ngs.CF(region.material.volumetric_modulus).Compile(),
            misfit=misfit.Compile(),
            volume=misfit.Diff(F).Compile(),
        )

    @cached_property
    def _slopes(self) -> list[dict[str, dict[int, Any]]]:
        """Derivatives of each law's stress and misfit by the parameters, by their index."""
        result = []
        for law in self._laws:
            F, energy, misfit = law.formulas
            # By the parameter first: differentiated the other way round, some laws would fill the memory.
            stress = {i: slope.Diff(F).Compile() for i, slope in self._symbols.derivatives(energy).items()}
            explicit = {} if misfit is None else self._symbols.derivatives(misfit)
            result.append({"stress": stress, "misfit": {i: slope.Compile() for i, slope in explicit.items()}})
        return result

    def _cells(self) -> CellGeometry:
        """The undeformed cells at the present parameters; without a shape parameter they are kept."""
        coordinates = self._shape.coordinates(self._symbols)
        if self._geometry is None or not np.array_equal(self._geometry[0], coordinates):
            self._geometry = coordinates, self._enhanced.geometry(coordinates)
        return self._geometry[1]

    def _deformed(self, x: Array) -> CellState:
        """The cells at ``x``, which `_evaluate` takes up."""
        state = self._enhanced.deformed(self._cells(), self._enhanced.unknowns(x))
        self._F.vec.FV().NumPy()[:] = state.F.reshape(-1, 9).T.ravel()
        strains = self._e.vec.FV().NumPy().reshape(-1, 8)
        strains[self._enhanced.split] = x[self._enhanced.strain_dofs]
        return state

    def _evaluate(self, name: str, *shape: int) -> Array:
        """One of the laws' expressions at all quadrature points (m, 8, *shape); zero where a law has none."""
        values = np.zeros((len(self._enhanced.nodes), 8, *shape))
        with threads(self._n_displacements):
            for law in self._laws:
                if getattr(law, name) is not None:
                    values[law.cells] = law.at(name, law.points, *shape)
        return values

    def _slopes_by(self, index: int, name: str, *shape: int) -> Array:
        """Derivatives of one of the laws' expressions by a parameter (m, 8, *shape)."""
        values = np.zeros((len(self._enhanced.nodes), 8, *shape))
        for law, slopes in zip(self._laws, self._slopes, strict=True):
            if index in slopes[name]:
                values[law.cells] = np.asarray(slopes[name][index](law.points)).reshape(-1, 8, *shape)
        return values

    def _assembled(self, state: CellState, stress: Array, misfit: Array) -> Array:
        """(n,) from ``stress`` (m, 8, 3, 3) and ``misfit`` (m, 8), both times volume."""
        result = self._enhanced.assembled(state.forces(stress))
        result[self._enhanced.strain_dofs] = misfit[self._enhanced.split]
        return result

    def quadrature_field(self) -> QuadratureField:
        """A tensor field to be set to values at the quadrature points."""
        return QuadratureField(self._enhanced)

    def deformation_gradients(self, x: Array) -> Array:
        """F (m, 8, 3, 3) at the quadrature points, at ``x`` (n,) and the present parameters."""
        return self._enhanced.deformed(self._cells(), self._enhanced.unknowns(x)).F

    def deformation_gradient_slopes(self, x: Array, slope: Array, index: int | None) -> Array:
        """Total derivative (m, 8, 3, 3) of F by parameter ``index``, by which ``x`` changes by ``slope`` (n,).

        ``index`` is None where ``x`` changes for another reason.
        """
        unknowns, cells = self._enhanced.unknowns(x), self._cells()
        result = self._enhanced.deformed(cells, unknowns).change(self._enhanced.unknowns(slope))
        if index is None:
            return result
        velocity = self._shape.coordinate_slopes(self._symbols)[index]
        if velocity.any():
            moved = self._enhanced.geometry_slopes(cells, velocity)
            result += self._enhanced.state_slopes(cells, moved, unknowns).F
        return result

    def residual(self, x: Array) -> Array:
        """(n,) at ``x`` (n,) and the present parameters, without nodal forces."""
        state, volumes = self._deformed(x), self._cells().volumes
        stress = self._evaluate("stress", 3, 3) * volumes[:, :, None, None]
        result = self._assembled(state, stress, self._evaluate("misfit") * volumes)
        if self._others:
            result[: self._n_displacements] += self._others.residual(x[: self._n_displacements])
        return result

    def energy(self, x: Array, n_terms: int) -> float:
        """Energy of the materials at ``x`` and the present parameters, J."""
        self._deformed(x)
        return float(np.sum(self._evaluate("energy") * self._cells().volumes))

    def residual_slopes(self, x: Array) -> Array:
        """(d, n) derivatives by the parameters at fixed ``x``."""
        state, volumes = self._deformed(x), self._cells().volumes
        result = np.zeros((len(self._symbols), len(x)))
        for index in sorted({i for law in self._slopes for part in law.values() for i in part}):
            stress = self._slopes_by(index, "stress", 3, 3) * volumes[:, :, None, None]
            result[index] = self._assembled(state, stress, self._slopes_by(index, "misfit") * volumes)
        if self._shape.functions:
            result += self._shape_slopes(x, state)
        if self._others:
            n = self._n_displacements
            result[:, :n] += self._others.residual_slopes(x[:n])
        return result

    def _shape_slopes(self, x: Array, state: CellState) -> Array:
        """(d, n) derivatives of the materials' forces by the parameters, through the undeformed shape alone."""
        cells, unknowns = self._cells(), self._enhanced.unknowns(x)
        stress, moduli = self._evaluate("stress", 3, 3), self._evaluate("moduli", 9, 9)
        misfit, volume_slope = self._evaluate("misfit"), self._evaluate("volume", 3, 3)
        volumes = cells.volumes[:, :, None, None]
        result = np.zeros((len(self._symbols), len(x)))
        for index, velocity in enumerate(self._shape.coordinate_slopes(self._symbols)):
            if not velocity.any():
                continue
            moved = self._enhanced.geometry_slopes(cells, velocity)
            changes = self._enhanced.state_slopes(cells, moved, unknowns)
            stress_change = (moduli @ changes.F.reshape(*cells.volumes.shape, 9, 1)).reshape(stress.shape)
            stress_change += moved.volumes[:, :, None, None] * stress
            misfit_change = np.einsum("mqij,mqij->mq", volume_slope, changes.F) + moved.volumes * misfit
            result[index] = self._assembled(state, stress_change * volumes, misfit_change * cells.volumes)
            result[index] += self._enhanced.assembled(changes.forces(stress * volumes))
        return result

    @cached_property
    def _pattern(self) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Columns and row pointers of K, and where the cells' entries go in it: see `add_to_csr`."""
        nodes, n = self._enhanced.nodes, self._n_displacements // 3
        pairs = nodes[:, :, None] * n + nodes[:, None, :]
        entries, positions = np.unique(pairs, return_inverse=True)
        rows, columns = np.divmod(entries, n)
        block = sp.csr_matrix((np.ones(len(entries)), (rows, columns)), shape=(n, n))
        whole = sp.csr_matrix(sp.kron(np.ones((3, 3)), block, format="csr"))
        whole.sort_indices()
        pointers = np.concatenate(
            [whole.indptr, np.full(self._enhanced.n_dofs - self._n_displacements, whole.nnz)]
        ).astype(np.int32)
        lengths = np.diff(block.indptr)
        starts = np.stack([block.indptr[:-1][nodes], lengths[nodes]], axis=2).astype(np.int64)
        return whole.indices.astype(np.int32), pointers, positions.reshape(pairs.shape), starts

    def _add_others(self, x: Array, data: Array) -> None:
        """Add the tangent of loads and foundations to K's ``data``."""
        if self._stiff is None:
            return
        matrix = self._stiff.tangent(x[: self._n_displacements])
        if self._other_entries is None:
            indices, pointers, *_ = self._pattern
            n = self._n_displacements
            numbers = sp.csr_matrix((np.arange(1, len(indices) + 1), indices, pointers[: n + 1]), shape=(n, n))
            rows = np.repeat(np.arange(n), np.diff(matrix.indptr))
            columns = matrix.indices
            one_sided = self.symmetric and not (np.any(columns > rows) and np.any(columns < rows))
            mirrored = np.flatnonzero(columns != rows) if one_sided else np.zeros(0, dtype=np.int64)
            source = np.concatenate([np.arange(len(rows)), mirrored])
            i, j = np.concatenate([rows, columns[mirrored]]), np.concatenate([columns, rows[mirrored]])
            place = np.asarray(numbers[i, j]).ravel() - 1
            self._other_entries = place[place >= 0], source[place >= 0]
        place, source = self._other_entries
        np.add.at(data, place, matrix.data[source])

    def linearise(
        self, x: Array, mu: Array, residual: Array, solver: TangentSolver, contact: sp.csr_matrix | None = None
    ) -> Linearisation:
        """See `solid_assembly.Assembly.linearise`."""
        state, cells = self._deformed(x), self._cells()
        indices, pointers, positions, starts = self._pattern
        data = np.zeros(len(indices))
        follow, inner, negative = np.empty((len(starts), ADDED, NODAL)), np.empty((len(starts), ADDED, ADDED)), 0
        for law in self._laws:
            for some, points in law.portions():
                with threads(self._n_displacements):
                    moduli, stress = law.at("moduli", points, 3, 3, 3, 3), law.at("stress", points, 3, 3)
                    if law.bulk is not None:
                        volume, bulk = law.at("volume", points, 3, 3) / law.shear, law.at("bulk", points)
                        scaled = bulk[:, :, None, None] * volume
                        moduli += volume[:, :, :, :, None, None] * scaled[:, :, None, None]
                try:
                    small, follow[some], inner[some], found = condensed_matrices(
                        moduli,
                        stress,
                        (state.nodal[some], state.added[some], state.bulk[some]),
                        (cells.added[some], cells.bulk[some], cells.centre[some], cells.volumes[some]),
                    )
                except (np.linalg.LinAlgError, ZeroDivisionError) as error:
                    raise SolverError("the tangent of a cell is singular") from error
                add_to_csr(small, positions[some], starts[some], data)
                negative += found
        self._add_others(x, data)
        matrix = sp.csr_matrix((data, indices, pointers), shape=(len(x), len(x)))
        if contact is not None:
            matrix = added(matrix, contact, triangular=False)
        coupled = AssembledLinearisation(residual, matrix, solver)
        following = _rows(follow, self._enhanced.dofs[:, :NODAL], len(x))
        cellwise = CellwiseLinearisation(coupled, self._n_displacements, following, inner, negative)
        split = self._enhanced.split
        if not len(split):
            return cellwise
        along = state.part(split).products((self._evaluate("volume", 3, 3) * cells.volumes[:, :, None, None])[split])
        diagonal, ratio = -self._shear * cells.volumes[split], self._evaluate("bulk")[split] / self._shear
        rows = _rows(along, self._enhanced.dofs[split], len(x))
        return PointwiseLinearisation(cellwise, rows, diagonal.ravel(), ratio.ravel())


def _rows(values: Array, dofs: NDArray[np.int64], n: int) -> sp.csr_matrix:
    """Sparse matrix (m r, n) of cells' ``values`` (m, r, c), whose columns are ``dofs`` (m, c)."""
    m, r, c = values.shape
    columns = np.repeat(dofs.astype(np.int32), r, axis=0)
    pointers = np.arange(0, m * r * c + 1, c, dtype=np.int32)
    return sp.csr_matrix((values.ravel(), columns.ravel(), pointers), shape=(m * r, n))
