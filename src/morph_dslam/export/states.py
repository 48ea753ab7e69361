"""The states of an export: parameter values along a path or on a grid, and their table.

Users give values in each parameter's own unit (that of `morph info`); arrays here are SI, (s, d) for s states
of d parameters.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import ExportError
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.units import to_si

Array = NDArray[np.float64]

#: States that one export may have: beyond, a grid was meant to be coarser.
MOST_STATES = 10_000
#: Values may pass the end of a range by so much of its width: tables round.
_ROUNDING = 1e-6
#: States of a tour from the default to one end of a range; twice as many cross it.
_QUARTER = 6


def _index(model: ReducedModel, name: str) -> int:
    names = [p.name for p in model.parameters]
    if name not in names:
        raise ExportError(f"the model has no parameter '{name}'; it has {', '.join(names)}")
    return names.index(name)


def _to_range(parameter: Parameter, value: float, where: str) -> float:
    """A value in the parameter's unit as SI, checked to lie in its range."""
    si = to_si(value, parameter.unit, parameter.quantity)
    slack = _ROUNDING * (parameter.upper - parameter.lower)
    if not parameter.lower - slack <= si <= parameter.upper + slack:  # NaN as well
        low, high = (parameter.display(bound) for bound in (parameter.lower, parameter.upper))
        raise ExportError(
            f"{where}: {value:g} is outside the range of {parameter.name}, "
            f"{low:g} to {high:g} {parameter.unit}"
        )
    return min(max(si, parameter.lower), parameter.upper)


def fixed_values(model: ReducedModel, settings: Sequence[str]) -> Array:
    """The parameters (d,) with some of them set by texts "name=value"; the others keep their defaults.

    Raises
    ------
    ExportError
        If a text is not of that form, or names no parameter, or its value is outside the range.
    """
    mu = model.default
    for text in settings:
        matched = re.fullmatch(r"(\w+)=([^:]+)", text)
        try:
            name, value = (matched[1], float(matched[2])) if matched else ("", math.nan)
        except ValueError:
            name = ""
        if not name:
            raise ExportError(f"--at {text} is not a parameter and its value, such as bend=12.5")
        k = _index(model, name)
        mu[k] = _to_range(model.parameters[k], value, f"--at {text}")
    return mu


def grid(model: ReducedModel, ranges: Sequence[str], base: Array) -> Array:
    """All combinations (s, d) of ranges "name=from:to:count", the last one varying fastest.

    Parameters
    ----------
    base : (d,) values of the parameters without a range, SI.

    Raises
    ------
    ExportError
        If a text is not of that form, names no parameter or one twice, leaves the box, or if the states
        are more than `MOST_STATES`.
    """
    axes: dict[int, Array] = {}
    for text in ranges:
        try:
            name, _, limits = text.partition("=")
            first, last, count = limits.split(":")
            ends, n = (float(first), float(last)), int(count)
        except ValueError:
            n, name, ends = 0, "", (0.0, 0.0)
        if n < 1 or not name:
            raise ExportError(f"--vary {text} is not a parameter and its values, such as bend=-10:10:21")
        k = _index(model, name)
        if k in axes:
            raise ExportError(f"--vary {text}: parameter '{name}' has a range already")
        low, high = (_to_range(model.parameters[k], end, f"--vary {text}") for end in ends)
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


def read_path(model: ReducedModel, path: Path, base: Array) -> Array:
    """The states (s, d) in the rows of a CSV table.

    A column is headed "name [unit]", as in the table of an export, or "name_unit", as in the ``frames.csv``
    of a run. Other columns are passed over, and so are rows without values: frames that were not tracked.
    Parameters without a column keep their value in ``base``.

    Raises
    ------
    ExportError
        If the file cannot be read, has no column of a parameter, or holds a value outside its range.
    """
    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
            header = list(rows[0]) if rows else []
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ExportError(f"cannot read the path {path}: {error}") from error
    columns = {}
    for k, p in enumerate(model.parameters):
        found = [name for name in (f"{p.name} [{p.unit}]", f"{p.name}_{p.unit}") if name in header]
        if found:
            columns[k] = found[0]
    if not columns:
        wanted = ", ".join(f"'{p.name} [{p.unit}]'" for p in model.parameters)
        raise ExportError(f"{path} has no column of a parameter; name the columns {wanted}")
    states = []
    for line, row in enumerate(rows, start=2):
        texts = {k: (row[name] or "").strip() for k, name in columns.items()}
        if not all(texts.values()):
            continue
        mu = base.copy()
        for k, text in texts.items():
            mu[k] = _number(model.parameters[k], text, f"{path}, line {line}")
        states.append(mu)
    if not 0 < len(states) <= MOST_STATES:
        raise ExportError(f"{path} holds {len(states)} states, and 1 to {MOST_STATES} can be exported")
    return np.array(states)


def _number(parameter: Parameter, text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ExportError(f"{where}: '{text}' is not a value of {parameter.name}") from None
    return _to_range(parameter, value, where)


def write_table(
    path: Path, model: ReducedModel, states: Array, places: Sequence[dict[str, str | int]]
) -> None:
    """The parameters of each state (s, d, SI) as CSV, after the columns that say where it is.

    The layout is that of tables of external solutions, so that a study can be made from an export.
    """
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*places[0], *(f"{p.name} [{p.unit}]" for p in model.parameters)])
        for place, mu in zip(places, states, strict=True):
            values = [f"{p.display(x):.9g}" for p, x in zip(model.parameters, mu, strict=True)]
            writer.writerow([*place.values(), *values])
