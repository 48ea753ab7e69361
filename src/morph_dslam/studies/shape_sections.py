"""The [[shape]] sections of a solid's study: how the undeformed mesh depends on parameters."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import KDTree

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.kinematics import ShapeField
from morph_dslam.mechanics.morphing import radius_field, thickness_field
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.meshing.mesh_checks import check_size, described_extent, wrong_cells
from morph_dslam.meshing.meshes import Mesh
from morph_dslam.model import Parameter
from morph_dslam.model.parameters import state_text
from morph_dslam.studies.affine import Affine, read_affine
from morph_dslam.studies.sections import Length, LengthUnit, Number, Section, SetName, StudyPath
from morph_dslam.studies.solid_sections import Reader, Value
from morph_dslam.studies.solution_files import SAME, point_data, points_in_space, read_solution
from morph_dslam.units import to_si

Array = NDArray[np.float64]
Made = TypeVar("Made")
#: Of each section the amplitude, and how far nodes (n, 3) move for an amplitude of 1.
Shape = Sequence[tuple[Affine, Array]]


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
    axis: tuple[Number, Number, Number] = (0.0, 0.0, 1.0)
    centre: tuple[Length, Length, Length] = (0.0, 0.0, 0.0)

    def make(self, read: Reader) -> Any:
        if not any(self.axis):
            raise StudyError(f"the axis of the radius has no direction: {self.axis}")
        return super().make(read)

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
        unit, content = to_si(1.0, self.unit, "length"), read_solution(self.file, whole=False)
        points = unit * points_in_space(content)
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
    shape = read_shape(sections, mesh, parameters)
    _check_ends(mesh, shape, parameters)
    values = [symbols[parameter.name] for parameter in parameters]
    return [ShapeField(amplitude.expression(values), field) for amplitude, field in shape]


def read_shape(sections: Sequence[_ShapeSection], mesh: Mesh, parameters: Sequence[Parameter]) -> Shape:
    """The shape that sections describe.

    Raises StudyError, which names the section, where the mesh or the file does not suit it.
    """
    return [
        (read_affine(section.amplitude, section.measures, parameters), _named(k, section.moves, mesh))
        for k, section in enumerate(sections)
    ]


def shape_fingerprints(sections: Sequence[_ShapeSection], mesh: Mesh) -> list[dict[str, Any]]:
    """`_ShapeSection.fingerprint` of each; raises StudyError as `read_shape` does."""
    return [_named(k, section.fingerprint, mesh) for k, section in enumerate(sections)]


def _named(index: int, make: Callable[[Mesh], Made], mesh: Mesh) -> Made:
    """What is made of a section from the mesh; StudyError, if it cannot be, begins with its name."""
    try:
        return make(mesh)
    except StudyError as error:
        raise StudyError(f"shape {index + 1}: {error}") from error


def moved_nodes(mesh: Mesh, shape: Shape, mu: Array) -> Array:
    """The undeformed nodes (n, 3) of a shape (`read_shape`) at parameters ``mu`` (d,)."""
    return mesh.nodes + sum(amplitude(mu) * field for amplitude, field in shape)


def _check_ends(mesh: Mesh, shape: Shape, parameters: Sequence[Parameter]) -> None:
    """Refuse a shape that inverts cells, or has no plausible size, with any parameter at an end of its range."""
    used = [k for k in range(len(parameters)) if any(amplitude.slopes[k] for amplitude, _ in shape)]
    for ends in product(*((parameters[k].lower, parameters[k].upper) for k in used)) if shape else ():
        mu = np.array([p.default for p in parameters])
        mu[used] = ends
        moved = replace(mesh, nodes=moved_nodes(mesh, shape, mu))
        problem: object = wrong_cells(moved)
        try:
            check_size(moved)
        except StudyError:
            problem = f"the body measures {described_extent(np.ptp(moved.nodes, axis=0))} m, which is hardly meant"
        if problem is not None:
            state = state_text([parameters[k] for k in used], mu[used])
            names = " or ".join(parameters[k].name for k in used)
            advice = f"narrow the range of {names}" if used else "change its amplitude"
            raise StudyError(f"the shape at {state or 'its amplitude'}: {problem}: {advice}")
