"""Threads of the linear algebra that numpy and scipy call."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

P = ParamSpec("P")
R = TypeVar("R")


def one_thread_for_algebra(function: Callable[P, R]) -> Callable[P, R]:
    """Let linear algebra run in the thread that asks for it, as long as the decorated function does.

    A tracked frame multiplies many small matrices; threads that share one of them mostly wait for each other,
    and take the cores from the threads that work on other frames, or from other programs.
    """

    @wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        with threadpool_limits(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return alone
