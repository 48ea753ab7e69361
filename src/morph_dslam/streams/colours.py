"""Colours of values on a surface, the same in all streams."""

from __future__ import annotations

from functools import cache

import matplotlib
import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.inner_structure import SEE_THROUGH
from morph_dslam.streams.messages import ObjectInfo

#: Of values that are not a number, and of rigid objects.
GREY = np.array([128, 128, 128, 255], dtype=np.uint8)


@cache
def colour_map() -> NDArray[np.uint8]:
    """(256, 4) red, green, blue and alpha from the low to the high end."""
    return np.asarray(matplotlib.colormaps["turbo"](np.arange(256), bytes=True))


def colours_of(values: NDArray | None, info: ObjectInfo, count: int) -> NDArray[np.uint8]:
    """Colours (n, 4) of values (n,) on an object, grey where there is none, see-through where it has structures inside.

    Parameters
    ----------
    values : (n,), NaN where a value does not hold; None for an object without values.
    info : the object.
    count : number of vertices, n.
    """
    colours, scalar = np.tile(GREY, (count, 1)), info.scalar
    if values is not None and scalar is not None:
        shares = np.nan_to_num(np.clip((values - scalar.low) / (scalar.high - scalar.low), 0.0, 1.0))
        colours = np.where(np.isfinite(values)[:, None], colour_map()[np.rint(255 * shares).astype(int)], GREY)
    if info.inner:
        colours[:, 3] = round(255 * SEE_THROUGH)
    return colours
