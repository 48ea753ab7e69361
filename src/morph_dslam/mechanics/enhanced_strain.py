"""Enhanced strains of eight-node hexahedra, which bend without shearing and hardly lock at nearly constant volume.

Trilinear displacements cannot bend a cell without shearing it, nor keep its volume everywhere. Twelve unknowns a cell
are added to the deformation gradient, a_r and c_r with r = 1, 2, 3:

    F = 1 + du/dX + F0 M,   M = sum_r (h_r a_r' + t_r c_r 1),   h_r = xi_r J0^-T e_r j0 / j,   t_r = xi_s xi_t j0 / j

with xi from -1 to 1 across the cell, s and t the other two directions, J = dX/dxi with determinant j, and 0 for its
centre. The a_r are Wilson's incompatible modes (Simo and Armero, IJNME 33, 1992), the c_r free the volume (Simo, Armero
and Taylor, Comput. Methods Appl. Mech. Engrg. 110, 1993). The factor j0 / j makes the added part vanish in the mean, so
that uniform stress is met exactly (patch test). The a_r are transposed and turn with F0 (Glaser and Armero, Engineering
Computations 14, 1997): for small strains they are Wilson's, but cells do not buckle one against the other where they
are compressed along their length. All of them are discontinuous and are condensed cell by cell. With n_a the gradients
of the nodes' functions and u_a their displacements,

    dF = sum_a du_a (n_a + M' n_a0)' + sum_r ((F0 h_r) da_r' + t_r F0 dc_r)

so that residuals and tangents need hardly other formulas than a plain cell's.
"""

from __future__ import annotations

from dataclasses import dataclass

import ngsolve as ngs
import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.mechanics.spaces import DisplacementSpace
from morph_dslam.meshing.meshes import Mesh
from morph_dslam.model.cell_types import cell_type

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Unknowns of a cell: three of each of its nodes, and the added ones.
NODAL, ADDED = 24, 12


def takes_enhanced_strain(mesh: Mesh, order: int) -> bool:
    """Whether elements of this order on this mesh are eight-node hexahedra throughout."""
    return order == 1 and all(block.cell_type == "hex8" for block in mesh.blocks)


@dataclass(frozen=True)
class CellGeometry:
    """What integrals over m undeformed cells need.

    Attributes
    ----------
    nodal : (m, 8, 8, 3) gradients of the nodes' functions at the quadrature points, 1/m.
    added : (m, 8, 3, 3) vectors h_r there, 1/m.
    bulk : (m, 8, 3) t_r there.
    centre : (m, 8, 3) gradients of the nodes' functions in the middle, 1/m.
    volumes : (m, 8) of the quadrature points, m3.
    """

    nodal: Array
    added: Array
    bulk: Array
    centre: Array
    volumes: Array


@dataclass(frozen=True)
class CellState:
    """m deformed cells at their quadrature points.

    Attributes
    ----------
    F : (m, 8, 3, 3) deformation gradients.
    nodal : (m, 8, 8, 3) vectors n_a + M' n_a0, 1/m: what a node's displacement changes F by.
    added : (m, 8, 3, 3) vectors F0 h_r, 1/m.
    bulk : (m, 8, 3, 3, 3) tensors t_r F0, r last.
    """

    F: Array
    nodal: Array
    added: Array
    bulk: Array

    def part(self, cells: Indices) -> CellState:
        """Some of the cells."""
        return CellState(self.F[cells], self.nodal[cells], self.added[cells], self.bulk[cells])

    def products(self, tensors: Array) -> Array:
        """Changes (m, 8, 36) of F with each unknown, contracted with ``tensors`` (m, 8, 3, 3)."""
        nodal = np.einsum("mqij,mqaj->mqai", tensors, self.nodal)
        added = np.einsum("mqij,mqri->mqrj", tensors, self.added)
        bulk = np.einsum("mqij,mqijr->mqr", tensors, self.bulk)[:, :, None]
        products = np.concatenate([nodal, added, bulk], axis=2)
        return products.reshape(*products.shape[:2], -1)

    def change(self, unknowns: Array) -> Array:
        """Change (m, 8, 3, 3) of F with the ``unknowns`` (m, 12, 3)."""
        change = _change(unknowns, self.nodal, self.added)
        return change + np.einsum("mqijr,mr->mqij", self.bulk, unknowns[:, 11])

    def forces(self, stress: Array) -> Array:
        """Forces (m, 12, 3) of ``stress`` times volume (m, 8, 3, 3): the transpose of `change`."""
        forces = _forces(stress, self.nodal, self.added)
        forces[:, 11] = np.einsum("mqijr,mqij->mr", self.bulk, stress)
        return forces


class EnhancedStrain:
    """The added unknowns of a mesh of m hex8 cells, and the cells' geometry; cells come in NGSolve's order.

    Attributes
    ----------
    dofs : (m, 36) numbers of each cell's dofs: x, y and z of its eight nodes, then of a_1, a_2, a_3 and c, which
        follow the 3 n_scalar dofs of displacements cell by cell.
    split : (k,) cells whose volumetric strain is an unknown at each quadrature point.
    strain_dofs : (k, 8) numbers of these, which come last.
    n_dofs : how many dofs there are in all.
    nodes : (m, 8) scalar dofs of each cell.
    points : IntegrationRuleSpace of the eight quadrature points.
    """

    def __init__(self, displacements: DisplacementSpace, split: Indices) -> None:
        geometry = displacements.geometry
        self.nodes: Indices = displacements.corner_dofs()[geometry.cell_of_element]
        m, n = len(self.nodes), displacements.n_scalar
        self.split, inside = split, 3 * n + m * ADDED
        self.strain_dofs: Indices = inside + np.arange(8 * len(split)).reshape(-1, 8)
        self.n_dofs = inside + 8 * len(split)
        nodal = (self.nodes[:, :, None] + n * np.arange(3)).reshape(m, NODAL)
        added = 3 * n + np.arange(m * ADDED).reshape(m, ADDED)
        self.dofs: Indices = np.concatenate([nodal, added], axis=1)
        self.points = ngs.comp.IntegrationRuleSpace(geometry.ngs, order=1)
        rule = self.points.GetIntegrationRules()[ngs.HEX]
        hexahedron, self._reference = cell_type("hex8"), np.array(rule.points)
        self._weights = np.array(rule.weights)
        self._slopes = hexahedron.shape_gradients(self._reference)
        x, y, z = 2.0 * self._reference.T - 1.0
        self._linear, self._bilinear = np.column_stack([x, y, z]), np.column_stack([y * z, z * x, x * y])
        self._centre_slopes = hexahedron.shape_gradients(np.full((1, 3), 0.5))[0]

    def _centre_jacobian(self, coordinates: Array) -> Array:
        """Derivatives (m, 3, 3) of ``coordinates`` (n_scalar, 3) by the reference ones, from 0 to 1, at the centres."""
        return np.einsum("mak,ar->mkr", coordinates[self.nodes], self._centre_slopes)

    def unknowns(self, dofs: Array) -> Array:
        """Those of each cell (m, 12, 3)."""
        return dofs[self.dofs].reshape(len(self.dofs), -1, 3)

    def assembled(self, forces: Array) -> Array:
        """(n_dofs,) from cells' forces (m, 12, 3)."""
        return np.bincount(self.dofs.ravel(), forces.ravel(), minlength=self.n_dofs).astype(np.float64, copy=False)

    def geometry(self, coordinates: Array) -> CellGeometry:
        """The cells whose nodes' functions have the coefficients ``coordinates`` (n_scalar, 3), m."""
        jacobian = np.einsum("mak,qar->mqkr", coordinates[self.nodes], self._slopes)
        centre = self._centre_jacobian(coordinates)
        volume, inverse = np.linalg.det(jacobian), np.linalg.inv(centre)
        ratio = (np.linalg.det(centre)[:, None] / volume)[:, :, None]
        added = (self._linear * ratio)[:, :, :, None] * inverse[:, None]
        nodal = self._slopes @ np.linalg.inv(jacobian)
        return CellGeometry(nodal, added, self._bilinear * ratio, self._centre_slopes @ inverse, self._weights * volume)

    def geometry_slopes(self, cells: CellGeometry, velocity: Array) -> CellGeometry:
        """Derivatives of ``cells`` (volumes': relative) as coordinates change by ``velocity`` (n_scalar, 3)."""
        corners = velocity[self.nodes]
        spread = np.einsum("mak,mqaj->mqkj", corners, cells.nodal)
        middle = np.einsum("mak,maj->mkj", corners, cells.centre)
        growth = np.trace(spread, axis1=2, axis2=3)
        relative = (np.trace(middle, axis1=1, axis2=2)[:, None] - growth)[:, :, None]
        added = relative[:, :, :, None] * cells.added - cells.added @ middle[:, None]
        return CellGeometry(-cells.nodal @ spread, added, relative * cells.bulk, -cells.centre @ middle, growth)

    def deformed(self, cells: CellGeometry, unknowns: Array) -> CellState:
        """The cells at their ``unknowns`` (m, 12, 3)."""
        F, nodal, added, middle = _deformed(unknowns, cells.nodal, cells.added, cells.bulk, cells.centre)
        return CellState(F, nodal, added, middle[:, None, :, :, None] * cells.bulk[:, :, None, None])

    def state_slopes(self, cells: CellGeometry, slopes: CellGeometry, unknowns: Array) -> CellState:
        """Derivatives of `deformed` at fixed ``unknowns`` by what changes ``cells`` by ``slopes``."""
        u = unknowns[:, :8]
        modes, changed = _modes(cells, unknowns), _modes(slopes, unknowns)
        nodal = slopes.nodal + cells.centre[:, None] @ changed + slopes.centre[:, None] @ modes
        middle = np.eye(3) + np.einsum("mai,maj->mij", u, cells.centre)
        turning = np.einsum("mai,maj->mij", u, slopes.centre)
        added = np.einsum("mij,mqrj->mqri", turning, cells.added) + np.einsum("mij,mqrj->mqri", middle, slopes.added)
        bulk = np.einsum("mij,mqr->mqijr", turning, cells.bulk) + np.einsum("mij,mqr->mqijr", middle, slopes.bulk)
        return CellState(np.einsum("mai,mqaj->mqij", u, nodal) + changed, nodal, added, bulk)


def _modes(cells: CellGeometry, unknowns: Array) -> Array:
    """M (m, 8, 3, 3)."""
    bulk = np.einsum("mqr,mr->mq", cells.bulk, unknowns[:, 11])
    return np.einsum("mqri,mrj->mqij", cells.added, unknowns[:, 8:11]) + bulk[:, :, None, None] * np.eye(3)


class QuadratureField:
    """A tensor field, trilinear in each cell, through values at its eight quadrature points.

    Attributes
    ----------
    function : coefficient function (3x3).
    """

    def __init__(self, enhanced: EnhancedStrain) -> None:
        space = ngs.L2(enhanced.points.mesh, order=1)
        self._coefficients = ngs.GridFunction(ngs.VectorValued(space, 9))
        element = space.GetFE(ngs.ElementId(ngs.VOL, 0))
        points = enhanced.points.GetIntegrationRules()[ngs.HEX].points
        self._fit = np.linalg.inv([np.array(element.CalcShape(*map(float, point))).ravel() for point in points])
        ids = [ngs.ElementId(ngs.VOL, i) for i in range(len(enhanced.nodes))]
        self._dofs = np.array([space.GetDofNrs(i) for i in ids])
        self.function = ngs.CF(tuple(self._coefficients[i] for i in range(9)), dims=(3, 3))

    def set(self, values: Array) -> None:
        """Take ``values`` (m, 8, 3, 3)."""
        parts = self._coefficients.vec.FV().NumPy().reshape(9, -1)
        parts[:, self._dofs] = np.einsum("tq,mqc->cmt", self._fit, values.reshape(len(values), -1, 9))


@njit(cache=True, nogil=True)
def _deformed(
    unknowns: Array, nodal: Array, added: Array, bulk: Array, centre: Array
) -> tuple[Array, Array, Array, Array]:
    """F, `nodal` and `added` of `CellState`, from fields of `CellGeometry`, and F0 (m, 3, 3)."""
    m, q = len(nodal), nodal.shape[1]
    F, moved, turned = np.empty((m, q, 3, 3)), np.empty((m, q, 8, 3)), np.zeros((m, q, 3, 3))
    middle, M = np.empty((m, 3, 3)), np.empty((3, 3))
    for cell in range(m):
        F0, u, a, c = middle[cell], unknowns[cell, :8], unknowns[cell, 8:11], unknowns[cell, 11]
        for i in range(3):
            for j in range(3):
                F0[i, j] = 1.0 if i == j else 0.0
                for b in range(8):
                    F0[i, j] += u[b, i] * centre[cell, b, j]
        for point in range(q):
            for i in range(3):
                for j in range(3):
                    M[i, j] = 0.0
                    for r in range(3):
                        M[i, j] += added[cell, point, r, i] * a[r, j]
                        turned[cell, point, r, i] += F0[i, j] * added[cell, point, r, j]
                for r in range(3):
                    M[i, i] += bulk[cell, point, r] * c[r]
            for b in range(8):
                for j in range(3):
                    total = nodal[cell, point, b, j]
                    for i in range(3):
                        total += M[i, j] * centre[cell, b, i]
                    moved[cell, point, b, j] = total
            for i in range(3):
                for j in range(3):
                    total = M[i, j] + (1.0 if i == j else 0.0)
                    for b in range(8):
                        total += u[b, i] * moved[cell, point, b, j]
                    F[cell, point, i, j] = total
    return F, moved, turned, middle


@njit(cache=True, nogil=True)
def _change(unknowns: Array, nodal: Array, added: Array) -> Array:
    """`CellState.change`."""
    m, q = len(nodal), nodal.shape[1]
    result = np.zeros((m, q, 3, 3))
    for cell in range(m):
        for point in range(q):
            for i in range(3):
                for j in range(3):
                    for b in range(8):
                        result[cell, point, i, j] += unknowns[cell, b, i] * nodal[cell, point, b, j]
                    for r in range(3):
                        result[cell, point, i, j] += added[cell, point, r, i] * unknowns[cell, 8 + r, j]
    return result


@njit(cache=True, nogil=True)
def _forces(stress: Array, nodal: Array, added: Array) -> Array:
    """`CellState.forces`."""
    m, q = len(nodal), nodal.shape[1]
    result = np.zeros((m, 12, 3))
    for cell in range(m):
        for point in range(q):
            for i in range(3):
                for j in range(3):
                    value = stress[cell, point, i, j]
                    for b in range(8):
                        result[cell, b, i] += value * nodal[cell, point, b, j]
                    for r in range(3):
                        result[cell, 8 + r, j] += value * added[cell, point, r, i]
    return result


@njit(cache=True, nogil=True)
def _add_point(
    moduli: Array, nodal: Array, added: Array, bulk: Array, volume: float, turned: Array, matrix: Array
) -> None:
    """Add one quadrature point's material part to the upper triangle of a cell's tangent (36, 36)."""
    for b in range(12):
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    total = 0.0
                    for el in range(3):
                        if b < 8:
                            total += moduli[i, j, k, el] * nodal[b, el]
                        elif b < 11:
                            total += moduli[i, j, el, k] * added[b - 8, el]
                        else:
                            for en in range(3):
                                total += moduli[i, j, el, en] * bulk[el, en, k]
                    turned[i, j, k] = total * volume
        for a in range(min(b + 1, 8)):
            for i in range(3):
                for k in range(3):
                    total = 0.0
                    for j in range(3):
                        total += nodal[a, j] * turned[i, j, k]
                    matrix[3 * a + i, 3 * b + k] += total
        for a in range(8, min(b + 1, 11)):
            for j in range(3):
                for k in range(3):
                    total = 0.0
                    for i in range(3):
                        total += added[a - 8, i] * turned[i, j, k]
                    matrix[3 * a + j, 3 * b + k] += total
        if b == 11:
            for r in range(3):
                for k in range(3):
                    for i in range(3):
                        for j in range(3):
                            matrix[33 + r, 33 + k] += bulk[i, j, r] * turned[i, j, k]


@njit(cache=True, nogil=True)
def _negative_pivots(matrices: Array) -> int:
    """Negative eigenvalues of symmetric matrices (m, n, n), by elimination without pivoting; overwrites them."""
    (m, n), count = matrices.shape[:2], 0
    for cell in range(m):
        matrix = matrices[cell]
        for step in range(n):
            pivot = matrix[step, step]
            count += pivot < 0.0
            for row in range(step + 1, n):
                factor = matrix[row, step] / pivot
                for column in range(step + 1, n):
                    matrix[row, column] -= factor * matrix[step, column]
    return count


def condensed_matrices(
    moduli: Array, stress: Array, state: tuple[Array, Array, Array], cells: tuple[Array, Array, Array, Array]
) -> tuple[Array, Array, Array, int]:
    """Tangents of m cells, the added unknowns eliminated.

    Parameters
    ----------
    moduli : (m, q, 3, 3, 3, 3) second derivatives of the energy density by F, Pa.
    stress : (m, q, 3, 3) first derivatives, Pa.
    state : `nodal`, `added` and `bulk` of `CellState`.
    cells : `added`, `bulk`, `centre` and `volumes` of `CellGeometry`.

    Returns
    -------
    S = K_uu - K_ua K_aa^-1 K_au (m, 24, 24), K_aa^-1 K_au (m, 12, 24), K_aa (m, 12, 12), and the number of negative
    eigenvalues of K_aa in all. A cell whose tangent is not finite is NaN.

    Raises
    ------
    numpy.linalg.LinAlgError, ZeroDivisionError
        If K_aa is singular.
    """
    matrices = _tangents(moduli, stress, *state, *cells)
    coupling, inner = matrices[:, NODAL:, :NODAL], matrices[:, NODAL:, NODAL:]
    # Not compiled: numba takes four seconds to compile what solves equations.
    follow = np.asarray(np.linalg.solve(inner, coupling), dtype=np.float64)
    small = matrices[:, :NODAL, :NODAL] - coupling.transpose(0, 2, 1) @ follow
    return small, follow, inner, _negative_pivots(inner.copy())


@njit(cache=True, nogil=True)
def _tangents(
    moduli: Array,
    stress: Array,
    nodal: Array,
    added: Array,
    bulk: Array,
    modes: Array,
    growths: Array,
    centre: Array,
    volumes: Array,
) -> Array:
    """Tangents (m, 36, 36) of m cells, NaN where one is not finite; for the parameters see `condensed_matrices`."""
    m, q = volumes.shape
    matrices, turned = np.zeros((m, NODAL + ADDED, NODAL + ADDED)), np.empty((3, 3, 3))
    for cell in range(m):
        matrix = matrices[cell]
        for point in range(q):
            volume = volumes[cell, point]
            of_point = nodal[cell, point], added[cell, point], bulk[cell, point]
            _add_point(moduli[cell, point], *of_point, volume, turned, matrix)
            # F is bilinear in the nodes' displacements and the added unknowns.
            for a in range(8):
                for r in range(3):
                    both = 0.0
                    for i in range(3):
                        both += centre[cell, a, i] * modes[cell, point, r, i] * volume
                    for i in range(3):
                        for k in range(3):
                            matrix[3 * a + i, NODAL + 3 * r + k] += both * stress[cell, point, i, k]
                            growth = growths[cell, point, r] * centre[cell, a, k] * volume
                            matrix[3 * a + i, 33 + r] += growth * stress[cell, point, i, k]
        total = 0.0
        for row in range(NODAL + ADDED):
            total += matrix[row, row]
            for column in range(row):
                matrix[row, column] = matrix[column, row]
                total += matrix[row, column]
        if not np.isfinite(total):
            matrix[:, :] = np.nan
    return matrices


@njit(cache=True, nogil=True)
def add_to_csr(small: Array, positions: Indices, starts: Indices, data: Array) -> None:
    """Add cells' matrices (m, 24, 24) to the ``data`` of a matrix of three by three like blocks in CSR form.

    Parameters
    ----------
    positions : (m, 8, 8) of each pair of a cell's nodes in the entries of one block.
    starts : (m, 8, 2) where the row of each node begins in the entries of one block, then its length.
    """
    block = len(data) // 9
    for cell in range(len(small)):
        for a in range(8):
            first, length = starts[cell, a, 0], starts[cell, a, 1]
            for b in range(8):
                offset = positions[cell, a, b] - first
                for i in range(3):
                    begin = 3 * (i * block + first) + offset
                    for k in range(3):
                        data[begin + k * length] += small[cell, 3 * a + i, 3 * b + k]
