"""Measures of a mesh by quadrature on its cells: volumes, centroids, areas, Jacobians."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.offline.meshing.meshes import CellBlock, Mesh

Array = NDArray[np.float64]


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


def cell_volumes(mesh: Mesh) -> Array:
    """Volume (m^3) of each cell, (n_cells,); of a sheet's cells the area (m^2)."""
    parts = [jacobian_determinants(mesh, block) @ block.type.quadrature()[1] for block in mesh.blocks]
    return np.concatenate(parts) if parts else np.empty(0)


def centroid(mesh: Mesh) -> Array:
    """Centre of volume (3,) of the mesh (of area, for sheets), metres."""
    moment, volume = np.zeros(3), 0.0
    for block in mesh.blocks:
        points, weights = block.type.quadrature()
        measures = jacobian_determinants(mesh, block) * weights
        places = np.einsum("pk,mka->mpa", block.type.shape_functions(points), mesh.nodes[block.connectivity])
        moment += np.einsum("mp,mpa->a", measures, places)
        volume += measures.sum()
    return moment / volume


def surface_area(mesh: Mesh, name: str) -> float:
    """Area (m^2) of a named surface, drawn through corner and middle nodes; raises StudyError if unknown."""
    corners = mesh.nodes[mesh.face_triangles(mesh.surface(name))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(0.5 * np.linalg.norm(normals, axis=1).sum())
