"""A `Mesh` as NGSolve's, with regions for cell sets and boundaries for surfaces.

NGSolve keeps the corners of cells only; second-order shapes are given to it as a deformation of the straight
mesh, once the displacement space (which contains them) exists: see `displacement_space`. Named sets may
overlap while NGSolve's regions may not, so each combination of sets becomes a region of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import netgen.meshing as netgen_meshing
import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.meshing.meshes import Mesh

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def reference_points(shape: str, points: Array) -> Array:
    """NGSolve's reference coordinates (p, 3) of points (p, 2 or 3) given in a `CellType`'s reference cell."""
    if shape == "hex":
        return points
    if points.shape[1] == 2:
        x, y = points.T
        zero = np.zeros_like(x)
        return np.column_stack([x, y, zero] if shape == "quad" else [1.0 - x - y, x, zero])
    x, y, z = points.T
    return np.column_stack([1.0 - x - y - z, x, y] if shape == "tet" else [1.0 - x - y, x, z])


def corner_monomials(count: int, points: Array) -> Array:
    """Values (p, count) at points (p, 3) of as many monomials as a reference cell has corners; 1 is the constant."""
    x, y, z = points.T
    return np.column_stack([np.ones_like(x), x, y, z, x * z, y * z, x * y, x * y * z][:count])


class NgsolveMesh:
    """A mesh, its counterpart in NGSolve and the numbering between them.

    Raises StudyError if the mesh has cells that are not solids.

    Attributes
    ----------
    mesh : the mesh it was made from.
    ngs : NGSolve's mesh of the corners.
    node_of_vertex : (n_vertices,) node index of each of NGSolve's vertices.
    element_of_cell : (n_cells,) NGSolve's element number of each cell; ``cell_of_element`` is its inverse.
    """

    #: What NGSolve's elements of the cells are, volumes, of which shapes, and the space of functions on them.
    kind, shapes, functions = ngs.VOL, (ngs.HEX, ngs.TET, ngs.PRISM), ngs.L2

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        for block in mesh.blocks:
            if block.type.dimension != 3:
                raise StudyError(f"cells of type {block.cell_type} are no solids; use a solid cell type")
        target = self._with_vertices()
        self._regions = Combinations(mesh.cell_sets, mesh.n_cells)
        self.element_of_cell = self._add_cells(target)
        self.cell_of_element: Indices = np.argsort(self.element_of_cell)
        self._boundaries = self._add_faces(target)
        self.ngs = ngs.Mesh(target)

    def _with_vertices(self) -> Any:
        """Netgen's mesh of the corners alone."""
        corners = [block.connectivity[:, : block.type.corners] for block in self.mesh.blocks]
        self.node_of_vertex: Indices = np.unique(np.concatenate([c.ravel() for c in corners]))
        self._vertex = np.full(self.mesh.n_nodes, -1, dtype=np.int64)
        self._vertex[self.node_of_vertex] = np.arange(len(self.node_of_vertex))
        target: Any = netgen_meshing.Mesh(dim=3)  # pyright: ignore[reportAttributeAccessIssue]
        target.AddPoints(np.ascontiguousarray(self.mesh.nodes[self.node_of_vertex]))
        return target

    def _add_cells(self, target: Any) -> Indices:
        for region in range(self._regions.count):
            target.SetMaterial(region + 1, region_name(region))
        return self._add_elements(target, dim=3)

    def _add_elements(self, target: Any, dim: int) -> Indices:
        """Add the cells region by region; returns the element number of each."""
        mesh, element_of_cell, count = self.mesh, np.empty(self.mesh.n_cells, dtype=np.int64), 0
        starts = mesh.block_starts()
        for block, start in zip(mesh.blocks, starts[:-1], strict=True):
            corners = self._vertex[block.connectivity[:, : block.type.corners]].astype(np.int32)
            of_region = self._regions.number[start : start + len(corners)]
            for region in np.unique(of_region):
                rows = np.flatnonzero(of_region == region)
                target.AddElements(dim=dim, index=int(region) + 1, data=np.ascontiguousarray(corners[rows]), base=0)
                element_of_cell[start + rows] = count + np.arange(len(rows))
                count += len(rows)
        return element_of_cell

    def _add_faces(self, target: Any) -> Combinations:
        """Every outer face, and every named one inside; a face that two surfaces share is added once.

        A face inside that surfaces name from the cells on its two sides is two, whose normals are opposite.
        """
        mesh = self.mesh
        faces = np.concatenate([mesh.boundary_faces(), *mesh.surfaces.values()]).astype(np.int64)
        nodes = mesh.face_nodes(faces, corners_only=True)
        seen_from = np.column_stack([np.sort(nodes, axis=1), faces[:, 0]])
        _, first, which = np.unique(seen_from, axis=0, return_index=True, return_inverse=True)
        which = which.ravel()
        members, position = {}, len(mesh.boundary_faces())
        for name, surface in mesh.surfaces.items():
            members[name] = which[position : position + len(surface)]
            position += len(surface)
        combinations = Combinations(members, len(first))
        for region in range(combinations.count):
            add_face_region(target, region)
            vertices = np.where(nodes >= 0, self._vertex[nodes], -1)[first[combinations.number == region]]
            for corners in (3, 4):
                data = vertices[(vertices >= 0).sum(axis=1) == corners][:, :corners].astype(np.int32)
                if len(data):
                    target.AddElements(dim=2, index=region + 1, data=np.ascontiguousarray(data), base=0)
        return combinations

    def region(self, cell_set: str) -> ngs.Region:
        """The cells of a set; "all" is every cell. Raises StudyError if there is no such set."""
        self.mesh.cells(cell_set)
        return self.ngs.Materials(".*" if cell_set == "all" else self._regions.pattern(cell_set))

    def partition(self, owners: Indices) -> dict[int, ngs.Region]:
        """Regions of cells by owner, ``owners`` (n_cells,): cells in the same sets must have the same."""
        regions = {}
        for owner in np.unique(owners):
            groups = np.unique(self._regions.number[owners == owner])
            regions[int(owner)] = self.ngs.Materials("|".join(region_name(int(g)) for g in groups))
        return regions

    def boundary(self, surface: str) -> ngs.Region:
        """The faces of a surface. Raises StudyError if there is none of this name."""
        self.mesh.surface(surface)
        return self.ngs.Boundaries(self._boundaries.pattern(surface))

    def cell_field(self, values: Array) -> Any:
        """Coefficient function constant in each cell: a number (n_cells,) or a vector (n_cells, c)."""
        values = np.asarray(values, dtype=np.float64)
        if len(values) != self.mesh.n_cells:
            raise StudyError(
                f"there are {len(values)} values for the mesh's {self.mesh.n_cells} cells; give each cell one"
            )
        columns = values.reshape(self.mesh.n_cells, -1)
        parts = []
        for column in columns.T:
            part = ngs.GridFunction(self.functions(self.ngs, order=0))
            part.vec.FV().NumPy()[self.element_of_cell] = column
            parts.append(part)
        return parts[0] if values.ndim == 1 else ngs.CF(tuple(parts))

    def mesh_points(self, elements: Indices, reference: Array) -> NDArray:
        """NGSolve's points (p,) in ``elements`` (p,) at its own reference coordinates (p, 3)."""
        rules = {shape: ngs.IntegrationRule(shape, 0) for shape in self.shapes}
        pattern = self.ngs.MapToAllElements(rules, self.kind)
        points = np.repeat(pattern[:1], len(elements))
        points["nr"] = elements
        points["x"], points["y"], points["z"] = reference.T
        return points


def region_name(number: int) -> str:
    return f"region{number}"


def add_face_region(target: Any, number: int) -> None:
    """Add a region of faces to a mesh of Netgen's."""
    face = netgen_meshing.FaceDescriptor(  # pyright: ignore[reportAttributeAccessIssue]
        surfnr=number + 1, domin=1, domout=0, bc=number + 1
    )
    target.Add(face)
    target.SetBCName(number, region_name(number))


class Combinations:
    """Items grouped by which of some overlapping sets they are in."""

    def __init__(self, sets: Mapping[str, Indices], n_items: int) -> None:
        membership = np.zeros((n_items, max(len(sets), 1)), dtype=bool)
        for column, indices in enumerate(sets.values()):
            membership[np.asarray(indices, dtype=np.int64), column] = True
        rows, number = np.unique(membership, axis=0, return_inverse=True)
        self.number: Indices = number.ravel()
        self.count = len(rows)
        self._groups = {name: np.flatnonzero(rows[:, column]) for column, name in enumerate(sets)}

    def pattern(self, name: str) -> str:
        """Regular expression for the groups that make up a set."""
        return "|".join(region_name(int(group)) for group in self._groups[name])
