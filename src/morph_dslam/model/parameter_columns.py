"""Columns of tables that hold parameters of a model, such as ``stroke_mm``."""

from __future__ import annotations

from morph_dslam.io.text import name_and_unit
from morph_dslam.model.reduced_model import ReducedModel
from morph_dslam.units import FACTORS


def parameter_of_column(header: str, model: ReducedModel) -> tuple[str, float] | None:
    """The parameter that a column such as ``stroke_mm`` holds, and the factor of its values to SI; None if none."""
    name, unit = name_and_unit(header)
    for parameter in model.parameters:
        if parameter.name == name and unit in FACTORS[parameter.quantity]:
            return name, FACTORS[parameter.quantity][unit]
    return None


def parameter_columns(model: ReducedModel) -> str:
    """How columns with the model's parameters are named, for messages."""
    return ", ".join(f"{parameter.name}_{parameter.unit}" for parameter in model.parameters)
