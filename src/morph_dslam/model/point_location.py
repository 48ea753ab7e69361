"""Where points lie in an undeformed mesh: the nodes of their cell, and its shape functions there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.errors import ParameterError
from morph_dslam.model.cell_types import CellType, cell_type
from morph_dslam.model.reduced_model import MaterialPoints

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Cells tried for a point, nearest first.
CANDIDATES = 24
NEWTON_STEPS = 20
#: How far outside of the reference cell still counts as inside.
TOLERANCE = 1e-8
#: Curved cells reach beyond the box around their nodes by less than this part of its size.
_BULGE = 0.2


def material_points(nodes: Array, cells: Mapping[str, Indices], positions: Array, reach: float = 0.0) -> MaterialPoints:
    """The points at given positions of an undeformed mesh.

    Parameters
    ----------
    nodes : (n, 3), metres.
    cells : (k, c) node indices by the type of cell; volume cells, or triangles of a surface.
    positions : (p, 3), metres.
    reach : points outside by at most about this, metres, are drawn to the mesh.

    Raises
    ------
    ParameterError
        If a point lies farther outside.
    """
    search = _Search(nodes, cells, positions)
    for candidates in search.near():
        search.try_cells(candidates)
    # A long thin cell around a point may have its centre far away.
    for candidates in search.with_boxes_around():
        search.try_cells(candidates)
    lost = np.flatnonzero(search.gaps > reach)
    if len(lost):
        place = ", ".join(f"{round(1e3 * value, 3):g}" for value in positions[lost[0]])
        raise ParameterError(
            f"{len(lost)} of {len(positions)} points lie outside of the object, the first at ({place}) mm, about "
            f"{1e3 * search.gaps[lost[0]]:.3g} mm away from it"
        )
    return search.points()


class _Search:
    """Points of a mesh, found cell by cell.

    Attributes
    ----------
    gaps : (p,) how far each position is from the best point so far, metres; zero inside.
    """

    def __init__(self, nodes: Array, cells: Mapping[str, Indices], positions: Array) -> None:
        self._nodes, self._positions = nodes, positions
        self._blocks = [(cell_type(name), connectivity) for name, connectivity in cells.items() if len(connectivity)]
        self._starts = np.cumsum([0, *(len(connectivity) for _, connectivity in self._blocks)])
        self._cells = np.full(len(positions), -1, dtype=np.int64)
        self._reference = np.zeros((len(positions), self._blocks[0][0].dimension))
        self.gaps = np.full(len(positions), np.inf)

    def near(self) -> Iterator[Indices]:
        """Cells (p,) to try, those with the nearest centres first."""
        centres = np.concatenate([self._nodes[connectivity].mean(axis=1) for _, connectivity in self._blocks])
        count = min(CANDIDATES, len(centres))
        _, found = KDTree(centres).query(self._positions, k=count)
        yield from np.reshape(found, (len(self._positions), count)).T

    def with_boxes_around(self) -> Iterator[Indices]:
        """Cells (p,) to try for points that are in none so far: those in whose boxes they lie; -1 for no cell."""
        corners = [self._nodes[connectivity] for _, connectivity in self._blocks]
        low, high = (np.concatenate([getattr(part, end)(axis=1) for part in corners]) for end in ("min", "max"))
        slack = _BULGE * (high - low).max(axis=1, keepdims=True)
        found = {}
        for row in np.flatnonzero(self.gaps > 0.0):
            position = self._positions[row]
            found[row] = np.flatnonzero(((low - slack <= position) & (position <= high + slack)).all(axis=1))
        for number in range(max(map(len, found.values()), default=0)):
            candidates = np.full(len(self._positions), -1)
            for row, cells in found.items():
                if number < len(cells):
                    candidates[row] = cells[number]
            yield candidates

    def try_cells(self, candidates: Indices) -> None:
        """Take a cell (p,) for each point that lies in it, or nearer to it than to those before."""
        for (kind, connectivity), start, stop in zip(self._blocks, self._starts[:-1], self._starts[1:], strict=True):
            rows = np.flatnonzero((self.gaps > 0.0) & (candidates >= start) & (candidates < stop))
            if not len(rows):
                continue
            corners, wanted = self._nodes[connectivity[candidates[rows] - start]], self._positions[rows]
            found = _inverse_map(kind, corners, wanted)
            # In a bent cell Newton's method may end nowhere, by chance within the reference cell.
            missed = np.linalg.norm(_positions(kind, corners, found) - wanted, axis=1)
            met = missed < TOLERANCE * np.ptp(corners, axis=1).max(axis=1)
            inside = met & (_outside_by(kind.shape, found) < TOLERANCE)
            moved = np.where(inside[:, None], found, _nearest_inside(kind.shape, found))
            gap = np.linalg.norm(_positions(kind, corners, moved) - wanted, axis=1)
            gap[inside] = 0.0
            better = gap < self.gaps[rows]
            chosen = rows[better]
            self._cells[chosen], self._reference[chosen] = candidates[chosen], moved[better]
            self.gaps[chosen] = gap[better]

    def points(self) -> MaterialPoints:
        """The points found."""
        width = max(connectivity.shape[1] for _, connectivity in self._blocks)
        corners = np.zeros((len(self._positions), width), dtype=np.int64)
        weights = np.zeros((len(self._positions), width))
        for (kind, connectivity), start, stop in zip(self._blocks, self._starts[:-1], self._starts[1:], strict=True):
            rows = np.flatnonzero((self._cells >= start) & (self._cells < stop))
            size = connectivity.shape[1]
            corners[rows, :size] = connectivity[self._cells[rows] - start]
            weights[rows, :size] = kind.shape_functions(self._reference[rows])
        return MaterialPoints(corners, weights, np.einsum("pc,pcx->px", weights, self._nodes[corners]))


def _outside_by(shape: str, reference: Array) -> Array:
    """How far (p,) points (p, dim) lie outside of a reference cell; negative inside."""
    x, y, z = reference[:, 0], reference[:, 1], reference[:, -1]
    beyond = {
        "tri": [x + y - 1.0],
        "tet": [x + y + z - 1.0],
        "prism": [x + y - 1.0, z - 1.0],
        "hex": [x - 1.0, y - 1.0, z - 1.0],
    }[shape]
    return np.max([*-reference.T, *beyond], axis=0)


def _positions(kind: CellType, corners: Array, reference: Array) -> Array:
    """Points (p, 3) at reference coordinates (p, dim) of cells with nodes (p, k, 3)."""
    return np.einsum("pk,pkx->px", kind.shape_functions(reference), corners)


def _inverse_map(kind: CellType, corners: Array, points: Array) -> Array:
    """Reference coordinates (p, dim) of points (p, 3) in cells with nodes (p, k, 3), by Newton's method.

    For a point beside a triangle they are those of the nearest point in its plane.
    """
    reference = np.tile(kind.nodes[: kind.corners].mean(axis=0), (len(points), 1))
    for _ in range(NEWTON_STEPS):
        gap = points - _positions(kind, corners, reference)
        jacobian = np.einsum("pka,pkx->pxa", kind.shape_gradients(reference), corners)
        if kind.dimension == 3:
            jacobian[np.abs(np.linalg.det(jacobian)) < 1e-300] = np.eye(3)
            step = np.linalg.solve(jacobian, gap[:, :, None])[:, :, 0]
        else:
            step = (np.linalg.pinv(jacobian) @ gap[:, :, None])[:, :, 0]
        before, reference = reference, np.clip(reference + step, -2.0, 3.0)
        if np.abs(reference - before).max(initial=0.0) < 1e-13:
            break
    return reference


def _nearest_inside(shape: str, reference: Array) -> Array:
    """Points (p, dim), of which some lie outside of a reference cell, drawn to its faces."""
    result = np.clip(reference, 0.0, 1.0)
    if shape != "hex":  # the slanting face of a tetrahedron, or of a triangle
        axes = 3 if shape == "tet" else 2
        result[:, :axes] /= np.maximum(result[:, :axes].sum(axis=1), 1.0)[:, None]
    return result
