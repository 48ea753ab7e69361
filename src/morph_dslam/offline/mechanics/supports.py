"""What holds a solid: prescribed displacement and rigid rotation of named sets, elastic foundations.

Every prescribed motion is affine in the position, u(X) = A X + b, so that second-order elements, whose shapes
are isoparametric, take it exactly. Where two supports hold the same component of the same node, the one
listed first decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.offline.mechanics.parameters import ParameterSymbols, Scalar

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AffineMotion:
    """u(X) = matrix X + shift of the held points.

    Attributes
    ----------
    matrix (3, 3), shift (3,) in m; matrix_slopes (d, 3, 3) and shift_slopes (d, 3) by the parameters.
    """

    matrix: Array
    shift: Array
    matrix_slopes: Array
    shift_slopes: Array


class PrescribedMotion(Protocol):
    """A support that prescribes displacements of the set ``on``."""

    @property
    def on(self) -> str: ...
    @property
    def components(self) -> tuple[bool, bool, bool]:
        """Which of x, y and z are held."""
        ...

    @property
    def centred_on(self) -> str | None:
        """The set whose centroid the motion depends on, if any."""
        ...

    def motion(self, symbols: ParameterSymbols, centroid: Array, centroid_slopes: Array) -> AffineMotion:
        """The motion at the present parameters, given that centroid (3,) and its derivatives (d, 3)."""
        ...


@dataclass(frozen=True, eq=False)
class PrescribedDisplacement:
    """Holds the given components of the displacement of a set; a component that is None stays free.

    A symmetry plane or a roller holds the component normal to it at zero.

    Attributes
    ----------
    on : node set or surface.
    x, y, z : displacement, m: a number or an expression of parameters.
    """

    on: str
    x: Scalar | None = None
    y: Scalar | None = None
    z: Scalar | None = None
    centred_on = None

    @property
    def components(self) -> tuple[bool, bool, bool]:
        return self.x is not None, self.y is not None, self.z is not None

    def motion(self, symbols: ParameterSymbols, centroid: Array, centroid_slopes: Array) -> AffineMotion:
        values = [0.0 if value is None else value for value in (self.x, self.y, self.z)]
        d = len(symbols)
        return AffineMotion(
            matrix=np.zeros((3, 3)),
            shift=np.array([symbols.value(value) for value in values]),
            matrix_slopes=np.zeros((d, 3, 3)),
            shift_slopes=np.column_stack([symbols.slopes(value) for value in values]),
        )


def fixed(on: str) -> PrescribedDisplacement:
    """Holds all components of a set at zero."""
    return PrescribedDisplacement(on, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class RigidRotation:
    """Moves a set as a rigid body: a finite rotation about an axis through a centre, then a translation.

    R = 1 + sin(angle) K + (1 - cos(angle)) K^2 with K the cross product with the unit axis (Rodrigues).

    Attributes
    ----------
    on : node set or surface.
    axis : (3,) direction of the axis, right-handed; its length does not matter.
    angle : rad: a number or an expression of parameters.
    centre : point (3,) on the axis, m, or the name of the set whose centroid (mean of its nodes) it is; None
        for the set's own.
    translation : m, numbers or expressions.
    """

    on: str
    axis: tuple[float, float, float]
    angle: Scalar
    centre: tuple[Scalar, Scalar, Scalar] | str | None = None
    translation: tuple[Scalar, Scalar, Scalar] = (0.0, 0.0, 0.0)
    components = (True, True, True)

    def __post_init__(self) -> None:
        if not np.linalg.norm(self.axis) > 0.0:
            raise StudyError(f"the axis of the rotation of '{self.on}' has no direction: {self.axis}")

    @property
    def centred_on(self) -> str | None:
        if self.centre is None:
            return self.on
        return self.centre if isinstance(self.centre, str) else None

    def motion(self, symbols: ParameterSymbols, centroid: Array, centroid_slopes: Array) -> AffineMotion:
        x, y, z = np.array(self.axis, dtype=float) / np.linalg.norm(self.axis)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        angle = symbols.value(self.angle)
        matrix = np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
        per_angle = np.cos(angle) * cross + np.sin(angle) * cross @ cross
        matrix_slopes = symbols.slopes(self.angle)[:, None, None] * per_angle
        if isinstance(self.centre, tuple):
            centroid = np.array([symbols.value(value) for value in self.centre])
            centroid_slopes = np.column_stack([symbols.slopes(value) for value in self.centre])
        translation = np.array([symbols.value(value) for value in self.translation])
        translation_slopes = np.column_stack([symbols.slopes(value) for value in self.translation])
        return AffineMotion(
            matrix=matrix,
            shift=translation - matrix @ centroid,
            matrix_slopes=matrix_slopes,
            shift_slopes=translation_slopes - matrix_slopes @ centroid - centroid_slopes @ matrix.T,
        )


@dataclass(frozen=True, eq=False)
class ElasticFoundation:
    """Springs spread over a surface that resist its displacement (Winkler): energy k/2 |u|^2 per area.

    Attributes
    ----------
    on : surface.
    stiffness : k, Pa/m, on the undeformed area: a number or an expression of parameters.
    normal_only : resist the displacement along the undeformed normal alone.
    """

    on: str
    stiffness: Scalar
    normal_only: bool = False
