"""What is known of an object's state in its reference frame, as residuals beside those of other frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.model import ReducedModel
from morph_dslam.tracking.binding import bind_pixels, view_of
from morph_dslam.tracking.depth import PointDepths
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

    def away(self, camera: Camera, state: State) -> Array:
        """How far the landmarks are from their pixels (k, 2), in standard deviations."""
        away = camera.project(self.points.in_camera(state)) - camera.undistort_pixels(self.recorded)
        return np.nan_to_num(away / self.sigma_px, nan=UNSEEN)

    def residuals(self, camera: Camera, state: State) -> Array:
        """(2 k,) in standard deviations."""
        return self.away(camera, state).ravel()

    def scaled(self, factor: float) -> LandmarkTerm:
        """The same, had the depth camera measured all depths so many times as large."""
        return self


@dataclass(frozen=True)
class DepthTerm:
    """What the depth image of the reference frame says of the reference state.

    Attributes
    ----------
    model : the object.
    recorded : (p, 2) pixels as recorded.
    depths : measured there, of weights in standard deviations.
    share : of each residual that counts, as neighbours err alike.
    """

    model: ReducedModel
    recorded: Array
    depths: PointDepths
    share: float = 1.0

    def scaled(self, factor: float) -> DepthTerm:
        """The same with all depths so many times as large."""
        return replace(self, depths=self.depths.scaled(factor))

    def residuals(self, camera: Camera, state: State) -> Array:
        """(p,) in standard deviations; 0 where a pixel does not see the object."""
        view, pixels = view_of(self.model, camera, state), camera.undistort_pixels(self.recorded)
        surface, met = bind_pixels(self.model, camera, view, pixels)
        seen, found = self.depths.take(met), np.zeros(len(pixels))
        found[met] = self.share * seen.bounded(seen.terms(BoundPoints.from_surface(self.model, surface), state)[3])
        return found


@dataclass(frozen=True)
class LandmarkDepthTerm(LandmarkTerm):
    """What landmarks and a depth image of the same frame say of the reference state.

    Attributes
    ----------
    depth : of the depth image.
    """

    depth: DepthTerm

    def residuals(self, camera: Camera, state: State) -> Array:
        """(2 k + p,) in standard deviations."""
        return np.concatenate([super().residuals(camera, state), self.depth.residuals(camera, state)])

    def scaled(self, factor: float) -> LandmarkDepthTerm:
        """The same with all depths so many times as large."""
        return replace(self, depth=self.depth.scaled(factor))


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

    def scaled(self, factor: float) -> StateTerm:
        """The same: what depths of its own frame have put into it is in its covariance."""
        return self

    @cached_property
    def _whitening(self) -> Array:
        """The matrix (d + 6, d + 6) that turns what a state is away by into standard deviations."""
        values, vectors = np.linalg.eigh(self.covariance / np.outer(self.scale, self.scale))
        return (vectors / np.sqrt(np.maximum(values, LEAST_VARIANCE))).T / self.scale
