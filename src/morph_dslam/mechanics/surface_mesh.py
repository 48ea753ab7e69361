"""A `Mesh` of surface cells as NGSolve's: faces in space without a volume, and the edges that carry loads."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.ngsolve_mesh import Combinations, NgsolveMesh, add_face_region
from morph_dslam.meshing.meshes import Mesh, faces_of_cells
from morph_dslam.meshing.surface_checks import mesh_edges

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class SurfaceMesh(NgsolveMesh):
    """A mesh of a surface, its counterpart in NGSolve and the numbering between them.

    Raises StudyError if the mesh has cells that are no surfaces, or a set of ``edges`` holds no edge.

    Parameters
    ----------
    mesh : of surface cells.
    edges : node sets whose edges are to be integrated over.

    Attributes
    ----------
    mesh : with its cell sets, and all cells by the name "all", as surfaces too.
    """

    kind, shapes, functions = ngs.BND, (ngs.TRIG, ngs.QUAD), ngs.SurfaceL2

    def __init__(self, mesh: Mesh, edges: Iterable[str] = ()) -> None:
        self.mesh = _with_surfaces(mesh)
        for block in mesh.blocks:
            if block.type.dimension != 2:
                raise StudyError(f"cells of type {block.cell_type} are no surface; a shell needs triangles or quads")
        target = self._with_vertices()
        members = {name: faces[:, 0] for name, faces in self.mesh.surfaces.items()}
        self._regions = Combinations(members, mesh.n_cells)
        self.element_of_cell = self._add_cells(target)
        self.cell_of_element: Indices = np.argsort(self.element_of_cell)
        self._edge_sets = list(dict.fromkeys(edges))
        for number, name in enumerate(self._edge_sets, start=1):
            self._add_edges(target, name, number)
        self.ngs = ngs.Mesh(target)

    def _add_cells(self, target: Any) -> Indices:
        for region in range(self._regions.count):
            add_face_region(target, region)
        return self._add_elements(target, dim=2)

    def _add_edges(self, target: Any, name: str, number: int) -> None:
        """The edges of a set as segments of their own; two sets may share some."""
        target.SetCD2Name(number, f"edges{number}")
        segments = self._vertex[self.edges_on(name)].astype(np.int32)
        target.AddElements(dim=1, index=number, data=np.ascontiguousarray(segments), base=0)

    def edges_on(self, name: str) -> Indices:
        """Edges (e, 2), by their end nodes, all of whose nodes are in a set. Raises StudyError if there is none."""
        edges, _ = mesh_edges(self.mesh)
        held = np.append(np.isin(np.arange(self.mesh.n_nodes), self.mesh.set_nodes(name)), True)
        rows = held[edges].all(axis=1)
        if not rows.any():
            raise StudyError(f"no edge of the mesh has all of its nodes in the set '{name}': name one along edges")
        return np.unique(np.sort(edges[rows, :2], axis=1), axis=0)

    def edge_numbers(self, name: str) -> list[int]:
        """NGSolve's numbers of the edges all of whose nodes are in a set; raises as `edges_on` does."""
        numbers = {tuple(sorted(v.nr for v in edge.vertices)): edge.nr for edge in self.ngs.edges}
        return [numbers[tuple(sorted(pair))] for pair in self._vertex[self.edges_on(name)].tolist()]

    def region(self, cell_set: str) -> ngs.Region:
        self.mesh.cells(cell_set)
        return self.ngs.Boundaries(".*" if cell_set == "all" else self._regions.pattern(cell_set))

    def boundary(self, surface: str) -> ngs.Region:
        self.mesh.surface(surface)
        return self.ngs.Boundaries(self._regions.pattern(surface))

    def edge_region(self, name: str) -> ngs.Region:
        """The edges of one of the sets that the mesh was made with."""
        return self.ngs.BBoundaries(f"edges{self._edge_sets.index(name) + 1}")


def _with_surfaces(mesh: Mesh) -> Mesh:
    """The mesh with its cell sets, and all cells, as surfaces: a surface cell is its own face."""
    sets = {"all": np.arange(mesh.n_cells), **mesh.cell_sets}
    surfaces = {name: faces_of_cells(cells) for name, cells in sets.items()}
    return replace(mesh, surfaces={**surfaces, **mesh.surfaces})
