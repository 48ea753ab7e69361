"""Where a sweep's samples are solved: in this process, in worker processes, or on any other executor.

An executor's ``slots`` is how many samples may be on their way at once, so that no more starts wait in memory
than keep the workers busy.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import wait as wait_for
from multiprocessing.context import SpawnContext, SpawnProcess
from types import ModuleType
from typing import Any

from morph_dslam.errors import WorkerError
from morph_dslam.studies.sample_task import forget_problem
from morph_dslam.threads import one_openblas_thread, usable_cores

#: Of executors that do not say.
DEFAULT_SLOTS = 16
NOT_STARTED = (
    "no worker process could start. Each runs the main program's file first: in a script, call what takes workers "
    'under `if __name__ == "__main__":`, or take one process with workers=1 (`--workers 1`)'
)
DIED = (
    "a worker process died, most likely for want of memory; take fewer with workers=N (`--workers N`). What was solved "
    "is kept, and the same build goes on from there"
)


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


class _BareProcess(SpawnProcess):
    """A process that does not run the main program's file: a script needs no main guard then."""

    def start(self) -> None:
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")  # without a file, there is none to run
        try:
            super().start()
        finally:
            sys.modules["__main__"] = main


class _BareContext(SpawnContext):
    Process = _BareProcess


class _WorkerProcesses(ProcessPoolExecutor):
    """Processes that leave Ctrl-C to the main process and end when it does, however that ends."""

    def __init__(self, count: int, runs_main: bool) -> None:
        context = multiprocessing.get_context("spawn") if runs_main else _BareContext()
        self._started = context.RawValue("b", 0)  # without a lock, which a worker that is killed could hold
        laws = _laws()
        laws = {} if _sent(laws) is None else laws
        super().__init__(count, mp_context=context, initializer=_start_worker, initargs=(self._started, laws))
        self.slots = 2 * count
        self._others = set(multiprocessing.active_children())

    @property
    def has_started(self) -> bool:
        """Whether a worker has got as far as its first task."""
        return bool(self._started.value)

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


def _start_worker(started: Any, laws: dict[str, Any]) -> None:
    from morph_dslam.mechanics.materials.base import register_law, registered_laws
    from morph_dslam.mechanics.solid_materials import NearlyIncompressibleWarning

    for name in laws.keys() - registered_laws().keys():  # importing a law's module has registered it, as a rule
        register_law(name)(laws[name])
    started.value = 1
    one_openblas_thread()
    warnings.simplefilter("ignore", NearlyIncompressibleWarning)  # said once, by the build
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A main process that is killed cannot end its workers: each watches it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait_for([parent.sentinel])
        os._exit(1)


def _laws() -> dict[str, Any]:
    """The laws that studies may name beside those of this package."""
    from morph_dslam.mechanics.materials.base import registered_laws

    laws = registered_laws()
    return {name: law for name, law in laws.items() if not law.__module__.startswith("morph_dslam.")}


def _sent(item: object) -> bytes | None:
    """What is sent to a worker for it; None if it cannot be."""
    try:
        return pickle.dumps(item)
    except (pickle.PicklingError, AttributeError, TypeError):
        return None


def needs_main(study: object) -> bool:
    """Whether workers must run the main program's file: it defines what a study or a law is made of."""
    sent = _sent((study, _laws()))
    return sent is None or b"__main__" in sent


@contextmanager
def default_executor(workers: int | None, runs_main: bool = True) -> Iterator[Executor]:
    """Worker processes, one a core unless ``workers`` says otherwise; ended at once on an interruption.

    A single worker is this process itself.

    Parameters
    ----------
    workers : number of processes.
    runs_main : whether workers run the main program's file, for the functions and classes that it defines. It starts
        what takes workers under ``if __name__ == "__main__":`` then, or each worker would start it again.
    """
    if workers == 1:
        with SerialExecutor() as executor:
            yield executor
        return
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(1)  # a worker that runs a script without a main guard: the main process says so
    executor = _WorkerProcesses(workers or usable_cores(), runs_main)
    try:
        yield executor
    except BaseException as error:
        executor.end_now()
        if isinstance(error, BrokenProcessPool):
            raise WorkerError(DIED if executor.has_started or not runs_main else NOT_STARTED) from error
        raise
    executor.shutdown()
