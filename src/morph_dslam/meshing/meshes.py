"""Meshes: nodes in metres, cells in blocks of one type, and the named sets that a study refers to."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from morph_dslam.errors import StudyError
from morph_dslam.model.cell_types import CellType, cell_type
from morph_dslam.studies.problem import ModelMesh

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Triangles that draw a face of so many nodes (corners, then middle nodes), turning as the face does.
_FACE_TRIANGLES: dict[int, tuple[tuple[int, int, int], ...]] = {
    3: ((0, 1, 2),),
    4: ((0, 1, 2), (0, 2, 3)),
    6: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
    8: ((0, 4, 7), (4, 1, 5), (5, 2, 6), (6, 3, 7), (4, 5, 7), (5, 6, 7)),
    9: ((0, 4, 7), (4, 1, 5), (5, 2, 6), (6, 3, 7), (4, 5, 8), (5, 6, 8), (6, 7, 8), (7, 4, 8)),
}


#: What the message on a cavity that is not there adds.
CLOSED_ONLY = (
    ". Only a hollow that is closed all around is a cavity: name the wall of one with an inlet in [sets.NAME], by "
    "hollow = a point in it"
)


def natural_order(name: str) -> list[str | int]:
    """A key that sorts "face_2" before "face_10"."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


@dataclass(frozen=True)
class CellBlock:
    """Cells of one type.

    Attributes
    ----------
    cell_type : "hex8", "hex20", "hex27", "tet4", "tet10", "prism6", "prism15", "prism18"; for
        surfaces "tri3", "tri6", "quad4", "quad8", "quad9".
    connectivity : (m, k) node indices in VTK's order.
    """

    cell_type: str
    connectivity: Indices

    @property
    def type(self) -> CellType:
        return cell_type(self.cell_type)


@dataclass(frozen=True)
class Mesh:
    """A mesh with named sets.

    Attributes
    ----------
    nodes : (n, 3) coordinates, metres.
    blocks : the cells, numbered through all blocks in order.
    node_sets : node indices by name.
    cell_sets : cell indices by name; materials are given by cell set, and "all" always means every cell.
    surfaces : faces by name, (f, 2): cell index and local face number, the position in `CellType.faces`.
    found : names of surfaces that follow from nodes and cells, and that a file need not name: flat ends, cavities.
    """

    nodes: Array
    blocks: tuple[CellBlock, ...]
    node_sets: Mapping[str, Indices] = field(default_factory=dict)
    cell_sets: Mapping[str, Indices] = field(default_factory=dict)
    surfaces: Mapping[str, Indices] = field(default_factory=dict)
    found: frozenset[str] = frozenset()

    @property
    def n_nodes(self) -> int:
        return len(self.nodes)

    @property
    def n_cells(self) -> int:
        return sum(len(block.connectivity) for block in self.blocks)

    @property
    def is_sheet(self) -> bool:
        """Whether its cells are those of a surface."""
        return all(block.type.dimension == 2 for block in self.blocks)

    def block_starts(self) -> Indices:
        """Index of each block's first cell, and the number of cells at the end."""
        return np.cumsum([0, *(len(block.connectivity) for block in self.blocks)])

    def cells(self, name: str) -> Indices:
        """Indices of the cells of a set; "all" is every cell. StudyError if there is no such set."""
        if name == "all":
            return np.arange(self.n_cells)
        return self._named(self.cell_sets, name, "cell set")

    def set_nodes(self, name: str) -> Indices:
        """Sorted nodes of the node set, or else of the surface, of this name; StudyError if there is neither."""
        if name not in self.node_sets and name in self.surfaces:
            return self.surface_nodes(name)
        return np.unique(self._named(self.node_sets, name, "node set or surface", self.surfaces))

    def surface(self, name: str) -> Indices:
        """Faces (f, 2) of a surface. Raises StudyError if there is none of this name."""
        return self._named(self.surfaces, name, "surface")

    def faces_in(self, name: str) -> Indices:
        """Faces (f, 2) of the surface, or else the outer ones that have all nodes in the node set, of this name.

        Raises StudyError if there is neither, or the node set holds no whole face.
        """
        if name in self.surfaces or name not in self.node_sets:
            return self._named(self.surfaces, name, "surface", self.node_sets)
        inside = np.zeros(self.n_nodes, dtype=bool)
        inside[self.node_sets[name]] = True
        found = self.faces_within(self.boundary_faces(), inside)
        if not len(found):
            raise StudyError(
                f"'{name}' is a node set that holds no whole face of the mesh: name a surface, or all nodes of a face"
            )
        return found

    def surface_nodes(self, name: str) -> Indices:
        """Sorted nodes of a surface, the middle nodes of its faces included; raises as `surface` does."""
        nodes = np.unique(self.face_nodes(self.surface(name)))
        return nodes[nodes >= 0]

    def _named(self, sets: Mapping[str, Indices], name: str, what: str, more: Mapping = {}) -> Indices:
        if name not in sets:
            known = ", ".join(sorted({*sets, *more}, key=natural_order)) or "none"
            why = CLOSED_ONLY if re.fullmatch(r"cavity_\d+", name) else ""
            raise StudyError(f"the mesh has no {what} '{name}'; it has: {known}{why}")
        return sets[name]

    def all_faces(self) -> Indices:
        """Every face of every cell, (f, 2): cell index and local face number."""
        parts = []
        for block, start in zip(self.blocks, self.block_starts()[:-1], strict=True):
            m, n_faces = len(block.connectivity), len(block.type.faces)
            cells = np.repeat(np.arange(start, start + m), n_faces)
            parts.append(np.column_stack([cells, np.tile(np.arange(n_faces), m)]))
        return np.concatenate(parts) if parts else np.empty((0, 2), dtype=np.int64)

    def face_nodes(self, faces: Indices, corners_only: bool = False) -> Indices:
        """Nodes (f, k) of faces (f, 2), in the order of `CellType.faces`; shorter rows end in -1."""
        faces = np.asarray(faces, dtype=np.int64).reshape(-1, 2)
        result = np.full((len(faces), 9), -1, dtype=np.int64)
        starts = self.block_starts()
        for block, start, stop in zip(self.blocks, starts[:-1], starts[1:], strict=True):
            in_block = (faces[:, 0] >= start) & (faces[:, 0] < stop)
            for number, local in enumerate(block.type.faces):
                rows = np.flatnonzero(in_block & (faces[:, 1] == number))
                nodes = np.array(local)
                if corners_only:
                    nodes = nodes[nodes < block.type.corners]
                result[rows, : len(nodes)] = block.connectivity[np.ix_(faces[rows, 0] - start, nodes)]
        return result[:, : int((result >= 0).any(axis=0).sum())]

    def boundary_faces(self) -> Indices:
        """Faces (f, 2) that belong to one cell alone: the outer surface; for sheets, every cell."""
        faces = self.all_faces()
        keys = np.sort(self.face_nodes(faces, corners_only=True), axis=1)
        _, inverse, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
        return faces[counts[inverse.ravel()] == 1]

    def faces_within(self, faces: Indices, inside: NDArray[np.bool_]) -> Indices:
        """Those of faces (f, 2) all of whose nodes are among those ``inside`` (n,)."""
        nodes = self.face_nodes(faces)
        return faces[(inside[nodes] | (nodes < 0)).all(axis=1)]

    def face_triangles(self, faces: Indices) -> Indices:
        """Triangles (t, 3) of node indices over faces (f, 2), through middle nodes, turning as they do."""
        nodes = self.face_nodes(faces)
        sizes = (nodes >= 0).sum(axis=1)
        parts = [
            nodes[sizes == size][:, np.array(triangles)].reshape(-1, 3)
            for size, triangles in _FACE_TRIANGLES.items()
            if (sizes == size).any()
        ]
        return np.concatenate(parts) if parts else np.empty((0, 3), dtype=np.int64)

    def surface_triangles(self) -> Indices:
        """Outward triangles (t, 3) of the outer surface, through corner and middle nodes; for drawing."""
        return self.face_triangles(self.boundary_faces())

    def scaled(self, factor: float) -> Mesh:
        """The mesh with its coordinates times ``factor``."""
        return replace(self, nodes=self.nodes * factor)

    def renumbered(self, new_index: Indices, nodes: Array) -> Mesh:
        """The mesh on other ``nodes``: old node i becomes ``new_index[i]``; -1 drops it from all sets."""

        def moved(old: Indices) -> Indices:
            new = np.unique(new_index[old])
            return new[new >= 0]

        blocks = tuple(CellBlock(block.cell_type, new_index[block.connectivity]) for block in self.blocks)
        sets = {name: moved(old) for name, old in self.node_sets.items()}
        return replace(self, nodes=nodes, blocks=blocks, node_sets=sets)

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which nodes (n,) belong to cells."""
        used = np.zeros(self.n_nodes, dtype=bool)
        for block in self.blocks:
            used[block.connectivity] = True
        return used

    def without_unused_nodes(self) -> Mesh:
        """The mesh without the nodes that belong to no cell."""
        used = self.used
        return self.renumbered(np.where(used, np.cumsum(used) - 1, -1), self.nodes[used])


def faces_of_cells(cells: Indices) -> Indices:
    """Faces (m, 2) of cells (m,) of a sheet: each is its own."""
    return np.column_stack([cells, np.zeros_like(cells)])


#: Cells whose Jacobians are held at once.
_CHUNK = 4096


def model_mesh_of(mesh: Mesh) -> ModelMesh:
    """All nodes, the outer surface in triangles, and, for solids, the cells."""
    return ModelMesh(
        nodes=mesh.nodes,
        triangles=mesh.surface_triangles(),
        weights=lumped_weights(mesh),
        cells={} if mesh.is_sheet else cells_by_type(mesh),
    )


def cells_by_type(mesh: Mesh) -> dict[str, Indices]:
    """Connectivity (m, k) of all cells of each type, block after block, by the name of the type."""
    found: dict[str, list[Indices]] = {}
    for block in mesh.blocks:
        found.setdefault(block.cell_type, []).append(block.connectivity)
    return {name: np.concatenate(parts) for name, parts in found.items()}


def lumped_weights(mesh: Mesh) -> Array:
    """Share (n,) of each node in the volume (area, of sheets), each cell's split evenly among its nodes."""
    weights = np.zeros(mesh.n_nodes)
    for block in mesh.blocks:
        points, quadrature = block.type.quadrature()
        gradients = block.type.shape_gradients(points)
        for cells in np.array_split(block.connectivity, max(1, len(block.connectivity) // _CHUNK)):
            jacobians = np.einsum("mka,pkb->mpab", mesh.nodes[cells], gradients)
            # sqrt(det J'J) is |det J| in solids and the area ratio in sheets.
            metric = np.einsum("mpab,mpac->mpbc", jacobians, jacobians)
            sizes = np.sqrt(np.linalg.det(metric)) @ quadrature
            np.add.at(weights, cells, (sizes / cells.shape[1])[:, None])
    return weights / weights.sum()


def find_faces(mesh: Mesh, corners: Indices) -> Indices:
    """Faces (f, 2), cell and local face number, that have the given corners (f, 3 or 4) in any order.

    Between two cells it is the first one's face; where no cell has such a face the row is -1.
    """
    faces = mesh.all_faces()
    known = mesh.face_nodes(faces, corners_only=True)
    keys = np.full((len(known) + len(corners), 4), -1, dtype=np.int64)
    keys[: len(known), : known.shape[1]], keys[len(known) :, : corners.shape[1]] = known, corners
    _, ids = np.unique(np.sort(keys, axis=1), axis=0, return_inverse=True)
    ids = ids.ravel()
    first = np.full(len(keys), -1)
    first[ids[: len(known)][::-1]] = np.arange(len(known))[::-1]
    return np.vstack([faces, [[-1, -1]]])[first[ids[len(known) :]]]


#: Faces end a mesh along an axis if they are this part of its length there away from its end at most; single precision
#: and the decimation of surfaces leave such a flat end uneven.
AT_END = 1e-4
#: The most that faces which join go away from the end, as a part of their width: more is the pole of a curved surface.
CURVED = 1e-3


def end_surfaces(mesh: Mesh) -> dict[str, Indices]:
    """Boundary faces (f, 2) in the planes where a mesh ends along an axis: "x_min", "x_max", ..., those there are."""
    faces = mesh.boundary_faces()
    nodes = mesh.face_nodes(faces, corners_only=True)
    points = np.where((nodes >= 0)[:, :, None], mesh.nodes[nodes], np.nan)
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    found = {}
    for axis, letter in enumerate("xyz"):
        for name, end in (("min", low[axis]), ("max", high[axis])):
            away = np.nanmax(np.abs(points[:, :, axis] - end), axis=1)
            near = away <= AT_END * (high[axis] - low[axis])
            found[f"{letter}_{name}"] = faces[near][_flat(mesh, faces[near], away[near])]
    return {name: ends for name, ends in found.items() if len(ends)}


def _flat(mesh: Mesh, faces: Indices, away: Array) -> NDArray[np.bool_]:
    """Which of faces (f, 2), ``away`` (f,) from a plane, m, lie in it with all that join them (`CURVED`)."""
    flat = np.zeros(len(faces), dtype=bool)
    parts = parts_of(mesh, faces) if len(faces) else np.empty(0)
    for part in np.unique(parts):
        of_part = parts == part
        corners = mesh.nodes[mesh.face_triangles(faces[of_part])]
        area = (
            np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2.0
        )
        width = area / np.ptp(corners.reshape(-1, 3), axis=0).max()
        flat[of_part] = away[of_part].max() <= CURVED * width
    return flat


def with_found_surfaces(mesh: Mesh) -> Mesh:
    """A solid mesh with its flat ends (`end_surfaces`) and the walls of its closed cavities as surfaces.

    Names that the mesh has already stay what they are; the others are in ``found``.
    """
    if mesh.is_sheet:
        return mesh
    named = {*mesh.surfaces, *mesh.node_sets, *mesh.cell_sets}
    new = {name: faces for name, faces in (end_surfaces(mesh) | _cavities(mesh)).items() if name not in named}
    return replace(mesh, surfaces={**mesh.surfaces, **new}, found=mesh.found | new.keys())


def parts_of_cells(mesh: Mesh) -> tuple[int, Indices]:
    """How many parts that share no node a mesh falls into, and the number of its part (n,) of each node.

    A node of no cell is a part of its own.
    """
    ends = [np.broadcast_arrays(block.connectivity[:, :1], block.connectivity) for block in mesh.blocks]
    row, column = np.concatenate([np.reshape(pair, (2, -1)) for pair in ends], axis=1)
    links = sparse.coo_array((np.ones(len(row)), (row, column)), shape=(mesh.n_nodes, mesh.n_nodes))
    return csgraph.connected_components(links, directed=False)


def parts_of(mesh: Mesh, faces: Indices) -> Indices:
    """Numbers (f,) from 0 of the parts into which faces (f, 2) fall: those that share nodes are of one."""
    nodes = mesh.face_nodes(faces, corners_only=True)
    ends = np.concatenate([nodes[nodes[:, k] >= 0][:, [0, k]] for k in range(1, nodes.shape[1])]).T
    graph = sparse.coo_array((np.ones(ends.shape[1]), ends), shape=(mesh.n_nodes, mesh.n_nodes))
    labels = csgraph.connected_components(graph, directed=False)[1][nodes[:, 0]]
    return np.unique(labels, return_inverse=True)[1].ravel()


def _cavities(mesh: Mesh) -> dict[str, Indices]:
    """Walls of closed cavities, "cavity_1", ..., in the order of their centres along x, then y, then z."""
    faces = mesh.boundary_faces()
    of_face, found = parts_of(mesh, faces), []
    for label in np.unique(of_face) if len(np.unique(of_face)) > 1 else ():
        wall = faces[of_face == label]
        corners = mesh.nodes[mesh.face_triangles(wall)]
        # A wall that faces inwards bounds less than no volume (divergence theorem).
        if np.linalg.det(corners).sum() < 0.0:
            found.append((np.round(corners.mean(axis=(0, 1)) / np.ptp(mesh.nodes), 6).tolist(), wall))
    found.sort(key=lambda each: each[0])
    return {f"cavity_{number}": wall for number, (_, wall) in enumerate(found, start=1)}


def jacobian_determinants(mesh: Mesh, block: CellBlock) -> Array:
    """Volume (sheets: area) stretch (m, p) of each cell of a block at its quadrature points; SI.

    Negative where a solid cell is turned inside out.
    """
    points, _ = block.type.quadrature()
    gradients = block.type.shape_gradients(points)
    jacobians = np.einsum("mka,pkb->mpab", mesh.nodes[block.connectivity], gradients, optimize=True)
    if block.type.dimension == 2:
        return np.linalg.norm(np.cross(jacobians[..., 0], jacobians[..., 1]), axis=-1)
    return np.linalg.det(jacobians)


def cell_sizes(mesh: Mesh) -> Array:
    """Volume (c,) of each cell, m3; of a sheet's cells the area, m2."""
    return np.concatenate([jacobian_determinants(mesh, block) @ block.type.quadrature()[1] for block in mesh.blocks])
