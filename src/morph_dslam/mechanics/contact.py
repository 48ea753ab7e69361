"""What the surfaces of a solid touch: rigid obstacles, and other parts of the surface. There is no friction.

`contact_assembly` says how contact is solved.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.materials.base import evaluate
from morph_dslam.mechanics.parameters import ParameterSymbols, Scalar

Array = NDArray[np.float64]
Vector = tuple[Scalar, Scalar, Scalar]


@dataclass(frozen=True)
class Touch:
    """Where points are in relation to an obstacle of smooth shape.

    Attributes
    ----------
    gap : (q,) distance from it, m; negative inside.
    normal : (q, 3) derivatives of the gap by the point: the obstacle's outward unit normal.
    curvature : (q, 3, 3) second derivatives, 1/m.
    """

    gap: Array
    normal: Array
    curvature: Array


class RigidObstacle(Protocol):
    """A rigid body of smooth shape that a surface cannot enter."""

    @property
    def on(self) -> str:
        """The surface."""
        ...

    @property
    def name(self) -> str:
        """What messages call it."""
        ...

    @property
    def tolerance(self) -> float:
        """By how much its surface may be off, m."""
        ...

    def touch(self, symbols: ParameterSymbols, points: Array) -> Touch:
        """Where ``points`` (q, 3), m, are at the present parameters."""
        ...

    def slopes(self, symbols: ParameterSymbols) -> tuple[Array, Array]:
        """Derivatives by the parameters of its place (d, 3) and of all gaps at a fixed place (d,)."""
        ...


@dataclass(frozen=True, eq=False)
class RigidPlane:
    """Everything behind a plane.

    Attributes
    ----------
    on : surface.
    point : of the plane, m: numbers or expressions of parameters.
    normal : (3,) towards the solid; its length does not matter.
    """

    on: str
    point: Vector
    normal: tuple[float, float, float]
    name, tolerance = "plane", 0.0

    def __post_init__(self) -> None:
        _check_direction(self.on, "normal", self.normal)

    def touch(self, symbols: ParameterSymbols, points: Array) -> Touch:
        """See `RigidObstacle`."""
        unit, point = _unit(self.normal), symbols.values(self.point)
        return Touch((points - point) @ unit, np.tile(unit, (len(points), 1)), np.zeros((len(points), 3, 3)))

    def slopes(self, symbols: ParameterSymbols) -> tuple[Array, Array]:
        """See `RigidObstacle`."""
        return symbols.vector_slopes(self.point), np.zeros(len(symbols))


@dataclass(frozen=True, eq=False)
class RigidSphere:
    """A ball, or everything around one.

    Attributes
    ----------
    on : surface.
    centre : m: numbers or expressions of parameters.
    radius : m, positive: a number or an expression.
    inside : whether the solid is inside of the sphere.
    """

    on: str
    centre: Vector
    radius: Scalar
    inside: bool = False
    name, tolerance = "sphere", 0.0

    def __post_init__(self) -> None:
        _check_radius(self.radius)

    def touch(self, symbols: ParameterSymbols, points: Array) -> Touch:
        """See `RigidObstacle`."""
        arms = points - symbols.values(self.centre)
        return _around(arms, np.eye(3), symbols.value(self.radius), self.inside)

    def slopes(self, symbols: ParameterSymbols) -> tuple[Array, Array]:
        """See `RigidObstacle`."""
        return symbols.vector_slopes(self.centre), _sign(self.inside) * -symbols.slopes(self.radius)


@dataclass(frozen=True, eq=False)
class RigidCylinder:
    """A rod without ends, or everything around one.

    Attributes
    ----------
    on : surface.
    point : of the axis, m: numbers or expressions of parameters.
    axis : (3,) direction; its length does not matter.
    radius : m, positive: a number or an expression.
    inside : whether the solid is inside of the cylinder.
    """

    on: str
    point: Vector
    axis: tuple[float, float, float]
    radius: Scalar
    inside: bool = False
    name, tolerance = "cylinder", 0.0

    def __post_init__(self) -> None:
        _check_direction(self.on, "axis", self.axis)
        _check_radius(self.radius)

    def touch(self, symbols: ParameterSymbols, points: Array) -> Touch:
        """See `RigidObstacle`."""
        across = np.eye(3) - np.outer(_unit(self.axis), _unit(self.axis))
        arms = (points - symbols.values(self.point)) @ across
        return _around(arms, across, symbols.value(self.radius), self.inside)

    def slopes(self, symbols: ParameterSymbols) -> tuple[Array, Array]:
        """See `RigidObstacle`."""
        return symbols.vector_slopes(self.point), _sign(self.inside) * -symbols.slopes(self.radius)


@dataclass(frozen=True, eq=False)
class SurfaceContact:
    """Two surfaces of the solid that cannot pass through each other, or one that cannot pass through itself.

    Attributes
    ----------
    on : surface.
    against : the other surface, or the same.
    """

    on: str
    against: str

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"surface '{self.against}'"


Contact = RigidObstacle | SurfaceContact


def _check_direction(on: str, name: str, direction: tuple[float, float, float]) -> None:
    if not np.linalg.norm(direction) > 0.0:
        raise StudyError(f"the {name} of the contact on '{on}' has no direction: {direction}")


def _check_radius(radius: Scalar) -> None:
    """Refuse a radius that is not positive at the parameters' present values (StudyError)."""
    if not (value := evaluate(radius)) > 0.0:
        raise StudyError(f"radius = {1e3 * value:.4g} mm must be positive")


def _unit(direction: tuple[float, float, float]) -> Array:
    return np.array(direction, dtype=float) / np.linalg.norm(direction)


def _sign(inside: bool) -> float:
    return -1.0 if inside else 1.0


def _around(arms: Array, across: Array, radius: float, inside: bool) -> Touch:
    """Of points at ``arms`` (q, 3) from the nearest point of a centre or axis; ``across`` projects on their space."""
    lengths = np.maximum(np.linalg.norm(arms, axis=1), 1e-12 * radius)
    normals, sign = arms / lengths[:, None], _sign(inside)
    curvature = (across - normals[:, :, None] * normals[:, None, :]) / lengths[:, None, None]
    return Touch(sign * (lengths - radius), sign * normals, sign * curvature)
