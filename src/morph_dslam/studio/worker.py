"""A process of its own that reads what users bring: a file that breaks a reader does not break the server."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import resource
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from morph_dslam.errors import MorphError, StudioError

#: A file that takes longer to read than this, seconds, is given up.
LONGEST = 300.0
#: Memory that the process may ask for, bytes.
MOST_MEMORY = 24 << 30


class Worker:
    """Calls functions in one other process, one after the other; a process that hangs or dies is replaced."""

    def __init__(self) -> None:
        self._executor: ProcessPoolExecutor | None = None
        self._processes: set[Any] = set()
        self._lock = asyncio.Lock()

    async def call(self, function: Callable, *arguments: Any, seconds: float = LONGEST) -> Any:
        """What a function returns.

        Parameters
        ----------
        function : of a module, with what can be pickled.
        arguments : of the function.
        seconds : after which it is given up.

        Raises
        ------
        StudioError
            If the function raises, takes too long, or ends the process.
        """
        async with self._lock:
            if self._executor is None:
                self._start()
            assert self._executor is not None
            try:
                future = asyncio.wrap_future(self._executor.submit(_guarded, function, arguments))
                return await asyncio.wait_for(future, seconds)
            except TimeoutError:
                self._end()
                raise StudioError(f"this took longer than {seconds:g} s and was given up; use a smaller file") from None
            except BrokenProcessPool:
                self._end()
                raise StudioError(
                    "the process that reads files ended: the file is damaged, or asks for too much memory"
                ) from None

    def _start(self) -> None:
        others, context = set(multiprocessing.active_children()), multiprocessing.get_context("spawn")
        self._executor = ProcessPoolExecutor(1, mp_context=context, initializer=_start_worker)
        self._executor.submit(int)  # the first task starts the process
        self._processes = set(multiprocessing.active_children()) - others

    def _end(self) -> None:
        executor, self._executor = self._executor, None
        if executor is not None:
            for process in self._processes:
                process.kill()
            executor.shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        """End the process."""
        self._end()


def _end_with_parent() -> None:
    """End this process as soon as the one that started it has ended, however that was."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


def _start_worker() -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    # Readers of meshes print remarks of their own: messages come as errors, all else is for nobody.
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)


def _guarded(function: Callable, arguments: tuple) -> Any:
    """Call a function; whatever goes wrong in it is one message."""
    try:
        return function(*arguments)
    except MorphError as error:
        raise StudioError(str(error)) from None
    except (Exception, RecursionError) as error:
        raise StudioError(f"this cannot be read ({type(error).__name__}: {str(error)[:200]})") from None
