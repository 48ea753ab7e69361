"""Whether an object is still where the map has it, and how much its pose in the map counts.

An anchored object's pose comes from the camera's, and its points have to agree with it. Where they do not, in
several frames on end, the object has been moved: then its points alone say where it is, until they agree with
the map again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.geometry import RigidTransform
from morph_dslam.online.anchored.known_pose import KnownPose
from morph_dslam.online.attempt import Attempt
from morph_dslam.online.estimation.estimator import Estimate, Estimator, Prior, moved
from morph_dslam.online.estimation.robust_covariance import EIGENVALUE_FLOOR
from morph_dslam.online.reference.reference_view import ReferenceView
from morph_dslam.online.tracker_options import TrackerOptions
from morph_dslam.online.uncertainty.measurement_noise import Measured

Array = NDArray[np.float64]

#: Spread of residuals, pixels, before any frame has shown one, and the least that is believed.
FIRST_SIGMA_PX, LEAST_SIGMA_PX = 0.5, 0.1
#: How much more a pose counts that is to be held.
HELD = 1e6


class Anchoring:
    """Decides frame by frame.

    Attributes
    ----------
    has_moved : whether the object is away from its place in the map.
    reference : the view that frames are compared with.
    """

    def __init__(self, estimator: Estimator, reference: ReferenceView, options: TrackerOptions) -> None:
        self._estimator, self.reference, self._options = estimator, reference, options
        self._d = len(estimator.model.parameters)
        self._size = float(np.linalg.norm(np.ptp(estimator.model.nodes, axis=0)))
        self._squared_px, self._n_other = reference.redundancy * FIRST_SIGMA_PX**2, 0
        self.has_moved = False

    def prior(self, known: KnownPose | None) -> Prior | None:
        """What the map tells of the pose; None if the camera is lost or the object has moved."""
        if known is None or self.has_moved:
            return None
        return known.prior(self._d, self._squared_px, HELD if self._options.hold_pose else 1.0)

    def contradicts(self, known: KnownPose, attempt: Attempt) -> bool:
        """Whether the points of a believable attempt show the object elsewhere than in the map.

        Both must hold: it is farther off than the registration's usual error, and than the standard
        deviations of both poses explain.
        """
        pose, covariance = self._by_points_alone(attempt)
        points = self.reference.points.rest[attempt.inliers]
        apart = np.sqrt(np.mean(np.sum((pose.apply(points) - known.pose.apply(points)) ** 2, axis=1)))
        if not apart > self._options.moved_share * self._size:
            return False
        away, spread = known.away(pose), known.covariance + covariance
        return float(np.sqrt(away @ np.linalg.solve(spread, away))) > self._options.moved_sigmas

    def _by_points_alone(self, attempt: Attempt) -> tuple[RigidTransform, Array]:
        """The pose by an attempt's points and its covariance (6, 6), to first order from where it is.

        What the points do not tell at all stays as the attempt has it, with a very large variance.
        """
        estimate, points = attempt.estimate, self.reference.points
        weights = attempt.weights
        _, hessian, gradient, _ = self._estimator.evaluate(
            points, attempt.measurement.pixels, weights, estimate.state
        )
        scale = self._estimator.scale
        values, vectors = np.linalg.eigh(hessian * np.outer(scale, scale))
        vectors, floor = scale[:, None] * vectors, max(values[-1], 1e-30) * EIGENVALUE_FLOOR
        along = np.where(values > floor, vectors.T @ gradient / np.maximum(values, floor), 0.0)
        rows = vectors[self._d :]
        covariance = (rows / np.maximum(values, floor)) @ rows.T
        covariance *= self.reference.redundancy * max(estimate.sigma_px, LEAST_SIGMA_PX) ** 2
        return moved(estimate.state, -vectors @ along).camera_from_object, covariance

    def note(self, elsewhere: bool) -> None:
        """Take in whether a frame showed the object elsewhere; several on end change the opinion."""
        self._n_other = self._n_other + 1 if elsewhere != self.has_moved else 0
        if self._n_other >= self._options.moved_patience:
            self.has_moved, self._n_other = elsewhere, 0

    def learn(self, estimate: Estimate, measured: Measured) -> None:
        """Take in how well the points of an accepted frame agree, and how many count as one."""
        if np.isfinite(estimate.sigma_px):
            self._squared_px = measured.redundancy * max(estimate.sigma_px, LEAST_SIGMA_PX) ** 2
