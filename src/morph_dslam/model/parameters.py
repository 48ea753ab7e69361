"""The parameters of a model, states of them in words, and the columns of tables that hold them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from morph_dslam.io.text import name_and_unit
from morph_dslam.units import FACTORS, from_si

if TYPE_CHECKING:
    from morph_dslam.model.reduced_model import ReducedModel

#: Values may pass the end of a range by so much of its width: tables round.
ROUNDING = 1e-6


@dataclass(frozen=True)
class Parameter:
    """One coordinate of the parameter box.

    Attributes
    ----------
    name : of the parameter.
    quantity : what it measures, a key of `morph_dslam.units.FACTORS` ("length", "angle", "ratio" ...).
    unit : in which reports show it.
    lower : lower end of its range, SI.
    upper : upper end, SI.
    default : value of the state that nothing is known about, SI.
    description : for reports.
    """

    name: str
    quantity: str
    unit: str
    lower: float
    upper: float
    default: float
    description: str = ""

    def display(self, value: float) -> float:
        """``value`` (SI) in ``unit``."""
        return from_si(value, self.unit, self.quantity)

    def text(self, value: float) -> str:
        """``value`` (SI) for people, with its unit."""
        return f"{self.display(value):.6g} {self.unit}".removesuffix(" 1")

    @property
    def range_text(self) -> str:
        """The range for people, "0 to 20 mm"."""
        return f"{self.display(self.lower):.6g} to {self.text(self.upper)}"

    def in_range(self, value: float) -> bool:
        """Whether ``value`` (SI) lies in the range, but for rounding; NaN does not."""
        slack = ROUNDING * (self.upper - self.lower)
        return self.lower - slack <= value <= self.upper + slack


def state_text(parameters: Sequence[Parameter], mu: ArrayLike) -> str:
    """A state (d,), SI, for people: "load = 0.015 N, modulus = 3 MPa"."""
    values = np.atleast_1d(np.asarray(mu, dtype=np.float64))
    return ", ".join(f"{p.name} = {p.text(value)}" for p, value in zip(parameters, values, strict=True))


def parameter_of_column(header: str, model: ReducedModel) -> tuple[str, float] | None:
    """The parameter that a column such as ``stroke_mm`` holds, and the factor of its values to SI; None if none."""
    name, unit = name_and_unit(header)
    for parameter in model.parameters:
        if parameter.name == name and unit in FACTORS[parameter.quantity]:
            return name, FACTORS[parameter.quantity][unit]
    return None


def columns_of_run(header: Sequence[str]) -> dict[int, int] | None:
    """Of a run's ``frames.csv``, the columns of parameters' values, each with that of its deviation; None of others.

    Values, deviations and whether they are at a bound are side by side. Titles alone do not tell "x_std [mm]", the
    deviation of x, from "x_std_mm", the value of x_std.
    """
    if "pose_from" not in header:
        return None
    found = {}
    for column, three in enumerate(zip(header, header[1:], header[2:], strict=False)):
        name, unit = name_and_unit(three[0])
        plain = f"{name}_{unit}", f"{name}_std_{unit}", f"{name}_at_bound"
        if three in (plain, (f"{name} [{unit}]", f"{name}_std [{unit}]", f"{name} at_bound")):
            found[column] = column + 1
    return found


def parameter_columns(model: ReducedModel) -> str:
    """How columns with the model's parameters are named, for messages."""
    return ", ".join(f"{parameter.name}_{parameter.unit}" for parameter in model.parameters)
