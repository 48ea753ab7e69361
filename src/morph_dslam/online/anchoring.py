"""Whether an object is still where the map has it, and how much its pose in the map counts.

An anchored object's pose comes from the camera's, and its points have to agree with it. Where they do not, in
several frames on end, the object has been moved: then its points alone say where it is, until they agree with
the map again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.attempt import Attempt
from morph_dslam.online.estimation import Estimate, Estimator, Prior
from morph_dslam.online.known_pose import KnownPose
from morph_dslam.online.reference_view import ReferenceView
from morph_dslam.online.tracker_options import TrackerOptions

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
    """

    def __init__(self, estimator: Estimator, reference: ReferenceView, options: TrackerOptions) -> None:
        self._estimator, self._reference, self._options = estimator, reference, options
        self._d = len(estimator.model.parameters)
        self._size = float(np.linalg.norm(np.ptp(estimator.model.nodes, axis=0)))
        self._sigma_px, self._n_other = FIRST_SIGMA_PX, 0
        self.has_moved = False

    def prior(self, known: KnownPose | None) -> Prior | None:
        """What the map tells of the pose; None if the camera is lost or the object has moved."""
        if known is None or self.has_moved:
            return None
        squared_px = self._reference.redundancy * self._sigma_px**2
        return known.prior(self._d, squared_px, HELD if self._options.hold_pose else 1.0)

    def contradicts(self, known: KnownPose, attempt: Attempt) -> bool:
        """Whether the points of a believable attempt show the object elsewhere than in the map.

        Both must hold: it is farther off than the registration's usual error, and than the standard
        deviations of both poses explain.
        """
        weights = attempt.inliers.astype(float)
        free = self._estimator.estimate(
            self._reference.points, attempt.measurement.pixels, weights, attempt.estimate.state
        )
        points = self._reference.points.rest[attempt.inliers]
        pose = free.state.camera_from_object
        apart = np.sqrt(np.mean(np.sum((pose.apply(points) - known.pose.apply(points)) ** 2, axis=1)))
        if not apart > self._options.moved_share * self._size:
            return False
        return _mahalanobis(known, free, self._reference.redundancy) > self._options.moved_sigmas

    def note(self, elsewhere: bool) -> None:
        """Take in whether a frame showed the object elsewhere; several on end change the opinion."""
        self._n_other = self._n_other + 1 if elsewhere != self.has_moved else 0
        if self._n_other >= self._options.moved_patience:
            self.has_moved, self._n_other = elsewhere, 0

    def learn(self, estimate: Estimate) -> None:
        """Take in how well the points of an accepted frame agree."""
        if np.isfinite(estimate.sigma_px):
            self._sigma_px = max(estimate.sigma_px, LEAST_SIGMA_PX)


def _mahalanobis(known: KnownPose, free: Estimate, redundancy: float) -> float:
    """How many standard deviations a pose from points is off the known one."""
    d = len(free.state.parameters)
    away = known.away(free.state.camera_from_object)
    spread = known.covariance + redundancy * free.covariance[d:, d:]
    if not np.isfinite(spread).all():
        return 0.0
    return float(np.sqrt(away @ np.linalg.solve(spread, away)))
