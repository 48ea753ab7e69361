"""Studies of another program's solutions: a folder of VTU, VTK or XDMF files and a table of their parameters.

They go through the same reduction and certificate as this program's own. Their derivatives by the parameters
are not known, so the functions of the parameters are fitted to values only.
"""

from __future__ import annotations

import re
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from morph_dslam.errors import StudyError
from morph_dslam.io.text import read_csv
from morph_dslam.meshing.meshes import CellBlock, Mesh, model_mesh_of
from morph_dslam.model import Parameter
from morph_dslam.studies.problem import ModelMesh, Snapshot
from morph_dslam.studies.sections import LengthUnit, ReductionSection, Section, StressUnit, StudyPath
from morph_dslam.studies.solid_sections import check_unit
from morph_dslam.studies.solution_files import SAME, point_data, read_solution
from morph_dslam.units import quantity_of, to_si

Array = NDArray[np.float64]
#: Cell types by the names that meshio gives them; the order of their nodes is VTK's.
_CELL_TYPES = {
    "hexahedron": "hex8",
    "hexahedron20": "hex20",
    "hexahedron27": "hex27",
    "tetra": "tet4",
    "tetra10": "tet10",
    "wedge": "prism6",
    "wedge15": "prism15",
    "wedge18": "prism18",
    "triangle": "tri3",
    "quad": "quad4",
}
#: Where xx, yy, zz, yz, xz, xy stand among VTK's six components, and among nine row by row.
_VOIGT = {6: [0, 1, 2, 4, 5, 3], 9: [0, 4, 8, 5, 2, 1]}
_COLUMN = re.compile(r"\s*(?P<name>\w+)\s*(?:\[(?P<unit>[^\]]+)\])?\s*")


class _ExternalSection(Section):
    """Where the solutions are.

    ``table`` is a CSV file, relative to the study: a column ``file`` names each solution (relative to the
    table), a column ``step`` picks one of an XDMF series, and every other column is a parameter, its unit in
    brackets in the header, ``angle [deg]``. Files hold the undeformed mesh, coordinates and displacements in
    ``length_unit``, and point data by the names given here; ``stress`` (Cauchy, in ``stress_unit``) and
    ``strain`` (Green-Lagrange) have six components in VTK's order xx, yy, zz, xy, yz, xz, or nine.
    """

    table: StudyPath
    length_unit: LengthUnit
    displacement: str = "displacement"
    stress: str | None = None
    stress_unit: StressUnit = "Pa"
    strain: str | None = None


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
            If the table or a file cannot be read, lacks something, or has another mesh than the first.
        """
        parameters, coordinates, rows = read_table(self.external.table)
        snapshots: list[Snapshot] = []
        mesh: Mesh | None = None
        for row, point in zip(rows, coordinates, strict=True):
            path = self.external.table.parent / row["file"]
            if not path.is_file():
                raise StudyError(f"the solution {path} that the table names does not exist")
            content = read_solution(path, row.get("step"))
            here = _mesh(content, to_si(1.0, self.external.length_unit, "length"), path)
            if mesh is None:
                check_unit(here, self.external.length_unit, "external.length_unit")
                mesh = here
            _check_same(mesh, here, path)
            snapshots.append(Snapshot(point, self._fields(content, path)))
        assert mesh is not None
        return model_mesh_of(mesh), parameters, snapshots

    def _fields(self, content: meshio.Mesh, path: Path) -> dict[str, Array]:
        section = self.external
        length, stress = to_si(1.0, section.length_unit, "length"), to_si(1.0, section.stress_unit, "stress")
        fields = {"displacement": length * point_data(content, section.displacement, (3,), path)}
        for name, key, factor in (("stress_solid", section.stress, stress), ("strain", section.strain, 1.0)):
            if key is not None:
                values = point_data(content, key, tuple(_VOIGT), path)
                fields[name] = factor * values[:, _VOIGT[values.shape[1]]]
        return fields

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


def read_table(path: Path) -> tuple[tuple[Parameter, ...], Array, list[dict[str, str]]]:
    """The parameter table: parameters, their values (n, d) in SI, and the rows."""
    (_, header), *lines = read_csv(path, "table", StudyError) or [(1, [])]
    rows = [dict(zip(header, cells + [""] * len(header), strict=False)) for _, cells in lines]
    if "file" not in header or not rows:
        raise StudyError(f"{path} needs a column 'file' and a row for each solution")
    _check_listed_once(path, rows)
    columns = [_column(path, name) for name in header if name not in ("file", "step")]
    if not columns:
        raise StudyError(f"{path} has no parameter: add a column such as 'angle [deg]'")
    values = np.array([[_number(path, n, row, key) for key, _, _ in columns] for n, row in enumerate(rows, 2)])
    parameters = []
    for (_, name, unit), column in zip(columns, values.T, strict=True):
        quantity = quantity_of(unit)
        column *= to_si(1.0, unit, quantity)
        lower, upper = float(column.min()), float(column.max())
        if not lower < upper:
            raise StudyError(f"{path}: the parameter {name} is the same in all rows; leave the column out")
        parameters.append(Parameter(name, quantity, unit, lower, upper, min(max(0.0, lower), upper)))
    return tuple(parameters), values, rows


def _check_listed_once(path: Path, rows: list[dict[str, str]]) -> None:
    """One solution has one set of parameters."""
    lines: dict[tuple[str | None, str | None], int] = {}
    for line, row in enumerate(rows, 2):
        solution = (row.get("file"), row.get("step"))
        if solution in lines:
            raise StudyError(
                f"{path}, line {line}: '{solution[0]}' is in line {lines[solution]} already; list each solution once"
            )
        lines[solution] = line


def _column(path: Path, header: str) -> tuple[str, str, str]:
    """Header, name and unit of a parameter's column."""
    match = _COLUMN.fullmatch(header)
    if match is None:
        raise StudyError(f"{path}: '{header}' is no parameter's header; write 'angle [deg]' for example")
    return header, match["name"], match["unit"] or "1"


def _number(path: Path, line: int, row: dict[str, str], key: str) -> float:
    try:
        return float(row[key])
    except (TypeError, ValueError):
        raise StudyError(f"{path}, line {line}: '{row.get(key)}' is no number for {key}") from None


def _mesh(content: meshio.Mesh, unit: float, path: Path) -> Mesh:
    """The cells of the highest dimension; other types are an error."""
    blocks = [block for block in content.cells if block.type not in ("vertex", "line")]
    unknown = {block.type for block in blocks} - set(_CELL_TYPES)
    if unknown or not blocks:
        raise StudyError(
            f"{path} has {'cells of type ' + ', '.join(sorted(unknown)) if unknown else 'no cells'}; "
            f"known are {', '.join(_CELL_TYPES)}"
        )
    made = [CellBlock(_CELL_TYPES[block.type], np.asarray(block.data, dtype=np.int64)) for block in blocks]
    highest = max(block.type.dimension for block in made)
    nodes = np.zeros((len(content.points), 3))
    nodes[:, : content.points.shape[1]] = content.points
    return Mesh(unit * nodes, tuple(block for block in made if block.type.dimension == highest))


def _check_same(first: Mesh, other: Mesh, path: Path) -> None:
    same = len(first.blocks) == len(other.blocks) and first.nodes.shape == other.nodes.shape
    same = same and all(
        np.array_equal(a.connectivity, b.connectivity) for a, b in zip(first.blocks, other.blocks, strict=True)
    )
    if not same or np.abs(first.nodes - other.nodes).max() > SAME * np.ptp(first.nodes, axis=0).max():
        raise StudyError(
            f"{path} has another mesh than the first solution: all need the same undeformed nodes and cells, "
            "with the displacement as point data"
        )
