"""Tables of a certificate's errors, from certificates of any version of the model file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from morph_dslam.evaluation.field_names import field_title
from morph_dslam.evaluation.report import Table

#: Endings of a certificate's keys and the unit in which their values are.
_UNITS = {"_mm": "mm", "_MPa": "MPa", "_Nmm": "N mm", "_N": "N"}
_ABSOLUTE = ("mean", "max", "worst_sample_mean", "largest")
_HEADER = ("field", "mean", "largest", "worst mean", "largest value", "unit", "mean / largest", "relative L2")
_SENSITIVITY_HEADER = ("parameter", "mean / largest", "relative L2")
_UNKNOWN = "–"


def error_table(certificate: Mapping[str, Any]) -> Table:
    """One row for each field with its errors, and one for the von Mises stress of each stress."""
    rows = []
    for name, entry in certificate.items():
        if name not in ("displacement", "strain") and not name.startswith(("stress_", "reaction_")):
            continue
        errors = entry if isinstance(entry, Mapping) else {"relative_l2": entry}
        rows.append(_row(field_title(name), errors))
        if "von_mises" in errors:
            place = field_title(name).partition(", ")[2]
            rows.append(_row(f"von Mises stress, {place}".removesuffix(", "), errors["von_mises"]))
    return Table(rows, _HEADER)


def sensitivity_table(certificate: Mapping[str, Any]) -> Table:
    """One row for each parameter with both measures of its sensitivity's error."""
    entries = certificate.get("sensitivity", {})
    rows = []
    for name, entry in entries.items():
        errors = entry if isinstance(entry, Mapping) else {"relative_l2": entry}
        rows.append([name, *_relative(errors)])
    return Table(rows, _SENSITIVITY_HEADER)


def _row(title: str, errors: Mapping[str, Any]) -> list[str]:
    ending = next((ending for ending in _UNITS if f"mean{ending}" in errors), "")
    absolute = [_number(errors.get(name + ending), "#.3g") for name in _ABSOLUTE]
    return [title, *absolute, _UNITS.get(ending, _UNKNOWN), *_relative(errors)]


def _relative(errors: Mapping[str, Any]) -> list[str]:
    return [_number(errors.get(name), ".2e") for name in ("mean_relative_to_largest", "relative_l2")]


def _number(value: float | None, form: str) -> str:
    if value is None:
        return _UNKNOWN
    # Thousands in full, not as a power of ten.
    return f"{value:.0f}" if abs(value) >= 1e3 else f"{value:{form}}".removesuffix(".")
