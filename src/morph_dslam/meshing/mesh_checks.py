"""Checks of a mesh before anything is solved on it; each message says which cells, where, and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from morph_dslam.errors import StudyError
from morph_dslam.meshing.cell_types import CellType, cell_type
from morph_dslam.meshing.meshes import CellBlock, Mesh, find_faces, jacobian_determinants

Indices = NDArray[np.int64]

#: Diagonals of the bounding box (metres) beyond which a length unit was probably mistaken.
LARGEST, SMALLEST = 5.0, 1e-4


def check_mesh(mesh: Mesh, sets: Iterable[str] = (), regions: Iterable[str] = ()) -> None:
    """Raise StudyError at the first thing that would make a solution wrong or impossible.

    Checked in this order: nodes and cells exist and are finite; sets name what exists; the size is plausible
    for metres; no two cells are the same; no cell is inverted, folded or flat; no face has three cells; every
    node belongs to a cell; all is one part; the sets that the study names are there.

    Parameters
    ----------
    mesh : the mesh, metres.
    sets : node sets or surfaces that a study refers to.
    regions : cell sets that a study refers to.
    """
    _check_arrays(mesh)
    check_size(mesh)
    _check_duplicates(mesh)
    _check_orientation(mesh)
    _check_faces(mesh)
    _check_connection(mesh)
    for name in sets:
        if not len(mesh.set_nodes(name)):
            raise StudyError(f"the set '{name}' is empty; name a set that holds nodes")
    for name in regions:
        if not len(mesh.cells(name)):
            raise StudyError(f"the cell set '{name}' is empty; name a set that holds cells")


def _check_arrays(mesh: Mesh) -> None:
    if not mesh.n_nodes or not mesh.n_cells:
        raise StudyError(f"the mesh has {mesh.n_nodes} nodes and {mesh.n_cells} cells; it needs some of both")
    bad = np.flatnonzero(~np.isfinite(mesh.nodes).all(axis=1))
    if len(bad):
        raise StudyError(f"{len(bad)} nodes have coordinates that are not finite, the first at index {bad[0]}")
    if len({block.type.dimension for block in mesh.blocks}) > 1:
        raise StudyError("the mesh mixes solid and sheet cells; keep one kind, in a file of its own")
    named = [("cells", block.cell_type, block.connectivity, mesh.n_nodes) for block in mesh.blocks]
    named += [("node set", name, nodes, mesh.n_nodes) for name, nodes in mesh.node_sets.items()]
    named += [("cell set", name, cells, mesh.n_cells) for name, cells in mesh.cell_sets.items()]
    named += [("surface", name, faces[:, 0], mesh.n_cells) for name, faces in mesh.surfaces.items()]
    for what, name, numbers, count in named:
        if numbers.size and not 0 <= numbers.min() <= numbers.max() < count:
            raise StudyError(f"the {what} '{name}' refer to index {numbers.max()}, but there are {count}")


def check_size(mesh: Mesh) -> None:
    """Refuse a mesh of a size that no object has here: its unit is probably wrong; raises StudyError."""
    extent = np.ptp(mesh.nodes, axis=0)
    diagonal = float(np.linalg.norm(extent))
    if SMALLEST <= diagonal <= LARGEST:
        return
    size = " x ".join(f"{length:.3g}" for length in extent)
    guess = "smaller one such as mm" if diagonal > LARGEST else "larger one such as m"
    raise StudyError(
        f"the mesh measures {size} m, which is hardly meant: its unit of length is probably wrong; "
        f"declare the unit in which it was drawn (a {guess})"
    )


def _check_orientation(mesh: Mesh) -> None:
    for block, start in zip(mesh.blocks, mesh.block_starts()[:-1], strict=True):
        determinants = jacobian_determinants(mesh, block)
        # Rounding leaves a flat cell a volume of either sign; its size cubed is what to measure it by.
        corners = mesh.nodes[block.connectivity[:, : block.type.corners]]
        size = np.ptp(corners, axis=1).max(axis=1) ** block.type.dimension
        worst = determinants.min(axis=1)
        bad = np.flatnonzero(worst <= 1e-12 * size)
        if not len(bad):
            continue
        where = _place(mesh, block.connectivity[bad[0]])
        if len(bad) == len(worst) and (determinants < 0.0).all():
            raise StudyError(
                f"every {block.cell_type} cell is inverted: their nodes are listed in mirrored order; "
                "list them as VTK or Abaqus does"
            )
        kind = "inverted or folded" if worst[bad].min() < -1e-12 * size[bad].max() else "flat"
        raise StudyError(
            f"{len(bad)} of {len(worst)} {block.cell_type} cells are {kind}, the first cell {start + bad[0]} "
            f"{where}; mend the mesh there (a wall thicker than its bend's radius folds its cells)"
        )


def _check_duplicates(mesh: Mesh) -> None:
    for block, start in zip(mesh.blocks, mesh.block_starts()[:-1], strict=True):
        ordered = np.sort(block.connectivity, axis=1)
        repeated = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
        if len(repeated):
            raise StudyError(
                f"{len(repeated)} {block.cell_type} cells use a node twice, the first cell "
                f"{start + repeated[0]} {_place(mesh, block.connectivity[repeated[0]])}; "
                "use cells of the shape that is left instead (a prism, say)"
            )
        _, first, counts = np.unique(ordered, axis=0, return_index=True, return_counts=True)
        double = first[counts > 1]
        if len(double):
            raise StudyError(
                f"{len(double)} {block.cell_type} cells are there more than once, the first cell "
                f"{start + double[0]} {_place(mesh, block.connectivity[double[0]])}; remove the copies"
            )


def _check_faces(mesh: Mesh) -> None:
    if mesh.blocks[0].type.dimension == 2:
        return
    faces = mesh.all_faces()
    keys, counts = np.unique(np.sort(mesh.face_nodes(faces, corners_only=True), axis=1), axis=0, return_counts=True)
    crowded = np.flatnonzero(counts > 2)
    if len(crowded):
        nodes = keys[crowded[0]]
        raise StudyError(
            f"{len(crowded)} faces have more than two cells, the first {_place(mesh, nodes[nodes >= 0])}; "
            "cells overlap there: remove the extra ones"
        )


def _check_connection(mesh: Mesh) -> None:
    rows = [block.connectivity[:, :1].repeat(block.connectivity.shape[1], axis=1) for block in mesh.blocks]
    row = np.concatenate([part.ravel() for part in rows])
    column = np.concatenate([block.connectivity.ravel() for block in mesh.blocks])
    links = coo_array((np.ones(len(row)), (row, column)), shape=(mesh.n_nodes, mesh.n_nodes))
    _, part = connected_components(links, directed=False)
    used = np.unique(column)
    if len(used) < mesh.n_nodes:
        loose = np.setdiff1d(np.arange(mesh.n_nodes), used)
        raise StudyError(
            f"{len(loose)} nodes belong to no cell, the first at {_millimetres(mesh.nodes[loose[0]])}; remove them"
        )
    sizes = np.bincount(part)
    if len(sizes) > 1:
        second = np.flatnonzero(part == np.argsort(-sizes)[1])
        raise StudyError(
            f"the mesh falls into {len(sizes)} parts that share no node; the second largest has "
            f"{len(second)} nodes {_place(mesh, second)}: merge coincident nodes, or keep one part"
        )


def _millimetres(point: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{1e3 * x:.4g}" for x in point) + ") mm"


def _place(mesh: Mesh, nodes: Indices) -> str:
    return f"around {_millimetres(mesh.nodes[nodes].mean(axis=0))}"


# What mesh files often hold and a solver cannot take: mirrored cells, and hexahedra collapsed to prisms.


def _with_faces_found_again(mesh: Mesh, old: Mesh) -> Mesh:
    """``mesh`` with the surfaces of ``old``, found by their corners; faces that collapsed are left out."""
    surfaces = {}
    for name, faces in old.surfaces.items():
        corners = np.sort(old.face_nodes(faces, corners_only=True), axis=1)
        corners[:, 1:][corners[:, 1:] == corners[:, :-1]] = -1
        found = find_faces(mesh, corners[(corners >= 0).sum(axis=1) >= 3])
        surfaces[name] = found[found[:, 0] >= 0]
    return replace(mesh, surfaces=surfaces)


def _mirrored_order(kind: CellType) -> list[int]:
    """For each node the one opposite it across the plane x = y of the reference cell."""
    swapped = kind.nodes[:, [1, 0, 2]]
    return [int(np.argmin(np.linalg.norm(kind.nodes - place, axis=1))) for place in swapped]


def reoriented(mesh: Mesh) -> Mesh:
    """Turn the node order round in each block of solids all of whose cells have negative volume.

    Some programs list every cell mirrored; a block of which only some cells are inverted is left for
    `check_mesh` to refuse.
    """
    blocks = list(mesh.blocks)
    for i, block in enumerate(mesh.blocks):
        kind = block.type
        if kind.dimension == 3 and len(block.connectivity):
            volumes = jacobian_determinants(mesh, block) @ kind.quadrature()[1]
            if (volumes < 0.0).all():
                blocks[i] = CellBlock(kind.name, block.connectivity[:, _mirrored_order(kind)])
    if all(new is old for new, old in zip(blocks, mesh.blocks, strict=True)):
        return mesh
    return _with_faces_found_again(replace(mesh, blocks=tuple(blocks)), mesh)


def _collapses() -> list[tuple[tuple[tuple[int, int], tuple[int, int]], list[int]]]:
    """Pairs of a hexahedron's edges, opposite on one face, and the nodes of the prism left if both vanish."""
    hexahedron = cell_type("hex8")
    edges = cell_type("hex20").parents
    gaps = np.linalg.norm(hexahedron.nodes[:, None] - hexahedron.nodes, axis=2)
    result = []
    for one, other in combinations(edges, 2):
        a, b = hexahedron.nodes[list(one)]
        c, d = hexahedron.nodes[list(other)]
        face = set(one) | set(other)
        if len(face) < 4 or not any(face == set(corners) for corners in hexahedron.faces):
            continue
        if np.dot(b - a, d - c) < 0.0:
            other = other[::-1]
        ends = []
        for edge in (one, other):
            (side,) = [set(f) for f in hexahedron.faces if set(edge) <= set(f) and set(f) != face]
            # The triangle left of that side: where the edge was, then the corners beyond, the near one first.
            beyond = sorted(side - set(edge), key=gaps[edge[0]].__getitem__)
            ends.append([edge[0], *beyond])
        base, top = hexahedron.nodes[ends[0]], hexahedron.nodes[ends[1]]
        if np.dot(np.cross(base[1] - base[0], base[2] - base[0]), top[0] - base[0]) < 0.0:
            ends = [[x, z, y] for x, y, z in ends]
        result.append(((one, other), ends[0] + ends[1]))
    return result


def without_collapsed_cells(mesh: Mesh) -> Mesh:
    """Make prisms of first-order hexahedra that list two nodes twice, as meshes around an axis do.

    The prisms come after all other cells; cell sets and surfaces follow their cells.
    """
    starts, kept, prisms, numbers = mesh.block_starts(), [], [], []
    order = []
    for block, start in zip(mesh.blocks, starts[:-1], strict=True):
        cells = np.arange(start, start + len(block.connectivity))
        collapsed = np.zeros(len(cells), dtype=bool)
        for ((a, b), (c, d)), prism in _collapses() if block.cell_type == "hex8" else ():
            nodes = block.connectivity
            twice = (nodes[:, a] == nodes[:, b]) & (nodes[:, c] == nodes[:, d]) & ~collapsed
            prisms.append(nodes[twice][:, prism])
            numbers.append(cells[twice])
            collapsed |= twice
        kept.append(CellBlock(block.cell_type, block.connectivity[~collapsed]))
        order.append(cells[~collapsed])
    moved = np.concatenate(numbers) if numbers else np.empty(0, dtype=np.int64)
    if not len(moved):
        return mesh
    new_number = np.argsort(np.concatenate([*order, moved]))
    blocks = (*(block for block in kept if len(block.connectivity)), CellBlock("prism6", np.concatenate(prisms)))
    sets = {name: np.sort(new_number[cells]) for name, cells in mesh.cell_sets.items()}
    return _with_faces_found_again(replace(mesh, blocks=blocks, cell_sets=sets), mesh)
