"""Sampling a single parameter by bisection: full solves where interpolation between those so far errs most.

Each interval between two samples is checked by a solve in its middle, predicted by the functions that the model will
use (`line_functions`). Where the prediction misses by more than the tolerance, both halves are checked too. The middle
becomes a sample of the model, which so errs less than was measured: for a smooth function by a sixteenth of it. Which
samples are taken depends on solutions alone: a build that was stopped takes them again and finds them on disk.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.reduction.line_functions import interpolate_line
from morph_dslam.studies.problem import ParametricStudy, Snapshot
from morph_dslam.studies.sampling import even_samples
from morph_dslam.studies.snapshots import load_snapshot
from morph_dslam.studies.sweep import SweepResult

Array = NDArray[np.float64]


def sample_by_bisection(
    study: ParametricStudy, sweep: Callable[[Array], SweepResult]
) -> tuple[Array, list[dict[str, Any]]]:
    """The training samples (n, 1) and what each round found, as `adaptive_sampling.sample_adaptively` has it.

    Sampling ends when no middle misses the tolerance of the reduction, a norm over the body relative to the largest
    displacement, or at ``sampling.training`` samples.
    """
    weights = study.model_mesh().weights
    samples = even_samples(study, study.sampling.first)
    solved = sweep(samples).solved
    intervals = np.column_stack([samples[:-1], samples[1:]])
    rounds: list[dict[str, Any]] = []
    while len(intervals := intervals[: study.sampling.training - len(samples)]):
        line = _Line([load_snapshot(path) for _, path in sorted(solved.items())], weights)
        middles = intervals.mean(axis=1)
        samples = np.vstack([samples, middles[:, None]])
        solved = sweep(samples).solved
        new = range(len(samples) - len(middles), len(samples))
        # What cannot be solved is not looked at any closer.
        errors = np.array([line.error(load_snapshot(solved[index])) if index in solved else 0.0 for index in new])
        rounds.append({"solves": len(samples), "largest_estimate": float(errors.max())})
        # The worst first, in case samples run out.
        worst = [index for index in np.argsort(-errors, kind="stable") if errors[index] > study.reduction.tolerance]
        halves = np.column_stack([intervals[:, 0], middles, middles, intervals[:, 1]])[worst]
        intervals = halves.reshape(-1, 2)
    return samples, rounds


class _Line:
    """Displacements interpolated between snapshots of one parameter; ``weights`` (n,) are those of the nodes."""

    def __init__(self, snapshots: Sequence[Snapshot], weights: Array) -> None:
        points = np.array([snapshot.coordinates[0] for snapshot in snapshots])
        values = np.array([snapshot.fields["displacement"].ravel() for snapshot in snapshots], dtype=np.float64)
        slopes = [s.sensitivities["displacement"].ravel() for s in snapshots if "displacement" in s.sensitivities]
        self._weights = np.repeat(weights, 3)
        self._functions = interpolate_line(points, values, np.array(slopes, dtype=np.float64) if slopes else None)
        self._largest = max(self._norm(value) for value in values)

    def _norm(self, displacement: Array) -> float:
        return float(np.sqrt(displacement**2 @ self._weights))

    def error(self, snapshot: Snapshot) -> float:
        """Norm of the error at another snapshot, relative to the largest displacement."""
        predicted, _ = self._functions.evaluate(snapshot.coordinates)
        missed = self._norm(predicted - snapshot.fields["displacement"].ravel())
        return missed / self._largest if missed else 0.0
