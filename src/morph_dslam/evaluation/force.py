"""Measured forces against a reaction of the model that was tracked.

Images determine shapes, not forces: a model whose stiffnesses are all wrong by one factor tracks as well as a right
one. A measured force gives that factor. It is fitted with an offset, the zero of the load cell, by least squares.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.run_folder import Run
from morph_dslam.io.text import read_text
from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.model.reduced_model import FORCE
from morph_dslam.units import FACTORS

Array = NDArray[np.float64]
#: Fewer comparisons determine no factor and offset with anything left over.
LEAST = 3
_REACTION = re.compile(r"(?P<support>.+?)(?::(?P<sign>[+-]?)(?P<axis>[xyz]))?")


@dataclass(frozen=True)
class ForceCurve:
    """Measured forces.

    Attributes
    ----------
    against : "frame", or the name of a parameter of the model.
    places : (k,) frame numbers, or values of the parameter, SI.
    forces : (k,) newtons.
    name : of the forces, for plots.
    """

    against: str
    places: Array
    forces: Array
    name: str = "force"


@dataclass(frozen=True)
class ReactionInDirection:
    """The force of a model on a support, in a direction of the object frame.

    Attributes
    ----------
    support : the set that it holds.
    field : the force, N.
    axis : 0, 1 or 2.
    sign : 1 or -1.
    """

    support: str
    field: SeparatedField
    axis: int
    sign: float

    def __call__(self, mu: Array) -> float:
        """Newtons at parameters (d,), SI."""
        return self.sign * float(self.field.value(mu)[0, self.axis])


def reaction_in_direction(model: ReducedModel, text: str) -> ReactionInDirection:
    """The reaction that "SET:x" or "SET:-x" names.

    Raises
    ------
    EvaluationError
        If the model has no force on this support, or the text no direction.
    """
    asked = _REACTION.fullmatch(text)
    if asked is None or not asked["axis"]:
        raise EvaluationError(f"'{text}' names no direction: write SET:x, SET:-x, SET:y and so on, in the object frame")
    fields = _force_fields(model)
    if asked["support"] not in fields:
        raise EvaluationError(f"the model has no force on '{asked['support']}'; it has those on {', '.join(fields)}")
    sign = -1.0 if asked["sign"] == "-" else 1.0
    return ReactionInDirection(asked["support"], fields[asked["support"]], "xyz".index(asked["axis"]), sign)


def load_curve(path: str | Path, model: ReducedModel, column: str | None = None) -> ForceCurve:
    """Read a curve: CSV whose first column is ``frame``, or a parameter with its unit, ``stroke_mm`` say.

    The other columns are forces with their unit, ``force_N`` say, in newtons where they name none.

    Parameters
    ----------
    path : the file. Lines without a force are left out.
    model : whose parameters the first column may name.
    column : which column of forces; needed where there are several.

    Raises
    ------
    EvaluationError
        If the file is missing, a column is not known, or a value is no number.
    """
    rows = list(csv.reader(read_text(Path(path), "force curve", EvaluationError).splitlines()))
    rows = [[cell.strip() for cell in row] for row in rows if any(cell.strip() for cell in row)]
    first, *columns = rows[0] if rows else [""]
    against, scale = _place(path, first, model)
    if column is None and len(columns) == 1:
        column = columns[0]
    if column not in columns:
        asked = "several columns of forces" if column is None and columns else f"no column '{column or 'force_N'}'"
        raise EvaluationError(f"{path} has {asked}; name one of its own: {path}:COLUMN with {', '.join(columns)}")
    at = 1 + columns.index(column)
    values = np.array([_numbers(path, row, at) for row in rows[1:]]).reshape(-1, 2)
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) < LEAST:
        raise EvaluationError(f"{path} has {len(values)} forces in column '{column}': give at least {LEAST}")
    unit = column.rpartition("_")[2]
    return ForceCurve(against, scale * values[:, 0], FACTORS["force"].get(unit, 1.0) * values[:, 1], column)


def _place(path: str | Path, header: str, model: ReducedModel) -> tuple[str, float]:
    """What the first column is, and the factor of its values to SI."""
    if header == "frame":
        return header, 1.0
    found = parameter_of_column(header, model)
    if found is None:
        raise EvaluationError(
            f"{path}: the first column is '{header}'; name it frame, or as a parameter of the model with its unit: "
            f"{parameter_columns(model)}"
        )
    return found


def parameter_of_column(header: str, model: ReducedModel) -> tuple[str, float] | None:
    """The parameter that a column such as ``stroke_mm`` holds, and the factor of its values to SI; None if none."""
    name, _, unit = header.rpartition("_")
    for parameter in model.parameters:
        if parameter.name == name and unit in FACTORS[parameter.quantity]:
            return name, FACTORS[parameter.quantity][unit]
    return None


def parameter_columns(model: ReducedModel) -> str:
    """How columns with the model's parameters are named, for messages."""
    return ", ".join(f"{parameter.name}_{parameter.unit}" for parameter in model.parameters)


def _numbers(path: str | Path, row: Sequence[str], at: int) -> tuple[float, float]:
    """A place and a force of one line, NaN where the line has none."""
    try:
        found = float(row[0]), float((row[at] if at < len(row) else "") or "nan")
    except ValueError:
        found = np.inf, np.inf
    if np.isinf(found).any():
        raise EvaluationError(f"{path}: '{','.join(row)}' is not a place on the curve and its forces, all numbers")
    return found


@dataclass(frozen=True)
class ForceError:
    """Measured forces and those of the model, in newtons.

    Attributes
    ----------
    support : whose reaction is compared.
    direction : "x", "-z" and so on, in the object frame.
    curve : the measurement.
    frames : (e,) the frames compared.
    places : (e,) where on the curve they are.
    measured : (e,) the measured force there.
    modelled : (e,) the reaction of the model in the estimated state.
    factor, offset : that make ``factor * modelled + offset`` fit the measurement best.
    factor_std : standard deviation of the factor, from what the fit leaves.
    left_out : tracked frames that the curve does not have, or not in its range.
    axis : factor from ``places`` to what a plot shows, and its label.
    """

    support: str
    direction: str
    curve: ForceCurve
    frames: NDArray[np.int64]
    places: Array
    measured: Array
    modelled: Array
    factor: float
    offset: float
    factor_std: float
    left_out: tuple[int, ...]
    axis: tuple[float, str] = (1.0, "frame")

    @property
    def residuals(self) -> Array:
        """Fitted minus measured force (e,)."""
        return self.factor * self.modelled + self.offset - self.measured


def force_error(run: Run, curve: ForceCurve, reaction: str | None = None) -> ForceError:
    """Compare the reaction of every tracked frame on the curve, and fit factor and offset.

    Parameters
    ----------
    reaction : "SET", "SET:x" or "SET:-x": the support and the direction. Without a support that of the largest force
        in the frames compared; without a direction that axis of the object along which its force is largest; without a
        sign the one in which it grows with the measured force.
    """
    rows = np.flatnonzero(run.tracked)
    places, measured = _on_curve(run, curve, rows)
    kept = np.isfinite(measured)
    if kept.sum() < LEAST:
        raise EvaluationError(
            f"only {int(kept.sum())} tracked frames lie on the curve, and at least {LEAST} are needed: it covers "
            f"{_range(run, curve.against, curve.places)}, the run {_range(run, curve.against, places)}"
        )
    rows, left_out = rows[kept], run.frames[rows[~kept]]
    support, direction, modelled = _modelled(run, rows, measured[kept], reaction)
    factor, offset, deviation = _fit(modelled, measured[kept])
    return ForceError(
        support=support,
        direction=direction,
        curve=curve,
        frames=run.frames[rows],
        places=places[kept],
        measured=measured[kept],
        modelled=modelled,
        factor=factor,
        offset=offset,
        factor_std=deviation,
        left_out=tuple(left_out.tolist()),
        axis=_axis(run.model, curve.against),
    )


def _axis(model: ReducedModel, against: str) -> tuple[float, str]:
    for parameter in model.parameters:
        if parameter.name == against:
            return parameter.display(1.0), f"{against} [{parameter.unit}]"
    return 1.0, "frame"


def _on_curve(run: Run, curve: ForceCurve, rows: NDArray[np.integer]) -> tuple[Array, Array]:
    """Where on the curve rows of the run are, and the forces there, NaN off the curve."""
    order = np.argsort(curve.places, kind="stable")
    known, forces = curve.places[order], curve.forces[order]
    if (np.diff(known) <= 0.0).any():
        twice = _range(run, curve.against, known[1:][np.diff(known) <= 0.0][:1])
        raise EvaluationError(
            f"the curve has {twice} more than once: give one branch of it, or the forces by frame (first column frame)"
        )
    if curve.against == "frame":
        places = run.frames[rows].astype(float)
        found = np.isin(places, known)
    else:
        index = [parameter.name for parameter in run.model.parameters].index(curve.against)
        places = run.parameters[rows, index]
        found = (places >= known[0]) & (places <= known[-1])
    return places, np.where(found, np.interp(places, known, forces), np.nan)


def _range(run: Run, against: str, places: Array) -> str:
    """Smallest and largest place in words, "stroke [mm] 0 to 7" say."""
    scale, label = _axis(run.model, against)
    ends = [] if not len(places) else sorted({scale * float(places.min()), scale * float(places.max())})
    return f"{label} {' to '.join(f'{end:.6g}' for end in ends) or 'nowhere'}"


def _modelled(run: Run, rows: NDArray[np.integer], measured: Array, reaction: str | None) -> tuple[str, str, Array]:
    """The support, the direction, and the model's force (e,) in it."""
    forces = _forces(run, rows)
    asked = _REACTION.fullmatch(reaction) if reaction is not None else None
    support = max(forces, key=lambda name: float(np.abs(forces[name]).max())) if asked is None else asked["support"]
    if support not in forces:
        raise EvaluationError(
            f"the model has no force on '{support}'; it has those on {', '.join(forces)}: give --reaction SET, or "
            "SET:x, SET:-x and so on"
        )
    force = forces[support]
    axis = asked["axis"] if asked is not None and asked["axis"] else "xyz"[int(np.abs(force).max(axis=0).argmax())]
    along = force[:, "xyz".index(axis)]
    sign = asked["sign"] if asked is not None and asked["axis"] else ""
    if not sign:
        sign = "-" if np.dot(along - along.mean(), measured - measured.mean()) < 0.0 else "+"
    return support, sign.replace("+", "") + axis, -along if sign == "-" else along


def _forces(run: Run, rows: NDArray[np.integer]) -> dict[str, Array]:
    """The model's force (e, 3) on each support in the estimated states."""
    fields = _force_fields(run.model)
    return {name: np.array([field.value(run.parameters[row])[0] for row in rows]) for name, field in fields.items()}


def _force_fields(model: ReducedModel) -> dict[str, SeparatedField]:
    """The force on each support; EvaluationError if the model has none."""
    fields = {name[len(FORCE) :]: f for name, f in model.reactions.items() if name.startswith(FORCE)}
    if not fields:
        raise EvaluationError(
            f"the model '{model.name}' holds no reaction of a support. Models do, unless they were turned about the "
            "axis of a body of revolution or come from solutions of another program"
        )
    return fields


def _fit(modelled: Array, measured: Array) -> tuple[float, float, float]:
    """Factor, offset and the factor's standard deviation of the line through ``measured`` (e,) by ``modelled`` (e,)."""
    centred = modelled - modelled.mean()
    spread = float(centred @ centred)
    if not spread > (1e-9 * float(np.abs(modelled).max())) ** 2 * len(modelled):
        raise EvaluationError(
            "the model's force is the same in all frames compared: no factor can be found. Compare frames in which "
            "the load grows, or name another support or direction (--reaction)"
        )
    factor = float(centred @ measured) / spread
    offset = float(measured.mean() - factor * modelled.mean())
    left = factor * modelled + offset - measured
    return factor, offset, float(np.sqrt(left @ left / max(len(left) - 2, 1) / spread))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def summarise_force(error: ForceError) -> dict[str, Any]:
    """The figures of ``force_evaluation.json``, newtons, plain JSON."""
    rms = _rms(error.residuals)
    return {
        "support": error.support,
        "direction": error.direction,
        "column": error.curve.name,
        "against": error.curve.against,
        "factor": error.factor,
        "factor_std": error.factor_std,
        "offset_N": error.offset,
        "rms_N": rms,
        "relative_rms": rms / max(float(np.ptp(error.measured)), 1e-300),
        "largest_N": float(np.abs(error.residuals).max()),
        "rms_without_fit_N": _rms(error.modelled - error.measured),
        "largest_measured_N": float(np.abs(error.measured).max()),
        "frames_compared": error.frames.tolist(),
        "tracked_frames_off_the_curve": list(error.left_out),
        "per_frame": {
            str(frame): {"measured_N": measured, "model_N": modelled, "fitted_minus_measured_N": residual}
            for frame, measured, modelled, residual in zip(
                error.frames.tolist(),
                error.measured.tolist(),
                error.modelled.tolist(),
                error.residuals.tolist(),
                strict=True,
            )
        },
    }


def force_remarks(figures: Mapping[str, Any]) -> list[str]:
    """What a reader of the figures must know: which reaction it is, and frames that were not compared."""
    lines = [f"the force on '{figures['support']}' in direction {figures['direction']} of the object frame"]
    if frames := figures["tracked_frames_off_the_curve"]:
        lines.append(f"{len(frames)} tracked frames are not on the curve and were not compared: {_some(frames)}")
    return lines


def _some(frames: Sequence[int]) -> str:
    return ", ".join(map(str, frames[:10])) + (" ..." if len(frames) > 10 else "")


def force_line(figures: Mapping[str, Any]) -> str:
    """The last line of an evaluation against a force curve, newtons."""
    return (
        f"factor={figures['factor']:.4f} offset={figures['offset_N']:.4f} rms={figures['rms_N']:.4f} "
        f"relative_rms={figures['relative_rms']:.4f} frames={len(figures['frames_compared'])}/{figures['n_frames']} "
        f"tracked={figures['n_frames_tracked']}/{figures['n_frames']}"
    )
