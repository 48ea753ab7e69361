"""Colours of values on a surface, the same in all streams."""

from __future__ import annotations

from functools import cache

import matplotlib
import numpy as np
from numpy.typing import NDArray

from morph_dslam.streams.messages import ScalarInfo

#: Of values that are not a number, and of rigid objects.
GREY = np.array([128, 128, 128, 255], dtype=np.uint8)


@cache
def colour_map() -> NDArray[np.uint8]:
    """(256, 4) red, green, blue and alpha from the low to the high end."""
    return np.asarray(matplotlib.colormaps["turbo"](np.arange(256), bytes=True))


def colours_of(values: NDArray | None, info: ScalarInfo | None, count: int) -> NDArray[np.uint8]:
    """Colours (n, 4) of values (n,), grey where there is none.

    Parameters
    ----------
    values : (n,), NaN where a value does not hold; None for an object without values.
    info : what they are; None for an object without values.
    count : number of vertices, n.
    """
    if values is None or info is None:
        return np.tile(GREY, (count, 1))
    shares = np.nan_to_num(np.clip((values - info.low) / (info.high - info.low), 0.0, 1.0))
    return np.where(np.isfinite(values)[:, None], colour_map()[np.rint(255 * shares).astype(int)], GREY)
