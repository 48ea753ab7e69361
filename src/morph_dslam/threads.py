"""Threads of the linear algebra that numpy and scipy call."""

from __future__ import annotations

import os

_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def one_thread_for_algebra() -> None:
    """Let linear algebra run in the thread that asks for it, unless the environment says otherwise.

    A tracked frame multiplies many small matrices; threads that share one of them mostly wait for each other,
    and take the cores from the threads that work on other frames. It has an effect only before numpy is
    loaded, so the commands that track call it first of all.
    """
    for name in _VARIABLES:
        os.environ.setdefault(name, "1")
