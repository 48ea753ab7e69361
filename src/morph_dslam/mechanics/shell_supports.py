"""How the supports of a shell hold the direction of its edges, beside the place of its nodes (`supports`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.supports import AffineMotion, RigidRotation, cross_matrix
from morph_dslam.meshing.meshes import Mesh

Array = NDArray[np.float64]
#: A set lies in a plane if it extends across it by this part of its size at most: files round coordinates.
IN_PLANE = 0.01


@dataclass(frozen=True, eq=False)
class Clamp(RigidRotation):
    """Moves a set of a shell as a rigid body, its place and the direction of its normals."""

    def undeformed_normal(self, averaged: Any) -> Any:
        """The normal on edges that is held of the undeformed shell, from that of its cells; not of unit length."""
        return averaged

    def edge_normal(self, undeformed: Any, averaged: Any, share: Any) -> Any:
        """The normal that is held, from the undeformed one and from that of the cells; not of unit length.

        It has turned by that ``share`` of the angle that the support turns it by.
        """
        x, y, z = np.array(self.axis, dtype=float) / np.linalg.norm(self.axis)
        cross = cross_matrix(x, y, z)
        matrices = [ngs.CF(tuple(m.ravel()), dims=(3, 3)) for m in (np.eye(3), cross, cross @ cross)]
        angle = share * self.angle
        turn = matrices[0] + ngs.sin(angle) * matrices[1] + (1.0 - ngs.cos(angle)) * matrices[2]
        return turn * undeformed


@dataclass(frozen=True, eq=False)
class SymmetryPlane:
    """Keeps a set in a plane across a coordinate axis, and the normals of the shell there along the plane.

    Attributes
    ----------
    on : node set.
    axis : 0, 1 or 2: the plane is across x, y or z.
    """

    on: str
    axis: int
    centred_on = None

    def check(self, mesh: Mesh) -> None:
        """Refuse a set that does not lie in one plane across the axis (StudyError)."""
        points = mesh.nodes[mesh.set_nodes(self.on)]
        extents = np.ptp(points, axis=0)
        if extents[self.axis] > IN_PLANE * extents.max():
            axis = "xyz"[self.axis]
            raise StudyError(
                f"the set '{self.on}' is in no plane across {axis}: it extends {1e3 * extents[self.axis]:.4g} mm along "
                f"{axis}; name the axis that its plane is across, or another set"
            )

    @property
    def components(self) -> tuple[bool, bool, bool]:
        return self.axis == 0, self.axis == 1, self.axis == 2

    def motion(self, symbols: ParameterSymbols, centroid: Array, centroid_slopes: Array) -> AffineMotion:
        d = len(symbols)
        return AffineMotion(np.zeros((3, 3)), np.zeros(3), np.zeros((d, 3, 3)), np.zeros((d, 3)))

    def undeformed_normal(self, averaged: Any) -> Any:
        """See `Clamp`."""
        across = ngs.CF(tuple(np.eye(3)[self.axis]))
        return averaged - (averaged * across) * across

    def edge_normal(self, undeformed: Any, averaged: Any, share: Any) -> Any:
        """See `Clamp`."""
        return self.undeformed_normal(averaged)


#: Supports that say where the normals on the edges of their set point.
HoldsDirection = Clamp | SymmetryPlane


def clamped(on: str) -> Clamp:
    """Holds place and direction of a set as they are."""
    return Clamp(on, (0.0, 0.0, 1.0), 0.0)
