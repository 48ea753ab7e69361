"""Parameters that something else measures while the camera records, such as a pressure: values and deviations by frame.

They are one more term of the cost in their frames, as a prior on the parameters is. What a sensor knows needs not to be
found from images, which may then tell of other things: a force at the tip of a finger from the pressure in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import ArgumentError, TrackingError, check_kind
from morph_dslam.io.text import has_a_cell_for_each, name_and_unit, read_csv
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.model.parameters import columns_of_run, parameter_columns, parameter_of_column
from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.levenberg_marquardt import Box
from morph_dslam.tracking.outcomes import TimeOutside
from morph_dslam.tracking.state import moved

Array = NDArray[np.float64]
FRAME, STD = "frame", "_std"
#: An estimate is within so many standard deviations of what is known.
FARTHEST = 3.0
#: Without a deviation, a value is known to this part of its range.
USUAL_STD = 0.005
#: A time is known to half of the interval since the frame before, and to this part of its range at most.
USUAL_TIME_STD = 1e-3
#: The least spread of residuals, pixels, that is believed when they are weighed against what is known, or depths.
LEAST_SIGMA_PX = 0.1
#: Values may lie outside of the range by this part of it: a sensor has noise, also where nothing acts.
OUTSIDE = 0.02


@dataclass(frozen=True)
class KnownValues:
    """Values of some parameters in some frames.

    Attributes
    ----------
    indices : (k,) of the parameters.
    by_frame : value and standard deviation (k, 2) of each, SI, by the frame's number; NaN where it is not known.
    """

    indices: NDArray[np.int64]
    by_frame: Mapping[int, Array]

    @classmethod
    def read(cls, path: Path, model: ReducedModel) -> KnownValues:
        """A CSV file with the columns ``frame`` and, by parameter, ``pressure_kPa`` and perhaps ``pressure_std_kPa``.

        Of the ``frames.csv`` of a run, the columns of parameters of the model are taken.

        Raises
        ------
        TrackingError
            If it cannot be read, has other columns, or values that are no numbers, or not in the parameter's range.
        """
        (_, header), *lines = read_csv(path, "table of known parameters", TrackingError) or [(1, [])]
        columns = _Columns.of(path, header, model)
        by_frame: dict[int, Array] = {}
        for line, cells in lines:
            if not has_a_cell_for_each(header, cells):
                raise TrackingError(
                    f"{path}, line {line}: {len(cells)} cells under {len(header)} titles; keep the commas of empty "
                    "cells, and write decimals with points"
                )
            frame, values = columns.row(f"{path}, line {line}", cells)
            if frame in by_frame:
                raise TrackingError(f"{path}, line {line}: frame {frame} is there already; give each frame once")
            by_frame[frame] = values
        if not any(np.isfinite(values[:, 0]).any() for values in by_frame.values()):
            raise TrackingError(f"{path} has no value of a parameter")
        return cls(columns.indices, by_frame)

    def remarks(self, frames: Sequence[int]) -> list[str]:
        """What a reader must know where these values are of none of the frames that were tracked."""
        if not self.by_frame.keys().isdisjoint(frames):
            return []
        given, tracked = (f"{min(numbers)} to {max(numbers)}" for numbers in (self.by_frame, frames))
        return [f"--known told nothing: its values are of frames {given}, and frames {tracked} were tracked"]


@dataclass(frozen=True)
class _Columns:
    """Where a table has what: of each of k parameters the columns of value and deviation, with their factors to SI.

    A deviation that there is not is None. `is_of_run` says whether it is the table of a run.
    """

    frame: int
    indices: NDArray[np.int64]
    pairs: Sequence[Sequence[tuple[int, float] | None]]
    model: ReducedModel
    is_of_run: bool

    @classmethod
    def of(cls, path: Path, header: Sequence[str], model: ReducedModel) -> _Columns:
        found: dict[str, dict[bool, tuple[int, float]]] = {}
        for number, is_deviation, parameter in _parameters_in(header, model):
            if parameter is None:
                raise TrackingError(
                    f"{path}: '{header[number]}' is no column with a parameter of the model; write {FRAME}, "
                    f"{parameter_columns(model)}, and deviations with _std before the unit"
                )
            if is_deviation in found.setdefault(parameter[0], {}):
                raise TrackingError(f"{path}: two columns hold the parameter {parameter[0]}; leave one out")
            found[parameter[0]][is_deviation] = (number, parameter[1])
        named = [name for name, parts in found.items() if False in parts]
        if FRAME not in header or not named:
            raise TrackingError(f"{path} needs the columns {FRAME} and one or more of {parameter_columns(model)}")
        if alone := sorted(set(found) - set(named)):
            raise TrackingError(f"{path} has a deviation of {alone[0]}, but no value: add its column")
        names = [parameter.name for parameter in model.parameters]
        return cls(
            list(header).index(FRAME),
            np.array([names.index(name) for name in named], dtype=np.int64),
            [(found[name][False], found[name].get(True)) for name in named],
            model,
            columns_of_run(header) is not None,
        )

    def row(self, where: str, cells: Sequence[str]) -> tuple[int, Array]:
        """Frame, and values and deviations (k, 2), SI, of a line."""
        frame = _number(where, cells, self.frame)
        if not frame.is_integer():
            raise TrackingError(f"{where}: '{cells[self.frame]}' is no number of a frame")
        values = np.array([[_number(where, cells, *one) if one else np.nan for one in pair] for pair in self.pairs])
        if self.is_of_run:  # where a run does not know how exact a value is, it does not know the value
            values[~(np.isfinite(values[:, 1]) & (values[:, 1] > 0.0))] = np.nan
        for k, (value, deviation) in zip(self.indices.tolist(), values, strict=True):
            check_known(where, self.model, k, value, deviation)
        return int(frame), with_usual_deviations(self.model, self.indices, values)


def _parameters_in(header: Sequence[str], model: ReducedModel) -> Iterator[tuple[int, bool, tuple[str, float] | None]]:
    """Columns of a table, whether each holds a deviation, and the parameter, as of `parameter_of_column`.

    Of a run's table these are the columns of parameters that the model has.
    """
    of_run = columns_of_run(header)
    deviations = set() if of_run is None else set(of_run.values())
    for number, title in enumerate(header):
        if title == FRAME:
            continue
        parameter = None if number in deviations else parameter_of_column(title, model)
        is_deviation = parameter is None
        if is_deviation:
            parameter = _parameter_of_deviation(title, model)
        if of_run is None or (parameter is not None and number in {*of_run, *deviations}):
            yield number, is_deviation, parameter


def _parameter_of_deviation(header: str, model: ReducedModel) -> tuple[str, float] | None:
    """The parameter whose deviation a column such as ``stroke_std_mm`` holds, as of `parameter_of_column`."""
    name, unit = name_and_unit(header)
    return parameter_of_column(f"{name.removesuffix(STD)} [{unit}]", model) if name.endswith(STD) else None


def _number(where: str, cells: Sequence[str], column: int, factor: float = 1.0) -> float:
    """A cell's number times a factor; NaN where it is empty."""
    try:
        return factor * float(cells[column] or "nan")
    except ValueError:
        raise TrackingError(f"{where}: '{cells[column]}' is no number") from None


def check_known(where: str, model: ReducedModel, index: int, value: float, deviation: float) -> None:
    """Raise TrackingError unless a value, SI, is in its range and its deviation above zero; either may be NaN."""
    parameter = model.parameters[index]
    margin = OUTSIDE * (parameter.upper - parameter.lower)
    if np.isinf(value) or value < parameter.lower - margin or value > parameter.upper + margin:
        low, high = (f"{parameter.display(end):g}" for end in (parameter.lower, parameter.upper))
        raise TrackingError(
            f"{where}: {parameter.name} is {parameter.display(value):g} {parameter.unit}, outside of the model's range "
            f"from {low} to {high} {parameter.unit}: check its unit, or build the model with a wider range"
        )
    if np.isinf(deviation) or deviation <= 0.0:
        raise TrackingError(f"{where}: the deviation of {parameter.name} is not above zero: leave it out if unknown")


def with_usual_deviations(model: ReducedModel, indices: NDArray[np.int64], values: Array) -> Array:
    """Values and deviations (k, 2) of parameters with the usual deviation where there is none."""
    found = values.copy()
    usual = USUAL_STD * (model.upper - model.lower)[indices]
    found[:, 1] = np.where(np.isnan(values[:, 1]), usual, values[:, 1])
    return found


@dataclass
class KnownTime:
    """The one parameter of a model that measures time.

    Attributes
    ----------
    index : of the parameter.
    parameter : itself.
    zero : time of the recording at which it is zero, seconds.
    before : time of the frame before, seconds; None in the first.
    """

    index: int
    parameter: Parameter
    zero: float
    before: float | None = None

    @classmethod
    def of(cls, model: ReducedModel, zero: float) -> KnownTime:
        """That of a model.

        Raises
        ------
        TrackingError
            If none of its parameters measures time, or several and its study does not say which one is the time.
        """
        clocks = [(k, model.parameters[k]) for k in model.clocks]
        if len(clocks) != 1:
            named = ", ".join(p.name for _, p in clocks)
            raise TrackingError(
                f"--time-zero (time_zero): the model '{model.name}' has "
                + (
                    f"several parameters that measure time ({named}): give theirs by --known"
                    if clocks
                    else "no parameter that measures time: leave it out"
                )
            )
        return cls(*clocks[0], zero)

    def at(self, timestamp: float) -> tuple[float, float] | TimeOutside:
        """Time and its standard deviation in a frame of this time, seconds; or that it is outside of its range."""
        parameter, time = self.parameter, timestamp - self.zero
        most = USUAL_TIME_STD * (parameter.upper - parameter.lower)
        interval = 2.0 * most if self.before is None else timestamp - self.before
        self.before = timestamp
        if not parameter.lower <= time <= parameter.upper:
            is_before = time < parameter.lower
            return TimeOutside(parameter.name, parameter.text(time), parameter.range_text, is_before)
        return time, min(0.5 * interval, most) if interval > 0.0 else most


class KnownParameters:
    """The term of the cost from what is known of parameters in the present frame.

    Attributes
    ----------
    values : of a recording; None where there are none.
    clock : the parameter that is known by the frames' times; None where none is.
    warnings : of the present frame.
    model : whose parameters they are.
    indices : of the parameters (k,) that are known in the present frame.
    ever : (d,) which parameters were known in any frame so far.
    now : their values and standard deviations (k, 2), SI.
    squared_px : variance of an image coordinate, which turns likelihoods into costs in squared pixels.
    """

    def __init__(self, model: ReducedModel) -> None:
        self.model, self.squared_px = model, 0.25
        self.values: KnownValues | None = None
        self.clock: KnownTime | None = None
        self.warnings: tuple[TimeOutside, ...] = ()
        self.indices, self.now = np.empty(0, dtype=np.int64), np.empty((0, 2))
        self.ever = np.zeros(len(model.parameters), dtype=bool)

    def begin(self, frame: int | None, timestamp: float | None = None) -> None:
        """A frame of this number and time, seconds, begins: what the recording's table, or the time, says counts."""
        self.warnings = ()
        if self.values is None and self.clock is None:
            return
        now, indices = np.empty((0, 2)), np.empty(0, dtype=np.int64)
        if self.values is not None:
            now = self.values.by_frame.get(-1 if frame is None else frame, now)
            indices = self.values.indices[: len(now)]
        if self.clock is not None and timestamp is not None:
            time = self.clock.at(timestamp)
            if isinstance(time, TimeOutside):
                self.warnings = (time,)
            else:
                now, indices = np.vstack([now, time]), np.append(indices, self.clock.index)
        self._set(indices, now)

    def tell(self, known: Mapping[str, float | tuple[float, float]]) -> None:
        """Values, SI, by parameter, each perhaps with its standard deviation, from now on; none with an empty mapping.

        Raises
        ------
        TrackingError
            If the model has no such parameter, or the value is not in its range.
        ArgumentError
            If a value is no finite number in SI, or that with its deviation.
        """
        check_kind(known, Mapping, "what is known", "values by the parameter's name, {'pressure': 2e3}")
        names = [parameter.name for parameter in self.model.study_parameters]
        if wrong := [name for name in known if name not in names]:
            raise TrackingError(f"'{wrong[0]}' is not a parameter of the model: these are {', '.join(names) or 'none'}")
        values = np.array([_told(name, value) for name, value in known.items()], dtype=np.float64).reshape(-1, 2)
        indices = np.array([names.index(name) for name in known], dtype=np.int64)
        for k, (value, deviation) in zip(indices.tolist(), values, strict=True):
            check_known("known parameters", self.model, k, value, deviation)
        self._set(indices, with_usual_deviations(self.model, indices, values))

    def take(self, other: KnownParameters) -> None:
        """Know in the present frame what another one does, as a camera of a rig does what the rig knows."""
        self.indices, self.now, self.ever = other.indices, other.now, self.ever | other.ever

    def _set(self, indices: NDArray[np.int64], values: Array) -> None:
        there = np.isfinite(values[:, 0])
        self.indices, self.now = indices[: len(values)][there], values[there]
        self.ever[self.indices] = True

    def learn(self, sigma_px: float) -> None:
        """Take in how far an image coordinate is off in this frame, pixels; where no point is seen, nothing is learned.

        The scale of frames before goes on then: an infinite one would make what is known infinitely certain.
        """
        if np.isfinite(sigma_px):
            self.squared_px = max(sigma_px, LEAST_SIGMA_PX) ** 2

    @contextmanager
    def set_aside(self) -> Iterator[None]:
        """Meanwhile nothing is known: what do the images say alone?"""
        indices, now = self.indices, self.now
        self.indices, self.now = np.empty(0, dtype=np.int64), np.empty((0, 2))
        try:
            yield
        finally:
            self.indices, self.now = indices, now

    def bounded(self, box: Box) -> Box:
        """The box with known parameters near their values: what a model cannot explain does not outweigh a sensor."""
        if not len(self.indices):
            return box
        lower, upper, (value, deviation) = box.lower.copy(), box.upper.copy(), self.now.T
        rows, most = self.indices, FARTHEST * deviation
        lower[rows] = np.clip(value - most, box.lower[rows], box.upper[rows])
        upper[rows] = np.clip(value + most, box.lower[rows], box.upper[rows])
        return replace(box, lower=lower, upper=upper)

    def terms(self, parameters: Array) -> tuple[float, Array, Array]:
        """Cost, and its Hessian's diagonal (k,) and gradient (k,) at parameters (n,); in squared pixels."""
        information = self.squared_px / self.now[:, 1] ** 2
        away = parameters[self.indices] - self.now[:, 0]
        return 0.5 * float(information @ away**2), information, information * away


def registered_with(registration: Registration, known: KnownParameters) -> Registration:
    """The registration with what is known of parameters in its frame, to first order.

    What it is off by stays in all frames, by the places of the points on the mesh: where a sensor tells the shape
    better, later estimates of the same parameters would be worse than the sensor's.

    Parameters
    ----------
    registration : itself is returned where its covariance is not known.
    known : in the reference frame.
    """
    covariance, rows = registration.covariance, known.indices
    if covariance is None or not len(rows) or not np.isfinite(covariance).all():
        return registration
    told, deviations = known.now.T
    state, model = registration.state, registration.model
    gain = np.linalg.solve(covariance[np.ix_(rows, rows)] + np.diag(deviations**2), covariance[rows]).T
    step = gain @ (told - state.parameters[rows])
    found = moved(state, step)
    found = replace(found, parameters=np.clip(found.parameters, model.lower, model.upper))
    left = covariance - gain @ covariance[rows]
    return replace(registration, state=found, covariance=0.5 * (left + left.T))


def _told(name: str, value: object) -> tuple[float, float]:
    """A value and its standard deviation, NaN where none is given; raises ArgumentError unless they are finite."""
    numbers = [
        float(one) if isinstance(one, Real) else np.nan for one in (value if isinstance(value, tuple) else (value,))
    ]
    if len(numbers) not in (1, 2) or not np.isfinite(numbers).all():
        raise ArgumentError(
            f"the known '{name}' is {value!r}: give a finite number in SI, or a tuple of it and its standard "
            "deviation; what is not known now is left out"
        )
    return numbers[0], numbers[1] if len(numbers) == 2 else np.nan
