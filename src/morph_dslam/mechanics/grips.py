"""Rigid grips on the short edges of a sheet: how they move, and the coordinates that a model uses for it.

The object frame has its origin at the sheet's centre, x along the length, y up, z out of the face. Each grip holds a
rectangle rigidly and turns about the middle of its inner edge. Five numbers describe their motion (`MOTION`):

* bend_left, bend_right: rotation about the vertical axis, rad; both positive: the sheet arches to +z
* twist: relative rotation about the x axis, rad, half to each grip
* approach: how much closer the grips are, m
* turn: rotation of both in the sheet's plane, rad

The reduced model has four coordinates (`COORDINATES`):

* bulge: signed mean height of the middle of the sheet over the line between the grips, m
* bend: symmetric bend, as a multiple of that of a circular arc with this bulge; 1 is bent by pure moments, about 0.78
  is held like a hinge, 0 is clamped straight (Euler's column), above 1 pulled
* skew: antisymmetric bend, (bend_left - bend_right) / 2, rad
* slant: twist, as a multiple of twice the bend of that arc, levelled off (`LEVELLING`): in a gently bent sheet the
  tangent of the angle by which the rulings lean

For given angles and approach there may be two shapes, one to either side, or none; a thin sheet stays developable, so
it cannot twist without bending either. Over the four coordinates the family of shapes is one smooth graph. In the flat
state bend and slant have no effect: images cannot observe them there. The approach follows from the bulge, and no
moment acts on the turn. The grips do not turn against each other: a sheet that may fan out changes between cones with
their tips above and below at the slightest cause, and no smooth function of few terms follows it there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: End slope of a shallow circular arc over (mean height / free length), the mean weighted by cos^2 over the free
#: length.
ARC_SLOPE = 4.0 / (4.0 * (0.25 - (1.0 / 12.0 - 1.0 / (2.0 * np.pi**2))))
#: The twist grows in proportion to the bulge up to about this part of the free length, then levels off: what a slightly
#: bent sheet can follow would tear a strongly bent one apart.
LEVELLING = 0.1
MOTION = ("bend_left", "bend_right", "twist", "approach", "turn")
COORDINATES = ("bulge", "bend", "skew", "slant")
#: Motions that are unknowns of the equilibrium problem: found from the bulge and from zero moment.
FREE_MOTIONS = (3, 4)


@dataclass(frozen=True)
class Grips:
    """Two rectangles at the ends of a sheet of ``length``.

    Attributes
    ----------
    length : of the sheet along x, m.
    depth : how far each grip reaches over the sheet, m.
    height : of each grip along y, m.
    centre_left : y of the left grip's centre, m.
    centre_right : y of the right grip's centre, m.
    """

    length: float
    depth: float
    height: float
    centre_left: float
    centre_right: float

    @property
    def free_length(self) -> float:
        return self.length - 2.0 * self.depth

    @property
    def pivots(self) -> tuple[Array, Array]:
        """Middles of the grips' inner edges, about which they turn, metres."""
        offset = self.length / 2.0 - self.depth
        return np.array([-offset, self.centre_left, 0.0]), np.array([offset, self.centre_right, 0.0])

    def prescribed_motion(self, coordinates: Array) -> Array:
        """Motion (5,) that the coordinates (4,) prescribe; the free motions are left zero."""
        bulge, bend, skew, slant = coordinates
        arc = ARC_SLOPE * bulge / self.free_length
        twist = 2.0 * slant * ARC_SLOPE * self._twist_scale(bulge)[0]
        return np.array([bend * arc + skew, bend * arc - skew, twist, 0.0, 0.0])

    def _twist_scale(self, bulge: float) -> tuple[float, float]:
        """Bulge over the free length, levelled off; and its derivative."""
        x = bulge / self.free_length
        square = 1.0 + (x / LEVELLING) ** 2
        return x / square**0.5, 1.0 / square**1.5 / self.free_length

    def prescribed_motion_gradient(self, coordinates: Array) -> Array:
        """Derivative (5, 4) of `prescribed_motion`."""
        bulge, bend, _, slant = coordinates
        scale = ARC_SLOPE / self.free_length
        twist, twist_slope = self._twist_scale(bulge)
        gradient = np.zeros((5, 4))
        gradient[:3, 0] = bend * scale, bend * scale, 2.0 * slant * ARC_SLOPE * twist_slope
        gradient[:2, 1] = bulge * scale
        gradient[:2, 2] = 1.0, -1.0
        gradient[2, 3] = 2.0 * ARC_SLOPE * twist
        return gradient

    def positions(self, motion: Array, left: Array, right: Array) -> Array:
        """Positions (n_left + n_right, 3) of material points (n, 3) held by the grips."""
        bend_left, bend_right, twist, approach, turn = motion
        pivot_left, pivot_right = self.pivots
        shift = np.array([approach / 2.0, 0.0, 0.0])
        rotation_left = _about(0, -twist / 2.0) @ _about(2, turn) @ _about(1, -bend_left)
        rotation_right = _about(0, twist / 2.0) @ _about(2, turn) @ _about(1, bend_right)
        return np.vstack(
            [
                (left - pivot_left) @ rotation_left.T + pivot_left + shift,
                (right - pivot_right) @ rotation_right.T + pivot_right - shift,
            ]
        )

    def velocity(self, motion: Array, left: Array, right: Array) -> Array:
        """Derivative (n_left + n_right, 3, 5) of `positions` by central differences.

        The rotations are entire functions with derivatives below one: a step of 1e-5 is exact to 1e-11.
        """
        step = 1e-5
        columns = []
        for index in range(5):
            change = np.zeros(5)
            change[index] = step
            forward = self.positions(motion + change, left, right)
            backward = self.positions(motion - change, left, right)
            columns.append((forward - backward) / (2.0 * step))
        return np.stack(columns, axis=-1)


def _about(axis: int, angle: float) -> Array:
    """Rotation (3, 3) about a coordinate axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.eye(3)
    rotation[i, i] = rotation[j, j] = np.cos(angle)
    rotation[j, i] = np.sin(angle)
    rotation[i, j] = -rotation[j, i]
    return rotation
