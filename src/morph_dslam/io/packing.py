"""Arrays for a page in one answer: the length of a JSON head, the head, then the arrays as little-endian bytes."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TYPES = {"f": "<f4", "i": "<i4", "u": "<i4", "b": "<i4"}


def packed(facts: dict[str, Any], **arrays: NDArray) -> bytes:
    """Facts and arrays; integers become 32-bit ones and all other numbers single precision.

    The head is padded so that the arrays begin at a multiple of four bytes, as typed arrays of a browser want it. Its
    key ``arrays`` lists name, type ("<f4" or "<i4") and number of values of each, in the order of their bytes.
    """
    contents = {name: np.ascontiguousarray(array, dtype=_TYPES[array.dtype.kind]) for name, array in arrays.items()}
    listed = [[name, array.dtype.str, array.size] for name, array in contents.items()]
    head = json.dumps(facts | {"arrays": listed}).encode()
    head += b" " * (-len(head) % 4)
    return b"".join([np.array(len(head), dtype="<u4").tobytes(), head, *(a.tobytes() for a in contents.values())])
