"""The sections of a shell's study that differ from a solid's: mesh, shell, material, sets, supports and loads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Discriminator, Field, Tag, model_validator

from morph_dslam.errors import StudyError
from morph_dslam.mechanics import loads, supports
from morph_dslam.mechanics.materials.base import evaluate
from morph_dslam.mechanics.shell_material import ShellMaterial, isotropic
from morph_dslam.mechanics.shell_supports import Clamp, SymmetryPlane, clamped
from morph_dslam.mechanics.spaces import DisplacementSpace
from morph_dslam.mechanics.surface_mesh import SurfaceMesh
from morph_dslam.meshing import surface_generators
from morph_dslam.meshing.mesh_files import load_surface_mesh
from morph_dslam.meshing.meshes import Mesh
from morph_dslam.meshing.surface_checks import check_surface
from morph_dslam.studies.affine import Variables
from morph_dslam.studies.sections import Angle, Length, Number, PositiveLength, Section, SetName
from morph_dslam.studies.solid_sections import (
    BodyForceLoad,
    Count,
    DisplacementSupport,
    FileMesh,
    FixedSupport,
    ForceLoad,
    FoundationSupport,
    GravityLoad,
    MovingLineLoad,
    MovingPatchLoad,
    PointLoadSection,
    Reader,
    RotationSupport,
    Triple,
    Value,
    few_cells,
    make_mesh,
    mesh_kind,
    triple,
)

Array = NDArray[np.float64]
CellName = Literal["tri3", "tri6", "quad4", "quad8", "quad9"]
Divisions = Annotated[tuple[Count, Count], AfterValidator(few_cells)]
#: The largest thickness as a part of the size.
THICKEST = 0.05
#: Added to the order of quadrature where a part of a cell is measured.
FINE = 10
FULL_TURN = (0.0, surface_generators.FULL_TURN)


class _FileSurface(FileMesh):
    """A mesh of the shell's middle surface: Abaqus or CalculiX .inp, Gmsh .msh, VTK; STL, OBJ or PLY as they are.

    ``file`` is relative to the study file; ``unit`` is that of its coordinates.
    """

    size: None = None

    def make(self) -> Mesh:
        return load_surface_mesh(self.file, self.unit)


class _PlateMesh(Section):
    """A rectangle from the origin along x and y; sets x_min, x_max, y_min, y_max."""

    generator: Literal["plate"]
    size: tuple[PositiveLength, PositiveLength]
    divisions: Divisions
    cells: CellName = "quad9"

    def make(self) -> Mesh:
        return surface_generators.plate(self.size, self.divisions, self.cells)


class _TurnedMesh(Section):
    """A surface around the z axis; ``slit`` leaves a full turn open.

    Sets, for less than a full turn or with a slit: start and end.
    """

    divisions: Divisions
    cells: CellName = "quad9"
    angles: tuple[Angle, Angle] = FULL_TURN
    slit: bool = False


class _CylinderMesh(_TurnedMesh):
    """A cylinder around the z axis from z = 0; divisions are along z and around it.

    Sets: bottom, top and, for less than a full turn or with a ``slit``, start and end.
    """

    generator: Literal["cylinder"]
    radius: PositiveLength
    length: PositiveLength

    def make(self) -> Mesh:
        return surface_generators.cylinder(self.radius, self.length, self.divisions, self.cells, self.angles, self.slit)


class _SphereMesh(_TurnedMesh):
    """A part of a sphere around the origin, between two ``polar_angles`` from the z axis; from 0 it has no hole.

    Divisions are from the top to the rim and around. Sets: top (of a hole), rim and, for less than a full turn or with
    a ``slit``, start and end.
    """

    generator: Literal["sphere"]
    radius: PositiveLength
    polar_angles: tuple[Angle, Angle]

    def make(self) -> Mesh:
        return surface_generators.sphere(
            self.radius, self.polar_angles, self.divisions, self.cells, self.angles, self.slit
        )


class _AnnulusMesh(_TurnedMesh):
    """A flat ring around the origin, a disc if ``inner_radius`` is 0; divisions are outwards and around.

    Sets: inner (of a ring), outer and, for less than a full turn or with a ``slit``, start and end.
    """

    generator: Literal["annulus"]
    inner_radius: Length
    outer_radius: PositiveLength

    def make(self) -> Mesh:
        return surface_generators.annulus(
            self.inner_radius, self.outer_radius, self.divisions, self.cells, self.angles, self.slit
        )


SurfaceSection = Annotated[
    Annotated[_FileSurface, Tag("file")]
    | Annotated[_PlateMesh, Tag("plate")]
    | Annotated[_CylinderMesh, Tag("cylinder")]
    | Annotated[_SphereMesh, Tag("sphere")]
    | Annotated[_AnnulusMesh, Tag("annulus")],
    Discriminator(mesh_kind),
]


def shell_mesh(section: Any) -> Mesh:
    """The checked mesh of a `SurfaceSection`; made once, and again when its file has been written again."""
    return make_mesh(section, check_surface)


class ShellSection(Section):
    """The shell: its ``thickness``, half of it on either side of the mesh."""

    thickness: Value

    def make(self, read: Reader) -> Any:
        """The thickness, m."""
        thickness = read(self.thickness, "length")
        if not evaluate(thickness) > 0.0:
            raise StudyError(f"thickness = {1e3 * evaluate(thickness):.4g} mm must be positive")
        return thickness


def thickness_warnings(section: ShellSection, mesh: Mesh, variables: Variables) -> list[str]:
    """A sentence if the thickness, at its largest over the parameters, is not small beside the mesh."""
    thickness = variables.read(section.thickness, "length")
    ends = np.array([[p.lower, p.upper] for p in variables.parameters])
    largest, size = thickness.extremes(ends)[1], float(np.ptp(mesh.nodes, axis=0).max())
    if largest <= THICKEST * size:
        return []
    return [
        f"the shell is {1e3 * largest:.4g} mm thick and {1e3 * size:.4g} mm long: above a twentieth of the size it "
        "bends by transverse shear too, which is left out; solve it as a solid"
    ]


class ShellMaterialSection(Section):
    """Linear elasticity in the Green-Lagrange strain, plane stress.

    Isotropic with ``young`` and ``poisson``; orthotropic with ``young_fibre``, ``young_cross``, ``poisson`` (of the
    contraction across under tension along the fibres) and ``shear``. The ``fibre`` direction is projected on the
    surface and turned by ``fibre_angle`` about its normal. ``density`` is for gravity.
    """

    young: Value | None = None
    young_fibre: Value | None = None
    young_cross: Value | None = None
    poisson: Value
    shear: Value | None = None
    density: Value | None = None
    fibre: tuple[Number, Number, Number] = (1.0, 0.0, 0.0)
    fibre_angle: Value = "0 deg"

    @model_validator(mode="after")
    def _check_constants(self) -> ShellMaterialSection:
        orthotropic = (self.young_fibre, self.young_cross, self.shear)
        if self.young is None and any(value is None for value in orthotropic):
            raise ValueError("give young and poisson, or young_fibre, young_cross, poisson and shear")
        if self.young is not None and any(value is not None for value in orthotropic):
            raise ValueError("young is that of an isotropic material: leave it out, or young_fibre, young_cross, shear")
        return self

    def make(self, read: Reader) -> ShellMaterial:
        poisson = read(self.poisson, "ratio")
        others = {
            "density": None if self.density is None else read(self.density, "density"),
            "fibre": self.fibre,
            "fibre_angle": read(self.fibre_angle, "angle"),
        }
        if self.young is not None:
            material = isotropic(self._stress("young", read), poisson, **others)
        else:
            fibre, cross, shear = (self._stress(name, read) for name in ("young_fibre", "young_cross", "shear"))
            material = ShellMaterial(fibre, cross, poisson, shear, **others)
        material.check()
        return material

    def _stress(self, name: str, read: Reader) -> Any:
        return read(getattr(self, name), "stress")


def fibre_warnings(section: ShellMaterialSection, mesh: Mesh, variables: Variables) -> list[str]:
    """A sentence if another direction takes the place of the fibres' on a part of the shell alone."""
    if section.young is not None:
        return []
    material = section.make(variables.reader())
    turned = ngs.IfPos(material.outside(ngs.specialcf.normal(3)), 0.0, 1.0)
    # The space curves the cells, and lets them be curved as long as it lives.
    space, surface = DisplacementSpace(SurfaceMesh(mesh), 2), ngs.ds(bonus_intorder=FINE)
    area, turned = (ngs.Integrate(part * surface, space.geometry.ngs) for part in (ngs.CF(1.0), turned))
    if not 0.0 < turned < (1.0 - 1e-9) * area:
        return []
    return [
        f"the direction fibre = {list(section.fibre)} is within 6 degrees of the normal on {100.0 * turned / area:.2g} "
        f"% of the shell: the fibres run along {'xyz'[material.next_axis]} there and turn abruptly at the edge of that "
        "part; give a direction that is along the surface everywhere"
    ]


class _ClampedSupport(Section):
    """Holds a set in place and its edges in their direction."""

    kind: Literal["clamped"]
    on: SetName

    def make(self, read: Reader) -> Clamp:
        return clamped(self.on)


class _SymmetrySupport(Section):
    """Keeps a set in its plane across ``axis``, "x", "y" or "z", and the shell there perpendicular to that plane."""

    kind: Literal["symmetry"]
    on: SetName
    axis: Literal["x", "y", "z"]

    def make(self, read: Reader) -> SymmetryPlane:
        return SymmetryPlane(self.on, "xyz".index(self.axis))


def check_symmetry(sections: Sequence[Any], mesh: Mesh) -> None:
    """Refuse planes of symmetry, among the supports of a study, whose set is in none (StudyError)."""
    for number, section in enumerate(sections, start=1):
        if isinstance(section, _SymmetrySupport):
            try:
                SymmetryPlane(section.on, "xyz".index(section.axis)).check(mesh)
            except StudyError as error:
                raise StudyError(f"support {number}: {error}") from error


class _ShellRotationSupport(RotationSupport):
    """Turns a set as a rigid body about an axis, then shifts it; its edges are clamped in the body.

    ``axis`` gives the direction, right-handed; ``centre`` a point on it, or the set whose mean point it is
    (this one if absent).
    """

    def make(self, read: Reader) -> Clamp:
        moved: supports.RigidRotation = super().make(read)
        return Clamp(moved.on, moved.axis, moved.angle, moved.centre, moved.translation)


class _ShellFoundationSupport(FoundationSupport):
    """Springs spread over a cell set, all cells if absent: ``stiffness`` is force per area and displacement."""

    on: SetName = "all"


class _ShellTractionLoad(Section):
    """Force per undeformed area of a cell set that keeps its direction."""

    kind: Literal["traction"]
    on: SetName = "all"
    traction: Triple

    def make(self, read: Reader) -> loads.DeadTraction:
        return loads.DeadTraction(self.on, triple(self.traction, "stress", read))


class _ShellPressureLoad(Section):
    """Pressure that follows the deformed surface of a cell set; positive pushes against the normal.

    The normal is on the side from which the nodes of a cell turn anticlockwise.
    """

    kind: Literal["pressure"]
    on: SetName = "all"
    pressure: Value

    def make(self, read: Reader) -> loads.FollowerPressure:
        return loads.FollowerPressure(self.on, read(self.pressure, "pressure"))


class EdgeLoadSection(Section):
    """Force per undeformed length of the edges of a set that keeps its direction."""

    kind: Literal["edge"]
    on: SetName
    force: Triple

    def make(self, read: Reader) -> loads.EdgeLoad:
        return loads.EdgeLoad(self.on, triple(self.force, "force per length", read))


class _ShellForceLoad(ForceLoad):
    """A force spread evenly over a cell set, which keeps its direction."""

    on: SetName = "all"


class _ShellPatchLoad(MovingPatchLoad):
    """A force spread over a round patch of a cell set, whose ``centre`` may move with a parameter.

    ``width`` is the standard deviation of its Gaussian density, at least half a cell.
    """

    on: SetName = "all"


class _ShellLineLoad(MovingLineLoad):
    """A force per length along a straight line over a cell set; ``centre`` may move with a parameter."""

    on: SetName = "all"


ShellSupportSection = Annotated[
    FixedSupport
    | _ClampedSupport
    | DisplacementSupport
    | _SymmetrySupport
    | _ShellRotationSupport
    | _ShellFoundationSupport,
    Field(discriminator="kind"),
]
ShellLoadSection = Annotated[
    _ShellTractionLoad
    | _ShellForceLoad
    | _ShellPressureLoad
    | BodyForceLoad
    | GravityLoad
    | EdgeLoadSection
    | PointLoadSection
    | _ShellPatchLoad
    | _ShellLineLoad,
    Field(discriminator="kind"),
]
