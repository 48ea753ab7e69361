"""The [parameters.NAME] sections of a solid's study, and which of the parameters is the time."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated

from pydantic import Field, field_validator, model_validator

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.amplitudes import Amplitude
from morph_dslam.model import Parameter
from morph_dslam.studies.affine import read_affine
from morph_dslam.studies.sections import Number, Section, quantity
from morph_dslam.studies.solid_sections import Value
from morph_dslam.units import quantity_of


class ParameterSection(Section):
    """A parameter of the study.

    ``range`` are its ends, each a number with its unit, which says what it measures; plain numbers for a
    ratio. ``default`` is the state that nothing is known about (the value nearest to zero if absent); every
    path of solutions starts there.
    """

    range: tuple[Value, Value]
    default: Value | None = None
    description: str = ""

    @model_validator(mode="after")
    def _check(self) -> ParameterSection:
        try:
            self.parameter("parameter")
        except StudyError as error:
            raise ValueError(str(error)) from error
        return self

    def parameter(self, name: str) -> Parameter:
        """The parameter as the model file states it."""
        unit = _unit(self.range[0])
        measured = quantity_of(unit)
        lower, upper = (read_affine(end, measured, ()).constant for end in self.range)
        if not lower < upper:
            raise StudyError("the range must rise: its lower end is not below its upper end")
        default = min(max(0.0, lower), upper)
        if self.default is not None:
            default = read_affine(self.default, measured, ()).constant
        if not lower <= default <= upper:
            raise StudyError(f"the default {self.default} lies outside of the range")
        return Parameter(name, measured, unit, lower, upper, default, self.description)


def _unit(value: Value) -> str:
    if not isinstance(value, str):
        return "1"
    parts = value.split()
    if len(parts) != 2:
        raise StudyError(f"'{value}' is not a number and a unit")
    return parts[1]


Duration = Annotated[float, quantity("time"), Field(gt=0, allow_inf_nan=False)]
Instant = Annotated[float, quantity("time"), Field(ge=0, allow_inf_nan=False)]


class AmplitudeSection(Section):
    """What terms of loads and motions are multiplied by as time runs.

    ``values`` at ``times``, straight lines in between; before the first time and after the last it is constant.
    """

    times: tuple[Instant, ...] = Field(min_length=2)
    values: tuple[Number, ...]

    @model_validator(mode="after")
    def _check(self) -> AmplitudeSection:
        if len(self.times) != len(self.values):
            raise ValueError(f"{len(self.times)} times and {len(self.values)} values: give one value for each time")
        if any(later <= earlier for earlier, later in pairwise(self.times)):
            raise ValueError("times must rise from one to the next; a step takes a short time")
        return self

    def make(self) -> Amplitude:
        """The function."""
        return Amplitude(self.times, self.values)


class TimeSection(Section):
    """The parameter that is the time; at the lower end of its range the body is loaded in an instant.

    ``step`` is the longest increment of time; ``rest`` how long before that what is applied first has acted.
    ``amplitudes`` are functions of time that terms may be multiplied by.
    """

    parameter: str
    step: Duration
    rest: Duration | None = None
    amplitudes: dict[str, AmplitudeSection] = Field(default_factory=dict)

    @field_validator("amplitudes")
    @classmethod
    def _check_names(cls, amplitudes: dict[str, AmplitudeSection]) -> dict[str, AmplitudeSection]:
        for name in amplitudes:
            if not name.isidentifier():
                raise ValueError(f"'{name}' is no name for an amplitude: use letters, digits and underscores")
        return amplitudes
