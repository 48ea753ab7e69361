"""Threads that follow a camera live: what they need of the interpreter that they share."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

#: How long a thread may keep the interpreter while another waits for it, seconds. Tracking gives it up some
#: fifty times a frame, whenever compiled code runs, and may wait for so long each time: at the worst 5 ms of
#: the 33 that there are for a frame. With Python's own 5 ms it would be several frames. That the interpreter
#: changes hands so often costs no more processor time in `benchmarks/live.py` than with five times as long.
SWITCH_INTERVAL = 1e-4


@contextmanager
def threads_side_by_side() -> Iterator[None]:
    """Let the threads of this process take turns quickly, as long as they track live.

    OpenCV begins no threads of its own meanwhile. What exists already is left out when Python looks for
    garbage: over all that has been imported that takes tens of milliseconds, in which no thread goes on.
    """
    interval, threads = sys.getswitchinterval(), cv2.getNumThreads()
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(SWITCH_INTERVAL)
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
        sys.setswitchinterval(interval)
        gc.unfreeze()
