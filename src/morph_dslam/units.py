"""Units: declared on input, SI (metre, pascal, radian, second) inside, millimetres in reports."""

from __future__ import annotations

import re
from math import pi

from morph_dslam.errors import StudyError

#: A pound is 0.45359237 kg, its weight that under 9.80665 m/s2, an inch 25.4 mm: all exact by definition.
_PSI = 0.45359237 * 9.80665 / 0.0254**2
_STRESS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9, "N/mm2": 1e6, "bar": 1e5, "mbar": 1e2, "psi": _PSI}
#: Factor from each accepted unit to SI, by the quantity it measures.
FACTORS: dict[str, dict[str, float]] = {
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
    "stress": _STRESS,
    "pressure": _STRESS,
    "angle": {"rad": 1.0, "deg": pi / 180.0},
    "ratio": {"1": 1.0},
    "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    "moment": {"N.m": 1.0, "N.mm": 1e-3},
    "density": {"kg/m3": 1.0, "g/cm3": 1e3},
    "acceleration": {"m/s2": 1.0, "mm/s2": 1e-3},
    "force per length": {"N/m": 1.0, "N/mm": 1e3},
    "force per volume": {"N/m3": 1.0, "N/mm3": 1e9},
    "stiffness per area": {"N/m3": 1.0, "N/mm3": 1e9, "Pa/m": 1.0, "MPa/mm": 1e9},
    "time": {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0},
}
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(1|[A-Za-z]\S*)?\s*")


def quantity_of(unit: str) -> str:
    """The quantity that ``unit`` measures, "stress" for "MPa". Raises StudyError if it is not a unit known here."""
    for quantity, known in FACTORS.items():
        if unit in known:
            return quantity
    units = dict.fromkeys(unit for known in FACTORS.values() for unit in known)
    raise StudyError(f"'{unit}' is not a known unit; known are {', '.join(units)}")


def smaller_units(quantity: str) -> list[float]:
    """What makes values of smaller units of those in larger ones, each less than 1, ascending."""
    units = FACTORS[quantity].values()
    return sorted({a / b for a in units for b in units if a < b})


def to_si(value: float, unit: str, quantity: str) -> float:
    """Convert ``value`` in ``unit`` to SI. Raises StudyError if ``unit`` does not measure ``quantity``."""
    known = FACTORS[quantity]
    if unit not in known:
        raise StudyError(f"'{unit}' is not a unit of {quantity}; use one of {', '.join(known)}")
    return value * known[unit]


def read_quantity(text: str, quantity: str) -> float:
    """A text such as "20 mN" as SI.

    Parameters
    ----------
    text : a number and its unit; for a ratio the number alone.
    quantity : a key of `FACTORS`.

    Raises
    ------
    StudyError
        If the text is something else, or its unit does not measure ``quantity``.
    """
    read = _QUANTITY.fullmatch(text)
    unit = None if read is None else read[2] or ("1" if quantity == "ratio" else None)
    if read is None or unit is None:
        units = ", ".join(FACTORS[quantity])
        raise StudyError(f"'{text}' is not a number with a unit of {quantity} ({units}) behind it")
    return to_si(float(read[1]), unit, quantity)


def from_si(value: float, unit: str, quantity: str) -> float:
    """Convert an SI ``value`` to ``unit``; raises StudyError as `to_si` does."""
    return value / to_si(1.0, unit, quantity)
