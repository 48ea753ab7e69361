"""What parameters are identified from: points measured in loaded states, and forces on supports.

Each measurement predicts its values for given unknowns and says which of them belong together: errors within a state,
or along a stretch of a force curve, are not independent of each other.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import IdentificationError
from morph_dslam.evaluation.force import ForceCurve, ReactionInDirection, parameter_columns, parameter_of_column
from morph_dslam.evaluation.run_folder import Run
from morph_dslam.io.text import read_text
from morph_dslam.model import MaterialPoints, ReducedModel
from morph_dslam.tracking.binding import nearest_surface_points
from morph_dslam.units import FACTORS

Array = NDArray[np.float64]
#: Columns of a table of points: where they are on the undeformed object, and where they were measured.
PLACE, MEASURED = ("place_x", "place_y", "place_z"), ("x", "y", "z")
#: Points farther off the undeformed surface than this share of the object's size are a mistake.
FARTHEST = 0.25
#: A force curve counts as so many stretches whose errors are independent of each other.
STRETCHES = 8
#: A parameter that changes by less than this share of its range a frame is one over the sequence.
LEAST_RATE = 1e-6
#: Fewer forces determine no offset and anything else.
FEWEST_FORCES = 4


class Unknowns(Protocol):
    """Values of what is identified."""

    factor: float
    """Common factor of all moduli."""

    def vector(self, known: Mapping[str, float]) -> Array:
        """The model's parameters (d,), SI, where those that are not identified are known."""
        ...


class Measurement(Protocol):
    """One table of measured values."""

    @property
    def name(self) -> str: ...
    @property
    def unit(self) -> str:
        """Of errors in reports."""
        ...

    @property
    def scale(self) -> float:
        """From SI to this unit."""
        ...

    @property
    def values(self) -> Array:
        """(n,), SI."""
        ...

    @property
    def groups(self) -> NDArray[np.int64]:
        """(n,) labels of values whose errors may belong together."""
        ...

    @property
    def has_offset(self) -> bool:
        """Whether an unknown offset is added to the predictions, such as the zero of a load cell."""
        ...

    def predict(self, unknowns: Unknowns) -> Array:
        """(n,), SI."""
        ...


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
    """

    model: ReducedModel
    states: tuple[str, ...]
    known: Mapping[str, Array]
    places: Array
    measured: Array
    name = "points"
    unit = "mm"
    scale = 1e3
    has_offset = False

    @property
    def values(self) -> Array:
        return self.measured[self._present]

    @property
    def groups(self) -> NDArray[np.int64]:
        labels = np.unique(self.states, return_inverse=True)[1]
        return np.repeat(labels[:, None], 3, axis=1)[self._present]

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

    def predict(self, unknowns: Unknowns) -> Array:
        return self.positions(unknowns.vector)[self._present]

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
        return self.model.restrict(points).value(mu)[index.reshape(corners.shape)]


def _frames(triangles: Array) -> Array:
    """Axes (r, 3, 3), as columns, of triangles (r, 3, 3) by their corners: along an edge, in the plane, normal."""
    along = triangles[:, 1] - triangles[:, 0]
    normal = np.cross(along, triangles[:, 2] - triangles[:, 0])
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([along, np.cross(normal, along), normal], axis=2)


def load_points(path: str | Path, model: ReducedModel) -> MeasuredPoints:
    """Read a table of points: CSV with a header.

    Columns are ``state`` (a name), known parameters with their unit (``load_N``), where the point is on the undeformed
    object (``place_x_mm`` and so on), and where it was measured (``x_mm`` and so on; cells may be empty).

    Raises
    ------
    IdentificationError
        If the file is missing, a column is missing or not known, or a value is no number.
    """
    rows = list(csv.DictReader(read_text(Path(path), "table of points", IdentificationError).splitlines()))
    columns = [name for name in (rows[0] if rows else {}) if name]
    known = {name: _parameter(path, name, model) for name in columns if not _is_own(name)}
    missing = [name for name in (*PLACE, *MEASURED) if not any(column.rpartition("_")[0] == name for column in columns)]
    if not rows or missing or "state" not in columns:
        lacking = ["state"] * ("state" not in columns) + [f"{name}_mm" for name in missing]
        raise IdentificationError(f"{path} has no column {', '.join(lacking) or 'with a point'}: docs/identify.md")
    places, measured = (_coordinates(path, rows, columns, names) for names in (PLACE, MEASURED))
    if not np.isfinite(places).all():
        raise IdentificationError(f"{path}: every row needs {', '.join(PLACE)}")
    if not np.isfinite(measured).any():
        raise IdentificationError(f"{path}: no point was measured: columns {', '.join(MEASURED)} are empty")
    values = {
        parameter: factor * np.array([_number(path, row[column]) for row in rows])
        for column, (parameter, factor) in known.items()
    }
    if unknown := next((name for name, column in values.items() if not np.isfinite(column).all()), None):
        raise IdentificationError(f"{path}: parameter '{unknown}' is not given in every row")
    return MeasuredPoints(model, tuple(row["state"] or "" for row in rows), values, places, measured)


def _is_own(column: str) -> bool:
    return column == "state" or column.rpartition("_")[0] in (*PLACE, *MEASURED)


def _parameter(path: str | Path, column: str, model: ReducedModel) -> tuple[str, float]:
    """The parameter that a column holds, and the factor of its values to SI."""
    found = parameter_of_column(column, model)
    if found is None:
        raise IdentificationError(
            f"{path}: column '{column}' is no parameter of the model with its unit: {parameter_columns(model)}"
        )
    return found


def _coordinates(path: str | Path, rows: list[dict[str, str]], columns: list[str], names: tuple[str, ...]) -> Array:
    """Columns (r, 3) of lengths, m; NaN where a cell is empty."""
    result = np.empty((len(rows), 3))
    for axis, name in enumerate(names):
        column = next(column for column in columns if column.rpartition("_")[0] == name)
        unit = column.rpartition("_")[2]
        if unit not in FACTORS["length"]:
            raise IdentificationError(f"{path}: column '{column}' needs a unit of length: {name}_mm, say")
        result[:, axis] = [FACTORS["length"][unit] * _number(path, row[column]) for row in rows]
    return result


def _number(path: str | Path, cell: str | None) -> float:
    """The number in a cell, NaN where it is empty."""
    try:
        value = float(cell or "nan")
    except ValueError:
        value = np.inf
    if np.isinf(value):
        raise IdentificationError(f"{path}: '{cell}' is not a number")
    return value


@dataclass(frozen=True)
class MeasuredForces:
    """Forces on a support, by frame of a run or by a known parameter.

    Attributes
    ----------
    model : of the object.
    curve : the measured forces.
    reaction : the model's force in the direction in which they were measured; without a sign of its own, it has the one
        in which it grows with the measured force, at known parameters and the defaults of all others.
    run : whose frames the curve is given by, and whose estimates are the parameters that are not identified; None for a
        curve over a parameter.
    """

    model: ReducedModel
    curve: ForceCurve
    reaction: ReactionInDirection
    run: Run | None = None
    unit = "N"
    scale = 1.0
    has_offset = True

    def __post_init__(self) -> None:
        if self.curve.against == "frame" and self.run is None:
            raise IdentificationError("forces by frame need the run that tracked these frames: give --run")
        if len(self.values) < FEWEST_FORCES:
            raise IdentificationError(
                f"{len(self.values)} forces are left to compare, and {FEWEST_FORCES} are needed: the others are in "
                "frames that were not tracked"
            )

    @property
    def name(self) -> str:
        return self.curve.name

    @cached_property
    def _rows(self) -> NDArray[np.int64]:
        """Of the curve: those in tracked frames, or all."""
        if self.curve.against != "frame" or self.run is None:
            return np.arange(len(self.curve.places))
        return np.flatnonzero(np.isin(self.curve.places, self.run.frames[self.run.tracked]))

    @property
    def values(self) -> Array:
        return self.curve.forces[self._rows]

    @property
    def places(self) -> Array:
        """Where on the curve they are (n,)."""
        return self.curve.places[self._rows]

    @property
    def groups(self) -> NDArray[np.int64]:
        count = len(self._rows)
        groups = np.empty(count, dtype=np.int64)
        groups[np.argsort(self.places, kind="stable")] = np.arange(count) * min(STRETCHES, count) // count
        return groups

    @cached_property
    def compared(self) -> ReactionInDirection:
        """The reaction with its sign."""
        along = np.array([self.reaction(self.model.vector(known)) for known in self._known])
        return self.reaction.following(along, self.values)

    def predict(self, unknowns: Unknowns) -> Array:
        return unknowns.factor * np.array([self.compared(unknowns.vector(known)) for known in self._known])

    @cached_property
    def _known(self) -> list[dict[str, float]]:
        """The parameters of each force that are not identified."""
        if self.curve.against != "frame" or self.run is None:
            return [{self.curve.against: float(place)} for place in self.places]
        names = [parameter.name for parameter in self.run.model.parameters]
        row_of = {int(frame): row for row, frame in enumerate(self.run.frames)}
        return [dict(zip(names, self.run.parameters[row_of[int(p)]].tolist(), strict=True)) for p in self.places]

    @property
    def loading_rates(self) -> dict[str, float]:
        """How much the parameters that change change from frame to frame, SI; empty where no run tells.

        The rate of each is the slope of a straight line through its estimates.
        """
        if self.curve.against != "frame" or self.run is None:
            return {}
        rates = {
            name: float(np.polyfit(self.places, [known[name] for known in self._known], 1)[0])
            for name in self._known[0]
        }
        return {
            p.name: rates[p.name]
            for p in self.run.model.parameters
            if abs(rates[p.name]) > LEAST_RATE * (p.upper - p.lower)
        }
