"""The sweep: every sample solved once, each from its nearest solved neighbour, on any Executor.

Which sample starts from which depends on the samples alone, never on the number of workers, their timing, or
what an earlier build had solved when it was stopped: the numbers are the same every time.
"""

from __future__ import annotations

import fcntl
import hashlib
import sys
from collections.abc import Collection, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.errors import StudyError
from morph_dslam.io.writing import writing
from morph_dslam.studies.executors import slots
from morph_dslam.studies.problem import ParametricStudy
from morph_dslam.studies.sample_task import SampleResult, solve_sample
from morph_dslam.studies.snapshots import PARTIAL, SOLVER_VERSION, damage, load_state, snapshot_keys, write_atomically

Array = NDArray[np.float64]
#: A sample is given up after so many attempts from different neighbours.
MOST_ATTEMPTS = 2
FIRST_FAILURE = (
    "note: a sample was not solved at the first attempt: {}. It is tried again from another one. There is no model "
    "if fewer than half of the samples can be solved. {}"
)
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
    samples : (n, d).
    scale : (d,) lengths in which steps are measured.
    root : (d,).
    solved, failed : samples that may be started from already, and samples that nothing is to start from.

    Returns
    -------
    order : the unsolved samples.
    parent : for every sample, another one or -1 for the root state.
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


class _FailedAttempts:
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
        return file.read_text(encoding="utf-8", errors="replace") if file.is_file() else None

    def record(self, origin: int, sample: int, reason: str) -> None:
        """Keep the reason of an attempt that failed."""
        write_atomically(self._file(origin, sample), reason.encode())


@dataclass
class SweepResult:
    """Which samples were solved (paths by sample index) and why others were not."""

    solved: dict[int, Path] = field(default_factory=dict)
    failed: dict[int, str] = field(default_factory=dict)


def run_sweep(study: ParametricStudy, samples: Array, folder: str | Path, executor: Executor) -> SweepResult:
    """Solve all ``samples`` (n, d), canonical, keeping each as soon as it is solved.

    Samples found in ``folder`` are not solved again, so that a caller can come back with more of them; a
    damaged file is named and its sample solved anew. Each starts from its nearest neighbour in a tree; what
    lies behind a sample that did not converge is tried in the next pass from other neighbours, and so is the
    sample itself, once.

    Raises
    ------
    StudyError
        If not even half of the samples converge, another build is at work in ``folder``, or it cannot be written to.
    WorkerError
        If the executor's workers are lost or do not fit.
    """
    folder = Path(folder)
    with writing(StudyError, folder):
        folder.mkdir(parents=True, exist_ok=True)
    fingerprint = study.fingerprint()
    keys = snapshot_keys(fingerprint, samples)
    paths = [folder / f"{key}.npz" for key in keys]
    damaged = {path: reason for path in paths if path.is_file() and (reason := damage(path))}
    found = {number for number, path in enumerate(paths) if path.is_file() and path not in damaged}
    with (
        _alone(folder) if len(found) < len(samples) else nullcontext(),
        tqdm(total=len(samples), initial=len(found), desc="solving", unit="sample", smoothing=0.05) as progress,
    ):
        for path, reason in damaged.items():
            progress.write(f"{path} is damaged ({reason}): that sample is solved again", sys.stderr)
        attempts = _FailedAttempts(folder, keys)
        sweep = _Sweep(study, fingerprint, samples, paths, found, attempts, executor, progress)
        result = sweep.run()
    _check_reach(study, samples, result, folder)
    return result


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """No other sweep writes to this folder; what one that was killed left unfinished is removed."""
    with writing(StudyError):
        opened = (folder / ".lock").open("w", encoding="utf-8")
    with opened as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StudyError(
                f"another build is solving in {folder}: wait for it, or give this one another output"
            ) from error
        try:
            for partial in folder.glob(f"*{PARTIAL}"):
                partial.unlink()
            yield
        finally:  # workers forked meanwhile hold the file open too, which would keep it locked
            fcntl.flock(lock, fcntl.LOCK_UN)


class _Sweep:
    """One call of `run_sweep`.

    Parameters
    ----------
    paths : of the samples' files.
    found : samples whose files are there already.
    attempts : those that failed, in this sweep and in earlier ones.
    """

    def __init__(
        self,
        study: ParametricStudy,
        fingerprint: str,
        samples: Array,
        paths: list[Path],
        found: set[int],
        attempts: _FailedAttempts,
        executor: Executor,
        progress: tqdm,
    ) -> None:
        self.study, self.fingerprint, self.samples = study, fingerprint, samples
        self.paths, self.found, self.attempts = paths, found, attempts
        self.executor, self.progress = executor, progress
        self.result = SweepResult()
        self.tried: dict[int, list[int]] = {}
        self.told = False

    def run(self) -> SweepResult:
        """Pass after pass, until all samples are solved or tried often enough."""
        result, count = self.result, len(self.samples)
        while len(result.solved) < count:
            children = self._tree()
            if not children.keys() & {-1, *result.solved}:
                break
            self._walk(children)
        for sample in set(range(count)) - set(result.solved) - set(result.failed):
            result.failed[sample] = "not reached: no neighbour of it could be solved"
        return result

    def _tree(self) -> dict[int, list[int]]:
        """By sample (-1 for the root), the samples that are to start from it next."""
        order, parent = neighbour_tree(
            self.samples, self.study.scale(), self.study.root(), self.result.solved, self.result.failed
        )
        children: dict[int, list[int]] = {}
        for sample in order:
            starts = self.tried.get(sample, [])
            if parent[sample] not in starts and len(starts) < MOST_ATTEMPTS:
                children.setdefault(parent[sample], []).append(sample)
        return children

    def _walk(self, children: dict[int, list[int]]) -> None:
        """Walk a tree of samples from the solved ones outwards; branches behind a failure are left."""
        # The last one in is the next one out: a worker then mostly goes on from what it has just solved.
        waiting = _attempts_from(children, [-1, *sorted(self.result.solved)])
        running: dict[Future[SampleResult], tuple[int, int]] = {}
        try:
            while waiting or running:
                while waiting and len(running) < slots(self.executor):
                    origin, sample = waiting.pop()
                    self.tried.setdefault(sample, []).append(origin)
                    if sample in self.found:
                        self.result.solved[sample] = self.paths[sample]
                        waiting += _attempts_from(children, [sample])
                    elif reason := self.attempts.reason(origin, sample):
                        self._note_failure(sample, reason)
                    else:
                        running[self._submit(origin, sample)] = origin, sample
                for future in wait(running, return_when=FIRST_COMPLETED).done if running else ():
                    origin, sample = running.pop(future)
                    if self._keep(origin, sample, future.result()):
                        waiting += _attempts_from(children, [sample])
        except BaseException:
            self._keep_finished(running)
            raise

    def _submit(self, origin: int, sample: int) -> Future[SampleResult]:
        start = load_state(self.paths[origin]) if origin >= 0 else None
        return self.executor.submit(solve_sample, self.study, self.fingerprint, self.samples[sample], start)

    def _keep(self, origin: int, sample: int, outcome: SampleResult) -> bool:
        """Write what a worker sent; whether that is a solution."""
        if outcome.snapshot is None:
            self._tell_first(outcome.reason)
            self.attempts.record(origin, sample, outcome.reason)
            self._note_failure(sample, outcome.reason)
            return False
        write_atomically(self.paths[sample], outcome.snapshot)
        self.result.solved[sample] = self.paths[sample]
        self.result.failed.pop(sample, None)
        self.progress.update()
        return True

    def _tell_first(self, reason: str) -> None:
        """Say why an attempt failed, the first of this sweep: solving goes on, and may take long to no avail."""
        if not self.told:
            self.progress.write(FIRST_FAILURE.format(reason, self.study.advice), sys.stderr)
        self.told = True

    def _note_failure(self, sample: int, reason: str) -> None:
        self.result.failed[sample] = reason
        self.progress.set_postfix(failed=len(self.result.failed))

    def _keep_finished(self, running: dict[Future[SampleResult], tuple[int, int]]) -> None:
        """On an interruption, keep what has come back already."""
        for future, (origin, sample) in running.items():
            if future.done() and not future.cancelled() and future.exception() is None:
                self._keep(origin, sample, future.result())


def _attempts_from(children: dict[int, list[int]], origins: list[int]) -> list[tuple[int, int]]:
    """Pairs of a start and a sample, the last of which is to be tried first."""
    return [(origin, sample) for origin in reversed(origins) for sample in reversed(children.get(origin, []))]


def _check_reach(study: ParametricStudy, samples: Array, result: SweepResult, folder: Path) -> None:
    """Refuse a box of which too much could not be solved."""
    if len(result.solved) < 0.5 * len(samples):
        first = next(iter(result.failed.values()))
        raise StudyError(
            f"only {len(result.solved)} of {len(samples)} samples could be solved; the first failure: "
            f"{first}. The solved ones are kept in {folder}. {study.advice}"
        )
    if samples.shape[1] == 1 and result.failed:
        parameter, solved = study.model_parameters()[0], samples[list(result.solved), 0]
        beyond = [i for i in result.failed if not solved.min() < samples[i, 0] < solved.max()]
        if beyond:
            within = solved.min() <= study.root()[0] <= solved.max()
            reached = [parameter.display(value) for value in (solved.min(), solved.max())]
            raise StudyError(
                f"{parameter.name} could only be followed from {reached[0]:.4g} to {reached[1]:.4g} "
                f"{parameter.unit}: {result.failed[beyond[0]]}. The solutions up to there are kept in "
                f"{folder}; with that range{'' if within else ' and a default in it'} the same command goes on from "
                f"them. {study.advice}"
            )
