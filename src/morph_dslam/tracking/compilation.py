"""Says that the inner loops are compiled, which takes a while the first time that they are used."""

from __future__ import annotations

import logging
from functools import cache
from pathlib import Path

from morph_dslam.tracking import estimator

_LOG = logging.getLogger("morph_dslam")


@cache
def announce_compilation() -> None:
    """Warn in the log, once a process, if no earlier process has left the compiled loops on disk."""
    if not _is_compiled():
        _LOG.warning("compiling the inner loops, once after the installation: this takes about a minute ...")


def _is_compiled() -> bool:
    """Whether the cache has the loop that all estimates run through; also where compiling is switched off."""
    stats = getattr(estimator.linearise, "stats", None)
    if stats is None:
        return True
    # Numba names the index of a compiled function by its first line: one of an older version does not count.
    line = estimator.linearise.py_func.__code__.co_firstlineno
    return any(Path(stats.cache_path).glob(f"estimator.linearise-{line}.*.nbi"))
