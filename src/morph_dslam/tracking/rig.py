"""Cameras that are fixed to each other, and the estimators of what several of them measured.

The pose that is estimated is that of the object in the rig's frame, which is the first camera's. Each camera
sees the object at camera_from_object = camera_from_rig rig_from_object, so an increment (w, v) of the rig's
pose is (R w, R v) of the camera's, with R the rotation of camera_from_rig, and the costs of all are summed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import ReducedModel
from morph_dslam.registration.registration import PosePrior
from morph_dslam.tracking.estimator import BoundPoints, Estimate, EstimationOptions, Estimator, LinearCost, Prior, State
from morph_dslam.tracking.known_values import KnownParameters
from morph_dslam.tracking.levenberg_marquardt import minimise
from morph_dslam.tracking.noise import RigObservations
from morph_dslam.tracking.reference import PosedImage
from morph_dslam.tracking.reprojection import linearise

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RigCamera:
    """A camera of a rig.

    Attributes
    ----------
    camera : its intrinsics and lens.
    camera_from_rig : where it is, metres; the identity of the first camera.
    """

    camera: Camera
    camera_from_rig: RigidTransform

    def seen(self, state: State) -> State:
        """The state in this camera's frame of a state in the rig's."""
        return replace(state, camera_from_object=self.camera_from_rig @ state.camera_from_object)

    def seen_pose(self, known: PosePrior) -> PosePrior:
        """The pose in this camera of what the map gives of that in the rig's frame; the rig itself is exact."""
        rotation = self.camera_from_rig.rotation
        turn = np.asarray(scipy.linalg.block_diag(rotation, rotation))
        return PosePrior(self.camera_from_rig @ known.pose, turn @ known.from_camera @ turn.T, turn @ known.lasting)

    def seen_image(self, image: PosedImage) -> PosedImage:
        """What is known of an image in the rig's frame, in this camera's."""
        chain, factors = self.chain(len(image.state.parameters)), image.error_factors
        return replace(image, state=self.seen(image.state), error_factors=None if factors is None else chain @ factors)

    def in_rig(self, state: State) -> State:
        """The inverse of `seen`."""
        return replace(state, camera_from_object=self.camera_from_rig.inverse @ state.camera_from_object)

    def not_seen(self, state: State, model: ReducedModel) -> str:
        """That no node of the model, with the state in the rig's frame, is in this camera's image; empty if one is."""
        camera = self.camera
        pixels = camera.project(self.seen(state).camera_from_object.apply(model.positions(state.parameters)))
        if ((pixels >= -0.5) & (pixels < np.array([camera.width, camera.height]) - 0.5)).all(axis=1).any():
            return ""
        distance = np.linalg.norm(self.camera_from_rig.translation)
        return (
            f"the object is not in its picture, by the pose of the camera, {distance:.4g} m from the first one: check "
            "that the file has lengths in metres, and each camera as it stands to the one before it"
        )

    def chain(self, n_parameters: int) -> Array:
        """(d + 6, d + 6) from increments in the rig's frame to those in the camera's."""
        rotation = self.camera_from_rig.rotation
        return np.asarray(scipy.linalg.block_diag(np.eye(n_parameters), rotation, rotation))


class RigEstimator:
    """Finds states from what several cameras measured at the same time; as `Estimator` for one.

    Parameters
    ----------
    model : the object.
    cameras : of the rig; what they measured comes in the same order.
    options : of the estimator of each.
    """

    def __init__(
        self, model: ReducedModel, cameras: Sequence[RigCamera], options: EstimationOptions | None = None
    ) -> None:
        self.model, self.cameras = model, tuple(cameras)
        self.options = options or EstimationOptions()
        self._single = [Estimator(model, part.camera, self.options) for part in self.cameras]
        self._chains = [part.chain(len(model.parameters)) for part in self.cameras]

    @property
    def known(self) -> KnownParameters:
        """What something else measures of parameters, which counts once and not once a camera."""
        return self._single[0].known

    def known_information(self, parameters: Array) -> tuple[Array, Array]:
        """What known parameters add to the Hessian at parameters (d,), and its covariance; as `Estimator` has it."""
        return self._single[0].known_information(parameters)

    @property
    def scale(self) -> Array:
        """Of the unknowns (d + 6,), as `Estimator` has it."""
        return self._single[0].scale

    def evaluate(
        self, measured: RigObservations, state: State, prior: Prior | None = None
    ) -> tuple[float, Array, Array, Array]:
        """Cost, Hessian, gradient, and residuals (p, 2) of all points at a state in the rig's frame."""
        size = len(state.parameters) + 6
        cost, hessian, gradient, residuals = 0.0, np.zeros((size, size)), np.zeros(size), []
        for single, part, chain, view in zip(self._single, self.cameras, self._chains, measured.views, strict=True):
            found = single.evaluated(view, part.seen(state))
            cost += found[0]
            hessian += chain.T @ found[1] @ chain
            gradient += chain.T @ found[2]
            residuals.append(found[3])
        if prior is not None:
            terms = prior.terms(state)
            cost, hessian, gradient = cost + terms[0], hessian + terms[1], gradient + terms[2]
        return cost, hessian, gradient, np.concatenate(residuals)

    def fit(self, measured: RigObservations, start: State, prior: Prior | None = None) -> Estimate:
        """Minimise the sum of all cameras' costs from ``start``, a state in the rig's frame."""
        options, first = self.options, self._single[0]
        found = minimise(
            lambda state: self.evaluate(measured, state, prior),
            start, self.known.bounded(first.box), options.max_iterations, options.tolerance,
        )  # fmt: skip
        return first.finished(found, measured.weights, measured.numbers)

    def linear(self, measured: RigObservations, estimate: Estimate) -> LinearCost:
        """The cost of what was measured, about an estimate made from it."""
        costs, first = [], 0
        for single, part, chain, view in zip(self._single, self.cameras, self._chains, measured.views, strict=True):
            last = first + len(view.points)
            seen = replace(estimate, state=part.seen(estimate.state), residuals=estimate.residuals[first:last])
            costs.append(single.linear(view, seen).in_unknowns(chain))
            first = last
        return LinearCost.joined(costs, measured.correlation)


class PointsEstimator(Estimator):
    """Finds states from points that each one camera of a rig saw, as `Estimator` does for one camera.

    Parameters
    ----------
    model : the object.
    cameras : of the rig; states are in the first one's frame.
    of_points : (p,) number of the camera that saw each point.
    options : of the estimator.
    """

    def __init__(
        self,
        model: ReducedModel,
        cameras: Sequence[RigCamera],
        of_points: NDArray[np.int64],
        options: EstimationOptions | None = None,
    ) -> None:
        super().__init__(model, cameras[0].camera, options)
        self.cameras, self.of_points = tuple(cameras), of_points
        d = len(model.parameters)
        self._seen = [
            (part, part.chain(d), rows)
            for number, part in enumerate(self.cameras)
            if len(rows := np.flatnonzero(of_points == number))
        ]

    def taking(self, rows: NDArray[np.int64]) -> PointsEstimator:
        """The same of some of the points."""
        found = PointsEstimator(self.model, self.cameras, self.of_points[rows], self.options)
        found.box = self.box
        return found

    def of_pixels(
        self, points: BoundPoints, pixels: Array, weights: Array, state: State, normals: Array
    ) -> tuple[float, Array, Array, Array]:
        """As of `Estimator`, each point in the camera that saw it."""
        if len(self.cameras) == 1:
            return super().of_pixels(points, pixels, weights, state, normals)
        size, huber_px = len(state.parameters) + 6, self.options.huber_px
        cost, hessian, gradient, residuals = 0.0, np.zeros((size, size)), np.zeros(size), np.empty_like(pixels)
        for part, chain, rows in self._seen:
            of_part, seen = points.take(rows).in_state(part.seen(state)), (pixels[rows], weights[rows], normals[rows])
            found = linearise(*of_part, part.camera.intrinsics, *seen, huber_px)
            cost += found[0]
            hessian += chain.T @ found[1] @ chain
            gradient += chain.T @ found[2]
            residuals[rows] = found[3]
        return cost, hessian, gradient, residuals

    def pixels(self, points: BoundPoints, state: State) -> Array:
        """Where the cameras see the points (p, 2) in a state."""
        found = np.empty((len(points), 2))
        for part, _, rows in self._seen:
            found[rows] = part.camera.project(points.take(rows).in_camera(part.seen(state)))
        return found
