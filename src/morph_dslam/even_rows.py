"""A few of many rows, spread evenly."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray


@lru_cache(maxsize=64)
def evenly(count: int, most: int) -> NDArray[np.int64]:
    """At most ``most`` of ``count`` rows, spread evenly from the first to the last; kept, so not to be changed."""
    rows = np.linspace(0, count - 1, min(most, count)).astype(np.int64)
    rows.flags.writeable = False
    return rows
