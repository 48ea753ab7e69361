"""The mirrored tilt: from afar a flat object looks nearly the same tilted to either side.

Each of both tilts is a minimum of a frame's cost. Twice the difference of the costs, over the variance of a pixel
coordinate, is the log-likelihood ratio. Where it does not exclude the other tilt, the truth has two modes, and the
estimate stands in one: with the other one's probability p at a distance d, its mean square error is p d d' more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.geometry import RigidTransform
from morph_dslam.tracking.levenberg_marquardt import Minimum
from morph_dslam.tracking.state import BoundPoints, State, pose_increment

Array = NDArray[np.float64]
#: The other tilt is taken if it is likelier by so many standard deviations, and excluded if it is less likely by
#: as many as the second number.
LIKELIER, EXCLUDED = 3.0, 5.0
#: Two minima that are turned by less, rad, are one: from near, the mirrored tilt leads back to the estimate.
SAME_MINIMUM = np.radians(2.0)
#: Noise of a pixel coordinate is no smaller than this, pixels.
LEAST_NOISE_PX = 0.05


@dataclass(frozen=True)
class OtherTilt:
    """The state in the mirrored tilt that explains a frame best, beside the estimate.

    Attributes
    ----------
    state : there.
    apart : (d + 6,) unknowns from the estimate to it.
    ratio : twice the log of how many times likelier the estimate is.
    """

    state: State
    apart: Array
    ratio: float

    @property
    def probability(self) -> float:
        """That it is the right one of both."""
        return float(1.0 / (1.0 + np.exp(0.5 * min(self.ratio, 1e3))))

    @property
    def is_excluded(self) -> bool:
        """Whether there is none, or it is clearly less likely."""
        return self.ratio > EXCLUDED**2 or self.angle < SAME_MINIMUM

    @property
    def spread(self) -> Array:
        """What it adds to the estimate's covariance (d + 6, d + 6): its mean square error, not that of both's mean."""
        return self.probability * np.outer(self.apart, self.apart)

    @property
    def angle(self) -> float:
        """By which the object is turned from the one to the other, rad."""
        return float(np.linalg.norm(self.apart[-6:-3]))

    def left(self, state: State) -> OtherTilt:
        """The tilt of an estimate's ``state``, where this one is taken in its place."""
        return OtherTilt(state, -self.apart, -self.ratio)


def find_other_tilt(
    cost: Callable[[State], float],
    minimum: Callable[[State], Minimum],
    points: BoundPoints,
    state: State,
    n_numbers: int,
    redundancy: float,
) -> OtherTilt:
    """The minimum in the mirrored tilt, against that at a state; of one that is excluded at least so much likelier.

    Parameters
    ----------
    cost : of a frame at a state, squared pixels.
    minimum : of that cost from a start, no more than it is there.
    points : (p,) of the object.
    state : at or near the minimum where the frame has the object.
    n_numbers : that were measured.
    redundancy : so many of them count as one, as windows overlap.
    """
    positions = points.rest + points.field.value(state.parameters)
    pose = mirrored_tilt(positions, state.camera_from_object)
    there, freedom = minimum(State(state.parameters, pose)), max(n_numbers - len(state.parameters) - 6, 1)
    turned = pose_increment(state.camera_from_object, there.state.camera_from_object)
    apart = np.concatenate([there.state.parameters - state.parameters, turned])

    def against(here: float) -> OtherTilt:
        least = max(min(here, there.cost), 0.0)
        variance = redundancy * max(2.0 * least / freedom, LEAST_NOISE_PX**2)
        return OtherTilt(there.state, apart, 2.0 * (there.cost - here) / variance)

    # The smaller the cost here, the less likely is the other tilt: one that is excluded already need not be compared
    # with the minimum here, which takes as long as that there.
    other = against(cost(state))
    return other if other.is_excluded else against(minimum(state).cost)


def mirrored_tilt(points: Array, pose: RigidTransform) -> RigidTransform:
    """The pose in which flat points look the same from afar: tilted as much, the other way.

    Their depths beside that of their mean are reversed, which only perspective shows (Oberkampf, DeMenthon and Davis,
    Computer Vision and Image Understanding 63, 1996). The mirror image of points in a plane is a rotation of them.

    Parameters
    ----------
    points : (p, 3) in the object; the direction in which they are spread least takes the place of a plane's normal.
    pose : camera from object.
    """
    centre = points.mean(axis=0)
    at = pose.apply(centre)
    sight, normal = at / np.linalg.norm(at), np.linalg.svd(points - centre, full_matrices=False)[2][2]
    rotation = _mirror(sight) @ pose.rotation @ _mirror(normal)
    return RigidTransform(rotation, at - rotation @ centre)


def _mirror(direction: Array) -> Array:
    """The matrix (3, 3) that reverses a direction of length one."""
    return np.eye(3) - 2.0 * np.outer(direction, direction)
