"""Points of the object, measured in some states: a table of them, and where a model has them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import IdentificationError
from morph_dslam.geometry import SimilarityTransform, fit_similarity
from morph_dslam.identification.common_errors import shape_errors
from morph_dslam.identification.values import Values
from morph_dslam.io.text import has_a_cell_for_each, name_and_unit, read_csv
from morph_dslam.model import MaterialPoints, Parameter, ReducedModel
from morph_dslam.model.parameter_errors import ParameterErrors
from morph_dslam.model.parameters import parameter_columns, parameter_of_column
from morph_dslam.tracking.binding import nearest_surface_points
from morph_dslam.units import FACTORS

Array = NDArray[np.float64]
#: Columns of a table of points: the state, where they are on the undeformed object, and where they were measured.
STATE = "state"
PLACE, MEASURED = ("place_x", "place_y", "place_z"), ("x", "y", "z")
OWN = (STATE, *PLACE, *MEASURED)
#: Points farther off the undeformed surface than this share of the object's size are a mistake.
FARTHEST = 0.25
#: Step of a difference, of a parameter's range.
STEP = 1e-4


@dataclass(frozen=True)
class MeasuredPoints:
    """Points of the object, measured in the object frame in some states.

    A point beside the surface is carried by the nearest triangle as a rigid body, like a marker glued to it.

    Attributes
    ----------
    model : of the object.
    states : (r,) name of the state of each row.
    known : (r,) values of known parameters by name, SI.
    places : (r, 3) on the undeformed object, m.
    measured : (r, 3) in the state, m; NaN where a coordinate was not measured.
    aligned : whether one rigid motion of all points is unknown, as where they were measured in another frame.
    name : for people.
    """

    model: ReducedModel
    states: tuple[str, ...]
    known: Mapping[str, Array]
    places: Array
    measured: Array
    aligned: bool = False
    name: str = "points"
    unit = "mm"
    run = None
    scale = 1e3

    def __post_init__(self) -> None:
        if self.aligned and not self._present.all():
            raise IdentificationError("points that are to be aligned need all three measured coordinates in every row")

    @property
    def given(self) -> frozenset[str]:
        return frozenset(self.known)

    @property
    def values(self) -> Array:
        return self.measured[self._present]

    @property
    def groups(self) -> NDArray[np.int64]:
        labels = np.unique(self.states, return_inverse=True)[1]
        return self._of_values(labels)

    @property
    def value_states(self) -> tuple[str, ...]:
        """The state of each value (n,)."""
        return tuple(self._of_values(np.array(self.states)).tolist())

    def _of_values(self, rows: NDArray) -> NDArray:
        """What each row (r,) has, for each coordinate that was measured (n,)."""
        return np.repeat(rows[:, None], 3, axis=1)[self._present]

    @cached_property
    def _present(self) -> NDArray[np.bool_]:
        return np.isfinite(self.measured)

    @cached_property
    def _carriers(self) -> tuple[NDArray[np.int64], Array]:
        """Nodes (r, 3) of the triangle that carries each row's point, and its weights (r, 3)."""
        points, distances = nearest_surface_points(self.model.nodes, self.model.triangles, self.places)
        size = float(np.linalg.norm(np.ptp(self.model.nodes, axis=0)))
        worst = int(distances.argmax())
        if distances[worst] > FARTHEST * size:
            raise IdentificationError(
                f"point {worst + 1} is {1e3 * distances[worst]:.1f} mm off the undeformed object, which is "
                f"{1e3 * size:.0f} mm across: check columns {', '.join(PLACE)} and their unit"
            )
        return self.model.triangles[points.triangles], points.weights

    def changes(self, predicted: Array) -> Array:
        measured = self._motion(predicted).inverse.apply(self.measured) if self.aligned else self.measured
        return (measured - self.places)[self._present]

    @property
    def span(self) -> float | None:
        """Extent of the places, of the object's; None of fewer than three, which tell no unit."""
        size = float(np.linalg.norm(np.ptp(self.model.nodes, axis=0)))
        several = len(np.unique(self.places, axis=0)) > 2
        return float(np.linalg.norm(np.ptp(self.places, axis=0))) / size if several else None

    @property
    def mesh_error_stated(self) -> bool:
        return ParameterErrors.of(self.model) is not None

    def predict(self, unknowns: Values) -> Array:
        return self.positions(unknowns.vector)[self._present]

    def adjusted(self, predicted: Array) -> Array:
        if not self.aligned:
            return predicted
        return self._motion(predicted).apply(predicted.reshape(-1, 3)).ravel()

    def _motion(self, predicted: Array) -> SimilarityTransform:
        """That moves predictions (n,) of all coordinates to the measured ones."""
        return fit_similarity(predicted.reshape(-1, 3), self.measured, with_scale=False)

    def loose(self, predicted: Array) -> Array:
        if not self.aligned:
            return np.zeros((len(predicted), 0))
        points = predicted.reshape(-1, 3)
        arms = points - points.mean(axis=0)
        # By their size turns count like shifts, and those about the line of points that lie in one are none.
        arms /= max(float(np.abs(arms).max()), np.finfo(float).tiny)
        turns = np.asarray(np.cross(np.eye(3)[:, None], arms), dtype=np.float64).reshape(3, -1)
        return np.vstack([np.tile(np.eye(3), (1, len(points))), turns]).T

    def model_errors(self, unknowns: Values) -> Array:
        return shape_errors(self.model, self.positions, unknowns.vector, unknowns.free(self.given))[:, self._present]

    def state_errors(self, unknowns: Values) -> Array:
        """None: states are as the table gives them."""
        return np.zeros((0, len(self.values)))

    @property
    def given_values(self) -> Array:
        """Of each known parameter, its values (p, n) where coordinates were measured, over its range."""
        parameters = {p.name: p for p in self.model.parameters}
        shares = [
            (self.known[n] - parameters[n].lower) / (parameters[n].upper - parameters[n].lower) for n in self.known
        ]
        return np.array([self._of_values(share) for share in shares], dtype=np.float64)

    def slopes_by_given(self, unknowns: Values) -> Array:
        """Derivatives (n, p) of adjusted predictions by the known parameters, each over its range."""
        motion = self._motion(self.predict(unknowns)).rotation if self.aligned else np.eye(3)
        columns = []
        for parameter in (p for p in self.model.parameters if p.name in self.known):
            step = STEP * (parameter.upper - parameter.lower)
            values = self.known[parameter.name]
            ends = [np.clip(values + sign * step, parameter.lower, parameter.upper) for sign in (-1.0, 1.0)]
            below, above = (replace(self, known={**self.known, parameter.name: end}) for end in ends)
            change = above.positions(unknowns.vector) - below.positions(unknowns.vector)
            way = (ends[1] - ends[0])[:, None] / (parameter.upper - parameter.lower)
            columns.append((change / way @ motion.T)[self._present])
        return np.column_stack(columns) if columns else np.zeros((len(self.values), 0))

    def positions(self, vector: Callable[[Mapping[str, float]], Array]) -> Array:
        """Where the model has the points (r, 3), m; ``vector`` makes its parameters (d,) of the known ones."""
        corners, weights = self._carriers
        rest = self.model.nodes[corners]
        foot = np.einsum("rc,rcx->rx", weights, rest)
        frames = _frames(rest)
        result = np.empty_like(self.places)
        rows = np.column_stack([self.known[name] for name in self.known]) if self.known else np.empty((len(foot), 0))
        for values in np.unique(rows, axis=0):
            same = np.all(rows == values, axis=1)
            mu = vector(dict(zip(self.known, values.tolist(), strict=True)))
            moved = rest[same] + self._displacement(corners[same], mu)
            turn = np.einsum("rxi,ryi->rxy", _frames(moved), frames[same])
            offset = np.einsum("rxy,ry->rx", turn, (self.places - foot)[same])
            result[same] = np.einsum("rc,rcx->rx", weights[same], moved) + offset
        return result

    def _displacement(self, corners: NDArray[np.int64], mu: Array) -> Array:
        """Of nodes (r, 3), (r, 3, 3) m."""
        nodes, index = np.unique(corners, return_inverse=True)
        points = MaterialPoints(nodes[:, None], np.ones((len(nodes), 1)))
        return self.model.restrict(points).value(mu, "linear")[index.reshape(corners.shape)]


def _frames(triangles: Array) -> Array:
    """Axes (r, 3, 3), as columns, of triangles (r, 3, 3) by their corners: along an edge, in the plane, normal."""
    along = triangles[:, 1] - triangles[:, 0]
    normal = np.cross(along, triangles[:, 2] - triangles[:, 0])
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([along, np.cross(normal, along), normal], axis=2)


def load_points(path: str | Path, model: ReducedModel, aligned: bool = False) -> MeasuredPoints:
    """Read a table of points: CSV with a line of titles.

    Columns are ``state`` (a name), known parameters with their unit (``load_N``), where the point is on the undeformed
    object (``place_x_mm`` and so on), and where it was measured (``x_mm`` and so on; cells may be empty).

    Parameters
    ----------
    path : the file.
    model : whose parameters may be known.
    aligned : whether one rigid motion of all points is unknown.

    Raises
    ------
    IdentificationError
        If the file is missing, a column is missing, there twice or not known, a line is cut short, a value is no
        number, or a known parameter is outside of its range or has two values in a state.
    """
    table = _PointTable(path)
    known = {title: _parameter(path, title, model) for title in table.titles if _name(title) not in OWN}
    places, measured = (table.coordinates(names) for names in (PLACE, MEASURED))
    if not np.isfinite(places).all():
        raise IdentificationError(f"{path}: every row needs {', '.join(PLACE)}")
    if not np.isfinite(measured).any():
        raise IdentificationError(f"{path}: no point was measured: columns {', '.join(MEASURED)} are empty")
    parameters = {parameter.name: parameter for parameter in model.parameters}
    values = {name: table.known(title, parameters[name], factor) for title, (name, factor) in known.items()}
    return MeasuredPoints(model, tuple(table.states), values, places, measured, aligned)


class _PointTable:
    """The lines of a file of points, each with a cell under every title."""

    def __init__(self, path: str | Path) -> None:
        (_, titles), *rows = read_csv(Path(path), "table of points", IdentificationError) or [(1, [])]
        names = [_name(title) for title in titles]
        if missing := [name for name in OWN if name not in names]:
            lacking = ", ".join(name if name == STATE else f"{name}_mm" for name in missing)
            raise IdentificationError(f"{path} has no column {lacking}; its first line must name the columns")
        for name in filter(None, names):
            if len(same := [title for title, other in zip(titles, names, strict=True) if other == name]) > 1:
                raise IdentificationError(
                    f"{path}: the columns {' and '.join(same)} both hold {name}: leave one of them in"
                )
        if not rows:
            raise IdentificationError(f"{path} has no points below its titles")
        for line, cells in rows:
            if not has_a_cell_for_each(titles, cells):
                raise IdentificationError(
                    f"{path}, line {line}: {len(cells)} cells under {len(titles)} titles; keep the commas of empty "
                    "cells, and write decimals with points"
                )
        self._path, self._rows = path, rows
        self._columns = {title: at for at, title in enumerate(titles) if title}
        self.titles, self.states = list(self._columns), [cells[names.index(STATE)] for _, cells in rows]

    def numbers(self, title: str) -> Array:
        """A column (r,), NaN where a cell is empty."""
        return np.array([self._number(line, title, cells[self._columns[title]]) for line, cells in self._rows])

    def _number(self, line: int, title: str, cell: str) -> float:
        try:
            value = float(cell or "nan")
        except ValueError:
            value = np.inf
        if np.isinf(value):
            raise IdentificationError(f"{self._path}, line {line}, column '{title}': '{cell}' is not a number")
        return value

    def coordinates(self, names: tuple[str, ...]) -> Array:
        """Columns (r, 3) of lengths, m; NaN where a cell is empty."""
        found = []
        for name in names:
            title = next(title for title in self.titles if _name(title) == name)
            unit = name_and_unit(title)[1]
            if unit not in FACTORS["length"]:
                raise IdentificationError(f"{self._path}: column '{title}' needs a unit of length: {name}_mm, say")
            found.append(FACTORS["length"][unit] * self.numbers(title))
        return np.column_stack(found)

    def known(self, title: str, parameter: Parameter, factor: float) -> Array:
        """Values (r,) of a parameter, SI: one in each state, in its range."""
        values, first = factor * self.numbers(title), dict[str, tuple[int, float]]()
        for (line, _), state, value in zip(self._rows, self.states, values.tolist(), strict=True):
            where = f"{self._path}, line {line}, column '{title}'"
            if np.isnan(value):
                raise IdentificationError(f"{where} is empty: parameter '{parameter.name}' must be given in every row")
            if not parameter.in_range(value):
                raise IdentificationError(
                    f"{where}: {parameter.text(value)} is outside of the model's range, {parameter.range_text}"
                )
            line_before, before = first.setdefault(state, (line, value))
            if value != before:
                raise IdentificationError(
                    f"{where}: state '{state}' has {parameter.text(value)} here and {parameter.text(before)} in line "
                    f"{line_before}: give each state one value, or make them two states"
                )
        return values


def _name(title: str) -> str:
    """Of a column, without the unit."""
    return title if title == STATE else name_and_unit(title)[0]


def _parameter(path: str | Path, column: str, model: ReducedModel) -> tuple[str, float]:
    """The parameter that a column holds, and the factor of its values to SI."""
    found = parameter_of_column(column, model)
    if found is None:
        raise IdentificationError(
            f"{path}: column '{column}' is no parameter of the model with its unit: {parameter_columns(model)}"
        )
    return found
