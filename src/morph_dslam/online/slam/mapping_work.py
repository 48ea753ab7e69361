"""The mapper's work as steps, between which tracking goes on.

Work is a generator that pauses where what follows can wait for another frame. In step with the frames each
step changes the map itself, one step a frame, so that the same frames give the same map. Beside them, a
thread does each step on a copy of the map, which replaces the map when the step has ended: frames wait for
none.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor

Work = Generator[None, None, None]

#: By how much the thread's priority is lower, in steps of `nice`: with this it still gets a third of what
#: another program gets. With far less it would be stopped for long while it holds the interpreter.
STANDS_BACK = 5


def do_all(work: Work) -> None:
    """Do work from its beginning to its end."""
    for _ in work:
        pass


def one_step(do: Callable[[], None]) -> Work:
    """Work without a pause."""
    do()
    yield from ()


def _stand_back() -> None:
    """Let this thread run behind the one that tracks, where both want the same processor.

    Where other programs run too, frames would else wait for whole slices of the scheduler, some milliseconds
    each. On Linux each thread has a priority of its own.
    """
    if sys.platform == "linux":
        own = os.getpriority(os.PRIO_PROCESS, 0)
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), own + STANDS_BACK)


class MappingWork:
    """Work under way, at most one at a time.

    Parameters
    ----------
    threaded : whether steps are done in a thread beside the frames.
    before : done there before each step. after : done after each, by who goes on with the work.
    """

    def __init__(
        self,
        threaded: bool,
        before: Callable[[], None] = lambda: None,
        after: Callable[[], None] = lambda: None,
    ) -> None:
        self._work: Work | None = None
        self._running: Future[bool] | None = None
        self._before, self._after = before, after
        self._thread = ThreadPoolExecutor(1, "mapper", _stand_back) if threaded else None

    @property
    def is_idle(self) -> bool:
        """Whether nothing is under way."""
        return self._work is None

    @property
    def is_running(self) -> bool:
        """Whether a step is being done in the thread."""
        return self._running is not None and not self._running.done()

    def begin(self, work: Work) -> None:
        """Begin new work: do its first step, or have it done."""
        self._work = work
        self._next_step()

    def advance(self) -> None:
        """Go on with the next step; do nothing while one is running in the thread."""
        if self._running is None:
            self._next_step()
        elif self._running.done():
            self._end_step(self._running.result())
            self._next_step()

    def finish(self) -> None:
        """Do all that is left now."""
        while self._work is not None:
            if self._running is not None:
                self._end_step(self._running.result())
            self._next_step()

    def drop(self) -> None:
        """Leave what is under way; the map is as its last step left it."""
        self._work, self._running = None, None

    def _next_step(self) -> None:
        if self._work is None:
            return
        if self._thread is None:
            self._end_step(self._step(self._work))
        else:
            self._running = self._thread.submit(self._step, self._work)

    def _step(self, work: Work) -> bool:
        """Do work up to its next pause; whether that was its end."""
        self._before()
        return next(work, _END) is _END

    def _end_step(self, is_end: bool) -> None:
        self._running = None
        if is_end:
            self._work = None
        self._after()


_END = object()
