"""The [[shape]] sections of a solid's study: how its undeformed shape varies from the mesh.

Each moves the mesh's nodes by an amplitude, a length that may name parameters, along a field of
`morph_dslam.offline.mechanics.morphing`. Sections add up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from morph_dslam.errors import StudyError
from morph_dslam.model import Parameter
from morph_dslam.offline.mechanics.kinematics import ShapeField
from morph_dslam.offline.mechanics.morphing import radius_field, thickness_field
from morph_dslam.offline.mechanics.parameters import ParameterSymbols
from morph_dslam.offline.meshing.mesh_checks import check_mesh
from morph_dslam.offline.meshing.meshes import Mesh
from morph_dslam.offline.studies.affine import Affine, read_affine
from morph_dslam.offline.studies.load_sections import Reader, Value
from morph_dslam.offline.studies.study_sections import Length, Section

Array = NDArray[np.float64]


class _ShapeSection(Section):
    amplitude: Value

    def make(self, read: Reader) -> Any:
        """The amplitude, m."""
        return read(self.amplitude, "length")


class ThicknessShape(_ShapeSection):
    """A wall that is thicker by ``amplitude``: surface ``on`` moves outwards, surface ``kept`` stays."""

    kind: Literal["thickness"]
    on: str
    kept: str

    def field(self, mesh: Mesh) -> Array:
        """How far each node (n, 3) moves for an amplitude of 1."""
        return thickness_field(mesh, self.on, self.kept)


class RadiusShape(_ShapeSection):
    """A body that is wider by ``amplitude`` all around an axis, its wall as it was."""

    kind: Literal["radius"]
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    centre: tuple[Length, Length, Length] = (0.0, 0.0, 0.0)

    def field(self, mesh: Mesh) -> Array:
        """How far each node (n, 3) moves for an amplitude of 1."""
        return radius_field(mesh.nodes, np.array(self.centre), np.array(self.axis))


ShapeSection = Annotated[ThicknessShape | RadiusShape, Field(discriminator="kind")]


def shape_fields(
    sections: Sequence[ThicknessShape | RadiusShape], mesh: Mesh, symbols: ParameterSymbols
) -> list[ShapeField]:
    """The shape as the solver takes it, checked at the ends of the parameters that it depends on.

    Raises
    ------
    StudyError
        If a surface is unknown, or cells are inverted where parameters are at an end of their range.
    """
    parameters = symbols.parameters
    amplitudes = [read_affine(section.amplitude, "length", parameters) for section in sections]
    fields = [section.field(mesh) for section in sections]
    _check_ends(mesh, amplitudes, fields, parameters)
    values = [symbols[parameter.name] for parameter in parameters]
    return [
        ShapeField(amplitude.expression(values), field)
        for amplitude, field in zip(amplitudes, fields, strict=True)
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
