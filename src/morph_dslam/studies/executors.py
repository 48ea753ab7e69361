"""Where a sweep's samples are solved: in this process, in worker processes, or on any other executor.

An executor's ``slots`` is how many samples may be on their way at once, so that no more starts wait in memory
than keep the workers busy.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import wait as wait_for

from morph_dslam.errors import WorkerError
from morph_dslam.studies.sample_task import forget_problem

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
    from morph_dslam.mechanics.solid_materials import NearlyIncompressibleWarning

    warnings.simplefilter("ignore", NearlyIncompressibleWarning)  # said once, by the build
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
