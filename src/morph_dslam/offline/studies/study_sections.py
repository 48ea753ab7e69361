"""Sections that every study file may have, and how its quantities are read."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from morph_dslam.errors import StudyError
from morph_dslam.units import to_si


def quantity(kind: str) -> BeforeValidator:
    """Reads "420 mm" as SI; refuses a bare number, so that no unit is ever guessed."""

    def read(value: Any) -> float:
        if not isinstance(value, str):
            raise ValueError(f'write the value with its unit, "{value} mm" for example')
        parts = value.split()
        if len(parts) != 2:
            raise ValueError(f"'{value}' is not a number and a unit")
        try:
            return to_si(float(parts[0]), parts[1], kind)
        except StudyError as error:
            raise ValueError(str(error)) from error

    return BeforeValidator(read)


Length = Annotated[float, quantity("length")]
PositiveLength = Annotated[float, quantity("length"), Field(gt=0, allow_inf_nan=False)]
Stress = Annotated[float, quantity("stress"), Field(gt=0, allow_inf_nan=False)]
Angle = Annotated[float, quantity("angle")]


class Section(BaseModel):
    """A section of a study file: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class SamplingSection(Section):
    """Numbers of training and held-out solves, where they lie, and the seed of their positions.

    ``scheme`` places the training samples: "sobol" scatters them, denser towards the edges of the box; "even"
    spaces them evenly with both ends included, for a single parameter. Held-out samples are always scattered.
    """

    training: int = Field(default=256, ge=8)
    held_out: int = Field(default=59, ge=4)
    scheme: Literal["sobol", "even"] = "sobol"
    seed: int = 0


class ReductionSection(Section):
    """Modes kept (relative energy left out, and at most) and the highest polynomial degree tried."""

    tolerance: float = Field(default=5e-4, gt=0, lt=1)
    max_modes: int = Field(default=24, ge=1)
    max_degree: int = Field(default=8, ge=1, le=40)


class WorkSection(Section):
    """How the solves share the machine: worker processes, and threads in each (every core if absent)."""

    workers: int | None = Field(default=None, ge=1)
    threads: int | None = Field(default=None, ge=1)
