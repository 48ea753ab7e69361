"""Where points lie in a mesh: the cell, and the coordinates in its reference cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.errors import StudyError
from morph_dslam.meshing.cell_types import CellType
from morph_dslam.meshing.meshes import CellBlock, Mesh
from morph_dslam.model import MaterialPoints, ReducedModel

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Cells tried for a point, nearest first.
CANDIDATES = 24
NEWTON_STEPS = 20
#: How far outside of the reference cell still counts as inside.
TOLERANCE = 1e-8


@dataclass(frozen=True)
class LocatedPoints:
    """Points of the solid.

    Attributes
    ----------
    cells : (p,) cell indices.
    reference : (p, 3) coordinates in the reference cell of the `CellType`.
    """

    cells: Indices
    reference: Array


def _outside_by(shape: str, reference: Array) -> Array:
    """How far (p,) points (p, 3) lie outside of a reference cell; negative inside."""
    x, y, z = reference.T
    bounds = [-x, -y, -z]
    bounds += {"hex": [x - 1.0, y - 1.0, z - 1.0], "tet": [x + y + z - 1.0], "prism": [x + y - 1.0, z - 1.0]}[shape]
    return np.max(bounds, axis=0)


def _positions(kind: CellType, corners: Array, reference: Array) -> Array:
    """Points (p, 3) at reference coordinates (p, 3) of cells with nodes (p, k, 3)."""
    return np.einsum("pk,pkx->px", kind.shape_functions(reference), corners)


def _inverse_map(kind: CellType, corners: Array, points: Array) -> Array:
    """Reference coordinates (p, 3) of points (p, 3) in cells with nodes (p, k, 3), by Newton's method."""
    reference = np.tile(kind.nodes[: kind.corners].mean(axis=0), (len(points), 1))
    for _ in range(NEWTON_STEPS):
        gap = points - _positions(kind, corners, reference)
        jacobian = np.einsum("pka,pkx->pxa", kind.shape_gradients(reference), corners)
        jacobian[np.abs(np.linalg.det(jacobian)) < 1e-300] = np.eye(3)
        step = np.linalg.solve(jacobian, gap[:, :, None])[:, :, 0]
        reference = np.clip(reference + step, -2.0, 3.0)
        if np.abs(step).max(initial=0.0) < 1e-13:
            break
    return reference


def _nearest_inside(shape: str, reference: Array) -> Array:
    """Points (p, 3), of which some lie outside of a reference cell, drawn to its faces."""
    result = np.clip(reference, 0.0, 1.0)
    if shape != "hex":  # the slanting face of a tetrahedron or of a prism's base
        axes = 3 if shape == "tet" else 2
        result[:, :axes] /= np.maximum(result[:, :axes].sum(axis=1), 1.0)[:, None]
    return result


def locate(mesh: Mesh, points: Array, reach: float = 0.0) -> LocatedPoints:
    """The cells that points (p, 3) of the undeformed solid, m, lie in.

    Points outside, but not farther than about ``reach`` (m) from a cell, are drawn to its faces. Raises StudyError if
    one is farther outside.
    """
    points = np.atleast_2d(np.asarray(points, dtype=float))
    centres = np.concatenate([mesh.nodes[b.connectivity].mean(axis=1) for b in mesh.blocks])
    starts = mesh.block_starts()
    _, near = KDTree(centres).query(points, k=min(CANDIDATES, len(centres)))
    near = near.reshape(len(points), -1)
    cells, reference = np.full(len(points), -1, dtype=np.int64), np.zeros((len(points), 3))
    beside, drawn, gaps = cells.copy(), reference.copy(), np.full(len(points), reach)
    for candidate in near.T:
        for block, start, stop in zip(mesh.blocks, starts[:-1], starts[1:], strict=True):
            rows = np.flatnonzero((cells < 0) & (candidate >= start) & (candidate < stop))
            if not len(rows):
                continue
            nodes = mesh.nodes[block.connectivity[candidate[rows] - start]]
            found = _inverse_map(block.type, nodes, points[rows])
            # In a bent cell Newton's method may end nowhere, by chance within the reference cell.
            missed = np.linalg.norm(_positions(block.type, nodes, found) - points[rows], axis=1)
            met = missed < TOLERANCE * np.ptp(nodes, axis=1).max(axis=1)
            inside = met & (_outside_by(block.type.shape, found) < TOLERANCE)
            cells[rows[inside]] = candidate[rows[inside]]
            reference[rows[inside]] = found[inside]
            if reach > 0.0:
                moved = _nearest_inside(block.type.shape, found)
                gap = np.linalg.norm(_positions(block.type, nodes, moved) - points[rows], axis=1)
                nearer = gap < gaps[rows]
                chosen = rows[nearer]
                beside[chosen], drawn[chosen], gaps[chosen] = candidate[chosen], moved[nearer], gap[nearer]
    outside = cells < 0
    cells[outside], reference[outside] = beside[outside], drawn[outside]
    if (cells < 0).any():
        lost = points[np.flatnonzero(cells < 0)[0]]
        raise StudyError(
            f"{int((cells < 0).sum())} of {len(points)} points lie outside of the solid, the first at "
            f"({', '.join(f'{round(1e3 * value, 3):g}' for value in lost)}) mm"
        )
    return LocatedPoints(cells, reference)


def material_points(model: ReducedModel, positions: Array, reach: float = 0.0) -> MaterialPoints:
    """The points at ``positions`` (p, 3) of the undeformed solid, m, as nodes of their cells and shape functions.

    `ReducedModel.restrict` takes them. Points outside by at most about ``reach``, m, are drawn to the solid, as those
    of another mesh of the same body are. Raises StudyError if a point lies farther outside.
    """
    blocks = tuple(CellBlock(name, connectivity) for name, connectivity in model.cells.items())
    mesh = Mesh(model.nodes, blocks)
    located, starts = locate(mesh, positions, reach), mesh.block_starts()
    width = max(block.connectivity.shape[1] for block in blocks)
    corners, weights = np.zeros((len(positions), width), dtype=np.int64), np.zeros((len(positions), width))
    for block, start, stop in zip(blocks, starts[:-1], starts[1:], strict=True):
        rows = np.flatnonzero((located.cells >= start) & (located.cells < stop))
        size = block.connectivity.shape[1]
        corners[rows, :size] = block.connectivity[located.cells[rows] - start]
        weights[rows, :size] = block.type.shape_functions(located.reference[rows])
    return MaterialPoints(corners, weights)
