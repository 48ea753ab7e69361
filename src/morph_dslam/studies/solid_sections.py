"""The [mesh], [[supports]], [[loads]], [[couplings]] and [[contacts]] sections of a solid's study.

A value is a number with its unit, the name of a parameter, or a linear expression of parameters
(`morph_dslam.studies.affine`). ``make`` turns a section into what the solver understands.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, Discriminator, Field, Tag

from morph_dslam.errors import StudyError
from morph_dslam.mechanics import contact, couplings, loads, supports
from morph_dslam.mechanics.rigid_mesh import RigidMesh
from morph_dslam.meshing import generators as mesh_generators
from morph_dslam.meshing.extrusion import Hole, extrusion
from morph_dslam.meshing.mesh_checks import LARGEST, MOST_CELLS, SMALLEST, check_mesh, described_extent
from morph_dslam.meshing.mesh_files import load_closed_surface, load_mesh
from morph_dslam.meshing.meshes import Mesh
from morph_dslam.studies.sections import Angle, LengthUnit, Number, PositiveLength, Section, SetName, StudyPath
from morph_dslam.units import to_si

CellName = Literal["hex8", "hex20", "hex27", "tet4", "tet10", "prism6", "prism15", "prism18"]
Count = Annotated[int, Field(ge=1)]
#: Units of mesh files, the most usual first, and the diagonal (metres) from which a mesh in one is no surprise.
_USUAL_UNITS, _LEAST_USUAL = ("mm", "m", "cm", "um"), 2e-3


def few_cells(divisions: tuple[int, ...]) -> tuple[int, ...]:
    """Divisions of a generator; ValueError if they make too many cells."""
    if math.prod(divisions) > MOST_CELLS:
        raise ValueError(f"these make {math.prod(divisions)} cells, and {MOST_CELLS} are the most")
    return divisions


Divisions = Annotated[tuple[Count, Count, Count], AfterValidator(few_cells)]


class FileMesh(Section):
    """A mesh file: Abaqus or CalculiX .inp, Gmsh .msh, VTK, STL, OBJ, PLY or STEP.

    ``file`` is relative to the study file; ``unit`` is that of its coordinates; ``size`` the longest edge of
    a cell where the file has a surface only and its volume is meshed.
    """

    file: StudyPath
    unit: LengthUnit
    size: PositiveLength | None = None

    def make(self) -> Mesh:
        return load_mesh(self.file, self.unit, self.size)


class _BlockMesh(Section):
    """A block from the origin along x, y and z; sets x_min, x_max, y_min, y_max, z_min, z_max."""

    generator: Literal["block"]
    size: tuple[PositiveLength, PositiveLength, PositiveLength]
    divisions: Divisions
    cells: CellName = "hex20"

    def make(self) -> Mesh:
        return mesh_generators.block(self.size, self.divisions, self.cells)


class _TubeMesh(Section):
    """A tube around the z axis; divisions are along z, through the wall and around it.

    Sets: inner, outer, bottom, top and, for less than a full turn, start and end.
    """

    generator: Literal["tube"]
    inner_radius: PositiveLength
    outer_radius: PositiveLength
    length: PositiveLength
    divisions: Divisions
    cells: CellName = "hex20"
    angles: tuple[Angle, Angle] = (0.0, 2.0 * np.pi)

    def make(self) -> Mesh:
        return mesh_generators.tube(
            self.inner_radius, self.outer_radius, self.length, self.divisions, self.cells, self.angles
        )


class _CollarSection(Section):
    """A stretch of the wall, from ``start`` to ``stop`` of its length (0 to 1), thickened outside."""

    start: float = Field(ge=0.0, le=1.0)
    stop: float = Field(ge=0.0, le=1.0)
    thickness: PositiveLength
    layers: Count = 1


class _RevolutionMesh(Section):
    """A wall of revolution around the z axis; divisions are along the profile, through the wall and around.

    ``profile`` lists points [r, z] of the wall's middle from the bottom upwards, plain numbers in ``unit``.
    Sets: inner, outer, bottom, top and, for less than a full turn, start and end.
    """

    generator: Literal["revolution"]
    profile: tuple[tuple[Number, Number], ...]
    unit: LengthUnit
    thickness: PositiveLength
    divisions: Divisions
    cells: CellName = "hex20"
    angles: tuple[Angle, Angle] = (0.0, 2.0 * np.pi)
    collars: tuple[_CollarSection, ...] = ()

    def make(self) -> Mesh:
        profile = np.array(self.profile) * to_si(1.0, self.unit, "length")
        collars = [mesh_generators.Collar(c.start, c.stop, c.thickness, c.layers) for c in self.collars]
        return mesh_generators.revolution(profile, self.thickness, self.divisions, self.cells, self.angles, collars)


class _HoleSection(Section):
    """A round hole; ``centre`` is in the outline's unit."""

    centre: tuple[Number, Number]
    diameter: PositiveLength


class _ExtrusionMesh(Section):
    """A flat part: an outline in the plane z = 0, extruded to z = ``thickness``.

    ``outline`` lists corners [x, y] in order, plain numbers in ``unit``; a third number is the longest edge of a cell
    there. Sets: z_min, z_max, side_1 (from the first corner to the second), ..., hole_1, ..., and x_min, x_max, y_min,
    y_max where sides are there.
    """

    generator: Literal["extrusion"]
    outline: tuple[Annotated[tuple[Number, ...], Field(min_length=2, max_length=3)], ...]
    unit: LengthUnit
    thickness: PositiveLength
    size: PositiveLength
    layers: Count = 1
    holes: tuple[_HoleSection, ...] = ()
    cells: Literal["prism6", "prism15", "prism18"] = "prism15"

    def make(self) -> Mesh:
        unit = to_si(1.0, self.unit, "length")
        corners = [[unit * x for x in corner[:2]] for corner in self.outline]
        sizes = [unit * corner[2] if len(corner) > 2 else self.size for corner in self.outline]
        holes = [Hole((unit * hole.centre[0], unit * hole.centre[1]), hole.diameter) for hole in self.holes]
        return extrusion(corners, self.thickness, self.size, self.cells, self.layers, holes, sizes)


def mesh_kind(value: Any) -> str:
    """Tag of a [mesh] section: "file", or its generator."""
    if isinstance(value, Section):
        return "file" if isinstance(value, FileMesh) else value.generator  # type: ignore[attr-defined]
    return str(value.get("generator", "file")) if isinstance(value, dict) else "file"


MeshSection = Annotated[
    Annotated[FileMesh, Tag("file")]
    | Annotated[_BlockMesh, Tag("block")]
    | Annotated[_TubeMesh, Tag("tube")]
    | Annotated[_RevolutionMesh, Tag("revolution")]
    | Annotated[_ExtrusionMesh, Tag("extrusion")],
    Discriminator(mesh_kind),
]


def check_unit(mesh: Mesh, unit: str, key: str) -> None:
    """Refuse a mesh from a file whose size is hardly meant; StudyError naming the key and a unit that may be right."""
    extent = np.ptp(mesh.nodes, axis=0)
    diagonal = float(np.linalg.norm(extent))
    if SMALLEST <= diagonal <= LARGEST:
        return
    drawn = diagonal / to_si(1.0, unit, "length")
    better = next((name for name in _USUAL_UNITS if _LEAST_USUAL <= to_si(drawn, name, "length") <= LARGEST), None)
    advice = f'if it was drawn in {better}, write "{better}"' if better else "look at its coordinates"
    size = described_extent(extent)
    raise StudyError(f'{key}: in "{unit}" the mesh measures {size} m, which is hardly meant; {advice}')


def _file_stamp(path: Path) -> tuple[int, int]:
    """What changes when a file is written again: time in nanoseconds, and size; zeros if there is none."""
    try:
        found = path.stat()
    except OSError:
        return 0, 0
    return found.st_mtime_ns, found.st_size


def make_mesh(section: Any, *checks: Callable[[Mesh], None]) -> Mesh:
    """The mesh of a `MeshSection`, checked, by more ``checks`` too; made once, and again when its file has changed."""
    return _made(section, checks, _file_stamp(section.file) if isinstance(section, FileMesh) else None)


@lru_cache(maxsize=2)
def _made(section: Any, checks: tuple[Callable[[Mesh], None], ...], stamp: tuple[int, int] | None) -> Mesh:
    mesh = section.make()
    if isinstance(section, FileMesh):
        check_unit(mesh, section.unit, "mesh.unit")
    try:
        for check in (check_mesh, *checks):
            check(mesh)
    except StudyError as error:
        raise StudyError(f"mesh: {error}") from error
    return mesh


def mesh_fingerprint(mesh: Mesh) -> str:
    """Hash of nodes, cells and those sets that do not follow from them."""
    digest = hashlib.sha256(np.ascontiguousarray(mesh.nodes).tobytes())
    for block in mesh.blocks:
        digest.update(block.cell_type.encode() + np.ascontiguousarray(block.connectivity).tobytes())
    for sets in (mesh.node_sets, mesh.cell_sets, mesh.surfaces):
        for name in sorted(sets.keys() - (mesh.found if sets is mesh.surfaces else ())):
            digest.update(name.encode() + np.ascontiguousarray(sets[name], dtype=np.int64).tobytes())
    return digest.hexdigest()


#: A quantity in a study file.
Value = str | float
Triple = tuple[Value, Value, Value]
#: Turns a value that measures a quantity (None: any) into a number or an expression of parameters, SI.
Reader = Callable[[Value, str | None], Any]


def triple(values: Triple, quantity: str, read: Reader) -> tuple[Any, Any, Any]:
    """Three values of a vector."""
    x, y, z = (read(value, quantity) for value in values)
    return x, y, z


class _Applied(Section):
    """What is applied to the solid, ``first``: before all that is not."""

    first: bool = False


class FixedSupport(Section):
    """Holds a set in all three directions."""

    kind: Literal["fixed"]
    on: SetName
    first: ClassVar[bool] = False

    def make(self, read: Reader) -> supports.PrescribedDisplacement:
        return supports.fixed(self.on)


class DisplacementSupport(_Applied):
    """Moves a set by given lengths; a direction that is left out stays free."""

    kind: Literal["displacement"]
    on: SetName
    x: Value | None = None
    y: Value | None = None
    z: Value | None = None

    def make(self, read: Reader) -> supports.PrescribedDisplacement:
        values = [None if value is None else read(value, "length") for value in (self.x, self.y, self.z)]
        return supports.PrescribedDisplacement(self.on, *values)


class RotationSupport(_Applied):
    """Turns a set as a rigid body about an axis, then shifts it.

    ``axis`` gives the direction, right-handed; ``centre`` a point on it, or the set whose mean point it is
    (this one if absent).
    """

    kind: Literal["rotation"]
    on: SetName
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
            triple(centre, "length", read) if isinstance(centre, tuple) else centre,
            triple(self.translation, "length", read),
        )


class FoundationSupport(Section):
    """Springs spread over a surface: ``stiffness`` is force per area and displacement."""

    kind: Literal["foundation"]
    on: SetName
    stiffness: Value
    normal_only: bool = False
    first: ClassVar[bool] = False

    def make(self, read: Reader) -> supports.ElasticFoundation:
        return supports.ElasticFoundation(self.on, read(self.stiffness, "stiffness per area"), self.normal_only)


class _TractionLoad(_Applied):
    """Force per undeformed area that keeps its direction."""

    kind: Literal["traction"]
    on: SetName
    traction: Triple

    def make(self, read: Reader) -> loads.DeadTraction:
        return loads.DeadTraction(self.on, triple(self.traction, "stress", read))


class _PressureLoad(_Applied):
    """Pressure that follows the deformed surface; positive pushes inwards."""

    kind: Literal["pressure"]
    on: SetName
    pressure: Value

    def make(self, read: Reader) -> loads.FollowerPressure:
        return loads.FollowerPressure(self.on, read(self.pressure, "pressure"))


class BodyForceLoad(_Applied):
    """Force per undeformed volume of a cell set."""

    kind: Literal["body_force"]
    on: SetName = "all"
    force: Triple

    def make(self, read: Reader) -> loads.BodyForce:
        return loads.BodyForce(triple(self.force, "force per volume", read), self.on)


class GravityLoad(_Applied):
    """Weight: materials need their density."""

    kind: Literal["gravity"]
    acceleration: Triple = ("0 m/s2", "0 m/s2", "-9.80665 m/s2")

    def make(self, read: Reader) -> loads.Gravity:
        return loads.Gravity(triple(self.acceleration, "acceleration", read))


class PointLoadSection(_Applied):
    """A force shared equally by the nodes of a set."""

    kind: Literal["point"]
    on: SetName
    force: Triple

    def make(self, read: Reader) -> loads.PointLoad:
        return loads.PointLoad(self.on, triple(self.force, "force", read))


class ForceLoad(_Applied):
    """A force spread evenly over a surface, which keeps its direction."""

    kind: Literal["force"]
    on: SetName
    force: Triple

    def make(self, read: Reader) -> loads.SurfaceForce:
        return loads.SurfaceForce(self.on, triple(self.force, "force", read))


class MovingPatchLoad(_Applied):
    """A force spread over a round patch of a surface, whose ``centre`` may move with a parameter.

    ``width`` is the standard deviation of its Gaussian density, at least half a cell of the surface.
    """

    kind: Literal["moving_patch"]
    on: SetName
    force: Triple
    centre: Triple
    width: PositiveLength

    def make(self, read: Reader) -> loads.MovingPatch:
        force, centre = triple(self.force, "force", read), triple(self.centre, "length", read)
        return loads.MovingPatch(self.on, force, centre, self.width)


class MovingLineLoad(_Applied):
    """A force per length along a straight line over a surface; ``centre`` may move with a parameter."""

    kind: Literal["moving_line"]
    on: SetName
    force: Triple
    centre: Triple
    direction: tuple[Number, Number, Number]
    width: PositiveLength

    def make(self, read: Reader) -> loads.MovingLine:
        force, centre = triple(self.force, "force per length", read), triple(self.centre, "length", read)
        return loads.MovingLine(self.on, force, centre, self.direction, self.width)


class CouplingSection(_Applied):
    """A set that moves as a rigid body under a force and a moment, which keep their directions.

    The force acts at ``point``, which moves with the set: the mean of the set's nodes if absent. Motions that are
    ``held`` stay zero: those of the point along the axes, and turns about them.
    """

    on: SetName
    point: Triple | None = None
    force: Triple = ("0 N", "0 N", "0 N")
    moment: Triple = ("0 N.m", "0 N.m", "0 N.m")
    held: tuple[couplings.Motion, ...] = ()

    def make(self, read: Reader) -> couplings.Coupling:
        point = None if self.point is None else triple(self.point, "length", read)
        force, moment = triple(self.force, "force", read), triple(self.moment, "moment", read)
        return couplings.Coupling(self.on, force, moment, point, self.held)


class _PlaneContact(Section):
    """A rigid plane that a surface cannot pass; ``normal`` points towards the solid."""

    kind: Literal["plane"]
    on: SetName
    point: Triple
    normal: tuple[Number, Number, Number]

    def make(self, read: Reader) -> contact.RigidPlane:
        return contact.RigidPlane(self.on, triple(self.point, "length", read), self.normal)


class _SphereContact(Section):
    """A rigid sphere that a surface cannot enter, or cannot leave where it is ``inside``."""

    kind: Literal["sphere"]
    on: SetName
    centre: Triple
    radius: Value
    inside: bool = False

    def make(self, read: Reader) -> contact.RigidSphere:
        centre = triple(self.centre, "length", read)
        return contact.RigidSphere(self.on, centre, read(self.radius, "length"), self.inside)


class _CylinderContact(Section):
    """A rigid cylinder without ends that a surface cannot enter, or cannot leave where it is ``inside``.

    ``point`` is one of the ``axis``, which gives the direction.
    """

    kind: Literal["cylinder"]
    on: SetName
    point: Triple
    axis: tuple[Number, Number, Number]
    radius: Value
    inside: bool = False

    def make(self, read: Reader) -> contact.RigidCylinder:
        point, radius = triple(self.point, "length", read), read(self.radius, "length")
        return contact.RigidCylinder(self.on, point, self.axis, radius, self.inside)


class _MeshContact(Section):
    """A rigid body that a surface cannot enter: the inside of a closed STL, OBJ or PLY ``file``, moved by ``place``.

    ``unit`` is that of the file's coordinates, and ``spacing`` that of the grid on which its distance is kept: a 64th
    of its longest side if absent.
    """

    kind: Literal["mesh"]
    on: SetName
    file: StudyPath
    unit: LengthUnit
    place: Triple = ("0 mm", "0 mm", "0 mm")
    spacing: PositiveLength | None = None

    def make(self, read: Reader) -> RigidMesh:
        points, triangles = load_closed_surface(self.file, self.unit)
        return RigidMesh(self.on, points, triangles, triple(self.place, "length", read), self.spacing)


class _SurfaceContact(Section):
    """A surface that cannot pass through another, ``against``, or through itself where that is absent."""

    kind: Literal["surface"]
    on: SetName
    against: SetName | None = None

    def make(self, read: Reader) -> contact.SurfaceContact:
        return contact.SurfaceContact(self.on, self.against or self.on)


SupportSection = Annotated[
    FixedSupport | DisplacementSupport | RotationSupport | FoundationSupport, Field(discriminator="kind")
]
LoadSection = Annotated[
    _TractionLoad
    | ForceLoad
    | _PressureLoad
    | BodyForceLoad
    | GravityLoad
    | PointLoadSection
    | MovingPatchLoad
    | MovingLineLoad,
    Field(discriminator="kind"),
]
ContactSection = Annotated[
    _PlaneContact | _SphereContact | _CylinderContact | _MeshContact | _SurfaceContact, Field(discriminator="kind")
]
