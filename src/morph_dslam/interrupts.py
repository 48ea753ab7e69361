"""Ctrl-C and SIGTERM that wait: until a frame has been handed out, until results are written."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from types import FrameType, TracebackType
from typing import Any

_NUMBERS = (signal.SIGINT, signal.SIGTERM)


class WaitingInterrupts:
    """Lets interrupts wait while a context lasts, so that what is done in it is whole.

    One that waited is raised at the end, unless the context ends by an exception, or was entered because of another
    interrupt: then all ends as it is. Only the main thread gets interrupts; in others this does nothing.

    Parameters
    ----------
    said : printed once, when the first one has to wait; nothing if it is empty.
    only_first : whether a second one is raised at once, for work that may never end by itself.
    """

    def __init__(self, said: str = "", only_first: bool = False) -> None:
        self._said, self._only_first = said, only_first
        self._before: dict[int, Callable[[int, FrameType | None], Any]] = {}
        self._waiting: int | None = None
        self._is_ending = False

    def __enter__(self) -> WaitingInterrupts:
        self._waiting, self._is_ending = None, isinstance(sys.exc_info()[1], KeyboardInterrupt)
        if threading.current_thread() is threading.main_thread():
            for number in _NUMBERS:
                handler = signal.getsignal(number)
                if callable(handler):  # else it is ignored, or ends the process without Python
                    self._before[number] = handler
                    signal.signal(number, self._take)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before, waiting = {}, self._waiting
        if waiting is not None and kind is None and not self._is_ending:
            signal.raise_signal(waiting)

    def _take(self, number: int, frame: FrameType | None) -> None:
        if self._waiting is not None and self._only_first:
            self._before[number](number, frame)
            return
        if self._waiting is None and self._said:
            with suppress(RuntimeError, OSError):  # it came while something was being printed
                print(f"\n{self._said}", file=sys.stderr, flush=True)
        self._waiting = number

    @property
    def is_waiting(self) -> bool:
        """Whether an interrupt waits, so that the work can end early."""
        return self._waiting is not None

    def raise_waiting(self) -> None:
        """Raise the interrupt that waits, if there is one."""
        if self._waiting is not None:
            number, self._waiting = self._waiting, None
            self._before[number](number, None)
