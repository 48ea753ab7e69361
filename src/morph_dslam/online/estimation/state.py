"""What is estimated, and the surface points that it is estimated from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.geometry import RigidTransform, rotation_exp
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

    def in_camera(self, state: State) -> Array:
        """Positions (p, 3) in the camera frame, metres."""
        return state.camera_from_object.apply(self.rest + self.field.value(state.parameters))


def moved(state: State, step: Array) -> State:
    """The state after an increment (d + 6,): parameters added, pose increment on the left."""
    d = len(state.parameters)
    pose = state.camera_from_object
    rotation = rotation_exp(step[d : d + 3]) @ pose.rotation
    return State(state.parameters + step[:d], RigidTransform(rotation, pose.translation + step[d + 3 :]))
