"""The [[supports]] and [[loads]] of a solid's study: each names a set of the mesh and what acts there.

A value is a number with its unit, the name of a parameter, or a linear expression of parameters
(`morph_dslam.offline.studies.affine`). ``make`` turns a section into what the solver understands.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import Field

from morph_dslam.offline.mechanics import loads, supports
from morph_dslam.offline.studies.study_sections import Number, PositiveLength, Section

#: A quantity in a study file.
Value = str | float
Triple = tuple[Value, Value, Value]
#: Turns a value that measures a quantity (None: any) into a number or an expression of parameters, SI.
Reader = Callable[[Value, str | None], Any]


def _triple(values: Triple, quantity: str, read: Reader) -> tuple[Any, Any, Any]:
    x, y, z = (read(value, quantity) for value in values)
    return x, y, z


class FixedSupport(Section):
    """Holds a set in all three directions."""

    kind: Literal["fixed"]
    on: str

    def make(self, read: Reader) -> supports.PrescribedDisplacement:
        return supports.fixed(self.on)


class DisplacementSupport(Section):
    """Moves a set by given lengths; a direction that is left out stays free."""

    kind: Literal["displacement"]
    on: str
    x: Value | None = None
    y: Value | None = None
    z: Value | None = None

    def make(self, read: Reader) -> supports.PrescribedDisplacement:
        values = [None if value is None else read(value, "length") for value in (self.x, self.y, self.z)]
        return supports.PrescribedDisplacement(self.on, *values)


class RotationSupport(Section):
    """Turns a set as a rigid body about an axis, then shifts it.

    ``axis`` gives the direction, right-handed; ``centre`` a point on it, or the set whose mean point it is
    (this one if absent).
    """

    kind: Literal["rotation"]
    on: str
    axis: tuple[Number, Number, Number]
    angle: Value
    centre: Triple | str | None = None
    translation: Triple = ("0 m", "0 m", "0 m")

    def make(self, read: Reader) -> supports.RigidRotation:
        centre = self.centre
        return supports.RigidRotation(
            self.on,
            self.axis,
            read(self.angle, "angle"),
            _triple(centre, "length", read) if isinstance(centre, tuple) else centre,
            _triple(self.translation, "length", read),
        )


class FoundationSupport(Section):
    """Springs spread over a surface: ``stiffness`` is force per area and displacement."""

    kind: Literal["foundation"]
    on: str
    stiffness: Value
    normal_only: bool = False

    def make(self, read: Reader) -> supports.ElasticFoundation:
        return supports.ElasticFoundation(
            self.on, read(self.stiffness, "stiffness per area"), self.normal_only
        )


class TractionLoad(Section):
    """Force per undeformed area that keeps its direction."""

    kind: Literal["traction"]
    on: str
    traction: Triple

    def make(self, read: Reader) -> loads.DeadTraction:
        return loads.DeadTraction(self.on, _triple(self.traction, "stress", read))


class PressureLoad(Section):
    """Pressure that follows the deformed surface; positive pushes inwards."""

    kind: Literal["pressure"]
    on: str
    pressure: Value

    def make(self, read: Reader) -> loads.FollowerPressure:
        return loads.FollowerPressure(self.on, read(self.pressure, "pressure"))


class BodyForceLoad(Section):
    """Force per undeformed volume of a cell set."""

    kind: Literal["body_force"]
    on: str = "all"
    force: Triple

    def make(self, read: Reader) -> loads.BodyForce:
        return loads.BodyForce(_triple(self.force, "force per volume", read), self.on)


class GravityLoad(Section):
    """Weight: materials need their density."""

    kind: Literal["gravity"]
    acceleration: Triple = ("0 m/s2", "0 m/s2", "-9.80665 m/s2")

    def make(self, read: Reader) -> loads.Gravity:
        return loads.Gravity(_triple(self.acceleration, "acceleration", read))


class PointLoadSection(Section):
    """A force shared equally by the nodes of a set."""

    kind: Literal["point"]
    on: str
    force: Triple

    def make(self, read: Reader) -> loads.PointLoad:
        return loads.PointLoad(self.on, _triple(self.force, "force", read))


class MovingPatchLoad(Section):
    """A force spread over a round patch of a surface, whose ``centre`` may move with a parameter.

    ``width`` is the standard deviation of its Gaussian density, at least about half an element.
    """

    kind: Literal["moving_patch"]
    on: str
    force: Triple
    centre: Triple
    width: PositiveLength

    def make(self, read: Reader) -> loads.MovingPatch:
        force, centre = _triple(self.force, "force", read), _triple(self.centre, "length", read)
        return loads.MovingPatch(self.on, force, centre, self.width)


class MovingLineLoad(Section):
    """A force per length along a straight line over a surface; ``centre`` may move with a parameter."""

    kind: Literal["moving_line"]
    on: str
    force: Triple
    centre: Triple
    direction: tuple[Number, Number, Number]
    width: PositiveLength

    def make(self, read: Reader) -> loads.MovingLine:
        force, centre = _triple(self.force, "force per length", read), _triple(self.centre, "length", read)
        return loads.MovingLine(self.on, force, centre, self.direction, self.width)


SupportSection = Annotated[
    FixedSupport | DisplacementSupport | RotationSupport | FoundationSupport, Field(discriminator="kind")
]
LoadSection = Annotated[
    TractionLoad
    | PressureLoad
    | BodyForceLoad
    | GravityLoad
    | PointLoadSection
    | MovingPatchLoad
    | MovingLineLoad,
    Field(discriminator="kind"),
]
