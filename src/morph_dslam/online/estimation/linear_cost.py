"""A cost about its minimum: how errors of measurements enter the estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.online.estimation.reprojection import project_with_jacobian
from morph_dslam.online.estimation.robust_covariance import EIGENVALUE_FLOOR
from morph_dslam.online.estimation.state import State
from morph_dslam.online.uncertainty.measurement_noise import Measured

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LinearCost:
    """A cost about its minimum.

    Attributes
    ----------
    scores : (p, 2, n) by which an error of a pixel enters the gradient, in units of what a point of weight 1
        is off by. of_depths : (n, n), covariance of the gradient from errors of depths. hessian : (n, n).
    scale : (n,) of the unknowns.
    """

    scores: Array
    of_depths: Array
    hessian: Array
    scale: Array

    @classmethod
    def about(
        cls,
        measured: Measured,
        state: State,
        residuals: Array,
        camera: PinholeCamera,
        huber_px: float,
        scale: Array,
    ) -> LinearCost:
        """That of the measurements of a frame, about a state that leaves these residuals (p, 2)."""
        points, pose = measured.points, state.camera_from_object
        _, jacobian = project_with_jacobian(
            points.field.functions.rows(state.parameters), pose.rotation, pose.translation, points.rest,
            points.field.modes, camera.intrinsics,
        )  # fmt: skip
        directed = (measured.normals != 0.0).any(axis=1)
        normals = measured.normals[directed]
        jacobian[directed] = (normals[:, :, None] * normals[:, None, :]) @ jacobian[directed]
        length = np.linalg.norm(residuals, axis=1)
        used = (measured.weights > 0.0) & np.isfinite(length)
        jacobian[~used] = 0.0
        factor = np.minimum(1.0, huber_px / np.maximum(np.where(used, length, 0.0), 1e-300))
        exactness = np.sqrt(measured.weights)[:, None, None]
        scores = exactness * factor[:, None, None] * jacobian
        hessian = np.tensordot(scores, exactness * jacobian, axes=([0, 1], [0, 1]))
        of_depths = np.zeros_like(hessian)
        if measured.depths is not None:
            _, part, _, far = measured.depths.terms(points, state)
            hessian, of_depths = hessian + part, measured.depths.variance_px(far) * part
        return cls(scores, of_depths, hessian, scale)

    def in_unknowns(self, chain: Array) -> LinearCost:
        """The same cost of other unknowns, whose increments ``chain`` (n, m) turns into these."""
        hessian, of_depths = (chain.T @ matrix @ chain for matrix in (self.hessian, self.of_depths))
        return LinearCost(self.scores @ chain, of_depths, hessian, self.scale)

    def holding(self, indices: NDArray[np.int64]) -> LinearCost:
        """The same cost with the unknowns at ``indices`` (k,) known: how well the others are then."""
        scores, of_depths, hessian = self.scores.copy(), self.of_depths.copy(), self.hessian.copy()
        largest = float(np.max(np.diag(hessian) * self.scale**2))
        scores[:, :, indices] = 0.0
        for matrix in (of_depths, hessian):
            matrix[indices], matrix[:, indices] = 0.0, 0.0
        hessian[indices, indices] = max(largest, 1e-30) / self.scale[indices] ** 2
        return LinearCost(scores, of_depths, hessian, self.scale)

    @staticmethod
    def joined(costs: Sequence[LinearCost]) -> LinearCost:
        """The sum of costs of the same unknowns, their points one after the other."""
        return LinearCost(
            np.concatenate([cost.scores for cost in costs]),
            np.sum([cost.of_depths for cost in costs], axis=0),
            np.sum([cost.hessian for cost in costs], axis=0),
            costs[0].scale,
        )

    @cached_property
    def _spectrum(self) -> tuple[Array, Array, float]:
        """Eigenvalues and eigenvectors in scaled unknowns, and the least value that counts."""
        values, vectors = np.linalg.eigh(self.hessian * np.outer(self.scale, self.scale))
        return values, self.scale[:, None] * vectors, max(values[-1], 1e-30) * EIGENVALUE_FLOOR

    @cached_property
    def inverse(self) -> Array:
        """H^-1 (n, n); what is not seen at all gets the inverse of the least value."""
        values, vectors, floor = self._spectrum
        return (vectors / np.maximum(values, floor)) @ vectors.T

    @property
    def unseen(self) -> Array:
        """The part (n, n) of `inverse` that is not seen at all."""
        values, vectors, floor = self._spectrum
        return (vectors * np.where(values > floor, 0.0, 1.0 / floor)) @ vectors.T
