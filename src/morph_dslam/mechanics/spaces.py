"""The finite element space of the displacements of a solid, and its relation to the mesh's nodes.

NGSolve's basis is hierarchical: vertex functions have nodal values for coefficients; edges, faces and cells add bubbles
(Zaglmayr, High Order Finite Element Methods for Electromagnetic Field Computation, PhD thesis, Linz 2006, chapter 5). A
solid knows nodes: this module translates in both directions, says which coefficients a set of nodes holds, and hands
NGSolve the curved shape of second-order cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import ngsolve as ngs
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.ngsolve_mesh import NgsolveMesh, reference_points
from morph_dslam.meshing.meshes import Mesh
from morph_dslam.model.cell_types import CellType, cell_type

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: The cell type of each shape that has a node for every function of second order.
FULL_TYPE = {"tri": "tri6", "quad": "quad9", "tet": "tet10", "prism": "prism18", "hex": "hex27"}
SERENDIPITY = {"quad8", "prism15", "hex20"}
WITH_CENTRES = {"quad9", "prism18", "hex27"}
#: Mid-side nodes nearer than this part of the mesh's size to the middle of straight edges count as straight.
STRAIGHT = 1e-12
#: A basis function smaller than this at a point is zero there.
VANISHING = 1e-12


@dataclass(frozen=True)
class _BlockBasis:
    """The space on one block of cells.

    Attributes
    ----------
    dofs : (m, b) scalar dof numbers of each cell.
    owner : (b,) part of the cell (`_parts`) that each function belongs to: a corner, an edge, a face or the inside.
    beyond : (b,) whether a function is of higher than second order; these vanish at all nodes.
    values : (k, b) functions at the nodes of the block's own cell type.
    """

    type: CellType
    connectivity: Indices
    dofs: Indices
    owner: Indices
    beyond: NDArray[np.bool_]
    values: Array


class DisplacementSpace:
    """Continuous displacements of first, second or third order.

    Scalar dofs are numbered 0 ... n_scalar - 1; a displacement field has n_scalar of x, then of y, then of z. Raises
    StudyError if cell types do not go together, or the order is below that of the cells.

    Parameters
    ----------
    geometry : the mesh.
    order : 1, 2 or 3; None takes that of the cells.
    full : use every function of that order even where hex20 or prism15 give the shape, as order 3 always does.
    serendipity : leave out second-order functions on faces with four corners and inside of cells that have no nodes
        there, unless ``full``: half the unknowns of all, and little less accurate.

    Attributes
    ----------
    scalar : NGSolve's space of one component.
    vector : NGSolve's space of the displacements.
    node_values : sparse (n_nodes, n_scalar): values at nodes from coefficients.
    coefficients : sparse (n_scalar, n_nodes): coefficients of the interpolation of nodal values.
    coordinates : (n_scalar, 3) coefficients of the position X, m.
    constant : (n_scalar,) coefficients of the constant 1.
    bonus_order : what integrals over cells need beyond NGSolve's own order of quadrature.
    """

    def __init__(
        self, geometry: NgsolveMesh, order: int | None = None, full: bool = False, serendipity: bool = False
    ) -> None:
        self.geometry = geometry
        mesh = geometry.mesh
        types = {block.cell_type for block in mesh.blocks}
        shape_order = max(block.type.order for block in mesh.blocks)
        self.order = shape_order if order is None else order
        if min(block.type.order for block in mesh.blocks) < shape_order:
            raise StudyError(f"first- and second-order cells meet in one mesh: {', '.join(sorted(types))}")
        if self.order not in (1, 2, 3) or self.order < shape_order:
            raise StudyError(f"elements of order {order} on cells of order {shape_order}: use {shape_order} to 3")
        if types & SERENDIPITY and types & WITH_CENTRES:
            raise StudyError(f"cells with and without nodes on their faces meet: {', '.join(sorted(types))}")
        self.scalar = ngs.H1(geometry.ngs, order=self.order)
        serendipity = bool(types & SERENDIPITY) or (serendipity and not types & WITH_CENTRES)
        if serendipity and self.order == 2 and not full:
            self.scalar.SetOrder(ngs.QUAD, 1)
            self.scalar.SetOrder(ngs.HEX, 1)
            self.scalar.Update()
        self.vector = ngs.VectorValued(self.scalar, 3)
        self.n_scalar: int = self.scalar.ndof
        self._blocks = self._make_blocks()
        self._relate_nodes()
        self.bonus_order = 0
        self.coordinates: Array = self.coefficients @ mesh.nodes
        # One at vertices, zero for bubbles.
        self.constant: Array = (np.arange(self.n_scalar) < geometry.ngs.nv).astype(np.float64)
        self._curve()

    def _make_blocks(self) -> list[_BlockBasis]:
        mesh, blocks = self.geometry.mesh, []
        for block, start in zip(mesh.blocks, mesh.block_starts()[:-1], strict=True):
            elements = self.geometry.element_of_cell[start : start + len(block.connectivity)]
            ids = [ngs.ElementId(self.geometry.kind, int(e)) for e in elements]
            dofs = np.array([self.scalar.GetDofNrs(i) for i in ids], dtype=np.int64)
            # Functions of order 2 are even along edges and faces, those beyond vanish at nodes: the first cell's serve
            # for all.
            element = self.scalar.GetFE(ids[0])
            full = cell_type(FULL_TYPE[block.type.shape])

            values = _functions(element, full.shape, full.nodes)
            owner = np.argmax(np.abs(values), axis=0)
            beyond = np.abs(values).max(axis=0) < VANISHING
            values[:, beyond] = 0.0
            probes = np.array([_probe(full, part) for part in _parts(full)])
            # A function vanishes on every part but its own and those around that: the smallest one is its own.
            owner[beyond] = np.argmax(np.abs(_functions(element, full.shape, probes)[:, beyond]) > VANISHING, axis=0)
            nodes = len(block.type.nodes)
            blocks.append(_BlockBasis(block.type, block.connectivity, dofs, owner, beyond, values[:nodes]))
        return blocks

    def embedded(self, coarse: DisplacementSpace, dofs: Array) -> Array:
        """The same displacement (3 n_scalar,) as ``dofs`` (3 n,) of a space of lower order on the same mesh."""
        given, result = dofs.reshape(3, -1), np.zeros((3, self.n_scalar))
        for own, other in zip(self._blocks, coarse._blocks, strict=True):
            column = {int(own.owner[i]): i for i in np.flatnonzero(~own.beyond)}
            same = [column[int(owner)] for owner in other.owner]
            result[:, own.dofs[:, same]] = given[:, other.dofs]
        return result.ravel()

    def _relate_nodes(self) -> None:
        n_nodes = self.geometry.mesh.n_nodes
        self.node_values = sp.csr_matrix((n_nodes, self.n_scalar))
        self.coefficients = sp.csr_matrix((self.n_scalar, n_nodes))
        nodes_done, dofs_done = np.zeros(n_nodes, dtype=bool), np.zeros(self.n_scalar, dtype=bool)
        for basis in self._blocks:
            shape_functions = (basis.owner < len(basis.type.nodes)) & ~basis.beyond
            inverse = np.zeros(basis.values.T.shape)
            inverse[shape_functions] = np.linalg.inv(basis.values[:, shape_functions])
            self.node_values += _rows_once(
                basis.connectivity, basis.dofs, basis.values, nodes_done, (n_nodes, self.n_scalar)
            )
            self.coefficients += _rows_once(
                basis.dofs, basis.connectivity, inverse, dofs_done, (self.n_scalar, n_nodes)
            )

    def _curve(self) -> None:
        """Give NGSolve the cells' true shape: coefficients of the position beyond the corners.

        It goes on choosing quadrature for straight cells, which on triangles and tetrahedra is too low for curved ones.
        """
        bubbles = self.coordinates.copy()
        bubbles[: self.geometry.ngs.nv] = 0.0
        if np.abs(bubbles).max() > STRAIGHT * np.ptp(self.geometry.mesh.nodes, axis=0).max():
            self._deformation = ngs.GridFunction(self.vector)
            self._deformation.vec.FV().NumPy()[:] = bubbles.T.ravel()
            self.geometry.ngs.SetDeformation(self._deformation)
            self.bonus_order = self.curved_bonus_order

    def face_functions(self, faces: Indices) -> tuple[Indices, Array]:
        """The functions that do not vanish on faces (f, 2), as polynomials of two coordinates.

        The coordinates are 0 at a face's first corner; s grows to its second corner and t to its last.

        Returns
        -------
        Scalar dofs (f, b) and coefficients (f, b, m) of the monomials s^i t^j, i and j up to the order, j running
        fastest. Faces with fewer functions than others end in functions that are zero.
        """
        exponents = np.array(list(product(range(self.order + 1), repeat=2)))
        dofs = np.zeros((len(faces), len(exponents)), dtype=np.int64)
        coefficients = np.zeros((len(faces), len(exponents), len(exponents)))
        for basis, start in zip(self._blocks, self.geometry.mesh.block_starts()[:-1], strict=True):
            for number, local in enumerate(basis.type.faces):
                inside = (faces[:, 0] >= start) & (faces[:, 0] < start + len(basis.dofs)) & (faces[:, 1] == number)
                corners = basis.type.nodes[[node for node in local if node < basis.type.corners]]
                used = np.flatnonzero((len(corners) == 4) | (exponents.sum(axis=1) <= self.order))
                lattice = exponents[used] / self.order
                points = corners[0] + lattice @ (corners[[1, -1]] - corners[0])
                inverse = np.linalg.inv(np.prod(lattice[:, None] ** exponents[used], axis=2))
                rows = np.flatnonzero(inside)
                # Functions beyond the second order depend on how the cell's corners are numbered.
                for group in [rows] if self.order < 3 else rows[:, None]:
                    if len(group):
                        cells = faces[group, 0] - start
                        element = self.geometry.element_of_cell[faces[group[0], 0]]
                        fe = self.scalar.GetFE(ngs.ElementId(ngs.VOL, int(element)))
                        values = _functions(fe, basis.type.shape, points)
                        here = np.flatnonzero(np.abs(values).max(axis=0) > VANISHING)
                        dofs[group, : len(here)] = basis.dofs[cells][:, here]
                        coefficients[np.ix_(group, np.arange(len(here)), used)] = (inverse @ values[:, here]).T
        return dofs, coefficients

    def corner_dofs(self) -> Indices:
        """Scalar dofs (n_cells, k) of the corners of each cell, in the order of its nodes; all cells have k corners."""
        return np.concatenate([b.dofs[:, np.argsort(b.owner)[: b.type.corners]] for b in self._blocks])

    @property
    def curved_bonus_order(self) -> int:
        """`bonus_order` where cells are curved, by their nodes or by a shape parameter."""
        return 2 if any(basis.type.shape in ("tri", "tet") for basis in self._blocks) else 0

    def dofs_on(self, nodes: Indices) -> Indices:
        """Scalar dofs (sorted) that a set of nodes holds.

        Those of its own nodes; and where elements have functions beyond the nodes of the cells, those on edges and
        faces all of whose nodes are in the set. Functions inside of solid cells are never held.
        """
        inside = np.zeros(self.geometry.mesh.n_nodes, dtype=bool)
        inside[nodes] = True
        held = np.zeros(self.n_scalar, dtype=bool)
        for basis in self._blocks:
            full = cell_type(FULL_TYPE[basis.type.shape])
            corner_sets = _parts(full)
            for column, owner in enumerate(basis.owner):
                if len(corner_sets[owner]) == full.corners and full.dimension == 3:
                    continue
                closure = (
                    [owner]
                    if owner < len(basis.type.nodes) and not basis.beyond[column]
                    else [i for i in range(len(basis.type.nodes)) if corner_sets[i] <= corner_sets[owner]]
                )
                rows = inside[basis.connectivity[:, closure]].all(axis=1)
                held[basis.dofs[rows, column]] = True
        return np.flatnonzero(held)


def _functions(element: Any, shape: str, points: Array) -> Array:
    """Values (p, b) of the functions of one of NGSolve's elements at points (p, 3) of a `CellType`'s reference cell."""
    return np.array([np.array(element.CalcShape(*map(float, p))).ravel() for p in reference_points(shape, points)])


def _parts(full: CellType) -> list[set[int]]:
    """Corners of each part of a cell, smaller parts first: corners, edges, faces with four corners as the nodes of
    ``full`` are numbered, then triangles, and the inside where it has no node."""
    parts = [{i} for i in range(full.corners)] + [set(parents) for parents in full.parents]
    triangles = [set(face[:3]) for face in full.faces if len(face) == 6]
    inside = set(range(full.corners))
    return parts + triangles + ([] if inside in parts else [inside])


def _probe(full: CellType, part: set[int]) -> Array:
    """A point (3,) of a part of the reference cell, on none of the lines where its functions change sign."""
    corners = full.nodes[sorted(part)]
    weights = np.array([1.0, 0.61, 0.43, 0.29, 0.23, 0.17, 0.13, 0.11])[: len(corners)]
    return weights @ corners / weights.sum()


def _rows_once(
    rows: Indices, columns: Indices, values: Array, done: NDArray[np.bool_], shape: tuple[int, int]
) -> sp.csr_matrix:
    """Sparse matrix from cells' blocks ``values`` (r, c), each row written by the first cell that has it.

    ``rows`` (m, r) and ``columns`` (m, c) number them; ``done`` marks rows written before and is updated.
    """
    numbers, first = np.unique(rows.ravel(), return_index=True)
    new = ~done[numbers]
    numbers, first = numbers[new], first[new]
    done[numbers] = True
    cell, local = np.divmod(first, rows.shape[1])
    data = values[local]
    i = np.repeat(numbers, values.shape[1])
    matrix = sp.csr_matrix((data.ravel(), (i, columns[cell].ravel())), shape=shape)
    matrix.eliminate_zeros()
    return matrix


def default_order(mesh: Mesh) -> int:
    """Order of displacements that does not lock in bending: 2, save for meshes of hex8 cells alone.

    Linear tetrahedra and prisms have one strain a cell or little more: a slender bar of them sags by a fraction of
    what it should. Eight-node hexahedra take `enhanced_strain`.
    """
    return 1 if {block.cell_type for block in mesh.blocks} == {"hex8"} else 2


def has_mixed_form(mesh: Mesh, order: int) -> bool:
    """Whether elements of this order on these cells have a stable mixed form."""
    return order > 1 or {block.type.shape for block in mesh.blocks} == {"hex"}


def check_mixed(mesh: Mesh, order: int) -> None:
    """Refuse cells that have no stable mixed element (StudyError)."""
    if not has_mixed_form(mesh, order):
        raise StudyError(
            "mixed elements of first order exist for hex8 only: use tet10 or prism18, or order = 2, "
            "for a nearly incompressible material"
        )


class PressureSpace:
    """Pressures on one region, as a combination of scalar unknowns: the mixed form of `materials.base`.

    Displacements must be rich enough for them (the inf-sup condition). Hexahedra of second order take a pressure linear
    in each cell and discontinuous (Boffi, Brezzi and Fortin, Mixed Finite Element Methods and Applications, 2013,
    section 8.6), condensed cell by cell; tetrahedra and prisms Taylor and Hood's, linear and continuous within a
    material; hexahedra of first order one pressure a cell (Simo, Taylor and Pister, 1985), which may alternate between
    neighbours. Displacements of third order take the same with pressures of second order.

    Parameters
    ----------
    space : the displacements, of full order.
    region : where the material is.

    Attributes
    ----------
    spaces : NGSolve spaces of the unknowns; `combine` makes the pressure of their functions.
    """

    def __init__(self, space: DisplacementSpace, region: ngs.Region) -> None:
        geometry = space.geometry
        mesh, ngs_mesh = geometry.mesh, geometry.ngs
        hexahedra = {block.type.shape for block in mesh.blocks} == {"hex"}
        self._offsets: list[Any] = []
        if not hexahedra:
            self.spaces = [ngs.H1(ngs_mesh, order=space.order - 1, definedon=region)]
            return
        count = {1: 1, 2: 4, 3: 10}[space.order]
        self.spaces = [ngs.L2(ngs_mesh, order=0, definedon=region) for _ in range(count)]
        if count > 1:
            corners = np.concatenate([mesh.nodes[b.connectivity[:, :8]] for b in mesh.blocks])
            centre = geometry.cell_field(corners.mean(axis=1))
            size = geometry.cell_field(np.ptp(corners, axis=1).max(axis=1))
            offset = (ngs.CF((ngs.x, ngs.y, ngs.z)) - centre) / size
            self._offsets = [offset[i] for i in range(3)]
            if count == 10:
                self._offsets += [offset[i] * offset[j] for i in range(3) for j in range(i, 3)]

    @property
    def n_dofs(self) -> int:
        """Unknowns of all `spaces`."""
        return sum(space.ndof for space in self.spaces)

    def embedded(self, coarse: PressureSpace, dofs: Array) -> Array:
        """The same pressure (n_dofs,) as ``dofs`` of a space of lower order on the same region of the same mesh."""
        result = np.zeros(self.n_dofs)
        # Functions of lower order come first: in `combine`, and in each of NGSolve's continuous spaces.
        result[: coarse.n_dofs] = dofs
        return result

    def combine(self, unknowns: list[Any]) -> Any:
        """Pressure of functions of `spaces`, in their unit."""
        result = unknowns[0]
        for offset, slope in zip(self._offsets, unknowns[1:], strict=True):
            result = result + offset * slope
        return result
