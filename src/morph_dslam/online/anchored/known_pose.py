"""The object's pose as it is known beforehand in a frame, from a camera that was found in the scene's map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.geometry import RigidTransform, rotation_log
from morph_dslam.online.estimation.prior import Prior

Array = NDArray[np.float64]


@dataclass(frozen=True)
class KnownPose:
    """An object's pose in one frame.

    Attributes
    ----------
    pose : camera_from_object, metres.
    from_camera : (6, 6) covariance of the increment (rotation vector rad, translation m) that `state.moved`
        applies, from the camera's error, which is new in every frame.
    lasting : (6, k) the same increment by the k causes of the registration's error in their standard
        deviations: that error is the same in all frames.
    """

    pose: RigidTransform
    from_camera: Array
    lasting: Array

    @property
    def covariance(self) -> Array:
        """(6, 6) of the increment, from both."""
        return self.from_camera + self.lasting @ self.lasting.T

    def prior(self, d: int, squared_px: float, firmness: float = 1.0) -> Prior:
        """As a term of the estimator's cost, which knows nothing of the ``d`` parameters.

        ``squared_px`` is the variance of an image coordinate: it makes a covariance a weight in that cost.
        ``firmness`` multiplies the weight, but makes the pose no better known: its errors stay in what is
        stated of the estimate.
        """
        squared_px = firmness * squared_px
        information = np.asarray(squared_px * np.linalg.inv(self.covariance), dtype=np.float64)
        nothing = np.zeros((d, d))
        return Prior(np.zeros(d), nothing, self.pose, information, self.lasting, squared_px)

    def away(self, pose: RigidTransform) -> Array:
        """The increment (6,) from this pose to another."""
        turn = rotation_log(pose.rotation @ self.pose.rotation.T)
        return np.concatenate([turn, pose.translation - self.pose.translation])
