"""How places of an object turn: the rotation that carries a place's surroundings best from rest to where they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from morph_dslam.geometry import fit_similarity, rotation_log
from morph_dslam.model import MaterialPoints, ReducedModel, SeparatedField
from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.tracking.estimator import Estimate
from morph_dslam.tracking.reactions import VectorEstimate

Array = NDArray[np.float64]
#: Nodes whose second principal extent is a smaller share of the first lie on a line, about which they tell no turn.
LEAST_BREADTH = 0.05
#: A point has no part in a corner of its cell that weighs less: it is on the face opposite to that.
LEAST_WEIGHT = 1e-6


@dataclass(frozen=True)
class Surroundings:
    """The nodes about some places, whose turn is that of the place.

    Attributes
    ----------
    rows : of each place, where its nodes are among all.
    rest : (n, 3) of all nodes of the undeformed object, metres.
    field : displacement of these nodes.
    gyration : root mean square distance of the object's nodes from their middle, metres.
    """

    rows: tuple[NDArray[np.int64], ...]
    rest: Array
    field: SeparatedField
    gyration: float

    @classmethod
    def of(cls, model: ReducedModel, points: MaterialPoints) -> Surroundings:
        """The corners of each point's cell.

        Of a point on a face those of the face; of one on a node or an edge those of all cells about it.
        """
        near = _cells_about(model)
        found = [
            _grown(np.unique(corners[weights > LEAST_WEIGHT]), near, model.nodes)
            for corners, weights in zip(points.corners, points.weights, strict=True)
        ]
        nodes, rows = np.unique(np.concatenate(found), return_inverse=True)
        ends = np.cumsum([len(part) for part in found])
        gyration = float(np.sqrt(np.mean(np.sum((model.nodes - model.nodes.mean(axis=0)) ** 2, axis=1))))
        field = model.restrict(MaterialPoints(nodes[:, None], np.ones((len(nodes), 1))))
        return cls(tuple(np.split(rows, ends[:-1])), model.nodes[nodes], field, gyration)

    def turns(self, estimate: Estimate, discrepancy: Discrepancy | None = None) -> list[VectorEstimate]:
        """Rotation vector of each place in the object frame, radians.

        Deviations are those of a small turn that is added, from the left. An error of the model's displacement counts
        as that of a turn of the whole object.
        """
        values, slopes = self.field.value_and_sensitivities(estimate.state.parameters)
        if discrepancy is not None:
            values = values + discrepancy.displacement(self.rest)
        d = len(slopes)
        covariance = estimate.image_covariance[:d, :d]
        by_model = estimate.model_displacement_in_object**2 / (2.0 * self.gyration**2) * np.eye(3)
        found = []
        for rows in self.rows:
            rest = self.rest[rows]
            turn, by_parameters = turn_of(rest, rest + values[rows], slopes[:, rows])
            spread = np.full((3, 3), np.inf)
            if np.isfinite(covariance).all():
                spread = by_parameters @ covariance @ by_parameters.T + by_model
            if discrepancy is not None and discrepancy.deviation is not None:
                each = np.eye(rest.size).reshape(-1, *rest.shape)
                by_nodes = turn_of(rest, rest + values[rows], each)[1]
                spread = spread + by_nodes @ discrepancy.joint_covariance(rest) @ by_nodes.T
            found.append(VectorEstimate.of(turn, spread))
        return found


def turn_of(rest: Array, moved: Array, slopes: Array) -> tuple[Array, Array]:
    """The rotation that carries points closest from where they rest to where they are (Kabsch 1976).

    With M = sum a b' of the moved points a and the resting ones b about their middles, and M = P R, it is R. A change
    dM turns it by w with (tr(P) 1 - P) w = the axial vector of dM R' - R dM'.

    Parameters
    ----------
    rest, moved : (n, 3), not on a line.
    slopes : (d, n, 3) derivatives of ``moved``.

    Returns
    -------
    turn : (3,) rotation vector, radians.
    by_parameters : (3, d) derivatives of a small turn that is added, from the left.
    """
    b = rest - rest.mean(axis=0)
    rotation = fit_similarity(rest, moved, with_scale=False).rotation
    stretch = (moved - moved.mean(axis=0)).T @ b @ rotation.T
    changes = np.einsum("dni,nj->dij", slopes, b) @ rotation.T
    skew = changes - changes.transpose(0, 2, 1)
    axial = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]])
    return rotation_log(np.ascontiguousarray(rotation)), np.linalg.solve(np.trace(stretch) * np.eye(3) - stretch, axial)


def _cells_about(model: ReducedModel) -> scipy.sparse.csr_array:
    """Which nodes (n, n) share a cell."""
    blocks: Sequence[NDArray[np.int64]] = list(model.cells.values()) or [model.triangles]
    of_cells = [
        scipy.sparse.csr_array(
            (np.ones(cells.size), (np.repeat(np.arange(len(cells)), cells.shape[1]), cells.ravel())),
            shape=(len(cells), len(model.nodes)),
        )
        for cells in blocks
    ]
    incidence = scipy.sparse.vstack(of_cells).tocsr()
    return scipy.sparse.csr_array(incidence.T @ incidence)


def _grown(nodes: NDArray[np.int64], near: scipy.sparse.csr_array, places: Array) -> NDArray[np.int64]:
    """Some nodes, and those that share cells with them as long as they lie on a line."""
    while True:
        there = places[nodes] - places[nodes].mean(axis=0)
        sizes = np.linalg.svd(there, compute_uv=False) if len(nodes) > 2 else np.zeros(2)
        more = np.unique(near[nodes].indices)
        if sizes[1] > LEAST_BREADTH * sizes[0] or len(more) == len(nodes):
            return nodes
        nodes = more.astype(np.int64)
