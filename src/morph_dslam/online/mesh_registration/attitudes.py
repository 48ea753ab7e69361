"""Attitudes in which a surface starts when it is looked for in a map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.online.mesh_registration.surface import Axis

Array = NDArray[np.float64]

#: Turns about the normal of a plane that a body may stand on.
TURNS = 8
#: Directions of an axis nearer to each other than this (rad) are one.
ALIKE = 0.1


def attitudes(axis: Axis | None, normal: Array | None) -> list[Array]:
    """Rotations (3, 3), world from object: some spread over all, and those in which the body stands upright.

    Spread over all are those of the icosahedron. A body stands on the plane when one of the six directions of
    its frame's axes is along the plane's normal. Of a body of revolution only the direction of its axis
    counts.

    Parameters
    ----------
    axis : of a body of revolution. normal : (3,) of the plane that holds most of the map, if there is one.
    """
    rotations = list(Rotation.create_group("I").as_matrix())
    if normal is not None:
        rotations = [*_standing(normal, axis), *rotations]
    if axis is None:
        return rotations
    kept: list[Array] = []
    for rotation in rotations:
        if all(np.linalg.norm((rotation - other) @ axis.direction) > ALIKE for other in kept):
            kept.append(rotation)
    return kept


def _standing(normal: Array, axis: Axis | None) -> list[Array]:
    """Rotations that lay a direction of the object along a plane's normal, either side up."""
    if axis is not None:
        return [_onto(axis.direction, sign * normal) for sign in (1.0, -1.0)]
    turns = [Rotation.from_rotvec(2.0 * np.pi * k / TURNS * normal).as_matrix() for k in range(TURNS)]
    upright = [_onto(direction, normal) for direction in (*np.eye(3), *-np.eye(3))]
    return [turn @ rotation for rotation in upright for turn in turns]


def _onto(direction: Array, target: Array) -> Array:
    """A rotation that takes one direction to another; both of unit length."""
    return Rotation.align_vectors(target[None], direction[None])[0].as_matrix()
