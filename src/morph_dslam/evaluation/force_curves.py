"""Force curves as files have them: columns with units, against frames or a parameter of the model."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import EvaluationError
from morph_dslam.io.text import name_and_unit, read_csv
from morph_dslam.model import ReducedModel
from morph_dslam.model.parameters import parameter_columns, parameter_of_column
from morph_dslam.units import FACTORS

Array = NDArray[np.float64]
#: Fewer comparisons determine no factor and offset with anything left over.
LEAST = 3
_GRAM, _POUND = 9.80665e-3, 4.4482216152605
#: Newtons in each unit of a column of forces. Units of mass stand for weights here, as on the display of a load cell.
FORCE_UNITS = {
    **FACTORS["force"],
    **{"uN": 1e-6, "MN": 1e6, "gf": _GRAM, "g": _GRAM, "kgf": 1e3 * _GRAM, "kg": 1e3 * _GRAM},
    **{"lbf": _POUND, "lb": _POUND, "ozf": _POUND / 16.0, "oz": _POUND / 16.0},
}
#: Ends of names, in any case, that mean other units or spell one otherwise. Specimens have letters, so that one letter
#: is no unit; nor are times and angles here, for force_min and force_rad are forces.
_OTHER_UNITS = {
    *(unit.lower() for unit in FORCE_UNITS if len(unit) > 1),
    *(unit.lower() for name in FACTORS if name not in ("time", "angle") for unit in FACTORS[name] if len(unit) > 1),
    *("dyn", "kp", "kip", "kips", "tf", "ton", "tons", "lbs", "grams", "pounds"),
    *("nm", "nmm", "psi", "mv", "uv", "volt", "volts"),
}


@dataclass(frozen=True)
class ForceCurve:
    """Measured forces.

    Attributes
    ----------
    against : "frame", or the name of a parameter of the model.
    places : (k,) frame numbers, or values of the parameter, SI.
    forces : (k,) newtons.
    name : of the forces, for plots.
    empty : lines of the file that have no force.
    """

    against: str
    places: Array
    forces: Array
    name: str = "force"
    empty: int = 0


def load_curve(path: str | Path, model: ReducedModel, column: str | None = None, least: int = LEAST) -> ForceCurve:
    """Read a curve: CSV whose first column is ``frame``, or a parameter with its unit, ``stroke_mm`` or
    ``stroke [mm]`` or ``stroke (mm)`` say.

    The other columns are forces with their unit, ``force_N`` say, in newtons where they name none.

    Parameters
    ----------
    path : the file. Lines without a force are left out.
    model : whose parameters the first column may name.
    column : which column of forces; needed where there are several.
    least : so many forces are needed.

    Raises
    ------
    EvaluationError
        If the file is missing, a column is not known, its unit is none of force, a value is no number, or there are too
        few.
    """
    (_, titles), *rows = _table(path)
    against, scale = _place(path, titles[0], model)
    column = _column(path, titles, column)
    newtons, at = _newtons(path, column), titles.index(column, 1)
    for line, cells in rows:
        if len(cells) > len(titles):
            raise EvaluationError(
                f"{path}, line {line}: {len(cells)} cells under {len(titles)} titles; write decimals with points"
            )
    values = np.array([_numbers(f"{path}, line {line}", cells, at) for line, cells in rows]).reshape(-1, 2)
    full = np.isfinite(values).all(axis=1)
    values = values[full]
    if len(values) < least:
        raise EvaluationError(f"{path} has {len(values)} forces in column '{column}': give at least {least}")
    return ForceCurve(against, scale * values[:, 0], newtons * values[:, 1], column, int((~full).sum()))


def _table(path: str | Path) -> list[tuple[int, list[str]]]:
    """Line numbers and cells of the lines that hold any, without empty cells at their ends; the titles are first."""
    rows = read_csv(Path(path), "force curve", EvaluationError)
    return [(line, cells[: max(i for i, cell in enumerate(cells) if cell) + 1]) for line, cells in rows] or [(1, [""])]


def _column(path: str | Path, titles: Sequence[str], asked: str | None) -> str:
    """The column of forces that is asked for, or the only one."""
    columns = [title for title in titles[1:] if title]
    if not columns:
        raise EvaluationError(
            f"{path} has no column of forces: give one beside '{titles[0]}', with its unit, as {titles[0]},force_N"
        )
    if columns.count(asked or columns[0]) > 1:
        raise EvaluationError(f"{path} has several columns '{asked or columns[0]}': give each a name of its own")
    if asked is None and len(columns) == 1:
        return columns[0]
    if asked in columns:
        return asked
    wrong = "several columns of forces" if asked is None else f"no column '{asked}'"
    others = f"; the others are {', '.join(columns[1:])}" if len(columns) > 1 else ""
    raise EvaluationError(f"{path} has {wrong}; name one that it has, as {path}:{columns[0]}{others}")


def _newtons(path: str | Path, column: str) -> float:
    """Newtons in the unit that the name of a column ends in; 1 if it ends in none."""
    unit = name_and_unit(column)[1]
    if unit not in FORCE_UNITS and unit.lower() in _OTHER_UNITS:
        raise EvaluationError(
            f"{path}: column '{column}' ends in '{unit}', which is no unit of force that is known: give one of "
            f"{', '.join(FORCE_UNITS)}"
        )
    end = re.split(r"[\s/]", unit)[-1]
    if end != unit and len(end) > 1 and end in FORCE_UNITS:
        name = column.removesuffix(end).rstrip(" /")
        raise EvaluationError(f"{path}: the unit of column '{column}' is not set apart: write {name}_{end}")
    return newtons_of(column)


def newtons_of(column: str) -> float:
    """Newtons in the unit of force that the name of a column ends in; 1 if it ends in none."""
    return FORCE_UNITS.get(name_and_unit(column)[1], 1.0)


def _place(path: str | Path, header: str, model: ReducedModel) -> tuple[str, float]:
    """What the first column is, and the factor of its values to SI."""
    if header == "frame":
        return header, 1.0
    found = parameter_of_column(header, model)
    if found is None:
        raise EvaluationError(
            f"{path}: the first column is '{header}'; name it frame, or as a parameter of the model with its unit: "
            f"{parameter_columns(model)}"
        )
    return found


def _numbers(where: str, row: Sequence[str], at: int) -> tuple[float, float]:
    """A place and a force of one line, NaN where the line has none."""
    try:
        found = float(row[0]), float((row[at] if at < len(row) else "") or "nan")
    except ValueError:
        found = np.inf, np.inf
    if np.isinf(found).any():
        raise EvaluationError(f"{where}: '{','.join(row)}' is not a place on the curve and its forces, all numbers")
    return found
