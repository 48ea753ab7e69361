"""The study of a sheet in two grips: its sections, samples, snapshots on an output grid, and their mirror images.

A sheet does not know its two sides apart, so the mirror image of a solution is a solution; if its grips are
at the same height, it does not know left from right either, and if that is half its width, nor top from
bottom.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from morph_dslam.mechanics.gripped_sheet import EquilibriumState, GrippedSheet
from morph_dslam.mechanics.grips import COORDINATES, Grips
from morph_dslam.mechanics.shell import OrthotropicSheet
from morph_dslam.model import Parameter
from morph_dslam.model.reduced_model import FORCE, MOMENT, REACTION
from morph_dslam.studies.problem import ModelMesh, Snapshot
from morph_dslam.studies.sections import (
    Angle,
    Length,
    Number,
    PositiveLength,
    ReductionSection,
    SamplingSection,
    Section,
    Stress,
    WorkSection,
)
from morph_dslam.studies.snapshots import SOLVER_VERSION

Array = NDArray[np.float64]
#: Names of the grips, as of supports.
GRIPS = ("left", "right")
#: Signs that the coordinates take when the sheet is mirrored in its own plane, in x = 0 and in y = 0.
MIRROR_Z = np.array([-1.0, 1.0, -1.0, 1.0])
MIRROR_X = np.array([1.0, 1.0, -1.0, -1.0])
MIRROR_Y = np.array([1.0, 1.0, 1.0, -1.0])


def output_points(length: float, width: float, grid: tuple[int, int]) -> Array:
    """Points (n, 2) of a grid of cells over the sheet, x fastest, metres."""
    nx, ny = grid
    x = np.linspace(-length / 2.0, length / 2.0, nx + 1)
    y = np.linspace(-width / 2.0, width / 2.0, ny + 1)
    return np.column_stack([np.tile(x, ny + 1), np.repeat(y, nx + 1)])


def take_snapshot(problem: GrippedSheet, state: EquilibriumState, points: Array, thickness_ratio: float) -> Snapshot:
    """Displacement, stress, what the grips exert, and the derivatives of all at a solved state.

    Parameters
    ----------
    problem : the sheet.
    state : solved.
    points : (n, 2) material points.
    thickness_ratio : the sheet's thickness over that of ``problem``.
    """
    dof_slopes, _ = problem.sensitivities(state)
    fields = _fields(problem, state.dofs, points, thickness_ratio)
    slopes = [_fields(problem, slope, points, thickness_ratio) for slope in dof_slopes]
    derivatives = {name: np.array([slope[name] for slope in slopes]) for name in fields}
    # Forces go with bending stiffness, as the sheet does not stretch.
    reactions, reaction_slopes = (thickness_ratio**3 * part for part in problem.reactions(state))
    outputs = {"motion": state.motion}
    for i, grip in enumerate(GRIPS):
        for kind, part in ((FORCE, slice(3)), (MOMENT, slice(3, 6))):
            outputs[kind + grip] = reactions[i, part]
            derivatives[REACTION + kind + grip] = reaction_slopes[:, i, None, part]
    return Snapshot(state.coordinates, fields, derivatives, outputs)


def _fields(problem: GrippedSheet, dofs: Array, points: Array, ratio: float) -> dict[str, Array]:
    displacement, stress = problem.shell.sample(dofs, points)
    # The membrane part of the stress goes with thickness squared, the bending part with thickness.
    membrane = ratio**2 * (stress["top"] + stress["bottom"]) / 2.0
    bending = ratio * (stress["bottom"] - stress["top"]) / 2.0
    return {"displacement": displacement, "stress_top": membrane - bending, "stress_bottom": membrane + bending}


def _image(
    snapshot: Snapshot, signs: Array, vector: list[float], motion: Array, columns: int = 0, axis: int | None = None
) -> Snapshot:
    """A mirror image of a snapshot.

    Parameters
    ----------
    snapshot : to be mirrored.
    signs : (4,) of the coordinates.
    vector : signs of the displacement's components.
    motion : (5,) of the grips in the image.
    columns : points along x of the output grid.
    axis : of the grid that is reversed, -2 for x and -3 for y; None where the faces are swapped instead.
    """
    tensor = [1.0, 1.0, 1.0 if axis is None else -1.0]

    def moved(field: Array) -> Array:
        if axis is None:
            return field
        grid = field.reshape(*field.shape[:-2], -1, columns, 3)
        return np.flip(grid, axis).reshape(field.shape)

    def image(fields: Mapping[str, Array], sign: Array | float) -> dict[str, Array]:
        top, bottom = ("stress_bottom", "stress_top") if axis is None else ("stress_top", "stress_bottom")
        return {
            "displacement": moved(fields["displacement"]) * np.array(vector) * sign,
            "stress_top": moved(fields[top]) * np.array(tensor) * sign,
            "stress_bottom": moved(fields[bottom]) * np.array(tensor) * sign,
        }

    slopes = image(snapshot.sensitivities, signs[:, None, None])
    outputs = {"motion": motion}
    for grip, other in zip(GRIPS, reversed(GRIPS) if axis == -2 else GRIPS, strict=True):
        # A moment is a vector of a rotation: mirrored, it keeps what a force turns round.
        for kind, turned in ((FORCE, np.array(vector)), (MOMENT, -np.array(vector))):
            outputs[kind + grip] = snapshot.outputs[kind + other] * turned
            slope = snapshot.sensitivities[REACTION + kind + other]
            slopes[REACTION + kind + grip] = slope * turned * signs[:, None, None]
    return Snapshot(snapshot.coordinates * signs, image(snapshot.fields, 1.0), slopes, outputs)


def mirrored(snapshot: Snapshot) -> Snapshot:
    """The mirror image z -> -z: another state of the same sheet, with its faces swapped."""
    motion = snapshot.outputs["motion"] * np.array([-1.0, -1.0, -1.0, 1.0, 1.0])
    return _image(snapshot, MIRROR_Z, [1.0, 1.0, -1.0], motion)


def reversed_ends(snapshot: Snapshot, columns: int) -> Snapshot:
    """The mirror image x -> -x: another state of the same sheet if its grips are at the same height."""
    left, right, twist, approach, turn = snapshot.outputs["motion"]
    motion = np.array([right, left, -twist, approach, -turn])
    return _image(snapshot, MIRROR_X, [-1.0, 1.0, 1.0], motion, columns, -2)


def upside_down(snapshot: Snapshot, columns: int) -> Snapshot:
    """The mirror image y -> -y: another state of the same sheet if its grips are at the middle of its edges."""
    motion = snapshot.outputs["motion"] * np.array([1.0, 1.0, -1.0, 1.0, -1.0])
    return _image(snapshot, MIRROR_Y, [1.0, -1.0, 1.0], motion, columns, -3)


#: Cells along a side of a sheet: more than these are a mistake.
Count = Annotated[int, Field(ge=1, le=1000)]
#: Smallest |bulge| that is solved, over the largest: in the flat state itself the equations are singular.
SMALLEST_BULGE = 0.02


class _SheetSection(Section):
    """The flat sheet: length along x, width along y, thickness."""

    length: PositiveLength
    width: PositiveLength
    thickness: PositiveLength


class _SheetMaterialSection(Section):
    """Orthotropic elasticity, fibres along x: Young's moduli along and across, nu_12, G_12."""

    young_fibre: Stress
    young_cross: Stress
    poisson: float = Field(ge=0, lt=1)
    shear: Stress


class _GripsSection(Section):
    """Two rigid grips on the short edges: depth along x, height along y, y of their centres."""

    depth: PositiveLength
    height: PositiveLength
    centre_left: Length = 0.0
    centre_right: Length = 0.0

    @property
    def symmetric(self) -> bool:
        """Whether left and right are mirror images."""
        return self.centre_left == self.centre_right

    @property
    def centred(self) -> bool:
        """Whether the halves of the sheet above and below the grips' middles are mirror images too."""
        return self.centre_left == self.centre_right == 0.0


class _SheetParametersSection(Section):
    """Ranges of the four coordinates (`morph_dslam.mechanics.grips` says what they mean)."""

    bulge: tuple[Length, Length]
    bend: tuple[Number, Number]
    skew: tuple[Angle, Angle]
    slant: tuple[Number, Number]

    @property
    def bounds(self) -> Array:
        """Ranges (4, 2) in the order of `morph_dslam.mechanics.grips.COORDINATES`, SI."""
        return np.array([getattr(self, name) for name in COORDINATES])

    @model_validator(mode="after")
    def _check_order(self) -> _SheetParametersSection:
        for name in type(self).model_fields:
            lower, upper = getattr(self, name)
            if not lower < upper:
                raise ValueError(f"the range of {name} must rise: its lower end is not below its upper end")
        return self


class _SheetSolverSection(WorkSection):
    """Discretisation.

    ``thickness`` is the thickness at which equilibrium is solved, the sheet's own if absent. The shape of a
    sheet that bends without stretching does not depend on it, and a thicker one needs fewer iterations;
    bending stress is scaled back in proportion to thickness, membrane stress to its square.
    """

    divisions: tuple[Count, Count] = (12, 10)
    order: int = Field(default=3, ge=2, le=4)
    thickness: PositiveLength | None = None


class _SheetReductionSection(ReductionSection):
    """Reduction, and the cells of the model's mesh along x and y."""

    grid: tuple[Count, Count] = (60, 42)


class SheetStudy(Section):
    """A thin elastic sheet held by two rigid grips."""

    name: str
    sheet: _SheetSection
    material: _SheetMaterialSection
    grips: _GripsSection
    parameters: _SheetParametersSection
    solver: _SheetSolverSection = _SheetSolverSection()
    sampling: SamplingSection = SamplingSection()
    reduction: _SheetReductionSection = _SheetReductionSection()

    @model_validator(mode="after")
    def _check_sizes(self) -> SheetStudy:
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

    @property
    def work(self) -> WorkSection:
        """One thread in each worker unless the study says otherwise: the workers fill the cores."""
        return WorkSection(workers=self.solver.workers, threads=self.solver.threads or 1)

    @property
    def advice(self) -> str:
        """What to change when the sheet cannot be solved."""
        return "Narrow the ranges of the parameters, refine solver.divisions, or raise solver.thickness"

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
            self.sheet.length, self.grips.depth, self.grips.height, self.grips.centre_left, self.grips.centre_right
        )
        return GrippedSheet(material, grips, self.sheet.width, self.solver.divisions, self.solver.order)

    def sweep_problem(self) -> _GrippedSheetSweep:
        """What the sweep solves with."""
        return _GrippedSheetSweep(
            self.problem(), self._output_points(), self.sheet.thickness / self.solve_thickness, self.root()
        )

    def fingerprint(self) -> str:
        """Hash of the sheet, its grips, discretisation and output grid, and of the solver version."""
        content = self.model_dump(include={"sheet", "material", "grips", "solver"})
        for option in WorkSection.model_fields:
            del content["solver"][option]
        content["grid"] = self.reduction.grid
        content["code"], content["reactions"] = SOLVER_VERSION, True
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

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

    def root(self) -> Array:
        """The gentle circular arch that every path starts from."""
        bulge = min(0.03 * self.sheet.length, 0.5 * max(abs(b) for b in self.parameters.bulge))
        return np.array([bulge, 1.0, 0.0, 0.0])

    def scale(self) -> Array:
        """The sizes of the ranges, for the bulge its largest value: both signs are one state."""
        bounds = self.parameters.bounds
        size = np.diff(bounds, axis=1).ravel()
        size[0] = np.abs(bounds[0]).max()
        return size

    def admissible(self, samples: Array) -> Array:
        """Samples (n, 4) with the bulge kept off zero."""
        smallest = SMALLEST_BULGE * max(abs(b) for b in self.parameters.bulge)
        result, bulge = samples.copy(), samples[:, 0]
        result[:, 0] = np.where(np.abs(bulge) < smallest, np.copysign(smallest, bulge), bulge)
        return result

    def canonical(self, samples: Array) -> Array:
        """The mirror image of each sample (n, 4) that is solved in its place.

        The sheet does not know its sides apart, so bulge can be made positive; if its grips are at the same
        height, slant too, and if that is the middle, skew as well.
        """
        samples = np.where(samples[:, :1] < 0.0, samples * MIRROR_Z, samples)
        if self.grips.symmetric:
            samples = np.where(samples[:, 3:] < 0.0, samples * MIRROR_X, samples)
        if self.grips.centred:
            samples = np.where(samples[:, 2:3] < 0.0, samples * MIRROR_X * MIRROR_Y, samples)
        return samples

    def images(self, snapshot: Snapshot) -> list[Snapshot]:
        """This state and its mirror images that are states of the same sheet."""
        # Fields are read from a file each time they are asked for.
        read = replace(snapshot, fields=dict(snapshot.fields), sensitivities=dict(snapshot.sensitivities))
        result = [snapshot, mirrored(read)]
        columns = self.reduction.grid[0] + 1
        if self.grips.symmetric:
            result += [reversed_ends(image, columns) for image in (read, result[1])]
        if self.grips.centred:
            result += [upside_down(image, columns) for image in result]
        return result

    def model_mesh(self) -> ModelMesh:
        """The output grid, two triangles a cell, with trapezoidal weights."""
        nx, ny = self.reduction.grid
        points = self._output_points()
        x, y = np.ones(nx + 1), np.ones(ny + 1)
        x[[0, -1]] = y[[0, -1]] = 0.5
        return ModelMesh(
            nodes=np.column_stack([points, np.zeros(len(points))]),
            triangles=_grid_triangles(nx, ny),
            weights=np.outer(y, x).ravel() / (nx * ny),
            supports=self._held_points(points),
        )

    def _held_points(self, points: Array) -> dict[str, NDArray[np.int64]]:
        """Output points (n, 2) under each grip, as far as there are any."""
        grips, inner = self.grips, self.sheet.length / 2.0 - self.grips.depth
        found = {}
        for grip, sign, centre in zip(GRIPS, (-1.0, 1.0), (grips.centre_left, grips.centre_right), strict=True):
            near = np.abs(points[:, 1] - centre) <= grips.height / 2.0 * (1.0 + 1e-9)
            held = np.flatnonzero((sign * points[:, 0] >= inner * (1.0 - 1e-9)) & near)
            found |= {grip: held} if len(held) else {}
        return found

    def _output_points(self) -> Array:
        return output_points(self.sheet.length, self.sheet.width, self.reduction.grid)


@dataclass(frozen=True)
class _GrippedSheetSweep:
    """The gripped sheet as the sweep sees it (`morph_dslam.studies.problem.SweepProblem`).

    Attributes
    ----------
    sheet : the discrete problem.
    points : (n, 2) output grid.
    thickness_ratio : the sheet's thickness over the one it is solved at.
    root : (4,) coordinates of the first state.
    """

    sheet: GrippedSheet
    points: Array
    thickness_ratio: float
    root: Array

    def first_state(self) -> EquilibriumState:
        return self.sheet.first_state(self.root[0])

    def pack(self, state: EquilibriumState) -> dict[str, Array]:
        return {"coordinates": state.coordinates, "motion": state.motion, "dofs": state.dofs}

    def unpack(self, arrays: dict[str, Array]) -> EquilibriumState:
        return EquilibriumState(arrays["coordinates"], arrays["motion"], arrays["dofs"])

    def advance(self, start: EquilibriumState, target: Array) -> EquilibriumState:
        return self.sheet.advance(start, target)

    def take_snapshot(self, state: EquilibriumState) -> Snapshot:
        return take_snapshot(self.sheet, state, self.points, self.thickness_ratio)


def _grid_triangles(nx: int, ny: int) -> NDArray[np.int64]:
    """Two triangles (2 nx ny, 3) for each grid cell, counter-clockwise seen from +z."""
    corner = (np.arange(ny)[:, None] * (nx + 1) + np.arange(nx)).ravel()
    right, above = corner + 1, corner + nx + 1
    lower = np.column_stack([corner, right, above + 1])
    upper = np.column_stack([corner, above + 1, above])
    return np.stack([lower, upper], axis=1).reshape(-1, 3)
