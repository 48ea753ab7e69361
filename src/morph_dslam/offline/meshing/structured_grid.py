"""Structured grids of unit cells, which the mesh generators bend into shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.offline.meshing.cell_types import cell_type
from morph_dslam.offline.meshing.mesh_conversion import FIRST_ORDER, to_second_order
from morph_dslam.offline.meshing.meshes import CellBlock, Mesh

Indices = NDArray[np.int64]

#: Solid cell types, all of which the solid generators make.
SOLIDS = ("hex8", "hex20", "hex27", "tet4", "tet10", "prism6", "prism15", "prism18")

#: How a unit cube, its corners numbered as a hex8's, is cut into cells; cubes side by side match.
CUTS: dict[str, tuple[tuple[int, ...], ...]] = {
    "hex8": ((0, 1, 2, 3, 4, 5, 6, 7),),
    "prism6": ((0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7)),
    "tet4": (
        (0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6),
    ),
    "quad4": ((0, 1, 2, 3),),
    "tri3": ((0, 1, 2), (0, 2, 3)),
}  # fmt: skip


def check_divisions(divisions: tuple[int, ...], count: int, names: str) -> None:
    """Raise StudyError unless there are ``count`` divisions, whole and positive; ``names`` says of what."""
    if len(divisions) != count or any(int(n) != n or n < 1 for n in divisions):
        raise StudyError(
            f"divisions are {tuple(divisions)}; give {count} whole numbers of at least 1: {names}"
        )


def check_type(name: str, known: tuple[str, ...]) -> None:
    """Raise StudyError unless the cell type is one that the generator knows."""
    if name not in known:
        raise StudyError(f"'{name}' is not a cell type of this generator; use one of {', '.join(known)}")


def unit_grid(kept: NDArray[np.bool_], name: str) -> Mesh:
    """Unit cubes at whole-number coordinates, where ``kept`` (n, m, l) is true, cut into cells of a type."""
    shape = tuple(n + 1 for n in kept.shape)
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    corners = cell_type("hex8").nodes.astype(np.int64)
    cubes = (np.argwhere(kept)[:, None, :] + corners) @ strides
    first_order = FIRST_ORDER.get(name, name)
    cut = np.array(CUTS[first_order])
    blocks = (CellBlock(first_order, cubes[:, cut].reshape(-1, cut.shape[1])),)
    mesh = Mesh(np.argwhere(np.ones(shape, dtype=bool)).astype(np.float64), blocks).without_unused_nodes()
    return mesh if first_order == name else to_second_order(mesh, name)


def with_surfaces(mesh: Mesh, surfaces: dict[str, Indices]) -> Mesh:
    """Name surfaces, and the set of nodes of each by the same name; empty ones are left out."""
    mesh = replace(mesh, surfaces={name: faces for name, faces in surfaces.items() if len(faces)})
    return replace(mesh, node_sets={name: mesh.surface_nodes(name) for name in mesh.surfaces})
