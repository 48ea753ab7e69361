"""Checks of a surface mesh that a shell needs beyond `mesh_checks`: one sheet without branches, one side up."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.errors import StudyError
from morph_dslam.meshing.mesh_checks import place
from morph_dslam.meshing.meshes import Mesh

Indices = NDArray[np.int64]
#: Points nearer to an edge than this part of its length lie on it.
ON_EDGE = 1e-6


def mesh_edges(mesh: Mesh) -> tuple[Indices, Indices]:
    """Every edge of every cell of a surface: (e, 3) from, to, and the node between or -1, and its cell (e,).

    Edges run as the cell turns.
    """
    nodes, cells = [], []
    for block, start in zip(mesh.blocks, mesh.block_starts()[:-1], strict=True):
        corners = block.type.corners
        for first in range(corners):
            second = (first + 1) % corners
            middle = block.connectivity[:, corners + first] if block.type.order == 2 else -1
            row = np.full((len(block.connectivity), 3), -1, dtype=np.int64)
            row[:, 0], row[:, 1], row[:, 2] = block.connectivity[:, first], block.connectivity[:, second], middle
            nodes.append(row)
            cells.append(np.arange(start, start + len(row)))
    return np.concatenate(nodes), np.concatenate(cells)


def check_surface(mesh: Mesh) -> None:
    """Raise StudyError where cells do not make one surface with a normal.

    Checked are edges with more than two cells, corners in the middle of an edge of other cells, and neighbours with
    opposite sides up.
    """
    nodes, of_cell = mesh_edges(mesh)
    ends = nodes[:, :2]
    _, first, which, counts = np.unique(
        np.sort(ends, axis=1), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    which = which.ravel()
    crowded = np.flatnonzero(counts > 2)
    if len(crowded):
        raise StudyError(
            f"{len(crowded)} edges of the surface have more than two cells (a T-junction), the first "
            f"{place(mesh, ends[first[crowded[0]]])}; a shell is one surface without branches: remove the extra cells"
        )
    _check_hanging(mesh, ends[first[counts == 1]])
    # Neighbours that turn alike run along their common edge in opposite directions.
    rising = np.bincount(which, weights=np.where(ends[:, 0] < ends[:, 1], 1.0, -1.0))
    turned = np.flatnonzero((counts == 2) & (rising != 0.0))
    if len(turned):
        cells = np.sort(of_cell[which == turned[0]])
        raise StudyError(
            f"neighbouring cells of the surface have opposite sides up at {len(turned)} edges, the first "
            f"{place(mesh, ends[first[turned[0]]])} between cells {cells[0]} and {cells[1]}; list the nodes of all "
            "cells anticlockwise as seen from one side"
        )


def _check_hanging(mesh: Mesh, rim: Indices) -> None:
    """Refuse corners of the ``rim`` (e, 2) that lie on one of its edges but are not its ends (StudyError)."""
    corners = np.unique(rim)
    if not len(corners):
        return
    start, along = mesh.nodes[rim[:, 0]], mesh.nodes[rim[:, 1]] - mesh.nodes[rim[:, 0]]
    length = np.linalg.norm(along, axis=1)
    near = KDTree(mesh.nodes[corners]).query_ball_point(start + along / 2.0, length / 2.0 * (1.0 - ON_EDGE))
    for edge, found in enumerate(near):
        offset = mesh.nodes[corners[found]] - start[edge]
        beside = np.linalg.norm(np.cross(offset, along[edge]), axis=1) / length[edge]
        hanging = corners[found][beside < ON_EDGE * length[edge]]
        if len(hanging):
            raise StudyError(
                f"node {hanging[0]} of the surface {place(mesh, hanging[:1])} lies in the middle of an edge of a "
                "cell that does not have it (a T-junction): divide that cell, or close the gap beside it"
            )
