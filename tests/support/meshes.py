"""Measures of meshes, and a sheet of one cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.meshing.meshes import CellBlock, Mesh, jacobian_determinants

Array = NDArray[np.float64]
CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
SHEET = Mesh(CORNERS, (CellBlock("quad4", np.array([[0, 1, 2, 3]])),), node_sets={"x_min": np.array([0, 3])})


def cell_volumes(mesh: Mesh) -> Array:
    """Volume (m^3) of each cell, (n_cells,); of a sheet's cells the area (m^2)."""
    return np.concatenate([jacobian_determinants(mesh, block) @ block.type.quadrature()[1] for block in mesh.blocks])


def centroid(mesh: Mesh) -> Array:
    """Centre of volume (3,) of a mesh of cells of one type."""
    (block,) = mesh.blocks
    points, weights = block.type.quadrature()
    measures = jacobian_determinants(mesh, block) * weights
    places = np.einsum("pk,mka->mpa", block.type.shape_functions(points), mesh.nodes[block.connectivity])
    return np.einsum("mp,mpa->a", measures, places) / measures.sum()


def surface_area(mesh: Mesh, name: str) -> float:
    """Area (m^2) of a named surface, drawn through corner and middle nodes."""
    a, b, c = np.moveaxis(mesh.nodes[mesh.face_triangles(mesh.surface(name))], 1, 0)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
