"""Sections that every study file may have, and how its quantities are read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from morph_dslam.errors import StudyError
from morph_dslam.reduction.registry import reduction_method
from morph_dslam.studies.affine import LARGEST, possible, usual_unit
from morph_dslam.units import to_si


def quantity(kind: str) -> BeforeValidator:
    """Reads "420 mm" as SI; refuses a bare number, so that no unit is ever guessed."""

    def read(value: Any) -> float:
        example = usual_unit(kind)
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise ValueError(f'write a number with its unit in quotes, "20 {example}" for example')
        if not isinstance(value, str):
            raise ValueError(f'write the value with its unit, "{value} {example}" for example')
        try:
            number, unit = value.split()
            size = float(number)
        except ValueError:
            raise ValueError(f"'{value}' is not a number and a unit, as \"20.5 {example}\" is") from None
        try:
            return to_si(possible(size, value), unit, kind)
        except StudyError as error:
            raise ValueError(str(error)) from error

    setattr(read, "quantity", kind)  # noqa: B010, for the reference of keys
    return BeforeValidator(read)


#: Between the names of sets that a study lists together.
JOINED = "+"


def _joined(value: Any) -> Any:
    if isinstance(value, list | tuple) and value and all(isinstance(name, str) for name in value):
        return JOINED.join(value)
    return value


#: The name of a set of the mesh, or the names of several listed, which stand for all that is in one of them.
SetName = Annotated[str, BeforeValidator(_joined)]
#: A plain number of a study: a ratio, a component of a direction.
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Length = Annotated[float, quantity("length")]
PositiveLength = Annotated[float, quantity("length"), Field(gt=0, allow_inf_nan=False)]
Stress = Annotated[float, quantity("stress"), Field(gt=0, allow_inf_nan=False)]
Angle = Annotated[float, quantity("angle")]


def _unit(kind: str) -> AfterValidator:
    """Takes the units of a quantity."""

    def check(unit: str) -> str:
        try:
            to_si(1.0, unit, kind)
        except StudyError as error:
            raise ValueError(str(error)) from error
        return unit

    return AfterValidator(check)


#: The unit of a file's or a list's lengths, and of its stresses.
LengthUnit = Annotated[str, _unit("length")]
StressUnit = Annotated[str, _unit("stress")]


def _in_folder(path: Path, info: ValidationInfo) -> Path:
    return Path((info.context or {}).get("folder", ".")) / path


#: A file, relative to the study's.
StudyPath = Annotated[Path, AfterValidator(_in_folder)]


class Section(BaseModel):
    """A section of a study file: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


#: More solves than these are a mistake.
MOST_SAMPLES = 1_000_000
#: Held-out solves that may be solved again with finer elements.
MOST_REFINED = 5


class SamplingSection(Section):
    """Numbers of training and held-out solves, where they lie, and the seed of their positions.

    ``scheme`` places the training samples: "sobol" scatters ``training`` of them, denser towards the edges of
    the box; "even" spaces them evenly with both ends included, for a single parameter; "grid" takes all
    points of a full grid with ``points`` for each parameter, or one number for all; "adaptive" solves
    ``first`` and then adds where the model's error is estimated to be largest, or, of a single parameter, in the
    middle of intervals, up to ``training``; "paths", of a study with a time, solves ``training`` paths at the same
    instants. The method of reduction chooses where it is absent. Held-out samples are always scattered.
    ``refined`` of them are solved again with finer elements to estimate the discretisation error, whatever time that
    takes; 0 for none. Where it is absent, 3 are, as far as the build's own time affords them.
    """

    training: int = Field(default=256, ge=8, le=MOST_SAMPLES)
    held_out: int = Field(default=59, ge=4, le=MOST_SAMPLES)
    scheme: Literal["sobol", "even", "grid", "adaptive", "paths"] | None = None
    points: int | tuple[int, ...] | None = None
    first: int = Field(default=16, ge=4)
    seed: int = Field(default=0, ge=0)
    refined: int | None = Field(default=None, ge=0, le=MOST_REFINED)

    @field_validator("points")
    @classmethod
    def _check_points(cls, points: int | tuple[int, ...] | None) -> int | tuple[int, ...] | None:
        if any(count < 2 for count in ((points,) if isinstance(points, int) else points or ())):
            raise ValueError("a grid needs at least 2 points along each parameter")
        return points

    @model_validator(mode="after")
    def _check_scheme(self) -> SamplingSection:
        given = self.model_fields_set
        if self.scheme == "grid" and self.points is None:
            raise ValueError('scheme = "grid" needs points: their number along each parameter, [9, 5] say')
        if self.scheme == "grid" and "training" in given:
            raise ValueError('with scheme = "grid" the points are the training samples: leave out training')
        if self.scheme != "grid" and "points" in given:
            raise ValueError('points are those of scheme = "grid": leave them out, or choose that scheme')
        if self.scheme not in (None, "adaptive") and "first" in given:
            raise ValueError('first is for scheme = "adaptive": leave it out, or choose that scheme')
        if self.scheme == "adaptive" and self.first > self.training:
            raise ValueError("first must be at most training: adaptive sampling starts with it and adds")
        return self


#: Names of formats of functions of several parameters, and of functions of one.
FormatName = Literal["tucker", "tensor_train", "cp", "polynomial"]
BasisName = Literal["chebyshev", "cubic_spline", "p_spline", "kriging", "fourier", "hat"]


class ReductionSection(Section):
    """How solutions are reduced.

    ``method`` finds the functions of the parameters, ``format`` is how those of several parameters are kept
    and ``basis`` what those of a single one are made of; the study and the method choose where one is absent.
    Modes, in which nodes count by their volume, are kept until the relative norm left out is below
    ``tolerance``, and at most ``max_modes``; ``max_degree`` is the highest polynomial degree tried in the
    parameters.
    """

    method: str | None = None
    format: FormatName | None = None
    basis: BasisName | None = None
    tolerance: float = Field(default=5e-4, gt=0, lt=1)
    max_modes: int = Field(default=24, ge=1)
    max_degree: int = Field(default=8, ge=1, le=40)

    @field_validator("method")
    @classmethod
    def _check_method(cls, method: str | None) -> str | None:
        try:
            return method and reduction_method(method).name
        except StudyError as error:
            raise ValueError(str(error)) from error


class UnknownLoadsSection(Section):
    """Unknown tractions: where, along which direction, and how many of the softest.

    ``on`` is a surface, of a shell all of it if absent. ``direction`` "inward" is for what presses: pressures
    about places spread over the surface, which never pull; "any" for the tractions that the body gives way to most,
    whatever their direction.
    """

    on: SetName = ""
    direction: Literal["inward", "any"] = "inward"
    modes: int = Field(default=30, ge=1, le=300)


class WorkSection(Section):
    """How the solves share the machine: worker processes, and threads in each (every core if absent)."""

    workers: int | None = Field(default=None, ge=1)
    threads: int | None = Field(default=None, ge=1)
