"""Gross errors in a table of points: another origin, a value that is far off, another unit, other axes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import permutations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.stats import qmc

from morph_dslam.better_fit import chance_of_better_fit
from morph_dslam.evaluation.likeness import root_mean_square
from morph_dslam.identification.found import Identification, Misfit
from morph_dslam.identification.measured_points import MeasuredPoints
from morph_dslam.identification.moved_states import CHANCE, ROUNDING
from morph_dslam.identification.scatter import scaled_directions
from morph_dslam.identification.values import FACTOR, Values

Array = NDArray[np.float64]
#: Another reading or frame is named where it leaves less than this part of what is missed.
MOST_LEFT = 0.5
#: Much is missed where it is more than this part of what the load changed; a reading fits where it is less.
MOST_MISSED = 0.25
#: A value is far off where it is missed by so many times the usual deviation, and no more than this share of all are.
FAR, MOST_FAR = 10.0, 0.05
#: Places within this part of the object are of one marker: its place may be measured again for each state.
ONE_PLACE = 0.02
#: The deviation of normal errors over the median of their sizes.
NORMAL = 1.4826
#: Units that are taken for each other; predictions over the range of the unknowns with which readings are compared (a
#: power of two).
UNITS, TRIED = (1e-3, 1e-2, 1e-1, 1e1, 1e2, 1e3), 16
#: Of readings that leave as much, up to this factor, the simplest.
ALIKE = 1.1
AXES = "xyz"


def point_doubts(misfit: Misfit, points: MeasuredPoints, found: Identification) -> dict[str, Any]:
    """What speaks for gross errors in a table, plain JSON; lengths are in the table's unit of reports.

    Parameters
    ----------
    misfit : of the points.
    points : as measured.
    found : what was identified.
    """
    return {
        "far_off": _far_off(misfit, points),
        "read_otherwise": _read_otherwise(misfit, points, found),
        "moved_as_one": _moved_as_one(misfit, points),
    }


def _far_off(misfit: Misfit, points: MeasuredPoints) -> list[dict[str, Any]]:
    """Values that are missed by far more than others: of all, of their coordinate, and of their state."""
    size = np.abs(misfit.missed)
    rows, axes = np.nonzero(np.isfinite(points.measured))
    usual = np.full(len(size), NORMAL * float(np.median(size)))
    for labels in (axes, np.unique(points.value_states, return_inverse=True)[1]):
        for label in np.unique(labels):
            usual[labels == label] = np.maximum(usual[labels == label], NORMAL * np.median(size[labels == label]))
    least = ROUNDING * float(np.abs(points.values).max())
    far = np.flatnonzero(size > FAR * np.maximum(usual, max(misfit.model_rms, least)))
    if len(far) > max(1.0, MOST_FAR * len(size)):
        return []
    return [
        {
            "state": points.states[rows[at]],
            "row": int(rows[at]) + 1,
            "coordinate": AXES[axes[at]],
            "missed": points.scale * float(misfit.missed[at]),
        }
        for at in far[np.argsort(-size[far])]
    ]


def _moved_as_one(misfit: Misfit, points: MeasuredPoints) -> dict[str, float] | None:
    """What is missed once all points are moved as one body; None where that does not leave much less.

    The statistic is F, of the means of each marker over the states: markers that are put on the body beside places
    err in all states alike. What known parameters that are off in each state explain is none of it, and is taken out
    of each state first: among the means there is no more room for what a state has of its own.
    """
    if points.aligned or not np.isfinite(points.measured).all():
        return None
    columns = np.column_stack([misfit.slopes, replace(points, aligned=True).loose(misfit.predicted)])
    lengths, k = np.linalg.norm(columns, axis=0), misfit.slopes.shape[1]
    left, means = np.column_stack([misfit.missed, columns]), _MarkerMeans(_markers(points))
    names, given = np.array(points.states), points.slopes_by_given(misfit.at).reshape(len(points.states), 3, -1)
    for state in dict.fromkeys(points.states):
        rows = np.flatnonzero(names == state)
        values = (3 * rows[:, None] + np.arange(3)).ravel()
        basis = scaled_directions(given[rows].reshape(len(values), -1))
        left[values] -= basis @ (basis.T @ left[values])
        means.take_out(rows, basis)
    without, with_it = (
        root_mean_square(_left(left[:, 0], _beyond_rounding(left[:, 1 : 1 + end], lengths[:end])))
        for end in (k, len(lengths))
    )
    mean = means.of(left)
    null, both = (scaled_directions(_beyond_rounding(mean[:, 1 : 1 + end], lengths[:end])) for end in (k, len(lengths)))
    freed, freedom = both.shape[1] - null.shape[1], means.freedom(both)
    if freed < 1 or freedom < 1.0:
        return None
    sums = [float(np.sum((mean[:, 0] - basis @ (basis.T @ mean[:, 0])) ** 2)) for basis in (null, both)]
    least = max(misfit.model_rms, ROUNDING * float(np.abs(points.values).max()))
    chance = chance_of_better_fit(sums[0], sums[1], freed, freedom, least)
    return {"rms": points.scale * with_it} if chance < CHANCE and with_it < MOST_LEFT * without else None


def _beyond_rounding(columns: Array, lengths: Array) -> Array:
    """Columns (n, q) without those of which rounding is left of their lengths (q,)."""
    return columns[:, np.linalg.norm(columns, axis=0) > ROUNDING * lengths]


class _MarkerMeans:
    """Means of each marker's rows, of which something is taken out state by state.

    Parameters
    ----------
    labels : (r,) of each row's marker, from 0.
    """

    def __init__(self, labels: NDArray[np.int64]) -> None:
        self._labels, self._counts = labels, np.bincount(labels)
        self._out: list[Array] = []

    def _sums(self, values: Array, rows: NDArray[np.int64] | slice = slice(None)) -> Array:
        """Of values (3 s, q) of some rows (s,), for each marker (3 p, q)."""
        sums = np.zeros((len(self._counts), 3 * values.shape[1]))
        labels = self._labels[rows]
        np.add.at(sums, labels, values.reshape(len(labels), -1))
        return sums.reshape(3 * len(sums), -1)

    def of(self, values: Array) -> Array:
        """The means (3 p, q) of values (3 r, q)."""
        return self._sums(values) / np.repeat(self._counts, 3)[:, None]

    def take_out(self, rows: NDArray[np.int64], basis: Array) -> None:
        """Take in that a state's rows (s,) are without what an orthonormal basis (3 s, q) spans."""
        self._out.append(self._sums(basis, rows))

    def freedom(self, basis: Array) -> float:
        """What squares of means without an orthonormal basis (3 p, q) come to by markers' errors of unit variance.

        With B of what was taken out, summed over each marker's rows, and D of one over their numbers, errors w of the
        markers make the means A w, A = 1 - D B B'. This is the trace of A' (1 - Q Q') A with the basis Q.
        """
        out = np.hstack(self._out)
        shares = out / np.repeat(self._counts, 3)[:, None]
        whole = len(out) - 2.0 * float(np.sum(out * shares)) + float(np.sum((shares.T @ shares) * (out.T @ out)))
        return whole - float(np.sum((basis - out @ (shares.T @ basis)) ** 2))


def _markers(points: MeasuredPoints) -> NDArray[np.int64]:
    """A label of each row (r,): rows are of one marker where their places are the same but for their own error.

    Different places in one state are of different markers, however near.
    """
    most = ONE_PLACE * float(np.linalg.norm(np.ptp(points.model.nodes, axis=0)))
    names, labels = np.array(points.states), np.zeros(len(points.states), dtype=np.int64)
    known = np.zeros((0, 3))
    for state in dict.fromkeys(points.states):
        rows = np.flatnonzero(names == state)
        places, which = np.unique(points.places[rows], axis=0, return_inverse=True)
        of_place = np.full(len(places), -1)
        if len(known):
            away, nearest = map(np.asarray, KDTree(known).query(places))
            order = np.argsort(away, kind="stable")
            order = order[away[order] <= most]
            taken = order[np.unique(nearest[order], return_index=True)[1]]  # of several, the nearest
            of_place[taken] = nearest[taken]
        others = np.flatnonzero(of_place < 0)
        of_place[others] = len(known) + np.arange(len(others))
        known, labels[rows] = np.vstack([known, places[others]]), of_place[which.ravel()]
    return labels


def _left(missed: Array, columns: Array) -> Array:
    """What is missed (n,) less all that columns (n, q) explain of it."""
    basis = scaled_directions(columns)
    return np.asarray(missed - basis @ (basis.T @ missed))


def _read_otherwise(misfit: Misfit, points: MeasuredPoints, found: Identification) -> dict[str, Any] | None:
    """Another unit, or other axes, with which the model explains the points somewhere in the range of the unknowns.

    It is asked only where the fit misses much, of tables with all coordinates.
    """
    own, complete = misfit.rms, np.isfinite(points.measured).all()
    if not complete or own <= MOST_MISSED * root_mean_square(misfit.changes):
        return None
    predictions = [points.predict(values) for values in _tried(misfit, points, found)]
    told = []
    for unit, order, signs in _readings(points.aligned):
        read = replace(points, measured=unit * points.measured[:, order] * signs)
        left = [root_mean_square(read.adjusted(each) - read.values) for each in predictions]
        best = int(np.argmin(left))
        changed = root_mean_square(read.changes(predictions[best]))
        if left[best] < min(MOST_LEFT * own, MOST_MISSED * changed):
            told.append((left[best] / changed, left[best], unit, order, signs))
    if not told:
        return None
    least = min(share for share, *_ in told)
    _, rms, unit, order, signs = next(each for each in told if each[0] <= ALIKE * least)
    axes = ["-" * int(sign < 0) + AXES[axis] for axis, sign in zip(order, signs, strict=True)]
    return {"times": unit, "axes": axes, "rms": points.scale * rms}


def _tried(misfit: Misfit, points: MeasuredPoints, found: Identification) -> Iterator[Any]:
    """Values over the range of the unknowns, after those that were found and the defaults."""
    yield misfit.at
    unknowns = [each.parameter for each in found.estimates]
    scaled = frozenset() if found.loads is None else found.loads.scaled
    yield Values(points.model, unknowns, np.array([p.default for p in unknowns]), scaled)
    for shares in qmc.Sobol(len(unknowns), scramble=False).random(TRIED):
        ends = [
            p.lower * (p.upper / p.lower) ** share if p.name == FACTOR else p.lower + share * (p.upper - p.lower)
            for p, share in zip(unknowns, shares, strict=True)
        ]
        yield Values(points.model, unknowns, np.array(ends), scaled)


def _readings(aligned: bool) -> Iterator[tuple[float, Sequence[int], Array]]:
    """Units, orders and signs of the axes, the simplest first; of points that a motion aligns all mirrors are one."""
    same, upright = (0, 1, 2), np.ones(3)
    for unit in UNITS:
        yield unit, same, upright
    if aligned:
        yield 1.0, same, np.array([1.0, 1.0, -1.0])
        return
    orders = [(order, np.array(signs)) for order in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)]
    for order, signs in sorted(orders, key=lambda each: (each[0] != same, int(np.sum(each[1] < 0)))):
        if order != same or np.any(signs < 0):
            yield 1.0, order, signs


def point_doubt_notes(each: Mapping[str, Any]) -> list[str]:
    """Notes on gross errors in one table, of its figures."""
    name, unit, said = each["name"], each["unit"], []
    if far := each.get("far_off"):
        listed = ", ".join(
            f"{value['coordinate']} of point {value['row']} (state {value['state']}) by {value['missed']:.3g} {unit}"
            for value in far[:3]
        )
        more = f" and {len(far) - 3} more" if len(far) > 3 else ""
        said.append(
            f"note: {name} is missed far beyond its scatter in {listed}{more}: check these values, or leave these "
            "points out; least squares follow them"
        )
    if read := each.get("read_otherwise"):
        said.append(f"note: {name} would be missed by {read['rms']:.3g} {unit} rms {_reading(each, read)}")
    elif moved := each.get("moved_as_one"):
        said.append(
            f"note: {name} would be missed by {moved['rms']:.3g} {unit} rms, moved as one body: where their frame is "
            "not the object's, give --align-points; else the body has another shape than the model"
        )
    return said


def _reading(each: Mapping[str, Any], read: Mapping[str, Any]) -> str:
    """Another reading in words, and what to check."""
    if read["times"] != 1.0:
        return f"with {read['times']:g} times x, y and z: check the unit in their titles"
    if "moved_rms" in each:
        return "as a mirror image: their frame is left-handed, turn the sign of one axis"
    return f"with {', '.join(read['axes'])} as x, y, z: check the order and the signs of the axes"
