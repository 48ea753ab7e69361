"""Ctrl-C, or SIGTERM as batch systems send it: a command ends, its workers stop, its results are kept."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any

#: What is done as a whole, by the names of Python's own files: a compiled module whose import is interrupted fails with
#: an error of its own, a pool whose processes are just being started waits for ever, and code that numba compiled goes
#: on after an error in what it calls back.
WHOLE = ("<frozen importlib", "concurrent/futures/process.py", "numba/core/serialize.py")
#: An interrupt that meets one of these comes again after so many seconds.
LATER_S = 0.05


class Interruption:
    """Ends a command by KeyboardInterrupt.

    Parameters
    ----------
    runner : the function in whose frame the command runs.
    """

    def __init__(self, runner: Callable[..., object]) -> None:
        self._runner = runner.__code__
        self._number: int = signal.SIGINT
        self._later: threading.Timer | None = None

    def _take(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt, once no module is being imported and no process started."""
        self._number = number
        if not self._is_whole(frame):
            raise KeyboardInterrupt
        self._come_again()

    def _come_again(self) -> None:
        self._later = threading.Timer(LATER_S, signal.pthread_kill, [threading.get_ident(), self._number])
        self._later.start()

    def _is_whole(self, frame: FrameType | None) -> bool:
        """Whether what a command does in a frame is one of `WHOLE`."""
        while frame is not None and frame.f_code is not self._runner:
            if any(name in frame.f_code.co_filename for name in WHOLE):
                return True
            frame = frame.f_back
        return False

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Raise KeyboardInterrupt where one comes."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        numbers = [signal.SIGTERM]
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else it is ignored, as in the background
            numbers.append(signal.SIGINT)
        before = [(number, signal.signal(number, self._take)) for number in numbers]
        try:
            with self._not_lost():
                yield
        finally:
            for number, handler in before:
                signal.signal(number, handler)
            if self._later is not None:
                self._later.cancel()

    @contextmanager
    def _not_lost(self) -> Iterator[None]:
        """Raise again what met compiled code, or a finaliser, that cannot raise errors and goes on."""
        unraisable, uncaught = sys.unraisablehook, sys.excepthook

        def take_unraisable(lost: Any) -> None:
            if issubclass(lost.exc_type, KeyboardInterrupt):
                self._come_again()
            else:
                unraisable(lost)

        # Cython prints the error first, with its traceback.
        def take_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
            if not issubclass(kind, KeyboardInterrupt):
                uncaught(kind, error, trace)

        sys.unraisablehook, sys.excepthook = take_unraisable, take_uncaught
        try:
            yield
        finally:
            sys.unraisablehook, sys.excepthook = unraisable, uncaught


def interrupt_behind(error: BaseException) -> KeyboardInterrupt | None:
    """The interrupt that an error is, or that it came from; None if there is none.

    Compiled code that calls Python back may go on after an error there. What comes of an interrupt is then a
    SystemError.
    """
    at: BaseException | None = error
    while at is not None and not isinstance(at, KeyboardInterrupt):
        at = at.__cause__ or at.__context__
    return at
