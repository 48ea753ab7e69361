"""The study file: what to solve and over which parameter box. Every quantity is written with its unit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from morph_dslam.errors import StudyError
from morph_dslam.io.toml_file import read_toml
from morph_dslam.model import Parameter
from morph_dslam.offline.gripped_sheet import GrippedSheet
from morph_dslam.offline.grips import COORDINATES, Grips
from morph_dslam.offline.shell import OrthotropicSheet
from morph_dslam.units import to_si


def _quantity(kind: str) -> BeforeValidator:
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


Length = Annotated[float, _quantity("length")]
PositiveLength = Annotated[float, _quantity("length"), Field(gt=0, allow_inf_nan=False)]
Stress = Annotated[float, _quantity("stress"), Field(gt=0, allow_inf_nan=False)]
Angle = Annotated[float, _quantity("angle")]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SheetSection(_Section):
    """The flat sheet: length along x, width along y, thickness."""

    length: PositiveLength
    width: PositiveLength
    thickness: PositiveLength


class MaterialSection(_Section):
    """Orthotropic elasticity, fibres along x: Young's moduli along and across, nu_12, G_12."""

    young_fibre: Stress
    young_cross: Stress
    poisson: float = Field(ge=0, lt=1)
    shear: Stress


class GripsSection(_Section):
    """Two rigid grips on the short edges: depth along x, height along y, y of their centres."""

    depth: PositiveLength
    height: PositiveLength
    centre_left: Length = 0.0
    centre_right: Length = 0.0

    @property
    def symmetric(self) -> bool:
        """Whether left and right are mirror images."""
        return self.centre_left == self.centre_right


class ParametersSection(_Section):
    """Ranges of the four coordinates (`morph_dslam.offline.grips` says what they mean)."""

    bulge: tuple[Length, Length]
    bend: tuple[float, float]
    skew: tuple[Angle, Angle]
    slant: tuple[float, float]

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Ranges (4, 2) in the order of `morph_dslam.offline.grips.COORDINATES`, SI."""
        return np.array([getattr(self, name) for name in COORDINATES])

    @model_validator(mode="after")
    def _check_order(self) -> ParametersSection:
        for name in type(self).model_fields:
            lower, upper = getattr(self, name)
            if not lower < upper:
                raise ValueError(f"the range of {name} must rise: its lower end is not below its upper end")
        return self


class SolverSection(_Section):
    """Discretisation.

    ``thickness`` is the thickness at which equilibrium is solved, the sheet's own if absent. The shape of a
    sheet that bends without stretching does not depend on it, and a thicker one needs fewer iterations;
    bending stress is scaled back in proportion to thickness, membrane stress to its square.
    """

    divisions: tuple[int, int] = (12, 10)
    order: int = Field(default=3, ge=2, le=4)
    thickness: PositiveLength | None = None


class SamplingSection(_Section):
    """Numbers of training and held-out solves, and the seed of their positions."""

    training: int = Field(default=256, ge=8)
    held_out: int = Field(default=59, ge=4)
    seed: int = 0


class ReductionSection(_Section):
    """Modes kept (relative energy left out, and at most), highest polynomial degree, output grid."""

    tolerance: float = Field(default=5e-4, gt=0, lt=1)
    max_modes: int = Field(default=24, ge=1)
    max_degree: int = Field(default=8, ge=1, le=12)
    grid: tuple[int, int] = (60, 42)


class Study(_Section):
    """A thin elastic sheet held by two rigid grips."""

    name: str
    sheet: SheetSection
    material: MaterialSection
    grips: GripsSection
    parameters: ParametersSection
    solver: SolverSection = SolverSection()
    sampling: SamplingSection = SamplingSection()
    reduction: ReductionSection = ReductionSection()

    @model_validator(mode="after")
    def _check_sizes(self) -> Study:
        sheet, grips = self.sheet, self.grips
        if not 1e-3 <= sheet.length <= 10.0 or not 1e-3 <= sheet.width <= 10.0:
            raise ValueError(
                f"the sheet is {sheet.length:g} x {sheet.width:g} m; are the units right? "
                "sizes from 1 mm to 10 m are expected"
            )
        if sheet.thickness > 0.05 * min(sheet.length, sheet.width):
            raise ValueError("the sheet is thicker than 5 % of its size: shell theory does not hold")
        if 4.0 * grips.depth > sheet.length:
            raise ValueError("the grips cover half of the sheet's length: make grips.depth smaller")
        for name in ("centre_left", "centre_right"):
            if abs(getattr(grips, name)) + grips.height / 2.0 > sheet.width / 2.0 * (1.0 + 1e-9):
                raise ValueError(f"grips.{name}: the grip reaches beyond the sheet's edge")
        return self

    @property
    def solve_thickness(self) -> float:
        """Thickness at which equilibrium is solved, m."""
        return self.solver.thickness or self.sheet.thickness

    def problem(self) -> GrippedSheet:
        """The discrete mechanical problem."""
        material = OrthotropicSheet(
            self.material.young_fibre,
            self.material.young_cross,
            self.material.poisson,
            self.material.shear,
            self.solve_thickness,
        )
        grips = Grips(
            self.sheet.length,
            self.grips.depth,
            self.grips.height,
            self.grips.centre_left,
            self.grips.centre_right,
        )
        return GrippedSheet(material, grips, self.sheet.width, self.solver.divisions, self.solver.order)

    def model_parameters(self) -> tuple[Parameter, ...]:
        """The parameters as the model file states them; the default is the state nearest to flat."""
        texts = {
            "bulge": ("length", "mm", "mean height of the middle over the line between the grips"),
            "bend": ("ratio", "1", "symmetric end slope over that of a circular arc with this bulge"),
            "skew": ("angle", "deg", "half the difference of the end slopes"),
            "slant": ("ratio", "1", "twist over twice the bend of that arc: lean of the rulings"),
        }
        result = []
        for name, (quantity, unit, description) in texts.items():
            lower, upper = getattr(self.parameters, name)
            natural = 1.0 if name == "bend" else 0.0
            default = min(max(natural, lower), upper)
            result.append(Parameter(name, quantity, unit, lower, upper, default, description))
        return tuple(result)


def load_study(path: Path) -> Study:
    """Read a study file.

    Raises
    ------
    StudyError
        If it is missing, is not TOML, has an unknown or missing key, or a value that cannot be.
    """
    content = read_toml(path, "study file", StudyError)
    try:
        return Study.model_validate(content)
    except ValidationError as error:
        raise StudyError(f"{path}: " + "; ".join(_explain(entry) for entry in error.errors())) from error


def _explain(entry: Any) -> str:
    where = ".".join(str(part) for part in entry["loc"]) or "study"
    if entry["type"] == "extra_forbidden":
        section: Any = Study
        for part in entry["loc"][:-1]:
            section = section.model_fields[part].annotation
        return f"unknown key {where}; known here: {', '.join(section.model_fields)}"
    if entry["type"] == "missing":
        return f"{where} is missing"
    return f"{where}: {entry['msg'].removeprefix('Value error, ')}"
