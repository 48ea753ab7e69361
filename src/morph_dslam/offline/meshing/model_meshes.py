"""From a finite element mesh to that of a model file: visible surface, cells, and weights of the nodes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.offline.meshing.meshes import Mesh
from morph_dslam.offline.problem import ModelMesh

Array = NDArray[np.float64]

#: Cells whose Jacobians are held at once.
_CHUNK = 4096


def model_mesh_of(mesh: Mesh) -> ModelMesh:
    """All nodes, the outer surface in triangles, and, for solids, the cells."""
    solid = all(block.type.dimension == 3 for block in mesh.blocks)
    return ModelMesh(
        nodes=mesh.nodes,
        triangles=mesh.surface_triangles(),
        weights=lumped_weights(mesh),
        cells={block.cell_type: block.connectivity for block in mesh.blocks} if solid else {},
    )


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
