"""Which states of a model an export has: along a path, on a grid, or a tour of all parameters.

Users give values in each parameter's own unit (that of `morph info`); arrays here are SI, (s, d) for s states of d
parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morph_dslam.errors import ExportError, StudyError
from morph_dslam.io.text import name_and_unit, read_csv
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.units import FACTORS, read_quantity, to_si

Array = NDArray[np.float64]
#: States that one export may have: beyond, a grid was meant to be coarser.
MOST_STATES = 10_000
#: States of a tour from the default to one end of a range; twice as many cross it.
_QUARTER = 6
#: Columns of a table that hold the seconds of its states, the first of them that there is; the second as in frames.csv.
TIMES = (("time", "s"), ("timestamp", "s"))


def _index(model: ReducedModel, name: str) -> int:
    names = [p.name for p in model.parameters]
    if name not in names:
        raise ExportError(f"the model has no parameter '{name}'; it has {', '.join(names) or 'none'}")
    return names.index(name)


def _in_range(parameter: Parameter, si: float, where: str) -> float:
    """A value in SI, checked to lie in the parameter's range."""
    if not parameter.in_range(si):
        shown = f"{parameter.display(si):g} is outside the range of {parameter.name}"
        raise ExportError(f"{where}: {shown}, {parameter.range_text}")
    return min(max(si, parameter.lower), parameter.upper)


def fixed_values(model: ReducedModel, settings: Sequence[str]) -> Array:
    """The parameters (d,) with some of them set by texts "name=value"; the others keep their defaults."""
    mu, given = model.default, dict[str, str]()
    for text in settings:
        name, equals, value = text.partition("=")
        if not equals:
            raise ExportError(f"--at {text} is not a parameter and its value{_example(model, '{0}={1}')}")
        k = _index(model, name)
        if name in given:
            raise ExportError(f"--at {given[name]} and --at {text} both set '{name}': give one of them")
        given[name] = text
        mu[k] = _number(model.parameters[k], value, f"--at {text}")
    return mu


def grid(model: ReducedModel, ranges: Sequence[str], base: Array) -> Array:
    """All combinations (s, d) of ranges "name=from:to:count", the last one varying fastest.

    Parameters
    ----------
    base : (d,) values of the parameters without a range, SI.
    """
    axes: dict[int, Array] = {}
    for text in ranges:
        name, _, limits = text.partition("=")
        parts = limits.split(":")
        if len(parts) != 3 or not name or not parts[2].isdecimal() or int(parts[2]) < 1:
            raise ExportError(f"--vary {text} is not a parameter and its values{_example(model, '{0}={1}:{2}:21')}")
        k, n = _index(model, name), int(parts[2])
        if k in axes:
            raise ExportError(f"--vary {text}: parameter '{name}' has a range already")
        low, high = (_number(model.parameters[k], end, f"--vary {text}") for end in parts[:2])
        if n > MOST_STATES:
            raise ExportError(f"--vary {text} asks for {n} states, and {MOST_STATES} is the most")
        axes[k] = np.linspace(low, high, n)
    count = math.prod(len(axis) for axis in axes.values())
    if count > MOST_STATES:
        raise ExportError(f"these ranges make {count} states, and {MOST_STATES} is the most; ask for fewer")
    states = np.tile(base, (count, 1))
    for k, values in zip(axes, np.meshgrid(*axes.values(), indexing="ij"), strict=True):
        states[:, k] = values.ravel()
    return states


def tour(model: ReducedModel, base: Array) -> Array:
    """Each parameter in turn from ``base`` (d,) to the top of its range, to the bottom, and back (s, d)."""
    states = [base]
    for k, parameter in enumerate(model.parameters):
        stops = [(base[k], parameter.upper), (parameter.upper, parameter.lower), (parameter.lower, base[k])]
        for (start, end), count in zip(stops, (_QUARTER, 2 * _QUARTER, _QUARTER), strict=True):
            leg = np.tile(base, (count, 1))
            leg[:, k] = np.linspace(start, end, count + 1)[1:]
            states.extend(leg)
    return np.array(states)


@dataclass(frozen=True)
class States:
    """States of a model.

    Attributes
    ----------
    parameters : (s, d) SI.
    origins : of each the cells of ``states.csv`` that say where it comes from, by the column's title.
    times : (s,) seconds; the numbers of the states where they have no times.
    """

    parameters: Array
    origins: Sequence[dict[str, str]]
    times: Array

    @classmethod
    def of(cls, parameters: Array) -> States:
        """States that come from no table."""
        return cls(parameters, [{}] * len(parameters), np.arange(len(parameters), dtype=np.float64))

    def __len__(self) -> int:
        return len(self.parameters)


def read_path(model: ReducedModel, path: Path, base: Array) -> States:
    """The states in the rows of a CSV table.

    A column is headed "name [unit]", as in the table of an export, or "name_unit", as in the ``frames.csv``
    of a run; the unit is any of the parameter's quantity. Other columns are passed over, and so are rows without
    values: frames that were not tracked. Parameters without a column keep their value in ``base``.

    Raises
    ------
    ExportError
        If the table cannot be read, a parameter's column has no unit, another quantity's, or a twin, no column is a
        parameter's, or a value is no number in the range.
    """
    if not model.parameters:
        raise ExportError(f"'{model.name}' has no parameters, and so one state only: leave --path out")
    (_, header), *rows = read_csv(path, "path", ExportError) or [(1, [])]
    found = {k: _column_of(p, header, path) for k, p in enumerate(model.parameters)}
    columns = {k: column for k, column in found.items() if column is not None}
    if not columns:
        wanted = ", ".join(f"'{p.name} [{p.unit}]'" for p in model.parameters)
        raise ExportError(f"{path} has no column of a parameter; name the columns {wanted}")
    states, taken = [], []
    for line, row in rows:
        texts = {k: _cell(row, column) for k, (column, _) in columns.items()}
        if not all(texts.values()):
            continue
        mu = base.copy()
        for k, text in texts.items():
            mu[k] = _number(model.parameters[k], text, f"{path}, line {line}", columns[k][1])
        states.append(mu)
        taken.append((line, row))
    if not 0 < len(states) <= MOST_STATES:
        raise ExportError(f"{path} holds {len(states)} states, and 1 to {MOST_STATES} can be exported")
    found = States.of(np.array(states))
    times = _times(header, [row for _, row in taken])
    return replace(found, origins=_origins(header, taken), times=found.times if times is None else times)


def _cell(row: Sequence[str], column: int) -> str:
    return row[column] if column < len(row) else ""


def _origins(header: Sequence[str], rows: Sequence[tuple[int, list[str]]]) -> list[dict[str, str]]:
    """What ``states.csv`` says of the table's rows: the frame where the table has it, else the line."""
    if "frame" not in header:
        return [{"from_line": str(line)} for line, _ in rows]
    column = header.index("frame")
    return [{"from_frame": _cell(row, column)} for _, row in rows]


def _times(header: Sequence[str], rows: Sequence[list[str]]) -> Array | None:
    """Seconds (s,) of the table's rows; None if it has none, or they do not grow, as in a grid."""
    named = [name_and_unit(title) for title in header]
    column = next((named.index(title) for title in TIMES if title in named), None)
    if column is None:
        return None
    try:
        times = np.array([float(_cell(row, column)) for row in rows])
    except ValueError:
        return None
    return times if np.isfinite(times).all() and (np.diff(times) > 0).all() else None


def _column_of(parameter: Parameter, header: Sequence[str], path: Path) -> tuple[int, str] | None:
    """The column that holds a parameter, and its unit; None if there is none.

    A title in the parameter's own unit goes before "name" alone and "name_unit" in another one: a parameter may be
    called as one of the columns of ``frames.csv`` ("time" as ``time_ms``).
    """
    units, all_units = FACTORS[parameter.quantity], {unit for known in FACTORS.values() for unit in known}
    found, wrong = dict[int, str](), []
    for column, title in enumerate(header):
        name, unit = name_and_unit(title)
        if name == parameter.name and unit in units:
            found[column] = unit
        elif title == parameter.name or (name == parameter.name and (title.endswith("]") or unit in all_units)):
            wrong.append(title)
    if parameter.unit in found.values():
        found = {k: unit for k, unit in found.items() if unit == parameter.unit or header[k].endswith("]")}
        wrong = [title for title in wrong if title.endswith("]")]
    if wrong:
        raise ExportError(
            f"{path}: the column '{wrong[0]}' has no unit of '{parameter.name}': name it "
            f"'{parameter.name} [{parameter.unit}]', or with another unit of {parameter.quantity} ({', '.join(units)})"
        )
    if len(found) > 1:
        titles = " and ".join(f"'{header[column]}'" for column in found)
        raise ExportError(f"{path}: the columns {titles} both hold '{parameter.name}': leave one of them in")
    return next(iter(found.items()), None)


def _number(parameter: Parameter, text: str, where: str, unit: str = "") -> float:
    """A value in the parameter's unit or ``unit``, or with another unit behind it, as SI."""
    unit = unit or parameter.unit
    try:
        value = to_si(float(text), unit, parameter.quantity)
    except ValueError:
        try:
            value = read_quantity(text, parameter.quantity)
        except StudyError as error:
            raise ExportError(
                f"{where}: '{text}' is not a value of {parameter.name}: write a number in {unit}, or with "
                f"another unit: {error}"
            ) from None
    return _in_range(parameter, value, where)


def _example(model: ReducedModel, form: str) -> str:
    """The end of a message: how to write it for a parameter that the model has, from its name and its range's ends."""
    if not model.parameters:
        return f": '{model.name}' has no parameters"
    p = model.parameters[0]
    return ", such as " + form.format(p.name, *(f"{p.display(end):.4g}" for end in (p.lower, p.upper)))


def states_of_array(model: ReducedModel, choice: ArrayLike) -> Array:
    """Parameters (s, d) or (d,), SI, as states; ExportError where they are none of the model's."""
    d = len(model.parameters)
    try:
        states = np.atleast_2d(np.array(choice, dtype=np.float64))
    except (TypeError, ValueError):
        raise ExportError("states are a StateChoice, or an array of parameters (s, d)") from None
    if states.ndim != 2 or states.shape[1] != d or not 0 < len(states) <= MOST_STATES:
        names = ", ".join(p.name for p in model.parameters) or "none"
        raise ExportError(
            f"an array of states has a row for each, 1 to {MOST_STATES}, and a column for each of the parameters "
            f"({names}), not the shape {states.shape}"
        )
    for number, row in enumerate(states):
        states[number] = [_in_range(p, x, f"state {number}") for p, x in zip(model.parameters, row, strict=True)]
    return states


@dataclass(frozen=True)
class StateChoice:
    """Which states of a model to export, in the parameters' units.

    Attributes
    ----------
    vary : texts "name=from:to:count"; several make a grid.
    path : CSV table with a state in each row, instead.
    at : texts "name=value" for parameters that are not varied.
    """

    vary: Sequence[str] = ()
    path: str | Path | None = None
    at: Sequence[str] = ()

    def states(self, model: ReducedModel) -> NDArray[np.float64]:
        """The states (s, d), SI; with neither ranges nor a path, a tour of all parameters."""
        return self.chosen(model).parameters

    def chosen(self, model: ReducedModel) -> States:
        """The states, and what the table of a path says of them."""
        twice = {text.partition("=")[0] for text in self.vary} & {text.partition("=")[0] for text in self.at}
        if twice:
            raise ExportError(f"'{min(twice)}' is both varied and fixed: leave out its --vary or its --at")
        if self.path is not None and self.vary:
            raise ExportError("--path and --vary both choose the states: give one of them")
        base = fixed_values(model, self.at)
        if self.path is not None:
            return read_path(model, Path(self.path), base)
        return States.of(grid(model, self.vary, base) if self.vary else tour(model, base))


#: The tour of all parameters.
EACH_IN_TURN = StateChoice()
