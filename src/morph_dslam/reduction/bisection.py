"""Sampling a single parameter by bisection: full solves where interpolation between those so far errs most.

Each interval between two samples is checked by a solve in its middle, predicted by the functions that the model will
use, piecewise cubics or those that the study names (`line_functions`). Where the prediction misses by more than the
tolerance, both halves are checked too. Stress and the forces of supports may miss by `COARSER` times as much: they
count where the displacement hardly changes, as that of a viscous body that is held. The middle becomes a sample of the
model, which so errs less than was measured: for a smooth function by a sixteenth of it, with hats by a quarter. Where
solutions jump it errs by as much as before, only in a shorter interval.
Which samples are taken depends on solutions alone: a build that was stopped takes them again and finds them on disk.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.reduced_model import FORCE, REACTION
from morph_dslam.reduction.line_functions import LINE_BASES, interpolate_line
from morph_dslam.reduction.task import STRESS
from morph_dslam.studies.problem import ParametricStudy, Snapshot
from morph_dslam.studies.sampling import first_samples
from morph_dslam.studies.sections import BasisName
from morph_dslam.studies.snapshots import load_snapshot
from morph_dslam.studies.sweep import SweepResult

Array = NDArray[np.float64]
#: An error that is still more than these parts of the one before and of the one before that does not fall.
STEADY, STEADY_TWICE = 0.75, 0.6
#: Intervals in which errors do not fall are halved until they are shorter than this part of the range.
LEAST = 1e-3
#: So many times the tolerance is that of stress, and of the forces of supports.
COARSER = 10.0


@dataclass(frozen=True)
class _Error:
    """Of a prediction.

    Attributes
    ----------
    size : relative to the largest norm of what misses most.
    of : "displacement", "stress" or "force".
    """

    size: float = 0.0
    of: str = "displacement"

    @property
    def share(self) -> float:
        """As an error of the displacement that counts as much."""
        return self.size if self.of == "displacement" else self.size / COARSER


@dataclass(frozen=True)
class _Interval:
    """Of the parameter, between two samples; ``errors`` in the middles of the intervals that it is a half of."""

    low: float
    high: float
    errors: tuple[_Error, ...] = ()

    @property
    def middle(self) -> float:
        return (self.low + self.high) / 2.0

    def halves(self, error: _Error) -> list[_Interval]:
        """Both, where the middle errs by so much."""
        errors = (*self.errors, error)
        return [_Interval(self.low, self.middle, errors), _Interval(self.middle, self.high, errors)]

    @property
    def steady(self) -> bool:
        """Whether the error has not fallen as intervals were halved; that of a bend falls to a half at least.

        Two halvings tell: where a bend lies by chance, the error of a single one need not fall.
        """
        last = [error.share for error in self.errors[-3:]]
        return len(last) == 3 and last[2] > max(STEADY * last[1], STEADY_TWICE * last[0])


def sample_by_bisection(
    study: ParametricStudy, sweep: Callable[[Array], SweepResult]
) -> tuple[Array, list[dict[str, Any]]]:
    """The training samples (n, 1) and what each round found, as `adaptive_sampling.sample_adaptively` has it.

    Sampling ends when no middle misses the tolerance of the reduction, a norm over the body relative to the largest
    displacement, stress or force, or at ``sampling.training`` samples. Intervals are halved no further where solutions
    jump. The last round has "unresolved" intervals in which the tolerance was missed and that were not halved:
    "between" (two coordinates, SI), "estimate" in the middle of the interval that it is a half of, "of" what, and
    "why": "jump" where solutions do, "failed" where the middle could not be solved, "training" where samples ran out,
    "steady" where the error does not fall in ever shorter intervals.
    """
    weights, tolerance = study.model_mesh().weights, study.reduction.tolerance
    # Polynomials are fitted to all samples together; splines through them tell where these are too few.
    basis = study.reduction.basis if study.reduction.basis in LINE_BASES else None
    samples = first_samples(study)
    solved = sweep(samples).solved
    waiting = [_Interval(float(low), float(high)) for low, high in pairwise(samples[:, 0])]
    least = LEAST * (samples[-1, 0] - samples[0, 0])
    rounds: list[dict[str, Any]] = []
    reasons: dict[_Interval, str] = {}
    while waiting:
        room = max(study.sampling.training - len(samples), 0)
        reasons |= {part: "training" for part in waiting[room:] if part.errors}
        waiting = waiting[:room]
        if not waiting:
            break
        lines = _Lines([load_snapshot(path) for _, path in sorted(solved.items())], weights, basis)
        samples = np.vstack([samples, [[interval.middle] for interval in waiting]])
        solved = sweep(samples).solved
        new = range(len(samples) - len(waiting), len(samples))
        # What cannot be solved is not looked at any closer.
        reasons |= {part: "failed" for part, index in zip(waiting, new, strict=True) if index not in solved}
        errors = [lines.error(load_snapshot(solved[index])) if index in solved else _Error() for index in new]
        shares = np.array([error.share for error in errors])
        rounds.append({"solves": len(samples), "largest_estimate": float(shares.max())})
        # The worst first, in case samples run out.
        worst = [index for index in np.argsort(-shares, kind="stable") if shares[index] > tolerance]
        halves = [half for index in worst for half in waiting[index].halves(errors[index])]
        waiting = [half for half in halves if half.high - half.low > least or not half.steady]
        reasons |= {half: "steady" for half in halves if half not in waiting}
    if reasons:
        lines = _Lines([load_snapshot(path) for _, path in sorted(solved.items())], weights, basis)
        if found := _unresolved(reasons, lines.displacement, least):
            rounds[-1]["unresolved"] = found
    return samples, rounds


def _unresolved(missed: Mapping[_Interval, str], line: _Line, least: float) -> list[dict[str, Any]]:
    """What is said of intervals that were ``missed``, by the reason why they were not halved.

    Those shorter than ``least`` jump whatever their slopes are.

    One without errors, whose middle could not be solved, is only known by its ends.
    """
    steady = [part for part in missed if part.steady or not part.errors]
    jumps = [part for part in steady if line.jumps(part, part.high - part.low > least)]
    found: list[dict[str, Any]] = []
    for part in sorted(missed, key=lambda part: part.low):
        width = part.high - part.low
        # Where the other half has the jump, this one has only its error.
        beside = any(part.low - width <= jump.low and jump.high <= part.high + width for jump in jumps)
        if part not in jumps and (beside or not part.errors):
            continue
        why = "jump" if part in jumps else missed[part]
        error = part.errors[-1] if part.errors else _Error(line.step(part) / 2.0)
        entry = {"between": [part.low, part.high], "estimate": error.size, "of": error.of, "why": why}
        if found and why != "jump" and (found[-1]["between"][1], found[-1]["why"]) == (part.low, why):
            before = found.pop()
            entry["between"] = [before["between"][0], part.high]
            worse = max((error, _Error(before["estimate"], before["of"])), key=lambda error: error.share)
            entry |= {"estimate": worse.size, "of": worse.of}
        found.append(entry)
    return found


class _Lines:
    """Displacement, stress and forces between snapshots of one parameter; ``weights`` (n,) are those of the nodes.

    ``basis`` is that of `interpolate_line`.
    """

    def __init__(self, snapshots: Sequence[Snapshot], weights: Array, basis: BasisName | None) -> None:
        self.displacement = _Line(snapshots, "displacement", weights, basis)
        names = [name for name in snapshots[0].fields if name.startswith(STRESS)]
        self._stresses = [_Line(snapshots, name, weights, basis) for name in names]
        forces = [name for name in snapshots[0].outputs if name.startswith(FORCE)]
        self._forces = [_Line(snapshots, name, np.ones(1), basis) for name in forces]

    def error(self, snapshot: Snapshot) -> _Error:
        """That at another snapshot which counts most."""
        errors = [_Error(self.displacement.error(snapshot))]
        for of, lines in (("stress", self._stresses), ("force", self._forces)):
            largest = max((line.largest for line in lines), default=0.0)
            errors += [_Error(line.error(snapshot, largest), of) for line in lines]
        return max(errors, key=lambda error: error.share)


def _values_of(snapshot: Snapshot, name: str) -> Array:
    """A field or an output of a snapshot, as one vector."""
    values = snapshot.fields[name] if name in snapshot.fields else snapshot.outputs[name]
    return np.asarray(values, dtype=np.float64).ravel()


class _Line:
    """Values interpolated between snapshots of one parameter.

    Parameters
    ----------
    name : of a field or an output.
    weights : (n,) of the places where it has values.
    basis : of `interpolate_line`.
    """

    def __init__(self, snapshots: Sequence[Snapshot], name: str, weights: Array, basis: BasisName | None) -> None:
        self._name = name
        points = np.array([snapshot.coordinates[0] for snapshot in snapshots])
        values = np.array([_values_of(snapshot, name) for snapshot in snapshots])
        known = name if name in snapshots[0].fields else REACTION + name
        slopes = [s.sensitivities[known].ravel() for s in snapshots if known in s.sensitivities]
        self._weights = np.repeat(weights, values.shape[1] // len(weights))
        self._slopes = np.array(slopes, dtype=np.float64) if slopes else None
        self._points, self._values = points, values
        self._functions = interpolate_line(points, values, self._slopes, basis)
        #: Norm; zero for a body that has not moved yet.
        self.largest = max(self._norm(value) for value in values)

    def _norm(self, values: Array) -> float:
        return float(np.sqrt(values**2 @ self._weights))

    def error(self, snapshot: Snapshot, largest: float = 0.0) -> float:
        """Norm of the error at another snapshot, relative to the largest, that one's and a given one included."""
        predicted, _ = self._functions.evaluate(snapshot.coordinates)
        truth = _values_of(snapshot, self._name)
        missed = self._norm(predicted - truth)
        return missed / max(largest, self.largest, self._norm(truth)) if missed else 0.0

    def _ends(self, interval: _Interval) -> tuple[int, int] | None:
        """The snapshots at both ends; None if one of them could not be solved."""
        low, high = (int(np.abs(self._points - end).argmin()) for end in (interval.low, interval.high))
        width = interval.high - interval.low
        found = abs(self._points[high] - self._points[low] - width) <= 1e-6 * width
        return (low, high) if found else None

    def step(self, interval: _Interval) -> float:
        """Norm of the difference between both ends, relative to the largest displacement; 0 where it is unknown."""
        ends = self._ends(interval)
        if ends is None or not self.largest:
            return 0.0
        return self._norm(self._values[ends[1]] - self._values[ends[0]]) / self.largest

    def jumps(self, interval: _Interval, by_slopes: bool) -> bool:
        """Whether solutions at both ends differ by as much as the error in the middle of what is twice as long says.

        ``by_slopes`` asks besides that they differ by more than their slopes explain, where these are known.
        """
        step, ends = self.step(interval), self._ends(interval)
        if ends is None or step == 0.0 or (interval.errors and step < interval.errors[-1].share):
            return False  # what jumps is the other half
        if self._slopes is None or not by_slopes:
            return bool(interval.errors)
        width = interval.high - interval.low
        return step * self.largest > width * sum(self._norm(self._slopes[end]) for end in ends)
