"""The tree along which a sweep goes from sample to sample, outwards from the root in short steps."""

from __future__ import annotations

import gc
import hashlib
import os
import threading
from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError, WorkerError
from morph_dslam.studies.problem import ParametricStudy, SweepProblem
from morph_dslam.studies.snapshots import SOLVER_VERSION, encode_snapshot, write_atomically

Array = NDArray[np.float64]

#: Steps and paths that differ by less, relatively, are equally long: rounding decides nothing.
TIE = 1e-9


def neighbour_tree(
    samples: Array, scale: Array, root: Array, solved: Collection[int] = (), failed: Collection[int] = ()
) -> tuple[list[int], list[int]]:
    """Prim's order of the samples that are not solved yet, and the neighbour that each starts from.

    The tree is as short as can be. Among equally short steps, as a grid has, the one is taken whose path from
    the root is shortest: every path of a grid then leads outwards from the defaults and never back, so that
    loads only grow along it and branches can be walked in parallel.

    Parameters
    ----------
    samples : (n, d). scale : (d,) lengths in which steps are measured. root : (d,).
    solved, failed : samples that may be started from already, and samples that nothing is to start from.

    Returns
    -------
    order : the unsolved samples. parent : for every sample, another one or -1 for the root state.
    """
    points = samples / scale
    distance = np.linalg.norm(points - root / scale, axis=1)
    path = distance.copy()
    parent = np.full(len(points), -1)
    waiting = np.ones(len(points), dtype=bool)
    known = sorted(solved)
    order: list[int] = []
    for step in range(len(points)):
        nearest = known[step] if step < len(known) else _next(waiting, distance, path)
        if step >= len(known):
            order.append(nearest)
        waiting[nearest] = False
        if nearest in failed:
            continue
        to_new = np.linalg.norm(points - points[nearest], axis=1)
        through_new = path[nearest] + to_new
        as_close = (to_new <= distance * (1.0 + TIE)) & (through_new < path * (1.0 - TIE))
        closer = waiting & ((to_new < distance * (1.0 - TIE)) | as_close)
        distance[closer], path[closer], parent[closer] = to_new[closer], through_new[closer], nearest
    return order, parent.tolist()


def _next(waiting: NDArray[np.bool_], distance: Array, path: Array) -> int:
    """The waiting sample of the shortest step and, among equals, of the shortest path."""
    left = np.flatnonzero(waiting)
    equals = left[distance[left] <= distance[left].min() * (1.0 + TIE)]
    shortest = path[equals].min()
    return int(equals[np.argmax(path[equals] <= shortest * (1.0 + TIE))])


# Attempts that did not converge, kept on disk, so that a build that comes back does not repeat them.


class FailedAttempts:
    """Small text files beside the snapshots, one for each attempt, that hold the reason.

    Parameters
    ----------
    keys : of the samples, by index (`morph_dslam.studies.snapshots.snapshot_keys`).
    """

    def __init__(self, folder: Path, keys: list[str]) -> None:
        self._folder, self._keys = folder, keys
        self._code = f"solver version {SOLVER_VERSION}"

    def _file(self, origin: int, sample: int) -> Path:
        start = self._keys[origin] if origin >= 0 else "root"
        name = hashlib.sha256(f"{self._code} {start} {self._keys[sample]}".encode()).hexdigest()[:24]
        return self._folder / f"{name}.failed"

    def reason(self, origin: int, sample: int) -> str | None:
        """Why ``sample`` could not be solved from ``origin`` (-1 for the root); None if never tried."""
        file = self._file(origin, sample)
        return file.read_text(errors="replace") if file.is_file() else None

    def record(self, origin: int, sample: int, reason: str) -> None:
        """Keep the reason of an attempt that failed."""
        write_atomically(self._file(origin, sample), reason.encode())


# One sample of a sweep, as a worker solves it: all it needs comes with the call, its result goes back.
# Nothing is read from or written to a folder here, so workers on other machines need none in common.


#: A problem holds one state at a time; a worker of several threads solves one sample after the other.
_one_at_a_time = threading.Lock()


@dataclass(frozen=True)
class SampleResult:
    """Content of the snapshot's file, or why there is none."""

    snapshot: bytes | None
    reason: str = ""


def solve_sample(
    study: ParametricStudy, fingerprint: str, coordinates: Array, start: dict[str, Array] | None
) -> SampleResult:
    """Solve at ``coordinates`` (d,) from the packed state of a neighbour, or from the first state.

    Parameters
    ----------
    fingerprint : of the study where the sweep was started.

    Raises
    ------
    WorkerError
        If this worker's program, or the files that the study names, are not those of the sweep.
    """
    with _one_at_a_time:
        problem = _problem(study, fingerprint)
        try:
            state = problem.unpack(start) if start is not None else problem.first_state()
            state = problem.advance(state, coordinates)
        except SolverError as error:
            return SampleResult(None, str(error))
        return SampleResult(encode_snapshot(problem.take_snapshot(state), problem.pack(state)))


@lru_cache(maxsize=1)
def _problem(study: ParametricStudy, fingerprint: str) -> SweepProblem:
    """The problem of this worker, made once."""
    if study.fingerprint() != fingerprint:
        raise WorkerError(
            "a worker has another release of morph-dslam, or other files under the names in the study, than "
            "the build: give all of them the same, or start the build again if either was changed meanwhile"
        )
    import ngsolve

    ngsolve.SetNumThreads(study.work.threads or os.cpu_count() or 1)
    return study.sweep_problem()


def forget_problem() -> None:
    """Give back the memory of the problem."""
    _problem.cache_clear()
    gc.collect()  # a problem and its linear solver refer to each other
