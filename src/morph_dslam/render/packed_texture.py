"""Images that are interpolated often: the four pixels that a grey level lies between take one access."""

from __future__ import annotations

import numpy as np
from numba import njit

#: Places in the texture are whole numbers of these parts of a pixel.
PARTS = 256
_OF_LEVEL = np.float32(1.0 / PARTS**2)
# Without a sign, no index is looked at for whether it counts from the end.
_BITS, _MASK = np.uint32(8), np.uint32(255)


@njit(cache=True, nogil=True)
def pack_texture(grey):
    """A texture (h, w) uint8 with the neighbours to the right, below and diagonal of each pixel in one number, uint32.

    What is interpolated then takes one access. Beyond the border, which is never interpolated towards, is zero.
    """
    height, width = grey.shape
    packed = np.zeros((height, width), np.uint32)
    for row in range(height):
        for column in range(width):
            for i in range(min(2, height - row)):
                for j in range(min(2, width - column)):
                    packed[row, column] |= np.uint32(grey[row + i, column + j]) << np.uint32(16 * i + 8 * j)
    return packed


@njit(cache=True, nogil=True, error_model="numpy")
def grey_at(packed, x, y):
    """Grey level of a packed texture at a place in `PARTS` of a pixel, float32, bilinear; outside it is its border."""
    # In this order NaN, of a triangle seen edge-on, is the border too.
    column = np.uint32(min(max(0.0, x), PARTS * (packed.shape[1] - 1)) + 0.5)
    row = np.uint32(min(max(0.0, y), PARTS * (packed.shape[0] - 1)) + 0.5)
    return np.float32(interpolated(packed[row >> _BITS, column >> _BITS], column & _MASK, row & _MASK)) * _OF_LEVEL


@njit(cache=True, nogil=True, inline="always")
def interpolated(four, right, below):
    """`PARTS` squared times the grey level that far right and below of the first of four packed pixels, in `PARTS`."""
    four = np.int64(four)
    # Upper and lower row at once: each of the sums has sixteen bits.
    both = (four & 0x00FF00FF) * (PARTS - right) + ((four >> 8) & 0x00FF00FF) * right
    return (both & 0xFFFF) * (PARTS - below) + (both >> 16) * below
