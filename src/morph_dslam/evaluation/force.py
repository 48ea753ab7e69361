"""Measured forces against a reaction of the model that was tracked.

Images determine shapes, not forces: a model whose stiffnesses are all wrong by one factor tracks as well as a right
one. A measured force gives that factor. It is fitted with an offset, the zero of the load cell, by least squares.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.run_folder import Run
from morph_dslam.io.text import read_csv
from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.model.reduced_model import FORCE
from morph_dslam.units import FACTORS

Array = NDArray[np.float64]
#: Fewer comparisons determine no factor and offset with anything left over.
LEAST = 3
#: Changes of a force below this share of it are rounding.
ROUNDING = 1e-9
#: A component below this share of a support's largest force is rounding, as where models are built; in so many states
#: beside the default.
NEGLIGIBLE, SAMPLES = 1e-6, 32
_GRAM, _POUND = 9.80665e-3, 4.4482216152605
#: Newtons in each unit of a column of forces. Units of mass stand for weights here, as on the display of a load cell.
FORCE_UNITS = {
    **FACTORS["force"],
    **{"uN": 1e-6, "MN": 1e6, "gf": _GRAM, "g": _GRAM, "kgf": 1e3 * _GRAM, "kg": 1e3 * _GRAM},
    **{"lbf": _POUND, "lb": _POUND, "ozf": _POUND / 16.0, "oz": _POUND / 16.0},
}
#: Ends of names, in any case, that mean other units or spell one otherwise. Specimens have letters, so that one letter
#: is no unit; nor are times and angles here, for force_min and force_rad are forces.
_OTHER_UNITS = {
    *(unit.lower() for unit in FORCE_UNITS if len(unit) > 1),
    *(unit.lower() for name in FACTORS if name not in ("time", "angle") for unit in FACTORS[name] if len(unit) > 1),
    *("dyn", "kp", "kip", "kips", "tf", "ton", "tons", "lbs", "grams", "pounds"),
    *("nm", "nmm", "psi", "mv", "uv", "volt", "volts"),
}
_BRACKETED = re.compile(r"(.*\S)\s*\[(.+)\]")
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
    literal : whether the sign was given; otherwise `following` finds that in which the force grows with a measured one.
    """

    support: str
    field: SeparatedField
    axis: int
    sign: float = 1.0
    literal: bool = True

    def __call__(self, mu: Array) -> float:
        """Newtons at parameters (d,), SI."""
        return self.sign * float(self.field.value(mu)[0, self.axis])

    @property
    def direction(self) -> str:
        """As in reports: "x", "-z" and so on."""
        return ("-" if self.sign < 0.0 else "") + "xyz"[self.axis]

    def following(self, along: Array, measured: Array) -> ReactionInDirection:
        """This reaction with its sign, if forces (e,) ``along`` its axis are compared with measured ones (e,)."""
        return self if self.literal else replace(self, sign=-1.0 if _growth(along, measured) < 0.0 else 1.0)

    def check_growth(self, modelled: Array, measured: Array) -> None:
        """Raise EvaluationError if values (e,) of this reaction fall where the measured ones (e,) grow."""
        if _growth(modelled, measured) < 0.0:
            other = f"{self.support}:{'-+'[self.sign < 0.0]}{'xyz'[self.axis]}"
            raise EvaluationError(
                f"the model's force on '{self.support}' in direction {self.direction} falls where the measured force "
                f"grows: write --reaction {other}"
            )


def _growth(modelled: Array, measured: Array) -> float:
    """Positive if a force (e,) grows with the measured one (e,), negative if it falls, 0 where that is rounding."""
    centred = measured - measured.mean()
    together = float((modelled - modelled.mean()) @ centred)
    size = float(np.linalg.norm(centred)) * float(np.abs(modelled).max()) * np.sqrt(len(modelled))
    return together if abs(together) > ROUNDING * size else 0.0


def reaction_in_direction(model: ReducedModel, text: str) -> ReactionInDirection:
    """The reaction that "SET:x", "SET:+x" or "SET:-x" names; without a sign, it follows the measured force.

    Raises
    ------
    EvaluationError
        If the model has no force on this support or none in this direction, or the text names no direction.
    """
    asked = _REACTION.fullmatch(text)
    if asked is None or not asked["axis"]:
        raise EvaluationError(f"'{text}' names no direction: write SET:x, SET:-x, SET:y and so on, in the object frame")
    return _reaction(model, asked["support"], asked["axis"], asked["sign"])


def _reaction(model: ReducedModel, support: str, axis: str, sign: str | None) -> ReactionInDirection:
    """The force on a support along "x", "y" or "z" with sign "+", "-", or that of the measured force."""
    field = _force_field(model, support)
    largest = np.abs(_values(field, model.spread_parameters(SAMPLES))).max(axis=0)
    at, most = "xyz".index(axis), int(largest.argmax())
    # Unknown loads act along any axis, and the samples have none.
    if not model.n_loads and largest[at] < NEGLIGIBLE * largest[most]:
        raise EvaluationError(
            f"the force on '{support}' along {axis} is zero in this model; it acts along {'xyz'[most]}: write "
            f"--reaction {support}:{'xyz'[most]}"
        )
    return ReactionInDirection(support, field, at, -1.0 if sign == "-" else 1.0, literal=bool(sign))


def load_curve(path: str | Path, model: ReducedModel, column: str | None = None) -> ForceCurve:
    """Read a curve: CSV whose first column is ``frame``, or a parameter with its unit, ``stroke_mm`` or
    ``stroke [mm]`` say.

    The other columns are forces with their unit, ``force_N`` say, in newtons where they name none.

    Parameters
    ----------
    path : the file. Lines without a force are left out.
    model : whose parameters the first column may name.
    column : which column of forces; needed where there are several.

    Raises
    ------
    EvaluationError
        If the file is missing, a column is not known, its unit is none of force, or a value is no number.
    """
    (_, titles), *rows = _table(path)
    against, scale = _place(path, titles[0], model)
    column = _column(path, titles, column)
    newtons, at = _newtons(path, column), titles.index(column, 1)
    for line, cells in rows:
        if len(cells) > len(titles):
            raise EvaluationError(
                f"{path}, line {line}: {len(cells)} cells under {len(titles)} titles; write decimals with points"
            )
    values = np.array([_numbers(f"{path}, line {line}", cells, at) for line, cells in rows]).reshape(-1, 2)
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) < LEAST:
        raise EvaluationError(f"{path} has {len(values)} forces in column '{column}': give at least {LEAST}")
    return ForceCurve(against, scale * values[:, 0], newtons * values[:, 1], column)


def _table(path: str | Path) -> list[tuple[int, list[str]]]:
    """Line numbers and cells of the lines that hold any, without empty cells at their ends; the titles are first."""
    rows = read_csv(Path(path), "force curve", EvaluationError)
    return [(line, cells[: max(i for i, cell in enumerate(cells) if cell) + 1]) for line, cells in rows] or [(1, [""])]


def _column(path: str | Path, titles: Sequence[str], asked: str | None) -> str:
    """The column of forces that is asked for, or the only one."""
    columns = [title for title in titles[1:] if title]
    if not columns:
        raise EvaluationError(
            f"{path} has no column of forces: give one beside '{titles[0]}', with its unit, as {titles[0]},force_N"
        )
    if asked is None and len(columns) == 1:
        return columns[0]
    if asked in columns:
        return asked
    wrong = "several columns of forces" if asked is None else f"no column '{asked}'"
    others = f"; the others are {', '.join(columns[1:])}" if len(columns) > 1 else ""
    raise EvaluationError(f"{path} has {wrong}; name one that it has, as {path}:{columns[0]}{others}")


def _newtons(path: str | Path, column: str) -> float:
    """Newtons in the unit that the name of a column ends in; 1 if it ends in none."""
    unit = name_and_unit(column)[1]
    if unit not in FORCE_UNITS and unit.lower() in _OTHER_UNITS:
        raise EvaluationError(
            f"{path}: column '{column}' ends in '{unit}', which is no unit of force that is known: give one of "
            f"{', '.join(FORCE_UNITS)}"
        )
    return FORCE_UNITS.get(unit, 1.0)


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


def name_and_unit(header: str) -> tuple[str, str]:
    """Both parts of a column's header, "stroke_mm" or "stroke [mm]"."""
    if bracketed := _BRACKETED.fullmatch(header):
        return bracketed[1], bracketed[2]
    name, _, unit = header.rpartition("_")
    return name, unit


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


def _numbers(where: str, row: Sequence[str], at: int) -> tuple[float, float]:
    """A place and a force of one line, NaN where the line has none."""
    try:
        found = float(row[0]), float((row[at] if at < len(row) else "") or "nan")
    except ValueError:
        found = np.inf, np.inf
    if np.isinf(found).any():
        raise EvaluationError(f"{where}: '{','.join(row)}' is not a place on the curve and its forces, all numbers")
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
    reaction : "SET", "SET:x", "SET:+x" or "SET:-x": the support and the direction. Without a support that of the
        largest force in the frames compared; without a direction that axis of the object along which its force is
        largest; without a sign the one in which it grows with the measured force.

    Raises
    ------
    EvaluationError
        If fewer than three tracked frames lie on the curve, or the model has no such force, one that does not change,
        or one that falls where the measured force grows.
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
    compared, modelled, size = _modelled(run, rows, measured[kept], reaction)
    factor, offset, deviation = _fit(modelled, measured[kept], size)
    return ForceError(
        support=compared.support,
        direction=compared.direction,
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
            f"the curve '{curve.name}' has {twice} more than once: give one branch of it, or the forces by frame "
            "(first column frame)"
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


def _modelled(
    run: Run, rows: NDArray[np.integer], measured: Array, text: str | None
) -> tuple[ReactionInDirection, Array, float]:
    """The reaction compared, its values (e,), and the largest force on its support in any direction."""
    asked = _REACTION.fullmatch(text or "")
    support, axis, sign = asked.group("support", "axis", "sign") if asked else (_most_loaded(run, rows), None, None)
    force = _values(_force_field(run.model, support), run.parameters[rows])
    largest = "xyz"[int(np.abs(force).max(axis=0).argmax())]
    reaction = _reaction(run.model, support, axis or largest, sign)
    reaction = reaction.following(force[:, reaction.axis], measured)
    modelled = reaction.sign * force[:, reaction.axis]
    reaction.check_growth(modelled, measured)
    return reaction, modelled, float(np.linalg.norm(force, axis=1).max())


def _most_loaded(run: Run, rows: NDArray[np.integer]) -> str:
    """The support with the largest force in rows of the run."""
    fields = _force_fields(run.model)
    return max(fields, key=lambda name: float(np.abs(_values(fields[name], run.parameters[rows])).max()))


def _values(field: SeparatedField, states: Array) -> Array:
    """A force (e, 3) at parameters (e, d)."""
    return np.array([field.value(mu)[0] for mu in states])


def _force_field(model: ReducedModel, support: str) -> SeparatedField:
    """The force on a support; EvaluationError if the model has none."""
    fields = _force_fields(model)
    if support not in fields:
        raise EvaluationError(f"the model has no force on '{support}'; it has those on {', '.join(fields)}")
    return fields[support]


def _force_fields(model: ReducedModel) -> dict[str, SeparatedField]:
    """The force on each support; EvaluationError if the model has no reactions."""
    fields = {name[len(FORCE) :]: f for name, f in model.reactions.items() if name.startswith(FORCE)}
    if not fields:
        raise EvaluationError(
            f"the model '{model.name}' holds no reaction of a support. Models do, unless they were turned about the "
            "axis of a body of revolution or come from solutions of another program"
        )
    return fields


def _fit(modelled: Array, measured: Array, size: float) -> tuple[float, float, float]:
    """Factor, offset and the factor's standard deviation of the line through ``measured`` (e,) by ``modelled`` (e,).

    ``size`` is the support's largest force: what changes by less than its rounding does not change.
    """
    centred = modelled - modelled.mean()
    spread = float(centred @ centred)
    if not spread > (ROUNDING * size) ** 2 * len(modelled):
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
    lines = [reaction_remark(figures)]
    if frames := figures["tracked_frames_off_the_curve"]:
        lines.append(f"{len(frames)} tracked frames are not on the curve and were not compared: {_some(frames)}")
    return lines


def reaction_remark(figures: Mapping[str, Any]) -> str:
    """Which reaction of the model measured forces are compared with."""
    return f"the force on '{figures['support']}' in direction {figures['direction']} of the object frame"


def _some(frames: Sequence[int]) -> str:
    return ", ".join(map(str, frames[:10])) + (" ..." if len(frames) > 10 else "")


def force_line(figures: Mapping[str, Any]) -> str:
    """The last line of an evaluation against a force curve, newtons."""
    return (
        f"factor={figures['factor']:.4f} offset={figures['offset_N']:.4f} rms={figures['rms_N']:.4f} "
        f"relative_rms={figures['relative_rms']:.4f} frames={len(figures['frames_compared'])}/{figures['n_frames']} "
        f"tracked={figures['n_frames_tracked']}/{figures['n_frames']}"
    )
