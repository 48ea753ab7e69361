"""What mesh files often hold and a solver cannot take: mirrored cells, and hexahedra collapsed to prisms."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from morph_dslam.meshing.cell_types import CellType, cell_type
from morph_dslam.meshing.meshes import CellBlock, Mesh, find_faces, jacobian_determinants


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
