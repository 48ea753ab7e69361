"""The [[shape]] sections of a solid's study: how the undeformed mesh depends on parameters."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import KDTree

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.kinematics import ShapeField
from morph_dslam.mechanics.morphing import radius_field, thickness_field
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.meshing.mesh_checks import check_mesh
from morph_dslam.meshing.meshes import Mesh
from morph_dslam.model import Parameter
from morph_dslam.studies.affine import Affine, read_affine
from morph_dslam.studies.sections import Length, LengthUnit, Section, SetName, StudyPath
from morph_dslam.studies.solid_sections import Reader, Value
from morph_dslam.studies.solution_files import SAME, point_data, read_solution
from morph_dslam.units import to_si

Array = NDArray[np.float64]


class _ShapeSection(Section):
    amplitude: Value
    #: What the amplitude measures.
    measures: ClassVar[str] = "length"

    def make(self, read: Reader) -> Any:
        """The amplitude, SI."""
        return read(self.amplitude, self.measures)

    def moves(self, mesh: Mesh) -> Array:
        """How far each node (n, 3) moves for an amplitude of 1."""
        raise NotImplementedError

    def fingerprint(self, mesh: Mesh) -> dict[str, Any]:
        """Everything that the shape depends on, in plain JSON types."""
        return self.model_dump(mode="json")


class _ThicknessShape(_ShapeSection):
    """A wall that is thicker by ``amplitude``: surface ``on`` moves outwards, surface ``kept`` stays."""

    kind: Literal["thickness"]
    on: SetName
    kept: SetName

    def moves(self, mesh: Mesh) -> Array:
        return thickness_field(mesh, self.on, self.kept)


class _RadiusShape(_ShapeSection):
    """A body that is wider by ``amplitude`` all around an axis, its wall as it was."""

    kind: Literal["radius"]
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    centre: tuple[Length, Length, Length] = (0.0, 0.0, 0.0)

    def moves(self, mesh: Mesh) -> Array:
        return radius_field(mesh.nodes, np.array(self.centre), np.array(self.axis))


class _FieldShape(_ShapeSection):
    """Nodes that move by ``amplitude``, a ratio, times a displacement field of the user's.

    ``file`` is a VTU, VTK or XDMF file, relative to the study, with a point at every node of the mesh, in any order;
    ``field`` names its point data with three components; ``unit`` is that of both points and field.
    """

    kind: Literal["field"]
    file: StudyPath
    unit: LengthUnit
    field: str = "displacement"
    measures: ClassVar[str] = "ratio"

    def moves(self, mesh: Mesh) -> Array:
        unit, content = to_si(1.0, self.unit, "length"), read_solution(self.file)
        points = np.zeros((len(content.points), 3))
        points[:, : content.points.shape[1]] = unit * content.points
        if not np.isfinite(points).all():
            raise StudyError(f"{self.file} has points whose coordinates are not finite")
        values = unit * point_data(content, self.field, (3,), self.file)
        distances, nearest = KDTree(points).query(mesh.nodes)
        missing = np.flatnonzero(distances > SAME * np.ptp(mesh.nodes, axis=0).max())
        if len(missing):
            place = ", ".join(f"{x:.4g}" for x in mesh.nodes[missing[0]] / unit)
            raise StudyError(
                f"{self.file} has no point at {len(missing)} of the mesh's {mesh.n_nodes} nodes, the first at "
                f"({place}) {self.unit}: the field must be given at the nodes of the undeformed mesh"
            )
        return values[nearest]

    def fingerprint(self, mesh: Mesh) -> dict[str, Any]:
        digest = hashlib.sha256(np.ascontiguousarray(self.moves(mesh)).tobytes()).hexdigest()
        return {"kind": self.kind, "amplitude": self.amplitude, "moves": digest}


ShapeSection = Annotated[_ThicknessShape | _RadiusShape | _FieldShape, Field(discriminator="kind")]


def shape_fields(sections: Sequence[_ShapeSection], mesh: Mesh, symbols: ParameterSymbols) -> list[ShapeField]:
    """The shape as the solver takes it, checked at the ends of the parameters that it depends on."""
    parameters = symbols.parameters
    amplitudes = [read_affine(section.amplitude, section.measures, parameters) for section in sections]
    fields = [section.moves(mesh) for section in sections]
    _check_ends(mesh, amplitudes, fields, parameters)
    values = [symbols[parameter.name] for parameter in parameters]
    return [
        ShapeField(amplitude.expression(values), field) for amplitude, field in zip(amplitudes, fields, strict=True)
    ]


def _check_ends(
    mesh: Mesh, amplitudes: Sequence[Affine], fields: Sequence[Array], parameters: Sequence[Parameter]
) -> None:
    varied = [any(a.slopes[i] for a in amplitudes) for i in range(len(parameters))]
    ends = [(p.lower, p.upper) if used else (p.default,) for p, used in zip(parameters, varied, strict=True)]
    for corner in product(*ends) if amplitudes else ():
        moves = [a(np.array(corner)) * field for a, field in zip(amplitudes, fields, strict=True)]
        try:
            check_mesh(replace(mesh, nodes=mesh.nodes + sum(moves)))
        except StudyError as error:
            where = ", ".join(
                f"{p.name} = {p.display(value):.4g} {p.unit}".removesuffix(" 1")
                for p, value, used in zip(parameters, corner, varied, strict=True)
                if used
            )
            raise StudyError(f"the shape at {where or 'its amplitude'}: {error}") from error
