"""What mesh files often hold and a solver cannot take: mirrored cells, and hexahedra collapsed to prisms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from morph_dslam.meshing.meshes import CellBlock, Mesh, find_faces, jacobian_determinants
from morph_dslam.model.cell_types import CellType


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


#: Pairs of a hexahedron's edges, opposite on one face, and the nodes of the prism left if both vanish.
_COLLAPSES = (
    (((0, 1), (3, 2)), [0, 4, 5, 3, 7, 6]),
    (((0, 1), (4, 5)), [0, 2, 3, 4, 6, 7]),
    (((1, 2), (0, 3)), [1, 5, 6, 0, 4, 7]),
    (((1, 2), (5, 6)), [1, 3, 0, 5, 7, 4]),
    (((2, 3), (6, 7)), [2, 0, 1, 6, 4, 5]),
    (((3, 0), (7, 4)), [3, 1, 2, 7, 5, 6]),
    (((4, 5), (7, 6)), [4, 1, 0, 7, 2, 3]),
    (((5, 6), (4, 7)), [5, 2, 1, 4, 3, 0]),
    (((0, 4), (1, 5)), [0, 3, 7, 1, 2, 6]),
    (((0, 4), (3, 7)), [0, 5, 1, 3, 6, 2]),
    (((1, 5), (2, 6)), [1, 0, 4, 2, 3, 7]),
    (((2, 6), (3, 7)), [2, 1, 5, 3, 0, 4]),
)


def without_collapsed_cells(mesh: Mesh) -> Mesh:
    """Make prisms of first-order hexahedra that list two nodes twice, as meshes around an axis do.

    The prisms come after all other cells; cell sets and surfaces follow their cells.
    """
    starts, kept, prisms, numbers = mesh.block_starts(), [], [], []
    order = []
    for block, start in zip(mesh.blocks, starts[:-1], strict=True):
        cells = np.arange(start, start + len(block.connectivity))
        collapsed = np.zeros(len(cells), dtype=bool)
        for ((a, b), (c, d)), prism in _COLLAPSES if block.cell_type == "hex8" else ():
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
