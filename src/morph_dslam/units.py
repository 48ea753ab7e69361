"""Units: declared on input, SI (metre, pascal, radian, second) inside, millimetres in reports."""

from __future__ import annotations

from math import pi

from morph_dslam.errors import StudyError

#: Factor from each accepted unit to SI, by the quantity it measures.
FACTORS: dict[str, dict[str, float]] = {
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "stress": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9},
    "angle": {"rad": 1.0, "deg": pi / 180.0},
    "ratio": {"1": 1.0},
}


def to_si(value: float, unit: str, quantity: str) -> float:
    """Convert ``value`` in ``unit`` to SI.

    Raises
    ------
    StudyError
        If ``unit`` does not measure ``quantity``.
    """
    known = FACTORS[quantity]
    if unit not in known:
        raise StudyError(f"'{unit}' is not a unit of {quantity}; use one of {', '.join(known)}")
    return value * known[unit]


def from_si(value: float, unit: str, quantity: str) -> float:
    """Convert an SI ``value`` to ``unit``; raises StudyError as `to_si` does."""
    return value / to_si(1.0, unit, quantity)
