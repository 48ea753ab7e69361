"""Points inside of a solid as the reduced model takes them: nodes of their cells and shape functions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import MaterialPoints, ReducedModel
from morph_dslam.offline.mechanics.point_location import locate
from morph_dslam.offline.meshing.meshes import CellBlock, Mesh

Array = NDArray[np.float64]


def material_points(model: ReducedModel, positions: Array) -> MaterialPoints:
    """The points at ``positions`` (p, 3) of the undeformed solid, metres, for `ReducedModel.restrict`.

    Raises
    ------
    StudyError
        If a point lies outside of the solid.
    """
    blocks = tuple(CellBlock(name, connectivity) for name, connectivity in model.cells.items())
    mesh = Mesh(model.nodes, blocks)
    located, starts = locate(mesh, positions), mesh.block_starts()
    width = max(block.connectivity.shape[1] for block in blocks)
    corners, weights = np.zeros((len(positions), width), dtype=np.int64), np.zeros((len(positions), width))
    for block, start, stop in zip(blocks, starts[:-1], starts[1:], strict=True):
        rows = np.flatnonzero((located.cells >= start) & (located.cells < stop))
        size = block.connectivity.shape[1]
        corners[rows, :size] = block.connectivity[located.cells[rows] - start]
        weights[rows, :size] = block.type.shape_functions(located.reference[rows])
    return MaterialPoints(corners, weights)
