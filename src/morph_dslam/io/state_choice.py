"""Which states of a model an export has: those of a run or a table, on a grid, or a tour of all parameters.

Users give values in each parameter's own unit (that of `morph info`); arrays here are SI, (s, d) for s states of d
parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morph_dslam.errors import ExportError, StudyError
from morph_dslam.io.run_states import RESULT, RunStates, load_run_states
from morph_dslam.io.text import name_and_unit, read_csv
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.model.inner_structure import CarriedStructure
from morph_dslam.model.parameters import columns_of_run
from morph_dslam.model.unknown_loads import with_unknown_loads
from morph_dslam.notices import Notice
from morph_dslam.units import FACTORS, read_quantity, to_si

if TYPE_CHECKING:
    from morph_dslam.model.discrepancy import Discrepancy

Array = NDArray[np.float64]
#: States that one export may have: beyond, a grid was meant to be coarser.
MOST_STATES = 10_000
#: States of a tour from the default to one end of a range; twice as many cross it.
_QUARTER = 6
#: Columns of a table that hold the seconds of its states, the first of them that there is; frames.csv has the second.
TIMES = (("time", "s"), ("timestamp", "s"))


def _index(model: ReducedModel, name: str) -> int:
    names = [p.name for p in model.parameters]
    if name not in names:
        raise ExportError(f"the model has no parameter '{name}'; it has {', '.join(names) or 'none'}")
    return names.index(name)


def _in_range(parameter: Parameter, si: float, where: str) -> float:
    """A value in SI, checked to lie in the parameter's range."""
    if not parameter.in_range(si):
        shown = f"{parameter.display(si):g} is outside the range of {parameter.name}"
        raise ExportError(f"{where}: {shown}, {parameter.range_text}")
    return min(max(si, parameter.lower), parameter.upper)


def fixed_values(model: ReducedModel, settings: Sequence[str]) -> Array:
    """The parameters (d,) with some of them set by texts "name=value"; the others keep their defaults."""
    mu, given = model.default, dict[str, str]()
    for text in settings:
        name, equals, value = text.partition("=")
        if not equals:
            raise ExportError(f"--at {text} is not a parameter and its value{_example(model, '{0}={1}')}")
        k = _index(model, name)
        if name in given:
            raise ExportError(f"--at {given[name]} and --at {text} both set '{name}': give one of them")
        given[name] = text
        mu[k] = _number(model.parameters[k], value, f"--at {text}")
    return mu


def grid(model: ReducedModel, ranges: Sequence[str], base: Array) -> Array:
    """All combinations (s, d) of ranges "name=from:to:count", the last one varying fastest.

    Parameters
    ----------
    base : (d,) values of the parameters without a range, SI.
    """
    axes: dict[int, Array] = {}
    for text in ranges:
        name, _, limits = text.partition("=")
        parts = limits.split(":")
        if len(parts) != 3 or not name or not parts[2].isdecimal() or int(parts[2]) < 1:
            raise ExportError(f"--vary {text} is not a parameter and its values{_example(model, '{0}={1}:{2}:21')}")
        k, n = _index(model, name), int(parts[2])
        if k in axes:
            raise ExportError(f"--vary {text}: parameter '{name}' has a range already")
        low, high = (_number(model.parameters[k], end, f"--vary {text}") for end in parts[:2])
        if n > MOST_STATES:
            raise ExportError(f"--vary {text} asks for {n} states, and {MOST_STATES} is the most")
        axes[k] = np.linspace(low, high, n)
    count = math.prod(len(axis) for axis in axes.values())
    if count > MOST_STATES:
        raise ExportError(f"these ranges make {count} states, and {MOST_STATES} is the most; ask for fewer")
    states = np.tile(base, (count, 1))
    for k, values in zip(axes, np.meshgrid(*axes.values(), indexing="ij"), strict=True):
        states[:, k] = values.ravel()
    return states


def tour(model: ReducedModel, base: Array) -> Array:
    """Each parameter in turn from ``base`` (d,) to the top of its range, to the bottom, and back (s, d)."""
    states = [base]
    for k, parameter in enumerate(model.parameters):
        stops = [(base[k], parameter.upper), (parameter.upper, parameter.lower), (parameter.lower, base[k])]
        for (start, end), count in zip(stops, (_QUARTER, 2 * _QUARTER, _QUARTER), strict=True):
            leg = np.tile(base, (count, 1))
            leg[:, k] = np.linspace(start, end, count + 1)[1:]
            states.extend(leg)
    return np.array(states)


@dataclass(frozen=True)
class TakenFromResult(Notice):
    """What the shapes have beside the parameters of a run's table was taken from the run's result.

    Attributes
    ----------
    what : "unknown loads", "discrepancy", or both.
    path : of the ``result.h5``.
    """

    template: ClassVar[str] = "{what} of the table's frames, which the table does not hold: taken from {path}"
    what: str
    path: str


@dataclass(frozen=True)
class StressWithoutDiscrepancy(Notice):
    """Displacements have the discrepancy; stress and strain, which have none, are the model's."""

    template: ClassVar[str] = (
        "displacements have the run's discrepancy; stress and strain are the model's without it, for the shape with it "
        "is not in equilibrium under the study's loads"
    )


@dataclass(frozen=True)
class States:
    """States of a model.

    Attributes
    ----------
    model : with the coefficients of its unknown loads among the parameters where the states have them.
    parameters : (s, d) SI.
    origins : of each the cells of ``states.csv`` that say where it comes from, by the column's title.
    times : (s,) seconds; the numbers of the states where they have no times.
    discrepancies : of each state what its displacement has beyond the model's; empty where none has any.
    poses : camera_from_object (s, 4, 4) where the states are wanted in the camera frame.
    inner : structures inside that are wanted too.
    notices : what a reader of the states must know.
    """

    model: ReducedModel
    parameters: Array
    origins: Sequence[dict[str, str]]
    times: Array
    discrepancies: Sequence[Discrepancy | None] = ()
    poses: Array | None = None
    inner: tuple[CarriedStructure, ...] = ()
    notices: tuple[Notice, ...] = ()

    @classmethod
    def of(cls, model: ReducedModel, parameters: Array) -> States:
        """States that come from no table."""
        return cls(model, parameters, [{}] * len(parameters), np.arange(len(parameters), dtype=np.float64))

    def __len__(self) -> int:
        return len(self.parameters)

    def beyond_model(self, state: int, positions: Array) -> Array | float:
        """What the discrepancy adds to the displacement (n, 3) at positions (n, 3) of the undeformed object, metres."""
        found = self.discrepancies[state] if self.discrepancies else None
        return 0.0 if found is None else found.displacement(positions)

    def inner_displacement(self, structure: CarriedStructure, state: int) -> Array:
        """Displacement (p, 3) of the nodes of a structure inside, object frame, metres."""
        moved = structure.field.value(self.parameters[state])
        return moved + self.beyond_model(state, structure.rest)

    def with_run(self, run: RunStates, in_camera: bool) -> States:
        """With the discrepancies of the same states of a run, and their poses where these are wanted."""
        found = replace(self, poses=run.poses) if in_camera else self
        if not run.has_discrepancy:
            return found
        notices = (*self.notices, StressWithoutDiscrepancy()) if self.model.stresses else self.notices
        return replace(found, discrepancies=run.discrepancies, notices=notices)


def read_run(model: ReducedModel, result: Path, in_camera: bool) -> States:
    """The states of all frames that a run tracked, from its ``result.h5``, whole.

    Raises
    ------
    ExportError
        If the file cannot be read, the run is of another model, or tracked too many frames.
    """
    run = load_run_states(result)
    loaded = run.model_with_loads(model.without_loads)
    if len(run.frames) > MOST_STATES:
        raise ExportError(f"{result} holds {len(run.frames)} states, and 1 to {MOST_STATES} can be exported")
    origins = [{"from_frame": str(frame)} for frame in run.frames]
    return States(loaded, run.parameters, origins, run.times).with_run(run, in_camera)


def read_path(
    model: ReducedModel, path: Path, base: Array, in_camera: bool = False, fixed: Sequence[str] = ()
) -> States:
    """The states in the rows of a CSV table.

    A column is headed "name [unit]", as in the table of an export, or "name_unit", as in the ``frames.csv``
    of a run; the unit is any of the parameter's quantity. Other columns are passed over, and so are rows without
    values: frames that were not tracked. Parameters without a column keep their value in ``base``. What the run of a
    table of frames found beside the parameters is taken from the ``result.h5`` beside it.

    Raises
    ------
    ExportError
        If the table cannot be read, a parameter's column has no unit, another quantity's, or a twin, no column is a
        parameter's, or a value is no number in the range; or if a result beside it has more than parameters, and not
        of the frames of the table.
    """
    if not model.parameters:
        raise ExportError(f"'{model.name}' has no parameters, and so one state only: leave --path out")
    (_, header), *rows = read_csv(path, "path", ExportError) or [(1, [])]
    model, columns = _columns(model, header, path)
    for k, (column, _) in columns.items():
        if model.parameters[k].name in fixed:
            name = model.parameters[k].name
            raise ExportError(f"--at {name} changes nothing: {path} has the column '{header[column]}'; leave one out")
    base = np.concatenate([base, np.zeros(model.n_loads)])
    states, taken = [], []
    for line, row in rows:
        if any(row[len(header) :]):
            raise ExportError(
                f"{path}, line {line}: more cells than the {len(header)} titles; write decimals with points"
            )
        texts = {k: _cell(row, column) for k, (column, _) in columns.items()}
        if not all(texts.values()):
            continue
        mu = base.copy()
        for k, text in texts.items():
            mu[k] = _number(model.parameters[k], text, f"{path}, line {line}", columns[k][1])
        states.append(mu)
        taken.append((line, row))
    if not 0 < len(states) <= MOST_STATES:
        raise ExportError(f"{path} holds {len(states)} states, and 1 to {MOST_STATES} can be exported")
    found = States.of(model, np.array(states))
    times = _times(header, [row for _, row in taken])
    found = replace(found, origins=_origins(header, taken), times=found.times if times is None else times)
    return _with_result_beside(found, path, in_camera)


def _columns(model: ReducedModel, header: Sequence[str], path: Path) -> tuple[ReducedModel, dict[int, tuple[int, str]]]:
    """The column of each parameter, and its unit; with the model that has loads, if there are columns of these."""

    def of(parameters: Sequence[Parameter]) -> dict[int, tuple[int, str]]:
        found = {k: _column_of(p, header, path) for k, p in enumerate(parameters)}
        return {k: column for k, column in found.items() if column is not None}

    columns, d = of(model.parameters), len(model.parameters)
    if not columns:
        wanted = ", ".join(f"'{p.name} [{p.unit}]'" for p in model.parameters)
        raise ExportError(f"{path} has no column of a parameter; name the columns {wanted}")
    if model.unknown_loads is None or model.n_loads:
        return model, columns
    loaded = with_unknown_loads(model)
    # The range of a coefficient is no limit: it goes by a work that differs from run to run.
    loads = [replace(p, lower=-math.inf, upper=math.inf) for p in loaded.parameters[d:]]
    of_loads = {d + k: column for k, column in of(loads).items()}
    loaded = replace(loaded, parameters=(*model.parameters, *loads))
    return (loaded, columns | of_loads) if of_loads else (model, columns)


def _with_result_beside(states: States, path: Path, in_camera: bool) -> States:
    """With what the result beside a table of frames has of these, if it has more than parameters."""
    result = path.with_name(RESULT)
    if "from_frame" not in states.origins[0] or not result.is_file():
        return states
    run, model = load_run_states(result), states.model
    adds_loads = run.has_loads(model) and not model.n_loads
    if not (adds_loads or run.has_discrepancy or in_camera):
        return states
    loaded, d = run.model_with_loads(model.without_loads), len(model.study_parameters)
    run = run.take([_frame(origin["from_frame"], path) for origin in states.origins])
    if adds_loads:
        states = replace(states, model=loaded, parameters=np.hstack([states.parameters, run.parameters[:, d:]]))
    what = ["unknown loads"] * adds_loads + ["discrepancy"] * run.has_discrepancy
    if what:
        states = replace(states, notices=(TakenFromResult(" and ".join(what), str(result)),))
    return states.with_run(run, in_camera)


def _frame(text: str, path: Path) -> int:
    if not text.isdecimal():
        raise ExportError(f"{path}: the frame '{text}' is no number, by which {path.with_name(RESULT)} has its state")
    return int(text)


def _cell(row: Sequence[str], column: int) -> str:
    return row[column] if column < len(row) else ""


def _origins(header: Sequence[str], rows: Sequence[tuple[int, list[str]]]) -> list[dict[str, str]]:
    """What ``states.csv`` says of the table's rows: the frame where the table has it, else the line."""
    if "frame" not in header:
        return [{"from_line": str(line)} for line, _ in rows]
    column = header.index("frame")
    return [{"from_frame": _cell(row, column)} for _, row in rows]


def _times(header: Sequence[str], rows: Sequence[list[str]]) -> Array | None:
    """Seconds (s,) of the table's rows; None if it has none, or they do not grow, as in a grid."""
    named = [name_and_unit(title) for title in header]
    # In a run's table "time" is a parameter, an estimate.
    titles = TIMES[1:] if "pose_from" in header else TIMES
    column = next((named.index(title) for title in titles if title in named), None)
    if column is None:
        return None
    try:
        times = np.array([float(_cell(row, column)) for row in rows])
    except ValueError:
        return None
    return times if np.isfinite(times).all() and (np.diff(times) > 0).all() else None


def _without_twins(header: Sequence[str]) -> list[str]:
    """The titles, of a run's table without deviations, and what stands for a pose beside a parameter "x [mm]"."""
    of_run = columns_of_run(header)
    if of_run is None:
        return list(header)
    titles = ["" if column in of_run.values() else title for column, title in enumerate(header)]
    named = {name_and_unit(title) for title in titles if title.endswith("]")}
    return ["" if not title.endswith("]") and name_and_unit(title) in named else title for title in titles]


def _column_of(parameter: Parameter, header: Sequence[str], path: Path) -> tuple[int, str] | None:
    """The column that holds a parameter, and its unit; None if there is none.

    A title in the parameter's own unit goes before "name" alone and "name_unit" in another one: a parameter may be
    called as one of the columns of ``frames.csv`` ("time" as ``time_ms``).
    """
    header = _without_twins(header)
    units, all_units = FACTORS[parameter.quantity], {unit for known in FACTORS.values() for unit in known}
    found, wrong = dict[int, str](), []
    for column, title in enumerate(header):
        name, unit = name_and_unit(title)
        if name == parameter.name and unit in units:
            found[column] = unit
        elif title == parameter.name or (name == parameter.name and (title.endswith("]") or unit in all_units)):
            wrong.append(title)
    if parameter.unit in found.values():
        found = {k: unit for k, unit in found.items() if unit == parameter.unit or header[k].endswith("]")}
        wrong = [title for title in wrong if title.endswith("]")]
    if wrong:
        raise ExportError(
            f"{path}: the column '{wrong[0]}' has no unit of '{parameter.name}': name it "
            f"'{parameter.name} [{parameter.unit}]', or with another unit of {parameter.quantity} ({', '.join(units)})"
        )
    if len(found) > 1:
        titles = " and ".join(f"'{header[column]}'" for column in found)
        raise ExportError(f"{path}: the columns {titles} both hold '{parameter.name}': leave one of them in")
    return next(iter(found.items()), None)


def _number(parameter: Parameter, text: str, where: str, unit: str = "") -> float:
    """A value in the parameter's unit or ``unit``, or with another unit behind it, as SI."""
    unit = unit or parameter.unit
    try:
        value = to_si(float(text), unit, parameter.quantity)
    except ValueError:
        try:
            value = read_quantity(text, parameter.quantity)
        except StudyError as error:
            raise ExportError(
                f"{where}: '{text}' is not a value of {parameter.name}: write a number in {unit}, or with "
                f"another unit: {error}"
            ) from None
    return _in_range(parameter, value, where)


def _example(model: ReducedModel, form: str) -> str:
    """The end of a message: how to write it for a parameter that the model has, from its name and its range's ends."""
    if not model.parameters:
        return f": '{model.name}' has no parameters"
    p = model.parameters[0]
    return ", such as " + form.format(p.name, *(f"{p.display(end):.4g}" for end in (p.lower, p.upper)))


def states_of_array(model: ReducedModel, choice: ArrayLike) -> Array:
    """Parameters (s, d) or (d,), SI, as states; ExportError where they are none of the model's."""
    d = len(model.parameters)
    try:
        states = np.atleast_2d(np.array(choice, dtype=np.float64))
    except (TypeError, ValueError):
        raise ExportError("states are a StateChoice, or an array of parameters (s, d)") from None
    if states.ndim != 2 or states.shape[1] != d or not 0 < len(states) <= MOST_STATES:
        names = ", ".join(p.name for p in model.parameters) or "none"
        raise ExportError(
            f"an array of states has a row for each, 1 to {MOST_STATES}, and a column for each of the parameters "
            f"({names}), not the shape {states.shape}"
        )
    for number, row in enumerate(states):
        states[number] = [_in_range(p, x, f"state {number}") for p, x in zip(model.parameters, row, strict=True)]
    return states


Axes = Literal["object", "camera"]


@dataclass(frozen=True)
class StateChoice:
    """Which states of a model to export, in the parameters' units.

    Attributes
    ----------
    vary : texts "name=from:to:count"; several make a grid.
    path : a run folder, or its ``result.h5``, for the states of its frames; or a CSV table with a state in each row.
    at : texts "name=value" for parameters that are not varied.
    coordinates : "camera" for the object where the camera of the run saw it, as only VTU files can have it.
    """

    vary: Sequence[str] = ()
    path: str | Path | None = None
    at: Sequence[str] = ()
    coordinates: Axes = "object"

    def states(self, model: ReducedModel) -> NDArray[np.float64]:
        """The states (s, d), SI; with neither ranges nor a path, a tour of all parameters.

        Those of a run with unknown loads have their coefficients behind the parameters.
        """
        return self.chosen(model).parameters

    def chosen(self, model: ReducedModel) -> States:
        """The states, and what the table of a path, or a run, says of them."""
        twice = {text.partition("=")[0] for text in self.vary} & {text.partition("=")[0] for text in self.at}
        if twice:
            raise ExportError(f"'{min(twice)}' is both varied and fixed: leave out its --vary or its --at")
        if self.path is not None and self.vary:
            raise ExportError("--path and --vary both choose the states: give one of them")
        if self.coordinates not in get_args(Axes):
            raise ExportError(f"coordinates are those of the object or the camera, not '{self.coordinates}'")
        in_camera = self.coordinates == "camera"
        states = self._chosen(model, in_camera)
        if in_camera and states.poses is None:
            raise ExportError("--coordinates camera needs the poses of a run: give its folder with --path")
        return states

    def _chosen(self, model: ReducedModel, in_camera: bool) -> States:
        base = fixed_values(model, self.at)
        if self.path is None:
            return States.of(model, grid(model, self.vary, base) if self.vary else tour(model, base))
        path = Path(self.path)
        if not path.is_dir() and path.suffix.lower() not in (".h5", ".hdf5"):
            return read_path(model, path, base, in_camera, [text.partition("=")[0] for text in self.at])
        if self.at:
            raise ExportError(f"--at {self.at[0]} changes nothing: a run has all parameters; leave it out")
        return read_run(model, path / RESULT if path.is_dir() else path, in_camera)


#: The tour of all parameters.
EACH_IN_TURN = StateChoice()
