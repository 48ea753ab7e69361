"""What a mesh and its named sets are, in words and figures: which face of a part is `face_7`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from morph_dslam.meshing.meshes import Mesh, faces_of_cells, natural_order

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Columns of `set_rows`.
SET_COLUMNS = ("set", "of", "number", "area mm2", "centre mm", "mean normal")
#: A mean of unit normals shorter than this has no direction: the surface is closed, or nearly.
NO_DIRECTION = 0.1


def described_mesh(mesh: Mesh) -> str:
    """Extent and numbers of cells and nodes on one line."""
    extent = " x ".join(f"{1e3 * length:.4g}" for length in np.ptp(mesh.nodes, axis=0))
    kinds: dict[str, int] = {}
    for block in mesh.blocks:
        kinds[block.cell_type] = kinds.get(block.cell_type, 0) + len(block.connectivity)
    cells = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    return f"{extent} mm, {cells}, {mesh.n_nodes} nodes"


def faces_figures(mesh: Mesh, faces: Indices) -> tuple[float, Array, Array]:
    """Area, m2, centre (3,), m, and mean (3,) of the unit normals of faces (f, 2), outwards of solids."""
    corners = mesh.nodes[mesh.face_triangles(faces)]
    halves = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2.0
    areas = np.linalg.norm(halves, axis=1)
    area = float(areas.sum())
    return area, areas @ corners.mean(axis=1) / area, halves.sum(axis=0) / area


def unit_normals(mesh: Mesh, faces: Indices) -> Array:
    """Mean normals (f, 3) of faces (f, 2), of length one, outwards of solids."""
    nodes = mesh.face_nodes(faces, corners_only=True)
    corners = mesh.nodes[nodes]
    # Half the cross product of the diagonals is the vector area, of a triangle too if it repeats its last corner.
    last = np.where((nodes[:, -1] >= 0)[:, None], corners[:, -1], corners[:, 2])
    normals = np.cross(corners[:, 2] - corners[:, 0], last - corners[:, 1])
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def set_rows(mesh: Mesh) -> list[list[str]]:
    """A row of `SET_COLUMNS` for each surface, node set and cell set, each kind in the order of names.

    A node set of the name of a surface is left out. Cell sets of sheets have an area and a normal, those of solids not.
    """
    rows = [_face_row(name, "faces", mesh, mesh.surfaces[name]) for name in _ordered(mesh.surfaces)]
    for name in _ordered(mesh.cell_sets):
        cells = mesh.cell_sets[name]
        if mesh.is_sheet:
            rows.append(_face_row(name, "cells", mesh, faces_of_cells(cells)))
        else:
            rows.append([name, "cells", str(len(cells)), "", "", ""])
    for name in _ordered({key: nodes for key, nodes in mesh.node_sets.items() if key not in mesh.surfaces}):
        nodes = mesh.node_sets[name]
        centre = _millimetres(mesh.nodes[nodes].mean(axis=0)) if len(nodes) else ""
        rows.append([name, "nodes", str(len(nodes)), "", centre, ""])
    return rows


def _ordered(sets: Mapping[str, Indices]) -> list[str]:
    return sorted(sets, key=natural_order)


def _face_row(name: str, of: str, mesh: Mesh, faces: Indices) -> list[str]:
    if not len(faces):
        return [name, of, "0", "", "", ""]
    area, centre, normal = faces_figures(mesh, faces)
    length = float(np.linalg.norm(normal))
    direction = "none" if length < NO_DIRECTION else " ".join(f"{x + 0.0:.2f}" for x in np.round(normal / length, 2))
    return [name, of, str(len(faces)), f"{1e6 * area:.4g}", _millimetres(centre), direction]


def _millimetres(point: Array) -> str:
    return " ".join(f"{x + 0.0:.4g}" for x in np.round(1e3 * point, 6))
