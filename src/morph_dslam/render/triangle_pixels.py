"""Which pixels one projected triangle covers, and where on it each lies; for compiled loops over a mesh.

Edge functions decide coverage (Pineda 1988). They are linear in the image, so along a row each is the value
at the first pixel plus so many steps.
"""

from __future__ import annotations

import numpy as np
from numba import njit

#: Barycentric slack that keeps a pixel centre lying on a shared edge from falling between both triangles.
EDGE_TOLERANCE = 1e-9
#: A triangle of at most this area in the image, squared pixels, covers nothing.
LEAST_AREA = 1e-12


@njit(cache=True, nogil=True, error_model="numpy")
def load_triangle(pixels, depths, triangles, t, closed, u, v, inverse_depth):
    """Load the corners of triangle ``t`` into u, v and inverse_depth, all (3,).

    Parameters
    ----------
    pixels, depths, triangles, closed : see `rasteriser.rasterise`.

    Returns
    -------
    Twice its area in the image, squared pixels, negative where the corners run anticlockwise; 0 if it is not
    to be drawn: a corner is not in front of the camera, or it is turned away or degenerate.
    """
    in_front = True
    for corner in range(3):
        node = triangles[t, corner]
        in_front &= depths[node] > 0.0 and np.isfinite(pixels[node, 0] + pixels[node, 1])
        u[corner], v[corner] = pixels[node, 0], pixels[node, 1]
    area = (u[1] - u[0]) * (v[2] - v[0]) - (u[2] - u[0]) * (v[1] - v[0])
    is_drawn = in_front and abs(area) > LEAST_AREA and not (closed and area >= 0.0)
    if is_drawn:
        for corner in range(3):
            inverse_depth[corner] = 1.0 / depths[triangles[t, corner]]
    return area if is_drawn else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def pixel_window(u, v, height, width):
    """First and last column, first and last row, of the pixels that a triangle may cover; it may be none."""
    # Clamp before the conversion: a corner just in front of the camera lies far outside any integer.
    left = int(np.ceil(max(min(u[0], u[1], u[2]), 0.0)))
    right = int(np.floor(min(max(u[0], u[1], u[2]), width - 1.0)))
    top = int(np.ceil(max(min(v[0], v[1], v[2]), 0.0)))
    bottom = int(np.floor(min(max(v[0], v[1], v[2]), height - 1.0)))
    return left, right, top, bottom


@njit(cache=True, nogil=True, error_model="numpy")
def weights_at(u, v, area, column, row):
    """Weights of the first two corners at a pixel, in the image plane."""
    b0 = ((u[1] - column) * (v[2] - row) - (u[2] - column) * (v[1] - row)) / area
    b1 = ((u[2] - column) * (v[0] - row) - (u[0] - column) * (v[2] - row)) / area
    return b0, b1


@njit(cache=True, nogil=True, error_model="numpy")
def weight_steps(v, area):
    """By how much the weights of the first two corners grow from one pixel to the next in its row."""
    return (v[1] - v[2]) / area, (v[2] - v[0]) / area


@njit(cache=True, nogil=True, error_model="numpy")
def is_inside(b0, b1, b2):
    """Whether a pixel with these weights is covered."""
    return b0 >= -EDGE_TOLERANCE and b1 >= -EDGE_TOLERANCE and b2 >= -EDGE_TOLERANCE
