"""What is estimated, and the surface points that it is estimated from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.geometry import RigidTransform, rotation_exp, rotation_log
from morph_dslam.model import ReducedModel, SeparatedField, SurfacePoints

Array = NDArray[np.float64]


@dataclass(frozen=True)
class State:
    """What is estimated in every frame: parameters (d,) in SI units and the object's pose."""

    parameters: Array
    camera_from_object: RigidTransform


@dataclass(frozen=True)
class BoundPoints:
    """Surface points with the displacement field restricted to them.

    Attributes
    ----------
    surface : where the p points are on the mesh.
    rest : (p, 3) undeformed positions, metres.
    field : displacement at the points only, metres.
    """

    surface: SurfacePoints
    rest: Array
    field: SeparatedField

    @classmethod
    def from_surface(cls, model: ReducedModel, surface: SurfacePoints) -> BoundPoints:
        """Points of a model's surface."""
        return cls(surface, model.rest_positions(surface), model.restrict(surface))

    def __len__(self) -> int:
        return len(self.rest)

    def joined(self, other: BoundPoints) -> BoundPoints:
        """These points followed by ``other`` ones of the same model."""
        surface = SurfacePoints(
            np.concatenate([self.surface.triangles, other.surface.triangles]),
            np.concatenate([self.surface.weights, other.surface.weights]),
        )
        modes = np.concatenate([self.field.modes, other.field.modes], axis=1)
        rest = np.concatenate([self.rest, other.rest])
        return BoundPoints(surface, rest, self.field.with_modes(modes))

    def corners(self, model: ReducedModel) -> BoundPoints:
        """The three corners of each point's triangle, (3 p) points."""
        surface = SurfacePoints(np.repeat(self.surface.triangles, 3), np.tile(np.eye(3), (len(self), 1)))
        return BoundPoints.from_surface(model, surface)

    def take(self, rows: NDArray[np.int64]) -> BoundPoints:
        """The points at ``rows`` (k,)."""
        field = self.field.with_modes(self.field.modes[:, rows])
        return BoundPoints(self.surface.take(rows), self.rest[rows], field)

    def in_state(
        self, state: State, rows: Array | None = None
    ) -> tuple[Array, Array, Array, Array, NDArray[np.floating]]:
        """What compiled functions take of the points in a state; see `reprojection.linearise`.

        ``rows`` (1 + d, m) : other values and derivatives of the functions than those of the state.
        """
        pose = state.camera_from_object
        rows = self.field.functions.rows(state.parameters) if rows is None else rows
        return rows, pose.rotation, pose.translation, self.rest, self.field.modes

    def in_camera(self, state: State) -> Array:
        """Positions (p, 3) in the camera frame, metres."""
        pose = state.camera_from_object
        return self.field.placed(self.rest, state.parameters, pose.rotation, pose.translation)


def moved(state: State, step: Array) -> State:
    """The state after an increment (d + 6,): parameters added, pose increment on the left."""
    d = len(state.parameters)
    pose = state.camera_from_object
    rotation = rotation_exp(step[d : d + 3]) @ pose.rotation
    return State(state.parameters + step[:d], RigidTransform(rotation, pose.translation + step[d + 3 :]))


def pose_increment(before: RigidTransform, pose: RigidTransform) -> Array:
    """The increment (6,) that `moved` applies to the pose ``before`` to make it ``pose``."""
    return np.concatenate([rotation_log(pose.rotation @ before.rotation.T), pose.translation - before.translation])


@dataclass(frozen=True)
class Prior:
    """What is known of the parameters, and of the pose, beforehand, as one more term of the cost.

    Attributes
    ----------
    mean : (d,), SI
    information : (d, d), the Hessian of the cost (mu - mean)' I (mu - mean) / 2, in squared pixels as the
        cost; zero for parameters of which nothing is known.
    pose : camera_from_object as known beforehand; None if nothing is.
    pose_information : (6, 6) in the same unit, of the increment (rotation vector, translation) that `moved`
        applies to ``pose``; None if nothing is known.
    lasting : (6, k), the part of that increment's error that is the same in all frames, by its k error
        factors in their standard deviations; None if all of it is new in every frame.
    squared_px : variance of an image coordinate by which covariances were turned into information; 0 for a pose that
        is only held: none of its error is new in a frame.
    """

    mean: Array
    information: Array
    pose: RigidTransform | None = None
    pose_information: Array | None = None
    lasting: Array | None = None
    squared_px: float = 1.0

    def terms(self, state: State) -> tuple[float, Array, Array]:
        """Cost, Hessian (d + 6, d + 6) and gradient (d + 6,) of the prior at a state."""
        known, of_pose = self.pose, self.pose_information
        if known is None or of_pose is None:
            known, of_pose = state.camera_from_object, _NOTHING
        there = state.camera_from_object
        arrays = (self.mean, self.information, of_pose, known.rotation, known.translation)
        arrays = (*arrays, state.parameters, there.rotation, there.translation)
        return _prior_terms(*map(np.ascontiguousarray, arrays))

    def placed(self, state: State) -> State:
        """The state in the known pose, if there is one."""
        return state if self.pose is None else replace(state, camera_from_object=self.pose)

    @property
    def lasting_push(self) -> Array:
        """How the lasting errors enter the gradient (k, d + 6)."""
        d = len(self.mean)
        if self.lasting is None or self.pose_information is None:
            return np.zeros((0, d + 6))
        return np.hstack([np.zeros((self.lasting.shape[1], d)), self.lasting.T @ self.pose_information])

    def new_in_frame(self, information: Array) -> Array:
        """Covariance (d + 6, d + 6) of the gradient by errors that are new in every frame.

        ``information`` (d + 6, d + 6) is that of all it knows; what lasts is not among them.
        """
        if not self.squared_px:
            return np.zeros_like(information)
        return self.squared_px * information - self.lasting_push.T @ self.lasting_push

    def joined(self, other: Prior) -> Prior:
        """Both together; ``other`` says what is known of the pose."""
        information = self.information + other.information
        pushed = self.information @ self.mean + other.information @ other.mean
        # Parameters of different units differ by many powers of ten, so they are scaled before the inverse.
        # Directions of which neither knows anything keep a mean of zero, with no weight.
        diagonal = np.diag(information)
        scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
        inverse = np.linalg.pinv(information * np.outer(scale, scale))
        return replace(other, mean=scale * (inverse @ (scale * pushed)), information=information)


@njit(cache=True, nogil=True)
def _log_slope(turn):
    """Derivative (3, 3) of log(exp(w) exp(turn)) by w at w = 0: the inverse left Jacobian of SO(3).

    I - [turn]/2 + c [turn]² with c = 1/a² - 1 / (2 a tan(a/2)) (Barfoot, State Estimation for Robotics, 7.1).
    """
    angle = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    slope = np.empty((3, 3))
    c = 1.0 / 12.0 if angle < 1e-4 else 1.0 / angle**2 - 0.5 / (angle * np.tan(0.5 * angle))
    slope[0, 1], slope[0, 2], slope[1, 2] = 0.5 * turn[2], -0.5 * turn[1], 0.5 * turn[0]
    slope[1, 0], slope[2, 0], slope[2, 1] = -0.5 * turn[2], 0.5 * turn[1], -0.5 * turn[0]
    for i in range(3):  # [turn]² = turn turn' - a²
        slope[i, i] = 1.0 - c * angle**2
        for j in range(3):
            slope[i, j] += c * turn[i] * turn[j]
    return slope


@njit(cache=True, nogil=True)
def _pose_terms(information, known_rotation, known_translation, rotation, translation):
    """Cost, Hessian (6, 6) and gradient (6,) by the increment of a pose that is known to be another.

    Parameters
    ----------
    information : (6, 6), symmetric.
    known_rotation, known_translation : (3, 3) and (3,) of the known pose.
    rotation, translation : of the pose.
    """
    apart, away, slope, push, half = np.zeros((3, 3)), np.empty(6), np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                apart[i, j] += rotation[i, k] * known_rotation[j, k]
    turn, cost, hessian, gradient = rotation_log(apart), 0.0, np.zeros((6, 6)), np.zeros(6)
    by_turn = _log_slope(turn)
    for i in range(3):
        away[i], away[3 + i], slope[3 + i, 3 + i] = turn[i], translation[i] - known_translation[i], 1.0
        for j in range(3):
            slope[i, j] = by_turn[i, j]
    for i in range(6):
        for j in range(6):
            push[i] += information[i, j] * away[j]
            for k in range(6):
                half[i, j] += information[i, k] * slope[k, j]
        cost += 0.5 * away[i] * push[i]
    for i in range(6):
        for j in range(6):
            gradient[i] += slope[j, i] * push[j]
            for k in range(6):
                hessian[i, j] += slope[k, i] * half[k, j]
    return cost, hessian, gradient


@njit(cache=True, nogil=True)
def _prior_terms(
    mean, information, pose_information, known_rotation, known_translation, parameters, rotation, translation
):
    """What `Prior.terms` returns, compiled; the arguments are those of the prior, then those of the state."""
    d = len(mean)
    hessian, gradient = np.zeros((d + 6, d + 6)), np.zeros(d + 6)
    cost, of_pose, push = _pose_terms(pose_information, known_rotation, known_translation, rotation, translation)
    for i in range(6):
        gradient[d + i] = push[i]
        for j in range(6):
            hessian[d + i, d + j] = of_pose[i, j]
    for i in range(d):
        for j in range(d):
            hessian[i, j] = information[i, j]
            gradient[i] += information[i, j] * (parameters[j] - mean[j])
        cost += 0.5 * (parameters[i] - mean[i]) * gradient[i]
    return cost, hessian, gradient


#: The information of an unknown pose.
_NOTHING = np.zeros((6, 6))
