"""A published curve of error against number of modes, to be drawn beside a model's own."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ReferenceCurve:
    """Mean displacement errors ``mean_mm`` (n,) of somebody else with so many ``modes`` (n,)."""

    label: str
    modes: Array
    mean_mm: Array


def read_reference_curve(path: Path) -> ReferenceCurve:
    """Read a CSV file of two columns: numbers of modes, and mean errors in mm under the curve's label.

    Raises
    ------
    StudyError
        If there is no such file, or it does not hold numbers in two columns under a line of titles.
    """
    form = 'a line of titles, "modes,the paper" for example, and lines "3,0.935", the error in mm'
    if not path.is_file():
        raise StudyError(f"there is no reference curve {path}: it needs {form}")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            (_, label), *rows = [row for row in csv.reader(file) if row]
        values = np.array(rows, dtype=np.float64)
        modes, errors = values.T
    except ValueError as error:
        raise StudyError(f"{path} is no reference curve ({error}): it needs {form}") from error
    if not (np.isfinite(values).all() and (values > 0.0).all()):
        raise StudyError(f"{path}: numbers of modes and errors must be positive")
    return ReferenceCurve(label.strip(), modes, errors)
