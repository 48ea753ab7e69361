"""One sample of a sweep, as a worker solves it: all it needs comes with the call, its result goes back.

Nothing is read from or written to a folder here, so workers on other machines need none in common.
"""

from __future__ import annotations

import gc
import threading
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError, WorkerError
from morph_dslam.studies.problem import ParametricStudy, SweepProblem
from morph_dslam.studies.snapshots import encode_snapshot
from morph_dslam.threads import usable_cores

Array = NDArray[np.float64]
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
    keep_threads(study)
    return study.sweep_problem()


def keep_threads(study: ParametricStudy) -> None:
    """Assemble in as many threads as the study has, from now on and in this process."""
    import ngsolve

    ngsolve.SetNumThreads(study.work.threads or usable_cores())


def forget_problem() -> None:
    """Give back the memory of the problem."""
    _problem.cache_clear()
    gc.collect()  # a problem and its linear solver refer to each other
