"""Whether landmarks in several cameras go together with how these stand to each other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from morph_dslam.better_fit import chance_of_better_fit
from morph_dslam.geometry import RigidTransform, rotation_log
from morph_dslam.registration.messages import CamerasContradict
from morph_dslam.registration.starts import pose_starts, shape_starts
from morph_dslam.tracking.estimator import BoundPoints, Estimate, State
from morph_dslam.tracking.rig import PointsEstimator
from morph_dslam.tracking.state import moved

Array = NDArray[np.float64]
#: Landmarks of cameras that stand as stated fit so much better with free poses with this chance at most.
RIG_CHANCE = 1e-4
#: So many landmarks of a camera show its pose about an object of known shape.
FEWEST_OF_CAMERA = 4


def cameras_contradict(
    estimator: PointsEstimator,
    bound: BoundPoints,
    pixels: Array,
    together: Estimate,
    click_px: float,
    is_far: bool = False,
) -> CamerasContradict | None:
    """That a camera stands or looks elsewhere than stated, as its landmarks have it; None if all may be right.

    All cameras see one shape. The statistic is F of the poses of the further cameras, set free, given the error that
    the landmarks show then, or that of carefully set ones if that is larger. Of several cameras the one is named whose
    landmarks are farthest from where its stated pose has them.

    Parameters
    ----------
    estimator : of all cameras.
    bound, pixels : their landmarks (k,).
    together : what these give with the stated poses.
    click_px : standard deviation of a carefully set landmark.
    is_far : whether they hardly fit together, so that the search begins with what each camera has by itself.
    """
    counts = np.bincount(estimator.of_points, minlength=len(estimator.cameras))
    freed = [number for number in range(1, len(counts)) if counts[number] >= FEWEST_OF_CAMERA]
    shape = np.flatnonzero(estimator.box.upper > estimator.box.lower)
    n_freed = 6 * len(freed)
    freedom = 2 * len(bound) - len(shape) - 6 - n_freed
    squares = float(np.sum(together.residuals**2))

    def is_chance(left: float) -> bool:
        return chance_of_better_fit(squares, left, n_freed, freedom, click_px) > RIG_CHANCE

    # Free poses that explain all of it have the largest F, which spares most fits.
    if not freed or counts[0] < FEWEST_OF_CAMERA or freedom < 1 or is_chance(0.0):
        return None
    poses = [part.camera_from_rig for part in estimator.cameras]
    state = together.state
    if is_far:
        state, poses = _each_alone(estimator, bound, pixels, state)
    free = _FreePoses(estimator, bound, pixels, state, poses, shape, freed)
    if not np.isfinite(free.residuals(np.zeros(len(free.units)))).all():
        return None  # a landmark is behind a camera
    found = least_squares(free.residuals, np.zeros(len(free.units)), bounds=free.room, x_scale="jac")
    if is_chance(2.0 * found.cost):
        return None
    state, poses = free.taken(found.x)
    stated = [part.camera_from_rig for part in estimator.cameras]
    seen, by_stated = free.seen(state, poses), free.seen(state, stated)
    number = max(freed, key=lambda k: np.sum((seen[k] - by_stated[k]) ** 2) / counts[k])
    turn = rotation_log(poses[number].rotation @ stated[number].rotation.T)
    places = [pose.inverse.translation for pose in (poses[number], stated[number])]
    return CamerasContradict(
        number,
        float(np.degrees(np.linalg.norm(turn))),
        1e3 * float(np.linalg.norm(places[0] - places[1])),
        float(np.sqrt(2.0 * found.cost / freedom)),
        float(np.sqrt(squares / (freedom + n_freed))),
    )


@dataclass(frozen=True)
class _FreePoses:
    """The state of an object and the poses of further cameras, as the landmarks of all have them.

    Attributes
    ----------
    estimator, bound, pixels : of all landmarks (k,).
    state, poses : to begin with.
    shape : parameters that are not known.
    freed : numbers of the cameras whose poses are free.
    """

    estimator: PointsEstimator
    bound: BoundPoints
    pixels: Array
    state: State
    poses: list[RigidTransform]
    shape: NDArray[np.int64]
    freed: list[int]

    @cached_property
    def units(self) -> Array:
        """Of the unknowns: the parameters that are not known, the object's pose, and each free one."""
        scale = self.estimator.scale
        return np.concatenate([scale[self.shape], np.tile(scale[-6:], 1 + len(self.freed))])

    @property
    def room(self) -> tuple[Array, Array]:
        """How far the unknowns may go from the start, in their units."""
        box, there, units = self.estimator.box, self.state.parameters, self.units
        low, high = np.full(len(units), -np.inf), np.full(len(units), np.inf)
        n = len(self.shape)
        # A start at a bound must be within it.
        low[:n] = ((box.lower - there)[self.shape] / units[:n]).clip(max=0.0) - 1e-9
        high[:n] = ((box.upper - there)[self.shape] / units[:n]).clip(min=0.0) + 1e-9
        return low, high

    def taken(self, steps: Array) -> tuple[State, list[RigidTransform]]:
        """The state and the cameras' poses after steps in their units."""
        steps = self.units * steps
        n, d = len(self.shape), len(self.state.parameters)
        step, poses = np.zeros(d + 6), list(self.poses)
        step[self.shape], step[d:] = steps[:n], steps[n : n + 6]
        for number, own in zip(self.freed, steps[n + 6 :].reshape(-1, 6), strict=True):
            poses[number] = moved(State(np.zeros(0), poses[number]), own).camera_from_object
        return moved(self.state, step), poses

    def seen(self, state: State, poses: list[RigidTransform]) -> list[Array]:
        """Where each camera, in these poses, sees its landmarks."""
        return [
            part.camera.project(points.in_camera(replace(part, camera_from_rig=pose).seen(state)))
            for part, pose, points in zip(self.estimator.cameras, poses, self._points, strict=True)
        ]

    def residuals(self, steps: Array) -> Array:
        """Of all landmarks, (2 k,) pixels."""
        seen = zip(self.seen(*self.taken(steps)), self._rows, strict=True)
        return np.concatenate([(pixels - self.pixels[rows]).ravel() for pixels, rows in seen])

    @cached_property
    def _rows(self) -> list[NDArray[np.int64]]:
        of_points = self.estimator.of_points
        return [np.flatnonzero(of_points == number) for number in range(len(self.poses))]

    @cached_property
    def _points(self) -> list[BoundPoints]:
        return [self.bound.take(rows) for rows in self._rows]


def _each_alone(
    estimator: PointsEstimator, bound: BoundPoints, pixels: Array, together: State
) -> tuple[State, list[RigidTransform]]:
    """The state that the first camera's landmarks give, and the cameras' poses in which the others have it there."""
    box, poses, first = estimator.box, [], together
    shapes = [together.parameters, *([] if (box.lower == box.upper).all() else shape_starts(estimator.model))]
    for number, part in enumerate(estimator.cameras):
        rows = np.flatnonzero(estimator.of_points == number)
        if len(rows) < FEWEST_OF_CAMERA:
            poses.append(part.camera_from_rig)
            continue
        alone, points, seen = estimator.taking(rows), bound.take(rows), np.ascontiguousarray(pixels[rows])
        starts = [together, *pose_starts(shapes, alone, points, seen)]
        found = alone.estimate_from(points, seen, np.ones(len(rows)), starts)[0].state
        first = first if number else found
        in_camera = part.camera_from_rig @ found.camera_from_object
        poses.append(in_camera @ first.camera_from_object.inverse)
    return first, poses
