"""Where a sweep's samples are solved: in this process, or in worker processes of this machine.

An executor's ``slots`` is how many samples may be on their way at once, so that no more starts wait in memory
than keep the workers busy.
"""

from __future__ import annotations

import fcntl
import logging
import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.errors import StudyError, WorkerError
from morph_dslam.studies.problem import ParametricStudy
from morph_dslam.studies.sample_task import FailedAttempts, SampleResult, forget_problem, neighbour_tree, solve_sample
from morph_dslam.studies.snapshots import PARTIAL, damage, load_state, snapshot_keys, write_atomically

if TYPE_CHECKING:
    from distributed import Client


#: Of executors that do not say.
DEFAULT_SLOTS = 16


def slots(executor: Executor) -> int:
    """How many samples may be on their way at once."""
    return getattr(executor, "slots", DEFAULT_SLOTS)


class SerialExecutor(Executor):
    """Runs each task here, when it is submitted: no second process, so the least memory."""

    slots = 1

    def submit(self, fn, /, *args, **kwargs) -> Future:
        future: Future = Future()
        future.set_result(fn(*args, **kwargs))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Give back the memory of the problem."""
        forget_problem()


class WorkerProcesses(ProcessPoolExecutor):
    """Processes that leave Ctrl-C to the main process and end when it does, however that ends."""

    def __init__(self, count: int) -> None:
        context = multiprocessing.get_context("spawn")
        super().__init__(count, mp_context=context, initializer=_start_worker)
        self.slots = 2 * count
        self._others = set(multiprocessing.active_children())

    def end_now(self) -> None:
        """Stop the workers where they are; what they were solving is lost.

        A worker may be stopped half-way through sending a result. The thread that receives it would wait for
        the rest for ever, and the interpreter for the thread, as long as this process has the sending end of
        that pipe open too.
        """
        results = self._result_queue
        self.shutdown(wait=False, cancel_futures=True)
        for worker in set(multiprocessing.active_children()) - self._others:
            worker.terminate()
        if results is not None:  # None once it was shut down
            results._writer.close()  # pyright: ignore[reportAttributeAccessIssue]


def _start_worker() -> None:
    warnings.filterwarnings("ignore", message=".* nearly incompressible")  # said once, by the build
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A main process that is killed cannot end its workers: each watches it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait_for([parent.sentinel])
        os._exit(1)


@contextmanager
def default_executor(workers: int | None) -> Iterator[Executor]:
    """Worker processes, one a core unless ``workers`` says otherwise; ended at once on an interruption.

    A single worker is this process itself.

    Raises
    ------
    WorkerError
        If a worker process died.
    """
    if workers == 1:
        with SerialExecutor() as executor:
            yield executor
        return
    executor = WorkerProcesses(workers or os.cpu_count() or 1)
    try:
        yield executor
    except BaseException as error:
        executor.end_now()
        if isinstance(error, BrokenProcessPool):
            raise WorkerError(
                "a worker process died, most likely for want of memory; take fewer with --workers. What was "
                "solved is kept, and the same command goes on from there"
            ) from error
        raise
    executor.shutdown()


# A Dask cluster to solve on, by the address of its scheduler.
# Starts are sent to its workers and snapshots come back, so they need no folder in common with the build. A
# worker that is lost is no harm: the scheduler gives its samples to others.


#: Seconds to wait for a scheduler to answer.
PATIENCE = 10.0

#: What must be of one version here and on the workers, by the name that Python imports.
PACKAGES = ("morph_dslam", "ngsolve", "numpy", "scipy", "dask", "distributed")


class ClusterExecutor(Executor):
    """A Dask client as an Executor that says how much it can have on its way."""

    def __init__(self, client: Client) -> None:
        self._client, self._executor = client, client.get_executor(pure=False)

    @property
    def slots(self) -> int:
        """Twice as many as the workers' threads now; workers may come and go."""
        try:
            threads: dict[str, int] = self._client.nthreads()  # type: ignore[assignment]
        except OSError as error:  # a time-out too
            raise ConnectionResetError(str(error)) from error
        return 2 * max(1, sum(threads.values()))

    def submit(self, fn, /, *args, **kwargs) -> Future:
        return self._executor.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for what is on its way, or cancel it."""
        self._executor.shutdown(wait=wait and not cancel_futures)


@contextmanager
def cluster_executor(address: str) -> Iterator[ClusterExecutor]:
    """The cluster whose scheduler listens at ``address``, "tcp://host:8786" say.

    Raises
    ------
    WorkerError
        If dask.distributed is not installed, the scheduler does not answer, no worker is there, a version
        differs, or the cluster is lost while it works.
    """
    try:
        import dask.config
        from distributed import Client, KilledWorker
        from distributed.comm.core import CommClosedError
    except ImportError as error:
        raise WorkerError("--scheduler needs dask.distributed: pip install 'morph-dslam[dask]'") from error
    with (
        # A start is an argument as large as a solution, which is no mistake here.
        dask.config.set({"distributed.admin.large-graph-warning-threshold": "1TiB"}),
        _quiet_client(),
        _connected(Client, address) as client,
    ):
        _check_workers(client, address)
        executor = ClusterExecutor(client)
        try:
            yield executor
        except KilledWorker as error:
            raise WorkerError(
                f"{error}. Most likely the workers want memory: start fewer on each machine. What was solved "
                "is kept, and the same command goes on from there"
            ) from error
        except (CancelledError, CommClosedError, ConnectionResetError) as error:
            raise WorkerError(
                f"the connection to the scheduler at {address} was lost. What was solved is kept: start the "
                "scheduler again, and the same command goes on from there"
            ) from error
        finally:
            executor.shutdown(wait=False)


@contextmanager
def _quiet_client() -> Iterator[None]:
    """The client logs a traceback when it loses its scheduler, which is reported in one message here."""
    logger = logging.getLogger("distributed.client")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


@contextmanager
def _connected(client_type: type[Client], address: str) -> Iterator[Client]:
    """A client of the scheduler; versions are compared by `_check_workers`, so dask need not warn of them."""
    from distributed.comm.addressing import get_address_host
    from distributed.versions import VersionMismatchWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", VersionMismatchWarning)
        try:
            get_address_host(address)  # a client that cannot be made for it would not be closed cleanly
            client = client_type(address, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise WorkerError(
                f"no Dask scheduler answers at {address} ({_first_line(error)}): start one with "
                "`dask scheduler`, which prints its address, and workers with `dask worker ADDRESS`"
            ) from error
    with client:
        yield client


def _first_line(error: BaseException) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]


def _check_workers(client: Client, address: str) -> None:
    """Refuse a cluster without workers, and one whose programs differ from this one."""
    if not client.nthreads():
        raise WorkerError(
            f"the scheduler at {address} has no workers: start some with `dask worker {address} --nthreads 1`"
        )
    found: Any = client.get_versions(packages=list(PACKAGES))
    here = _versions(found["client"])
    for worker, content in found["workers"].items():
        there = _versions(content)
        wrong = [
            f"{name} {there.get(name) or 'missing'} (here {version})"
            for name, version in here.items()
            if there.get(name) != version
        ]
        if wrong:
            raise WorkerError(
                f"the worker {worker} does not fit this program: {', '.join(wrong)}; install the same "
                "versions on every machine"
            )


def _versions(content: dict[str, Any]) -> dict[str, str | None]:
    """Versions by package, of the report that a client or worker gives of itself."""
    python = ".".join(content["host"]["python"].split(".")[:2])
    return {"python": python} | {name: content["packages"].get(name) for name in PACKAGES}


# The sweep: every sample solved once, each from its nearest solved neighbour, on any Executor.
# Which sample starts from which depends on the samples alone, never on the number of workers, their timing,
# or what an earlier build had solved when it was stopped: the numbers are the same every time.


Array = NDArray[np.float64]

#: A sample is given up after so many attempts from different neighbours.
MOST_ATTEMPTS = 2


@dataclass
class SweepResult:
    """Which samples were solved (paths by sample index) and why others were not."""

    solved: dict[int, Path] = field(default_factory=dict)
    failed: dict[int, str] = field(default_factory=dict)


def run_sweep(study: ParametricStudy, samples: Array, folder: Path, executor: Executor) -> SweepResult:
    """Solve all ``samples`` (n, d), canonical, keeping each as soon as it is solved.

    Samples found in ``folder`` are not solved again, so that a caller can come back with more of them; a
    damaged file is named and its sample solved anew. Each starts from its nearest neighbour in a tree; what
    lies behind a sample that did not converge is tried in the next pass from other neighbours, and so is the
    sample itself, once.

    Raises
    ------
    StudyError
        If not even half of the samples converge, or another build is at work in ``folder``.
    WorkerError
        If the executor's workers are lost or do not fit.
    """
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
        attempts = FailedAttempts(folder, keys)
        sweep = _Sweep(study, fingerprint, samples, paths, found, attempts, executor, progress)
        result = sweep.run()
    _check_reach(study, samples, result, folder)
    return result


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """No other sweep writes to this folder; what one that was killed left unfinished is removed."""
    with (folder / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StudyError(
                f"another build is solving in {folder}: wait for it, or give this one another output"
            ) from error
        for partial in folder.glob(f"*{PARTIAL}"):
            partial.unlink()
        yield


class _Sweep:
    """One call of `run_sweep`.

    Parameters
    ----------
    paths : of the samples' files. found : samples whose files are there already.
    attempts : those that failed, in this sweep and in earlier ones.
    """

    def __init__(
        self,
        study: ParametricStudy,
        fingerprint: str,
        samples: Array,
        paths: list[Path],
        found: set[int],
        attempts: FailedAttempts,
        executor: Executor,
        progress: tqdm,
    ) -> None:
        self.study, self.fingerprint, self.samples = study, fingerprint, samples
        self.paths, self.found, self.attempts = paths, found, attempts
        self.executor, self.progress = executor, progress
        self.result = SweepResult()
        self.tried: dict[int, list[int]] = {}

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
            self.attempts.record(origin, sample, outcome.reason)
            self._note_failure(sample, outcome.reason)
            return False
        write_atomically(self.paths[sample], outcome.snapshot)
        self.result.solved[sample] = self.paths[sample]
        self.result.failed.pop(sample, None)
        self.progress.update()
        return True

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
            reached = [parameter.display(value) for value in (solved.min(), solved.max())]
            raise StudyError(
                f"{parameter.name} could only be followed from {reached[0]:.4g} to {reached[1]:.4g} "
                f"{parameter.unit}: {result.failed[beyond[0]]}. The solutions up to there are kept in "
                f"{folder}; with that range the same command goes on from them. {study.advice}"
            )
