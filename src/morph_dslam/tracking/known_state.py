"""What is known of an object's state in its reference frame, as residuals beside those of other frames."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.tracking.estimator import BoundPoints, State
from morph_dslam.tracking.state import pose_increment

Array = NDArray[np.float64]
#: Residual of a landmark behind the camera, and the least variance of a scaled unknown that is believed.
UNSEEN, LEAST_VARIANCE = 1e3, 1e-12


@dataclass(frozen=True)
class LandmarkTerm:
    """What landmarks say of the reference state.

    Attributes
    ----------
    points : k of them, bound.
    recorded : (k, 2) pixels as recorded.
    sigma_px : standard deviation of each.
    """

    points: BoundPoints
    recorded: Array
    sigma_px: float

    def residuals(self, camera: Camera, state: State) -> Array:
        """(2 k,) in standard deviations."""
        away = camera.project(self.points.in_camera(state)) - camera.undistort_pixels(self.recorded)
        return np.nan_to_num(away / self.sigma_px, nan=UNSEEN).ravel()


@dataclass(frozen=True)
class StateTerm:
    """What another registration says of the reference state.

    Attributes
    ----------
    state : as registered.
    covariance : (d + 6, d + 6) of it.
    scale : (d + 6,) of the unknowns.
    """

    state: State
    covariance: Array
    scale: Array

    def residuals(self, camera: Camera, state: State) -> Array:
        """(d + 6,) in standard deviations; the camera does not matter."""
        turned = pose_increment(self.state.camera_from_object, state.camera_from_object)
        away = np.concatenate([state.parameters - self.state.parameters, turned])
        return np.asarray(self._whitening @ away)

    @cached_property
    def _whitening(self) -> Array:
        """The matrix (d + 6, d + 6) that turns what a state is away by into standard deviations."""
        values, vectors = np.linalg.eigh(self.covariance / np.outer(self.scale, self.scale))
        return (vectors / np.sqrt(np.maximum(values, LEAST_VARIANCE))).T / self.scale
