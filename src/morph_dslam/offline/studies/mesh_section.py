"""The [mesh] section of a study: a file, or a structured generator and its arguments."""

from __future__ import annotations

import hashlib
import math
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Discriminator, Field, Tag, ValidationInfo, field_validator

from morph_dslam.errors import StudyError
from morph_dslam.offline.meshing import mesh_generators
from morph_dslam.offline.meshing.mesh_checks import check_mesh
from morph_dslam.offline.meshing.mesh_files import load_mesh
from morph_dslam.offline.meshing.meshes import Mesh
from morph_dslam.offline.studies.study_sections import Angle, Number, PositiveLength, Section
from morph_dslam.units import to_si

CellName = Literal["hex8", "hex20", "hex27", "tet4", "tet10", "prism6", "prism15", "prism18"]
Count = Annotated[int, Field(ge=1)]

#: More cells than these are a mistake: no memory holds their factorisation.
MOST_CELLS = 5_000_000


def _few(divisions: tuple[int, int, int]) -> tuple[int, int, int]:
    if math.prod(divisions) > MOST_CELLS:
        raise ValueError(f"these make {math.prod(divisions)} cells, and {MOST_CELLS} are the most")
    return divisions


Divisions = Annotated[tuple[Count, Count, Count], AfterValidator(_few)]


class FileMesh(Section):
    """A mesh file: Abaqus or CalculiX .inp, Gmsh .msh, VTK, STL, OBJ, PLY or STEP.

    ``file`` is relative to the study file; ``unit`` is that of its coordinates; ``size`` the longest edge of
    a cell where the file has a surface only and its volume is meshed.
    """

    file: Path
    unit: str
    size: PositiveLength | None = None

    @field_validator("file")
    @classmethod
    def _resolve(cls, file: Path, info: ValidationInfo) -> Path:
        return Path((info.context or {}).get("folder", ".")) / file

    def make(self) -> Mesh:
        return load_mesh(self.file, self.unit, self.size)


class BlockMesh(Section):
    """A block from the origin along x, y and z; sets x_min, x_max, y_min, y_max, z_min, z_max."""

    generator: Literal["block"]
    size: tuple[PositiveLength, PositiveLength, PositiveLength]
    divisions: Divisions
    cells: CellName = "hex20"

    def make(self) -> Mesh:
        return mesh_generators.block(self.size, self.divisions, self.cells)


class TubeMesh(Section):
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


class CollarSection(Section):
    """A stretch of the wall, from ``start`` to ``stop`` of its length (0 to 1), thickened outside."""

    start: float = Field(ge=0.0, le=1.0)
    stop: float = Field(ge=0.0, le=1.0)
    thickness: PositiveLength
    layers: Count = 1


class RevolutionMesh(Section):
    """A wall of revolution around the z axis; divisions are along the profile, through the wall and around.

    ``profile`` lists points [r, z] of the wall's middle from the bottom upwards, plain numbers in ``unit``.
    Sets: inner, outer, bottom, top and, for less than a full turn, start and end.
    """

    generator: Literal["revolution"]
    profile: tuple[tuple[Number, Number], ...]
    unit: str
    thickness: PositiveLength
    divisions: Divisions
    cells: CellName = "hex20"
    angles: tuple[Angle, Angle] = (0.0, 2.0 * np.pi)
    collars: tuple[CollarSection, ...] = ()

    @field_validator("unit")
    @classmethod
    def _is_length(cls, unit: str) -> str:
        try:
            to_si(1.0, unit, "length")
        except StudyError as error:
            raise ValueError(str(error)) from error
        return unit

    def make(self) -> Mesh:
        profile = np.array(self.profile) * to_si(1.0, self.unit, "length")
        collars = [mesh_generators.Collar(c.start, c.stop, c.thickness, c.layers) for c in self.collars]
        return mesh_generators.revolution(
            profile, self.thickness, self.divisions, self.cells, self.angles, collars
        )


def _kind(value: Any) -> str:
    if isinstance(value, Section):
        return "file" if isinstance(value, FileMesh) else value.generator  # type: ignore[attr-defined]
    return str(value.get("generator", "file")) if isinstance(value, dict) else "file"


MeshSection = Annotated[
    Annotated[FileMesh, Tag("file")]
    | Annotated[BlockMesh, Tag("block")]
    | Annotated[TubeMesh, Tag("tube")]
    | Annotated[RevolutionMesh, Tag("revolution")],
    Discriminator(_kind),
]


def file_stamp(path: Path) -> tuple[int, int]:
    """What changes when a file is written again: time in nanoseconds, and size; zeros if there is none."""
    try:
        found = path.stat()
    except OSError:
        return 0, 0
    return found.st_mtime_ns, found.st_size


def make_mesh(section: Any) -> Mesh:
    """The mesh of a `MeshSection`, checked; made once, and again when its file has been written again.

    Raises
    ------
    StudyError
        If it cannot be made or read, or is not fit to be solved on.
    """
    return _made(section, file_stamp(section.file) if isinstance(section, FileMesh) else None)


@lru_cache(maxsize=2)
def _made(section: Any, stamp: tuple[int, int] | None) -> Mesh:
    mesh = section.make()
    check_mesh(mesh)
    return mesh


def mesh_fingerprint(mesh: Mesh) -> str:
    """Hash of nodes, cells and sets."""
    digest = hashlib.sha256(np.ascontiguousarray(mesh.nodes).tobytes())
    for block in mesh.blocks:
        digest.update(block.cell_type.encode() + np.ascontiguousarray(block.connectivity).tobytes())
    for sets in (mesh.node_sets, mesh.cell_sets, mesh.surfaces):
        for name in sorted(sets):
            digest.update(name.encode() + np.ascontiguousarray(sets[name], dtype=np.int64).tobytes())
    return digest.hexdigest()
