"""Cells of first order made cells of second order: middle nodes added halfway between corners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.meshing.meshes import CellBlock, Mesh
from morph_dslam.model.cell_types import cell_type

Indices = NDArray[np.int64]
#: Second-order types by the first-order type that they refine.
SECOND_ORDER: dict[str, tuple[str, ...]] = {
    "tri3": ("tri6",),
    "quad4": ("quad9", "quad8"),
    "hex8": ("hex20", "hex27"),
    "tet4": ("tet10",),
    "prism6": ("prism15", "prism18"),
}
FIRST_ORDER = {name: linear for linear, names in SECOND_ORDER.items() for name in names}


def _target(block: CellBlock, wanted: tuple[str, ...]) -> str:
    known = SECOND_ORDER.get(block.cell_type, ())
    if not known:
        raise StudyError(f"{block.cell_type} cells cannot be given middle nodes; only {', '.join(SECOND_ORDER)} can")
    return next((name for name in wanted if name in known), known[0])


def _corners_around(connectivity: Indices, parents: tuple[tuple[int, ...], ...]) -> Indices:
    """(m * len(parents), 8) sorted corners around each middle node; shorter rows begin with -1."""
    around = np.full((len(connectivity), len(parents), 8), -1, dtype=np.int64)
    for i, parent in enumerate(parents):
        around[:, i, : len(parent)] = connectivity[:, parent]
    return np.sort(around.reshape(-1, 8), axis=1)


def to_second_order(mesh: Mesh, *wanted: str) -> Mesh:
    """Give every cell its middle nodes, halfway between the corners around them.

    A node set takes in the middle nodes all of whose corners it holds; one that bears the name of a surface takes in
    that surface's. Surfaces and cell sets stay as they are. Raises StudyError if a cell is of second order
    already.

    Parameters
    ----------
    mesh : cells of first order only.
    wanted : second-order types such as "hex20"; the first of each type in `SECOND_ORDER` where none is named.
    """
    targets = [_target(block, wanted) for block in mesh.blocks]
    around = [
        _corners_around(block.connectivity, cell_type(name).parents)
        for block, name in zip(mesh.blocks, targets, strict=True)
    ]
    corners, numbers = np.unique(np.concatenate(around), axis=0, return_inverse=True)
    valid = corners >= 0
    positions = np.where(valid[:, :, None], mesh.nodes[corners], 0.0).sum(axis=1) / valid.sum(axis=1)[:, None]
    blocks, first = [], 0
    for block, name, rows in zip(mesh.blocks, targets, around, strict=True):
        middle = mesh.n_nodes + numbers.ravel()[first : first + len(rows)]
        first += len(rows)
        new = np.hstack([block.connectivity, middle.reshape(len(block.connectivity), -1)])
        blocks.append(CellBlock(name, new))
    sets = {}
    for name, nodes in mesh.node_sets.items():
        member = np.zeros(mesh.n_nodes, dtype=bool)
        member[nodes] = True
        added = mesh.n_nodes + np.flatnonzero((member[corners] | ~valid).all(axis=1))
        sets[name] = np.concatenate([np.unique(nodes), added])
    refined = replace(mesh, nodes=np.vstack([mesh.nodes, positions]), blocks=tuple(blocks), node_sets=sets)
    on_surfaces = {name: refined.surface_nodes(name) for name in sets if name in mesh.surfaces}
    return replace(refined, node_sets={**sets, **on_surfaces})
