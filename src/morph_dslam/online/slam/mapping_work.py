"""The mapper's work as steps, between which tracking goes on.

Work is a generator. It changes the map only between its yields. It yields jobs that leave the map as it is,
and is sent what they return; or None where what follows can wait for another frame. In step with the frames a
job is done at once, so that the same frames give the same map. Beside them, a thread does the jobs and work
goes on in the first frame after a job's end: frames never wait for it.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

Work = Generator[Callable[[], Any] | None, Any, None]


def do_all(work: Work) -> None:
    """Do work from its beginning to its end."""
    result = None
    while True:
        try:
            job = work.send(result)
        except StopIteration:
            return
        result = job() if job is not None else None


class MappingWork:
    """Work under way, at most one at a time.

    Parameters
    ----------
    threaded : whether jobs are done in a thread beside the frames.
    """

    def __init__(self, threaded: bool) -> None:
        self._work: Work | None = None
        self._running: Future | None = None
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="mapper") if threaded else None

    @property
    def is_idle(self) -> bool:
        """Whether nothing is under way."""
        return self._work is None

    def begin(self, work: Work) -> None:
        """Begin new work, up to its first pause."""
        self._work = work
        self._go_on(None)

    def advance(self) -> None:
        """Go on to the next pause; do nothing while a job is running in the thread."""
        if self._running is None:
            self._go_on(None)
        elif self._running.done():
            self._go_on(self._running.result())

    def finish(self) -> None:
        """Do all that is left now."""
        while self._work is not None:
            self._go_on(self._running.result() if self._running is not None else None)

    def drop(self) -> None:
        """Leave what is under way; the map is as its last step left it."""
        self._work, self._running = None, None

    def _go_on(self, result: Any) -> None:
        while self._work is not None:
            self._running = None
            try:
                job = self._work.send(result)
            except StopIteration:
                self._work = None
                return
            if job is None:
                return
            if self._thread is not None:
                self._running = self._thread.submit(job)
                return
            result = job()
