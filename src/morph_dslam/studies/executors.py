"""Where a sweep's samples are solved: in this process, in worker processes of this machine, or on a Dask cluster.

An executor's ``slots`` is how many samples may be on their way at once, so that no more starts wait in memory
than keep the workers busy.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import wait as wait_for
from typing import TYPE_CHECKING, Any

from morph_dslam.errors import WorkerError
from morph_dslam.studies.sample_task import forget_problem

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


class _WorkerProcesses(ProcessPoolExecutor):
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
    """
    if workers == 1:
        with SerialExecutor() as executor:
            yield executor
        return
    executor = _WorkerProcesses(workers or os.cpu_count() or 1)
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
            reason = (str(error) or type(error).__name__).splitlines()[0]
            raise WorkerError(
                f"no Dask scheduler answers at {address} ({reason}): start one with "
                "`dask scheduler`, which prints its address, and workers with `dask worker ADDRESS`"
            ) from error
    with client:
        yield client


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
