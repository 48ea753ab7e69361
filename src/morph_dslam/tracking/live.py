"""Items of a live stream through several steps, each in a thread of its own that always takes the newest.

While one frame is drawn the next is tracked already. No thread waits for a later one; an item that the next
thread has no time for is dropped. What is compiled, or OpenCV's, leaves the interpreter to the others.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from morph_dslam.interrupts import WaitingInterrupts
from morph_dslam.sources.live import LiveStream, Newest
from morph_dslam.threads import threads_side_by_side


class LivePipeline:
    """Passes what a live stream gives through steps until it ends.

    Parameters
    ----------
    stream : where items come from.
    steps : each takes what the one before returned; what the last one returns is not kept.
    """

    def __init__(self, stream: LiveStream, steps: Sequence[Callable[[Any], object]]) -> None:
        self._stream, self._places = stream, [Newest() for _ in steps[1:]]
        self._errors: list[BaseException] = []
        self._done = threading.Event()
        inputs: list[Iterable] = [stream, *(iter(place.take, None) for place in self._places)]
        self._threads = [
            threading.Thread(target=self._work, args=(step, items, following), name=step.__name__, daemon=True)
            for step, items, following in zip(steps, inputs, [*self._places, None], strict=True)
        ]

    @property
    def n_dropped(self) -> int:
        """Number of items that did not come to the end."""
        return sum(place.dropped for place in (self._stream, *self._places))

    def run(self, seconds: float | None = None) -> None:
        """Work until the stream ends, or for some seconds; raises what went wrong in a thread."""
        with threads_side_by_side():
            try:
                with WaitingInterrupts():
                    for thread in self._threads:
                        thread.start()
                end = None if seconds is None else time.monotonic() + seconds
                # Not by joining: a thread whose join is interrupted counts as ended in Python 3.11.
                while not self._done.wait(0.1) and (end is None or time.monotonic() < end):
                    pass
            finally:
                with WaitingInterrupts():  # what they hand out must not go on while it is written
                    self._stream.close()
                    for thread in self._threads:
                        if thread.is_alive():
                            thread.join(timeout=10.0)
        if self._errors:
            raise self._errors[0]

    def _work(self, step: Callable[[Any], object], items: Iterable, following: Newest | None) -> None:
        """One thread; when it ends, for whatever reason, so do the others."""
        try:
            for item in items:
                found = step(item)
                if following is not None:
                    following.put(found)
        except BaseException as error:
            self._errors.append(error)
            self._stream.closing = True
        finally:
            if following is None:
                self._done.set()
            else:
                following.end()
