"""The table of another program's solutions: which file holds which, and the parameters of each."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.io.text import has_a_cell_for_each, name_and_unit, read_csv
from morph_dslam.model import Parameter
from morph_dslam.units import FACTORS, quantity_of, read_quantity, to_si

Array = NDArray[np.float64]
_COLUMN = re.compile(r"\s*(?P<name>\w+)\s*(?:\[(?P<unit>[^\]]+)\])?\s*")
#: Columns that say where a solution is, and in tables of exports where it comes from.
PLACES = ("file", "step", "from_frame", "from_line")
#: Parameters are the same where they differ by less than this share of their ranges.
SAME_PARAMETERS = 1e-9
_UNITS = {unit for known in FACTORS.values() for unit in known} - {"1"}


class SolutionTable:
    """Rows and columns of a table of solutions.

    Attributes
    ----------
    path : of the file.
    rows : cells by header, one for each solution.
    lines : where each row stands in the file.

    Raises
    ------
    StudyError
        If the file cannot be read, has no rows or no column ``file``, a header twice, a row with more or fewer
        cells than headers or without a file, or one solution twice.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        (_, header), *content = read_csv(path, "table", StudyError) or [(1, [])]
        if "file" not in header or not content:
            raise StudyError(f"{path} needs a column 'file' and a row for each solution")
        for line, cells in content:
            if not has_a_cell_for_each(header, cells):
                raise StudyError(
                    f"{path}, line {line}: {len(cells)} cells under {len(header)} headers; write decimals with points, "
                    "and a cell for each header"
                )
        self.header = header
        self.rows = [dict(zip(header, cells, strict=False)) for _, cells in content]
        self.lines = [line for line, _ in content]
        self._check_listed_once()

    def _check_listed_once(self) -> None:
        """One solution has one set of parameters, and a header one column."""
        double = next((title for at, title in enumerate(self.header) if title in self.header[:at]), None)
        if double is not None:
            raise StudyError(f"{self.path} has two columns '{double}': leave one out, or rename it")
        lines: dict[tuple[str | None, str | None], int] = {}
        for line, row in zip(self.lines, self.rows, strict=True):
            solution = (row["file"], row.get("step"))
            if not row["file"]:
                raise StudyError(
                    f"{self.path}, line {line}: the cell of 'file' is empty; name the solution's file there"
                )
            if solution in lines:
                raise StudyError(
                    f"{self.path}, line {line}: '{solution[0]}' is in line {lines[solution]} already; list each "
                    "solution once"
                )
            lines[solution] = line

    def column(self, header: str) -> Array:
        """Numbers (n,) below a header, in its unit; StudyError if one is none, or not finite."""
        return np.array(
            [self._number(line, row[header], header) for line, row in zip(self.lines, self.rows, strict=True)]
        )

    def _number(self, line: int, cell: str, header: str) -> float:
        try:
            value = float(cell)
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise StudyError(f"{self.path}, line {line}: '{cell}' is no number for {header}")
        return value

    def column_of(self, name: str, quantity: str, key: str) -> tuple[str, float]:
        """Header of the column of a name, and the factor of its values to SI.

        Parameters
        ----------
        name : without the unit.
        quantity : that the unit in brackets must measure.
        key : of the study that names the column, for messages.

        Raises
        ------
        StudyError
            If there is no such column, or its unit is another.
        """
        for header in self.header:
            match = _COLUMN.fullmatch(header)
            if match is not None and match["name"] == name:
                try:
                    return header, to_si(1.0, match["unit"] or "1", quantity)
                except StudyError as error:
                    raise StudyError(f"{key}: column '{header}' of {self.path}: {error}") from error
        raise StudyError(f"{key}: {self.path} has no column '{name}'; it has: {', '.join(self.header)}")

    def parameters(
        self, others: Collection[str] = (), defaults: Mapping[str, str] | None = None
    ) -> tuple[tuple[Parameter, ...], Array]:
        """The parameters with the ranges of the table, and their values (n, d), SI.

        Parameters
        ----------
        others : headers of columns that are no parameters, beside `PLACES`.
        defaults : texts such as "0.85 MPa" by parameter; the value nearest to zero where there is none.

        Raises
        ------
        StudyError
            If there is no parameter, a header or a value is none, a parameter does not vary, two rows have the same
            parameters, or a default is of no parameter or outside of its range.
        """
        columns = [(title, *self._name_and_unit(title)) for title in self.header if title not in (*PLACES, *others)]
        names = [name for _, name, _ in columns]
        if not columns:
            raise StudyError(f"{self.path} has no parameter: add a column such as 'angle [deg]'")
        double = next((name for at, name in enumerate(names) if name in names[:at]), None)
        if double is not None:
            raise StudyError(f"{self.path} has two columns of the parameter '{double}': leave one out, or rename it")
        asked = dict(defaults or {})
        values = np.column_stack([self.column(title) * to_si(1.0, u, quantity_of(u)) for title, _, u in columns])
        parameters = tuple(
            self._parameter(name, unit, column, asked.pop(name, None))
            for (_, name, unit), column in zip(columns, values.T, strict=True)
        )
        if asked:
            known = ", ".join(names)
            raise StudyError(
                f"external.defaults: '{next(iter(asked))}' is no parameter of {self.path}; it has: {known}"
            )
        self._check_differ(parameters, values)
        return parameters, values

    def _name_and_unit(self, header: str) -> tuple[str, str]:
        """Of a parameter's column."""
        match = _COLUMN.fullmatch(header)
        if match is None:
            raise StudyError(f"{self.path}: '{header}' is no parameter's header; write 'angle [deg]' for example")
        name, unit = name_and_unit(header)
        if match["unit"] is None and name and unit in _UNITS:
            raise StudyError(
                f"{self.path}: the column '{header}' has no unit in brackets: write '{name} [{unit}]', or "
                f"'{header} [1]' if it is a ratio"
            )
        return match["name"], match["unit"] or "1"

    def _parameter(self, name: str, unit: str, values: Array, asked: str | None) -> Parameter:
        quantity, lower, upper = quantity_of(unit), float(values.min()), float(values.max())
        if not lower < upper:
            raise StudyError(f"{self.path}: the parameter {name} is the same in all rows; leave the column out")
        parameter = Parameter(name, quantity, unit, lower, upper, min(max(0.0, lower), upper))
        if asked is None:
            return parameter
        try:
            default = read_quantity(asked, quantity)
        except StudyError as error:
            raise StudyError(f"external.defaults.{name}: {error}") from error
        if not parameter.in_range(default):
            raise StudyError(
                f"external.defaults.{name}: {asked} is outside of the table's range, {parameter.range_text}"
            )
        return Parameter(name, quantity, unit, lower, upper, min(max(default, lower), upper))

    def _check_differ(self, parameters: tuple[Parameter, ...], values: Array) -> None:
        """Refuse two rows with the same parameters: copies would measure an error of nothing, others contradict."""
        ranges = np.array([parameter.upper - parameter.lower for parameter in parameters])
        for later in range(1, len(values)):
            same = np.flatnonzero((np.abs(values[:later] - values[later]) <= SAME_PARAMETERS * ranges).all(axis=1))
            if len(same):
                raise StudyError(
                    f"{self.path}, line {self.lines[later]}: the parameters are those of line {self.lines[same[0]]} "
                    f"('{self.rows[later]['file']}' and '{self.rows[same[0]]['file']}'); list each state once, or add "
                    "the parameter in which they differ"
                )
