"""How long each stage of a frame takes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from time import perf_counter, thread_time


class StageClock:
    """Adds up the wall time spent in named stages; stages must not nest."""

    def __init__(self, names: Sequence[str]) -> None:
        self.milliseconds = dict.fromkeys(names, 0.0)
        self._start = perf_counter()

    @property
    def total(self) -> float:
        """Milliseconds since the clock was made."""
        return 1e3 * (perf_counter() - self._start)


_CLOCK: ContextVar[StageClock | None] = ContextVar("frame_clock", default=None)


@contextmanager
def frame_clock(names: Sequence[str]) -> Iterator[StageClock]:
    """Time one frame: `stage` adds to this clock within the block, in this thread only."""
    clock = StageClock(names)
    token = _CLOCK.set(clock)
    try:
        yield clock
    finally:
        _CLOCK.reset(token)


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Add the time that the block takes to a stage of the current frame's clock; without a clock do nothing."""
    clock, start = _CLOCK.get(), perf_counter()
    try:
        yield
    finally:
        if clock is not None and name in clock.milliseconds:
            clock.milliseconds[name] += 1e3 * (perf_counter() - start)


class WaitClock:
    """Tells for how long its thread has not run since the clock was made."""

    def __init__(self) -> None:
        self._start, self._ran = perf_counter(), thread_time()

    @property
    def milliseconds(self) -> float:
        """How long so far."""
        return 1e3 * max(perf_counter() - self._start - (thread_time() - self._ran), 0.0)
