"""Several synchronised cameras that are fixed to each other: one estimate from what all of them see.

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

from morph_dslam.camera import PinholeCamera
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import ReducedModel
from morph_dslam.online.anchored.known_pose import KnownPose
from morph_dslam.online.estimation.estimator import Estimate, EstimationOptions, Estimator, Prior, State
from morph_dslam.online.estimation.levenberg_marquardt import minimise
from morph_dslam.online.estimation.linear_cost import LinearCost
from morph_dslam.online.uncertainty.measurement_noise import RigMeasured

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RigCamera:
    """A camera and where it is: ``camera_from_rig``, metres; the first camera's is the identity."""

    camera: PinholeCamera
    camera_from_rig: RigidTransform

    def seen(self, state: State) -> State:
        """The state in this camera's frame of a state in the rig's."""
        return replace(state, camera_from_object=self.camera_from_rig @ state.camera_from_object)

    def seen_pose(self, known: KnownPose) -> KnownPose:
        """The pose in this camera of what the map tells of that in the rig's; the rig itself is exact."""
        rotation = self.camera_from_rig.rotation
        turn = np.asarray(scipy.linalg.block_diag(rotation, rotation))
        return KnownPose(
            self.camera_from_rig @ known.pose, turn @ known.from_camera @ turn.T, turn @ known.lasting
        )

    def in_rig(self, state: State) -> State:
        """The inverse of `seen`."""
        return replace(state, camera_from_object=self.camera_from_rig.inverse @ state.camera_from_object)

    def chain(self, n_parameters: int) -> Array:
        """(d + 6, d + 6) from increments in the rig's frame to those in the camera's."""
        rotation = self.camera_from_rig.rotation
        return np.asarray(scipy.linalg.block_diag(np.eye(n_parameters), rotation, rotation))


class RigEstimator:
    """Finds states from what several cameras measured at the same time; as `Estimator` for one.

    Parameters
    ----------
    cameras : of the rig. What they measured comes in the same order.
    """

    def __init__(
        self, model: ReducedModel, cameras: Sequence[RigCamera], options: EstimationOptions | None = None
    ) -> None:
        self.model, self.cameras = model, tuple(cameras)
        self.options = options or EstimationOptions()
        self._single = [Estimator(model, part.camera, self.options) for part in self.cameras]
        self._chains = [part.chain(len(model.parameters)) for part in self.cameras]

    @property
    def scale(self) -> Array:
        """Of the unknowns (d + 6,), as `Estimator` has it."""
        return self._single[0].scale

    def evaluate(
        self, measured: RigMeasured, state: State, prior: Prior | None = None
    ) -> tuple[float, Array, Array, Array]:
        """Cost, Hessian, gradient, and residuals (p, 2) of all points at a state in the rig's frame."""
        size = len(state.parameters) + 6
        cost, hessian, gradient, residuals = 0.0, np.zeros((size, size)), np.zeros(size), []
        for single, part, chain, view in zip(
            self._single, self.cameras, self._chains, measured.views, strict=True
        ):
            found = single.evaluate(
                view.points,
                view.pixels,
                view.weights,
                part.seen(state),
                view.normals,
                depths=view.depths,
            )
            cost += found[0]
            hessian += chain.T @ found[1] @ chain
            gradient += chain.T @ found[2]
            residuals.append(found[3])
        if prior is not None:
            terms = prior.terms(state)
            cost, hessian, gradient = cost + terms[0], hessian + terms[1], gradient + terms[2]
        return cost, hessian, gradient, np.concatenate(residuals)

    def fit(self, measured: RigMeasured, start: State, prior: Prior | None = None) -> Estimate:
        """Minimise the sum of all cameras' costs from ``start``, a state in the rig's frame."""
        options, first = self.options, self._single[0]
        found = minimise(
            lambda state: self.evaluate(measured, state, prior),
            start,
            first.box,
            options.max_iterations,
            options.tolerance,
        )
        return first.finished(found, measured.weights, measured.numbers)

    def linear(self, measured: RigMeasured, estimate: Estimate) -> LinearCost:
        """The cost of what was measured, about an estimate made from it."""
        costs, first = [], 0
        for single, part, chain, view in zip(
            self._single, self.cameras, self._chains, measured.views, strict=True
        ):
            last = first + len(view.points)
            seen = replace(
                estimate, state=part.seen(estimate.state), residuals=estimate.residuals[first:last]
            )
            costs.append(single.linear(view, seen).in_unknowns(chain))
            first = last
        return LinearCost.joined(costs)
