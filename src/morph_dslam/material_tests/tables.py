"""Material tests as files have them: columns of stretch or strain, stress, and time, with their units."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import IdentificationError
from morph_dslam.io.text import name_and_unit, read_csv
from morph_dslam.material_tests.nominal_stress import MaterialTest
from morph_dslam.units import FACTORS

Array = NDArray[np.float64]
#: No rubber stands a larger stretch: percent were meant.
_LARGEST = 30.0
_STRAINS = {"stretch": (0.0, 1.0), "strain": (1.0, 1.0)}
_STRAINS |= dict.fromkeys(("strain [%]", "strain (%)", "strain_percent"), (1.0, 0.01))
_EXAMPLE = "stretch,stress_MPa"


def load_test(path: str | Path, kind: str = "uniaxial") -> MaterialTest:
    """Read a test: CSV with the columns ``stretch`` or ``strain`` (of the gauge length; ``strain_percent`` or
    ``strain [%]`` in percent) and ``stress_MPa`` or ``stress [MPa]`` (force over undeformed section) or
    ``true_stress_MPa`` (over the deformed one), in any unit of stress; and perhaps ``time_s``.

    Other columns are left out, as time stamps are, and so are lines with an empty cell in one of these. True stresses
    are converted for an incompressible solid.

    Parameters
    ----------
    path : the file.
    kind : of the test, see `MaterialTest`.

    Raises
    ------
    IdentificationError
        If the file is missing, a column is missing or there twice, a unit is none, a line has more cells than
        titles, as decimals with commas make them, or a value is no number or cannot be.
    """
    path = Path(path)
    rows = read_csv(path, "material test", IdentificationError) or [(1, [""])]
    titles = [cell.lower() for cell in rows[0][1]]
    strain = _only(path, titles, [title for title in titles if title in _STRAINS], "stretch or strain")
    stress, true, pascals = _stress_column(path, rows[0][1])
    times = [title for title in rows[0][1] if _is_time(title)]
    if not times:
        _check_no_time(path, rows)
    time = [rows[0][1].index(_only(path, times, times, "time"))] if times else []
    columns = [titles.index(strain), stress, *time]
    if wide := [line for line, cells in rows[1:] if any(cells[len(titles) :])]:
        raise IdentificationError(
            f"{path}, line {wide[0]}: more cells than the {len(titles)} titles; write decimals with points"
        )
    values = np.array([_numbers(path, line, cells, columns) for line, cells in rows[1:]]).reshape(-1, len(columns))
    values = values[np.isfinite(values).all(axis=1)]
    offset, factor = _STRAINS[strain]
    stretch = offset + factor * values[:, 0]
    if np.any(stretch > _LARGEST):
        raise IdentificationError(
            f"{path}: a {strain} of {values[:, 0].max():g} is more than any rubber stands; name the column "
            "strain_percent if it is in percent"
        )
    seconds = None if not time else values[:, 2] * FACTORS["time"][name_and_unit(times[0])[1].lower()]
    nominal = pascals * values[:, 1] / (stretch if true else 1.0)
    # A file's name may hold bytes that are no text, which cannot be written.
    name = path.name.encode(errors="replace").decode()
    return MaterialTest(name, stretch, nominal, seconds, kind)


def _only(path: Path, titles: Sequence[str], found: Sequence[str], what: str) -> str:
    if len(found) == 1:
        return found[0]
    if not found:
        raise IdentificationError(f"{path} has no column of {what}, but {', '.join(titles)}; write {_EXAMPLE} say")
    raise IdentificationError(f"{path} has several columns of {what}: {', '.join(found)}; leave one")


def _stress_column(path: Path, titles: Sequence[str]) -> tuple[int, bool, float]:
    """Place of the column of stresses, whether they are true ones, and pascals in its unit."""
    if bare := [title for title in titles if title.lower() in ("stress", "true_stress")]:
        raise IdentificationError(
            f"{path}: column '{bare[0]}' has no unit; name it {bare[0].lower()}_MPa or {bare[0].lower()}_kPa say"
        )
    found = [title for title in titles if _splits_into(title, "stress") or _splits_into(title, "true_stress")]
    title = _only(path, titles, found, "stress")
    return titles.index(title), _splits_into(title, "true_stress"), _factor(path, title, "stress")


def _splits_into(title: str, name: str) -> bool:
    return name_and_unit(title)[0].lower() == name


def _is_time(title: str) -> bool:
    """Whether it is one of times with their unit; time_stamp, say, is another column."""
    unit = name_and_unit(title)[1]
    return _splits_into(title, "time") and unit.lower() in FACTORS["time"]


def _check_no_time(path: Path, rows: Sequence[tuple[int, list[str]]]) -> None:
    """Refuse numbers that are times in no known unit: a test without times is taken for one that has relaxed."""
    for at, title in enumerate(rows[0][1]):
        if not (title.lower() == "time" or _splits_into(title, "time")):
            continue
        cells = [cells[at] for _, cells in rows[1:] if len(cells) > at and cells[at]]
        if not cells or not all(_is_number(cell) for cell in cells):
            continue
        if title.lower() == "time":
            raise IdentificationError(f"{path}: column 'time' has no unit; name it time_s or time_min say")
        _factor(path, title, "time")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _factor(path: Path, title: str, quantity: str) -> float:
    unit = name_and_unit(title)[1]
    if unit not in FACTORS[quantity]:
        raise IdentificationError(
            f"{path}: column '{title}' ends in '{unit}', which is no unit of {quantity}; give one of "
            f"{', '.join(FACTORS[quantity])}"
        )
    return FACTORS[quantity][unit]


def _numbers(path: Path, line: int, cells: Sequence[str], columns: Sequence[int]) -> list[float]:
    """The values of some columns in a line, NaN where one has none."""
    try:
        found = [float((cells[i] if i < len(cells) else "") or "nan") for i in columns]
    except ValueError:
        found = [np.inf]
    if np.isinf(found).any():
        raise IdentificationError(f"{path}, line {line}: '{','.join(cells)}' is not a line of numbers")
    return found
