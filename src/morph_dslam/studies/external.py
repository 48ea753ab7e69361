"""Studies of another program's solutions: a folder of VTU, VTK or XDMF files and a table of their parameters.

They go through the same reduction and certificate as this program's own. Their derivatives by the parameters
are not known, so the functions of the parameters are fitted to values only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import meshio
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from morph_dslam.errors import StudyError
from morph_dslam.meshing.meshes import Mesh, model_mesh_of
from morph_dslam.model import Parameter
from morph_dslam.studies.external_checks import check_strain, check_stress
from morph_dslam.studies.external_doubts import doubts
from morph_dslam.studies.external_mesh import announced_mesh, check_same, mesh_of
from morph_dslam.studies.external_reactions import PointForces, as_fields, columns_of
from morph_dslam.studies.external_table import SolutionTable
from morph_dslam.studies.problem import ModelMesh, Snapshot
from morph_dslam.studies.sections import LengthUnit, ReductionSection, Section, StressUnit, StudyPath
from morph_dslam.studies.solution_files import point_data, read_solution
from morph_dslam.units import to_si

Array = NDArray[np.float64]
#: Where xx, yy, zz, yz, xz, xy stand among VTK's six components, and among nine row by row.
_VOIGT = {6: [0, 1, 2, 4, 5, 3], 9: [0, 4, 8, 5, 2, 1]}


#: States whose stress and strain are compared with the displacement.
COMPARED = 3


class _ExternalSection(Section):
    """Where the solutions are.

    ``table`` is a CSV file, relative to the study: a column ``file`` names each solution (relative to the
    table), a column ``step`` picks one of an XDMF series, and every other column is a parameter, its unit in
    brackets in the header, ``angle [deg]``. Files hold the undeformed mesh, coordinates and displacements in
    ``length_unit``, and point data by the names given here; ``stress`` (Cauchy, in ``stress_unit``) and
    ``strain`` (Green-Lagrange) have six components in VTK's order xx, yy, zz, xy, yz, xz, or nine. ``defaults``
    has texts such as "0.85 MPa" by parameter; the default of every other is the value in its range nearest to zero.
    ``reactions`` names what each support exerts on the object: point data of forces (in ``force_unit``), which are
    summed up, or three columns of the table, the force along x, y and z, or six with its moment about the origin.
    """

    table: StudyPath
    length_unit: LengthUnit
    displacement: str = "displacement"
    stress: str | None = None
    stress_unit: StressUnit | None = None
    strain: str | None = None
    defaults: dict[str, str] = Field(default_factory=dict)
    reactions: dict[str, str | tuple[str, ...]] = Field(default_factory=dict)
    force_unit: Literal["N", "mN", "kN"] | None = None

    @model_validator(mode="after")
    def _check_units(self) -> _ExternalSection:
        if self.stress is not None and self.stress_unit is None:
            raise ValueError('stress_unit is missing: say the unit of the stress, as stress_unit = "MPa"')
        if self.force_unit is None and any(isinstance(source, str) for source in self.reactions.values()):
            raise ValueError('force_unit is missing: say the unit of forces at points, as force_unit = "N"')
        return self


class _HoldOutSection(Section):
    """How many of the solutions only measure the error (a fifth, and at least 4, if absent), and which."""

    held_out: int | None = Field(default=None, ge=4)
    seed: int = Field(default=0, ge=0)


class ExternalStudy(Section):
    """Solutions that were computed elsewhere, to be reduced like this program's own."""

    name: str
    external: _ExternalSection
    sampling: _HoldOutSection = _HoldOutSection()
    reduction: ReductionSection = ReductionSection()

    def solutions(self) -> tuple[ModelMesh, tuple[Parameter, ...], list[Snapshot]]:
        """The mesh, the parameters with the ranges of the table, and all snapshots.

        Raises
        ------
        StudyError
            If the table or a file cannot be read, lacks something, has another mesh than the first, or stress or strain
            that cannot be those of the displacement.
        """
        section = self.external
        table, parameters, coordinates, outputs = self._table()
        acting = [PointForces(name, key) for name, key in section.reactions.items() if isinstance(key, str)]
        snapshots: list[Snapshot] = []
        first: Mesh | None = None
        for number, (row, point) in enumerate(zip(table.rows, coordinates, strict=True)):
            path = table.path.parent / row["file"]
            if not path.is_file():
                raise StudyError(f"the solution {path} that the table names does not exist")
            content = read_solution(path, row.get("step") or None)
            here = mesh_of(content, section.length_unit, path)
            if first is None:
                first, used = here, here.used
                made = model_mesh_of(announced_mesh(here, section.length_unit, path))
            check_same(first, here, path)
            exerted = {name: values[number] for name, values in outputs.items()}
            for forces in acting:
                values = to_si(1.0, section.force_unit or "N", "force") * point_data(content, forces.data, (3,), path)
                exerted |= forces.take(first.nodes + self._displacement(content, path), values)
            snapshots.append(Snapshot(point, self._fields(content, path, used), outputs=exerted))
        self._check_tensors(made, table, snapshots)
        if section.reactions:
            made = replace(made, supports={forces.name: forces.held(used) for forces in acting})
            snapshots = as_fields(made, snapshots, section.reactions)
        return made, parameters, snapshots

    def _check_tensors(self, mesh: ModelMesh, table: SolutionTable, snapshots: Sequence[Snapshot]) -> None:
        """Compare stress and strain of the largest displacements with these."""
        if not mesh.cells:
            return
        sizes = [-float(np.linalg.norm(snapshot.fields["displacement"])) for snapshot in snapshots]
        chosen = np.argsort(sizes)[:COMPARED].tolist()
        moves = [snapshots[index].fields["displacement"] for index in chosen]
        file = table.path.parent / table.rows[chosen[0]]["file"]
        checks = (("strain", self.external.strain, check_strain), ("stress_solid", self.external.stress, check_stress))
        for name, key, check in checks:
            if key is not None:
                check(mesh, moves, [snapshots[index].fields[name] for index in chosen], f"{file}: '{key}'")

    def _table(self) -> tuple[SolutionTable, tuple[Parameter, ...], Array, dict[str, Array]]:
        """The table, its parameters, their values (n, d), and reactions (n, 3) that are columns of it."""
        table, headers, outputs = SolutionTable(self.external.table), list[str](), dict[str, Array]()
        for name, columns in self.external.reactions.items():
            if not isinstance(columns, str):
                found, parts = columns_of(table, name, columns)
                headers += found
                outputs |= parts
        return table, *table.parameters(headers, self.external.defaults), outputs

    def _displacement(self, content: meshio.Mesh, path: Path, used: NDArray[np.bool_] | None = None) -> Array:
        """Of nodes used, or of all: (n, 3), m."""
        length = to_si(1.0, self.external.length_unit, "length")
        return length * point_data(content, self.external.displacement, (3,), path, used)

    def _fields(self, content: meshio.Mesh, path: Path, used: NDArray[np.bool_]) -> dict[str, Array]:
        section = self.external
        fields, stress = {"displacement": self._displacement(content, path, used)}, 1.0
        if section.stress_unit is not None:
            stress = to_si(stress, section.stress_unit, "stress")
        for name, key, factor in (("stress_solid", section.stress, stress), ("strain", section.strain, 1.0)):
            if key is not None:
                values = point_data(content, key, tuple(_VOIGT), path, used)
                fields[name] = factor * values[:, _VOIGT[values.shape[1]]]
        return fields

    def doubts(self, snapshots: Sequence[Snapshot]) -> list[str]:
        """Sentences on what is doubtful about the solutions."""
        table, parameters, coordinates, _ = self._table()
        places = {
            point.tobytes(): f"{table.path.name}, line {line}, '{row['file']}'"
            for point, line, row in zip(coordinates, table.lines, table.rows, strict=True)
        }
        # In the order of the table, as sentences are.
        snapshots = sorted(snapshots, key=lambda snapshot: list(places).index(snapshot.coordinates.tobytes()))
        grams = {}
        for name in snapshots[0].fields:
            values = np.array([snapshot.fields[name].ravel() for snapshot in snapshots])
            grams[name] = values @ values.T
        return doubts(coordinates, [parameter.name for parameter in parameters], grams, list(places.values()))

    def split(self, count: int) -> tuple[list[int], list[int]]:
        """Training and held-out solutions, by index."""
        held_out = self.sampling.held_out or max(4, count // 5)
        if count - held_out < 8:
            raise StudyError(
                f"{self.external.table} lists {count} solutions; at least {8 + held_out} are needed, "
                f"{held_out} of them to measure the error"
            )
        order = np.random.default_rng(self.sampling.seed).permutation(count)
        return sorted(order[held_out:].tolist()), sorted(order[:held_out].tolist())
