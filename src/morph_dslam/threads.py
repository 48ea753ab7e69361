"""Threads: those of the linear algebra that numpy and scipy call, and work on the next frames beside this one."""

from __future__ import annotations

import gc
import os
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import cache, wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

import cv2
from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")
#: Frames that are made ready before they are asked for: one waits while the next is worked on.
N_AHEAD = 2


@cache
def _algebra() -> ThreadpoolController:
    """The libraries of numpy and scipy; to look for them takes milliseconds."""
    import scipy.linalg  # noqa: F401 - it has a library of its own

    return ThreadpoolController().select(user_api="blas")


def one_thread_for_algebra(function: Callable[P, R]) -> Callable[P, R]:
    """Let linear algebra run in the thread that asks for it, as long as the decorated function does.

    A tracked frame multiplies many small matrices; threads that share one of them mostly wait for each other,
    and take the cores from the threads that work on other frames, or from other programs. Beside a program that has one
    of two cores to itself, a frame took five times as long.
    """

    @wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        with _algebra().limit(limits=1):
            return function(*args, **kwargs)

    return alone


def one_openblas_thread() -> AbstractContextManager[object]:
    """Let OpenBLAS work in the thread that asks for it, from now on or, in a `with` statement, for its block.

    Threads that share small matrices gain little, and where another program has one of the cores they wait for each
    other: the reduction of a build then took 40 times as long. MKL, which factorises the large ones, keeps its threads.
    """
    return ThreadpoolController().select(internal_api="openblas").limit(limits=1)


#: Where Linux says what share of the processors a container may use: microseconds of work in so many, or "max".
_QUOTA = Path("/sys/fs/cgroup/cpu.max")


def usable_cores() -> int:
    """How many cores this process may use: a cluster's job or a container has often fewer than its machine.

    Threads beyond these wait for each other, and solves then take many times as long.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        work, period = _QUOTA.read_text(encoding="utf-8").split()
    except (OSError, ValueError):
        return cores
    return cores if work == "max" else max(1, min(cores, round(int(work) / int(period))))


def on_all_cores(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """What a function gives for each item, in their order, by as many threads as `usable_cores`.

    It saves time where most of the work is compiled code that needs no interpreter.
    """
    with ThreadPoolExecutor(usable_cores()) as threads:
        return list(threads.map(function, items))


# Threads that work on successive frames: what they need of the interpreter that they share.


def ahead(items: Iterator[R], number: int = N_AHEAD) -> Generator[R, None, None]:
    """The same items in the same order, made in another thread while the caller works on those before.

    What goes wrong in the other thread is raised where its item would come.

    Parameters
    ----------
    items : that take time to make.
    number : how many may be ready or under way before they are asked for.
    """
    end = object()
    with ThreadPoolExecutor(1, thread_name_prefix="ahead") as other:
        waiting = deque(other.submit(next, items, end) for _ in range(number))
        try:
            while (item := waiting.popleft().result()) is not end:
                waiting.append(other.submit(next, items, end))
                yield item  # type: ignore[misc]
        finally:
            other.shutdown(cancel_futures=True)


#: How long a thread may keep the interpreter while another waits for it, seconds. Tracking gives it up some
#: fifty times a frame, whenever compiled code runs, and may wait for so long each time: at the worst 5 ms of
#: the 33 that there are for a frame. With Python's own 5 ms it would be several frames. That the interpreter
#: changes hands so often costs no more processor time in `benchmarks/live.py` than with five times as long.
SWITCH_INTERVAL = 1e-4


@contextmanager
def threads_side_by_side() -> Iterator[None]:
    """Let the threads of this process take turns quickly, as long as they work on successive frames.

    OpenCV begins no threads of its own meanwhile. What exists already is left out when Python looks for
    garbage: over all that has been imported that takes tens of milliseconds, in which no thread goes on. A program that
    has left some out itself (`gc.freeze`) has chosen: nothing is added to that, and nothing taken back.
    """
    interval, threads, leaves_out = sys.getswitchinterval(), cv2.getNumThreads(), gc.get_freeze_count() == 0
    gc.collect()
    if leaves_out:
        gc.freeze()
    sys.setswitchinterval(SWITCH_INTERVAL)
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
        sys.setswitchinterval(interval)
        if leaves_out:
            gc.unfreeze()
